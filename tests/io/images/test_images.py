"""Images that others bring: damaged, animated, of several sizes."""

import io
from fractions import Fraction

import av
import numpy as np
import pytest
from PIL import Image

from lanebev.io import opening as video
from lanebev.io.images.pixels import is_damaged_jpeg, read_image, stated_size
from lanebev.io.live import open_live
from lanebev.io.opening import open_source


def _jpeg(size=(64, 48), **options):
    noise = np.random.default_rng(0).integers(0, 256, (size[1] // 8, size[0] // 8, 3), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(noise).resize(size).save(stream, "JPEG", **options)
    return stream.getvalue()


def _spoilt(data):
    """The same with the bytes in the middle of its data replaced by a code that is none."""
    middle = len(data) // 2
    return data[:middle] + b"\xfe" * 40 + data[middle + 40 :]


@pytest.mark.parametrize(
    "options", [{}, {"progressive": True}, {"subsampling": 0}, {"restart_marker_blocks": 4}, {"quality": 30}]
)
def test_a_whole_jpeg_of_any_kind_is_not_damaged(options):
    assert not is_damaged_jpeg(_jpeg(**options))


def test_a_jpeg_in_grey_or_cmyk_or_with_bytes_after_it_is_not_damaged():
    for mode in ("L", "CMYK"):
        stream = io.BytesIO()
        Image.new(mode, (32, 32)).save(stream, "JPEG")
        assert not is_damaged_jpeg(stream.getvalue())
    assert not is_damaged_jpeg(_jpeg() + bytes(100))


def test_a_jpeg_with_damaged_bytes_is_a_frame_without_image(tmp_path):
    for name in ("1.jpg", "2.jpg", "3.jpg"):
        (tmp_path / name).write_bytes(_jpeg())
    (tmp_path / "2.jpg").write_bytes(_spoilt(_jpeg()))
    with Image.open(tmp_path / "2.jpg") as image:
        image.load()  # Pillow alone says nothing
    frames = list(open_source(str(tmp_path)))
    assert [frame.image is None for frame in frames] == [False, True, False]
    assert frames[1].problem.endswith("expected a whole image, got: damaged jpeg data")


@pytest.mark.parametrize("name", ["a.png", "a.webp", "a.tif"])
def test_an_animation_is_refused(tmp_path, name):
    pictures = [Image.new("RGB", (16, 16), (80 * k, 0, 0)) for k in range(3)]
    pictures[0].save(tmp_path / name, save_all=True, append_images=pictures[1:])
    with pytest.raises(ValueError, match="got: 3 pictures in one file; write them as a video"):
        read_image(tmp_path / name)


def test_a_preview_in_the_file_is_no_second_picture(tmp_path):
    picture = Image.new("RGB", (16, 16))
    picture.save(tmp_path / "a.tif", save_all=True, append_images=[picture.resize((8, 8))])
    assert read_image(tmp_path / "a.tif").shape == (16, 16, 3)


def test_the_size_of_most_images_counts(tmp_path):
    for number in range(5):
        size = (16, 8) if number in (0, 3) else (64, 48)
        (tmp_path / f"{number}.jpg").write_bytes(_jpeg(size))
    data = (tmp_path / "1.jpg").read_bytes()
    (tmp_path / "1.jpg").write_bytes(data[:-60])  # its header is whole
    source = open_source(str(tmp_path))
    assert source.image_size == (48, 64)
    assert [frame.image is None for frame in source] == [True, True, False, True, False]


def test_a_whole_image_of_the_usual_size_is_not_searched_beyond_the_first(tmp_path, monkeypatch):
    for number in range(30):
        (tmp_path / f"{number:02d}.jpg").write_bytes(_jpeg((16, 8)) if number == 3 else _jpeg()[:-60])
    read = []
    monkeypatch.setattr(video, "read_image", lambda path: read.append(path) or read_image(path))
    assert open_source(str(tmp_path)).image_size == (8, 16)
    assert len(read) == 20


@pytest.mark.parametrize("kind", ["jpg", "tif", "png", "webp"])
@pytest.mark.parametrize(("orientation", "size"), [(3, (24, 32)), (6, (32, 24))])
def test_the_size_that_a_header_states_is_that_of_the_upright_image(tmp_path, kind, orientation, size):
    turned, path = Image.Exif(), tmp_path / f"a.{kind}"
    turned[0x0112] = orientation
    Image.new("RGB", (32, 24)).save(path, exif=turned)
    assert stated_size(path) == read_image(path).shape[:2] == size


def test_a_missing_image_states_no_size(tmp_path):
    assert stated_size(tmp_path / "none.jpg") is None


@pytest.mark.parametrize(
    ("source", "word"),
    [
        ("drives", "its files end with .mp4, images with .jpg"),
        ("drives/*.mp4", "expected images that match, got none; its files end with .mp4, images with"),
        ("drives/*.png", "expected images that match, got none; quote the pattern"),
        ("a.HEIC", "got HEIC; convert it to JPEG"),
        ("drives/%03d.jpg", "got nothing there; give the folder, or a quoted glob"),
        ("file:///drives/a.mp4", "got nothing there; give the path without file://"),
        ("0", "got nothing there; a camera is given as /dev/video0"),
        ("s3://bucket/a.mp4", "got nothing there; streams are rtsp, .*; download other addresses first"),
    ],
)
def test_what_is_no_source_says_what_to_give(tmp_path, monkeypatch, source, word):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drives").mkdir()
    (tmp_path / "drives" / "a.mp4").touch()
    (tmp_path / "a.HEIC").touch()
    with pytest.raises(ValueError, match=word):
        open_source(source)


def test_a_stream_with_pixels_that_are_not_square(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (20, 288, 352, 3), dtype=np.uint8)
    with av.open(str(tmp_path / "v.ts"), "w") as container:
        stream = container.add_stream("mpeg2video", rate=25)
        stream.width, stream.height, stream.pix_fmt = 352, 288, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(12, 11)
        for image in noise:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
        container.mux(stream.encode())
    source = open_live(str(tmp_path / "v.ts"))
    assert source.pixel_aspect == Fraction(12, 11)
    source.stop()
