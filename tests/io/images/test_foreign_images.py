"""Images and folders of them as more programs leave them, each after a public report."""

import cv2
import numpy as np
import pytest
from PIL import Image

from lanebev.app.config import RunConfig
from lanebev.app.drive.sources import make_source
from lanebev.io.images import names as image_names
from lanebev.io.images.names import drives_remark, in_natural_order, jump_remark
from lanebev.io.images.pixels import read_image
from lanebev.io.opening import open_source

SIZE = (48, 64)


def test_links_that_lead_nowhere_are_lost_frames(tmp_path):
    folder = _folder(tmp_path / "a", "1.png", "2.png", "3.png")
    (folder / "2.png").unlink()
    (folder / "2.png").symlink_to(tmp_path / "away.png")
    problems = [frame.problem for frame in open_source(str(folder))]
    assert problems == [
        "",
        f"image {folder}/2.png: expected a whole image, got: no such file or directory",
        "",
    ]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"fps": 1 / 30}, "30 s apart; is the frame rate right? if so, use --stills"),
        ({"fps": 0.5}, ""),
        ({"fps": 240.0}, ""),
        ({"fps": 1000.0}, ""),
        ({"fps": 1 / 30, "stills": True}, ""),
        (
            {"fps": 1e4},
            "0.0001 s apart; is the frame rate right? if not, correct --fps",
        ),
    ],
)
def test_steps_of_no_camera_are_said(tmp_path, settings, words):
    folder = str(_folder(tmp_path / "a", "1.png", "2.png"))
    problem = make_source(RunConfig(folder, "c", **settings)).problem
    assert problem == (f"{folder}: its frames are {words}" if words else "")


def _picture():
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.stack([3 * x + 20, 4 * y + 20, 60 * ((x < 20) & (y < 30))], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("orientation", [3, 6, 8])
@pytest.mark.parametrize("suffix", ["png", "webp", "tif"])
def test_images_of_other_kinds_are_turned_once(tmp_path, orientation, suffix):  # Pillow#7381
    exif = Image.Exif()
    exif[0x112] = orientation
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(_picture()).save(path, exif=exif, **({"lossless": True} if suffix == "webp" else {}))
    expected = {3: np.rot90(_picture(), 2), 6: np.rot90(_picture(), -1), 8: np.rot90(_picture())}
    np.testing.assert_array_equal(read_image(path), expected[orientation])


@pytest.mark.parametrize("suffix", ["png", "tif", "ppm"])
@pytest.mark.parametrize("alpha", [False, True])
def test_colours_of_16_bits_keep_their_scale(tmp_path, suffix, alpha):
    deep = 257 * _picture()[..., ::-1].astype(np.uint16)
    if alpha and suffix == "png":
        deep = np.dstack([deep, np.zeros(SIZE, np.uint16)])
    cv2.imwrite(str(tmp_path / f"a.{suffix}"), deep)
    np.testing.assert_array_equal(read_image(tmp_path / f"a.{suffix}"), _picture())


def test_cmyk_is_not_inverted(tmp_path):
    Image.fromarray(_picture()).convert("CMYK").save(tmp_path / "a.jpg", quality=98)
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - _picture()).mean() < 2


def _folder(path, *names):
    path.mkdir(parents=True)
    for name in names:
        Image.fromarray(_picture()).convert("L" if name.endswith("pgm") else "RGB").save(path / name)
    return path


def test_folders_with_brackets_in_their_names(tmp_path):  # gifski#314
    folder = _folder(tmp_path / "drive [1] é %d", "1.png", "2.png")
    nested = _folder(folder / "[a]", "3.png")
    assert open_source(str(folder)).count == 2
    assert open_source(f"{folder}/*.png").paths == (f"{folder}/1.png", f"{folder}/2.png")
    assert open_source(f"{folder}/[12].png").count == 2
    assert open_source(f"{folder}/**/*.png").count == 3
    assert open_source(f"{nested}/?.png").paths == (f"{nested}/3.png",)
    with pytest.raises(ValueError, match="expected images that match, got none"):
        open_source(f"{folder}/[45].png")


def test_relative_globs_have_the_names_that_were_asked_for(tmp_path, monkeypatch):
    _folder(tmp_path / "a", "1.png")
    monkeypatch.chdir(tmp_path)
    assert open_source("a/*.png").paths == ("a/1.png",)
    assert open_source("*/*.png").paths == ("a/1.png",)


def test_a_folder_of_pgm(tmp_path):
    source = open_source(str(_folder(tmp_path / "a", "1.pgm", "2.pgm")))
    assert (source.count, source.image_size) == (2, SIZE)


@pytest.mark.parametrize("bits", [10, 12])
def test_images_of_few_bits_stored_in_many_are_noticed(tmp_path, bits):
    values = np.random.default_rng(0).integers(0, 2**bits, (48, 64)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "1.png"), values)
    assert "nearly black, its brightest value" in open_source(str(tmp_path / "1.png")).problem
    cv2.imwrite(str(tmp_path / "1.png"), values * 2 ** (16 - bits))
    assert open_source(str(tmp_path / "1.png")).problem == ""


PAIRS = [f"{number:04d}_{side}.png" for number in range(4) for side in ("left", "right")]
MASKS = [f"{number}{suffix}" for number in range(4) for suffix in (".jpg", "_mask.png")]
CLIPS = [f"clips/{clip}/{number}.jpg" for clip in ("a", "b") for number in range(4)]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (PAIRS, "the same number, such as 0000_left.png and 0000_right.png, and are taken for frames one"),
        (MASKS, "the same number, such as 0.jpg and 0_mask.png, and"),
        (CLIPS, "the same name, such as 0.jpg in clips/a and clips/b, and are taken for one drive"),
        (PAIRS[::2], ""),
        (["a/left.jpg", "a/right.jpg", "1.jpg", "1b.jpg", "2.jpg", "3.jpg", "4.jpg"], ""),
        ([f"2024-05-01_12-30-{second}_{number}.jpg" for second in (1, 2) for number in range(3)], ""),
    ],
)
def test_images_of_several_cameras_or_drives_are_noticed(names, words):
    remark = drives_remark(names)
    assert words in remark
    assert bool(words) == bool(remark)


def test_a_run_says_that_images_are_of_several_cameras(tmp_path):
    for name in PAIRS:
        Image.fromarray(_picture()).save(tmp_path / name)
    source = make_source(RunConfig(str(tmp_path), fov=60.0))
    assert "several images have the same number" in source.problem
    assert "30 frames per second are assumed" in source.problem
    assert make_source(RunConfig(str(tmp_path), fov=60.0, stills=True)).problem == ""
    assert make_source(RunConfig(f"{tmp_path}/*_left.png", fov=60.0, fps=10)).problem == ""


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        (range(9990, 10010), "from IMG_0009.jpg to IMG_9990.jpg"),
        ([*range(10), *range(15, 30)], "from IMG_0009.jpg to IMG_0015.jpg"),
        (range(10), ""),
        (range(0, 50, 5), ""),
    ],
)
def test_a_counter_that_began_again_or_has_gaps_is_noticed(numbers, words):
    names = in_natural_order(f"IMG_{number % 10_000:04d}.jpg" for number in numbers)
    remark = jump_remark(names)
    assert words in remark
    assert bool(words) == bool(remark)


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda i: f"{round(i * 100 / 3)}.jpg", "from 133.jpg to 267.jpg"),  # ms
        (lambda i: f"{i / 30:.3f}.jpg", "from 0.133.jpg to 0.267.jpg"),  # s
        (lambda i: f"{i / 20}.jpg", "from 0.2.jpg to 0.4.jpg"),
    ],
)
def test_numbers_that_are_times_jump_only_where_images_are_missing(write, words):
    assert jump_remark(in_natural_order(write(i) for i in range(20))) == ""
    assert words in jump_remark(in_natural_order(write(i) for i in [*range(5), *range(8, 20)]))


def test_hexadecimal_numbers_are_not_the_same_for_their_letters():
    assert drives_remark([f"{number:04x}.png" for number in range(200, 230)]) == ""


def test_jumps_are_looked_for_in_time_that_grows_with_the_number_of_images(monkeypatch):
    """The median of all steps was calculated for each of them: minutes for 100,000 images."""
    calls = []
    original = image_names.median_low
    monkeypatch.setattr(image_names, "median_low", lambda steps: calls.append(1) or original(steps))
    assert jump_remark([f"{number:05d}.jpg" for number in range(1000)]) == ""
    assert len(calls) == 1


def test_names_of_several_numbers_or_of_none_have_no_jumps():
    assert jump_remark(["a/1_07.jpg", "a/2_09.jpg", "a/9_01.jpg"]) == ""
    assert jump_remark(["a.jpg", "b.jpg"]) == jump_remark(["a/7.jpg"]) == ""
