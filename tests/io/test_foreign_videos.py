"""Videos, images and folders as more recorders leave them, each after a public report."""

import math
import struct
from dataclasses import replace
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from lanebev import Camera
from lanebev.app.build import make_camera
from lanebev.app.config import RunConfig
from lanebev.app.observers import LaneFileObserver
from lanebev.app.sources import make_source
from lanebev.io import image_names
from lanebev.io.frames import Selection
from lanebev.io.image_names import drives_remark, in_natural_order, jump_remark
from lanebev.io.images import read_image
from lanebev.io.lane_parsing import FrameLines
from lanebev.io.lane_widths import unequal_lanes_remark
from lanebev.io.video import open_source
from lanebev.observation.polylines import LaneLine

SIZE = (48, 64)


def _stream(container, size=SIZE, codec="libx264", rate=10, fmt="yuv420p"):
    stream = container.add_stream(codec, rate=rate)
    stream.height, stream.width, stream.pix_fmt = *size, fmt
    return stream


def _write(container, stream, times, tick=Fraction(1, 10)):
    for i, pts in enumerate(times):
        image = np.full((stream.height, stream.width, 3), 10 * i + 20, np.uint8)
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts, frame.time_base = pts, tick
        container.mux(stream.encode(frame))
    container.mux(stream.encode())


def _levels(source):
    return [round((frame.image.mean() - 20) / 10) for frame in source]


def test_a_cover_before_the_video_is_passed_over(tmp_path):  # USDX#948, gopro-dashboard-overlay#245
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as container:
        cover = _stream(container, (24, 24), "mjpeg", 1, "yuvj420p")
        cover.disposition = av.stream.Disposition.attached_pic
        drive = _stream(container)
        _write(container, cover, [0])
        _write(container, drive, range(12))
    source = open_source(str(path))
    assert (source.image_size, source.count, source.problem) == (SIZE, 12, "")
    assert _levels(source) == list(range(12))


@pytest.mark.parametrize("first", [True, False])
def test_of_several_streams_the_largest_is_used_and_said(tmp_path, first):  # photoprism#3242
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        sizes = [SIZE, (24, 32)] if first else [(24, 32), SIZE]
        streams = [_stream(container, size) for size in sizes]
        for stream in streams:
            _write(container, stream, range(12))
    source = open_source(str(path))
    assert source.image_size == SIZE
    assert source.problem.endswith("v.mkv: it has 1 more video streams; that of 64 x 48 px is used")
    assert len(list(source)) == source.count == 12


@pytest.mark.parametrize("suffix", ["mkv", "mp4", "ts"])
@pytest.mark.parametrize("first", [True, False])
def test_a_picture_beside_a_video_is_passed_over_if_it_is_larger(tmp_path, suffix, first):  # LAVFilters#430
    path = tmp_path / f"v.{suffix}"
    with av.open(str(path), "w") as container:
        sizes = [(96, 128), SIZE] if first else [SIZE, (96, 128)]
        streams = {size: _stream(container, size) for size in sizes}
        for size in sizes:
            _write(container, streams[size], range(12 if size == SIZE else 1))
    source = open_source(str(path))
    assert (source.image_size, source.count, source.problem) == (SIZE, 12, "")
    assert _levels(source) == list(range(12))


def test_a_video_of_covers_only_is_none(tmp_path):
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as container:
        cover = _stream(container, (24, 24), "mjpeg", 1, "yuvj420p")
        cover.disposition = av.stream.Disposition.attached_pic
        _write(container, cover, [0])
    with pytest.raises(ValueError, match="expected a video stream, got none"):
        open_source(str(path))


def test_a_frame_rate_that_the_times_belie(tmp_path):  # picamera#541
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        _write(container, _stream(container, rate=1000), range(0, 1200, 100), Fraction(1, 1000))
    source = open_source(str(path))
    assert source.fps == 10
    assert source.problem.endswith("v.mkv: it states 1000 frames per second, they come at 10")
    np.testing.assert_allclose([frame.dt for frame in source], 0.1, atol=1e-3)


@pytest.mark.parametrize("times", [[0, 1, 2, 3, 9, 10, 11, 30], [0, 1, 2, 3, 4, 5000, 5001, 5002]])
def test_gaps_do_not_make_the_stated_rate_wrong(tmp_path, times):
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        _write(container, _stream(container), times)
    source = open_source(str(path))
    assert source.fps == 10
    assert "frames per second" not in source.problem
    np.testing.assert_allclose([frame.time for frame in source], np.array(times) / 10, atol=1e-3)


@pytest.mark.parametrize("times", [[0, 58, 91, 150, 200, 270, 290, 333], [0, 33, 66, 4000, 4033, 4066, 4100]])
@pytest.mark.parametrize("suffix", ["mkv", "mp4"])
def test_the_number_of_frames_that_are_taken_is_exact_where_times_vary(tmp_path, times, suffix):
    path = tmp_path / f"v.{suffix}"
    with av.open(str(path), "w") as container:
        stream = _stream(container, rate=30)
        stream.codec_context.time_base = Fraction(1, 1000)
        _write(container, stream, times, Fraction(1, 1000))
    source = open_source(str(path))
    np.testing.assert_allclose([frame.time for frame in source], np.array(times) / 1000, atol=1e-9)
    for start, end, every in ((0.06, 0.3, 1), (0.0, 4.04, 2), (0.1, 3.9, 1), (0.25, math.inf, 3)):
        part = replace(source, selection=Selection(start, end, every))
        expected = [i for i, t in enumerate(times) if start <= t / 1000 < end and i % every == 0]
        assert [frame.source_number for frame in part] == expected
        assert part.taken_count == len(expected)
        if expected:  # what a run on this part writes is given back to it
            LaneFileObserver([FrameLines(str(i), []) for i in expected], part, Camera.from_fov(60, 64, 48))


def _cut(path, out, packets):
    """Copy a stream without its first packets, as programs do that cut without a key frame."""
    with av.open(str(path)) as whole, av.open(str(out), "w") as container:
        stream = whole.streams.video[0]
        copy = container.add_stream_from_template(stream)
        for packet in [each for each in whole.demux(stream) if each.dts is not None][packets:]:
            packet.stream = copy
            container.mux(packet)


def test_an_edit_list_that_begins_within_a_frame_is_no_cut(tmp_path):  # as phones trim
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as container:
        stream = _stream(container, rate=30)
        stream.codec_context.time_base = Fraction(1, 1000)
        _write(container, stream, [-100 + 33 * i for i in range(20)], Fraction(1, 1000))
    source = open_source(str(path))
    assert (_levels(source), source.count, source.problem) == (list(range(4, 20)), 16, "")


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts"])
def test_frames_before_the_first_key_frame_are_not_counted(tmp_path, suffix):
    with av.open(str(tmp_path / f"v.{suffix}"), "w") as container:
        stream = _stream(container)
        stream.gop_size, stream.codec_context.options = 12, {"x264-params": "scenecut=0"}
        _write(container, stream, range(20))
    _cut(tmp_path / f"v.{suffix}", tmp_path / f"cut.{suffix}", 5)
    source = open_source(str(tmp_path / f"cut.{suffix}"))
    assert _levels(source) == list(range(12, 20))
    assert source.count == source.taken_count == 8


def test_a_decoder_that_shows_frames_before_the_first_key_frame_is_not_believed(tmp_path):
    with av.open(str(tmp_path / "v.mkv"), "w") as container:
        stream = _stream(container, codec="mpeg4")
        stream.gop_size, stream.codec_context.options = 12, {"sc_threshold": "1000000000"}
        _write(container, stream, range(20))
    _cut(tmp_path / "v.mkv", tmp_path / "cut.mkv", 5)
    source = open_source(str(tmp_path / "cut.mkv"))
    frames = list(source)
    assert len(frames) == source.count == 15
    assert [frame.image is None for frame in frames] == [True] * 7 + [False] * 8
    assert frames[0].problem == "expected a whole frame, got: one before the first key frame"


def test_a_field_of_view_with_pixels_that_are_not_square(tmp_path):  # opencv#4921
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as container:
        stream = _stream(container)
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        _write(container, stream, range(4))
    source = open_source(str(path))
    assert (source.image_size, source.pixel_aspect) == (SIZE, Fraction(4, 3))
    camera = make_camera(RunConfig("a", fov=60.0), SIZE, source.pixel_aspect)
    square = make_camera(RunConfig("a", fov=60.0), SIZE)
    assert camera.intrinsics[0].tolist() == square.intrinsics[0].tolist()
    assert float(camera.intrinsics[1, 1]) == pytest.approx(4 / 3 * float(square.intrinsics[1, 1]))


def test_interlaced_frames_are_said(tmp_path):
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        stream = _stream(container, codec="mpeg2video")
        stream.options = {"flags": "+ildct+ilme"}
        _write(container, stream, range(4))
    assert "its frames are interlaced, each of two moments; deinterlace it" in open_source(str(path)).problem


def test_frames_of_two_cameras_are_said(tmp_path):
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        stream = _stream(container)
        stream.metadata["stereo_mode"] = "left_right"
        _write(container, stream, range(4))
    assert "its header says that frames have the images of two cameras" in open_source(str(path)).problem


def test_videos_of_360_degrees_are_said(tmp_path):
    """Google's box for spherical videos, as cameras and YouTube's injector write it into the track."""
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as container:
        _write(container, _stream(container), range(4))
    words = b"<GSpherical:Spherical>true<GSpherical:Stitched>true<GSpherical:StitchingSoftware>"
    words += b"<GSpherical:ProjectionType>equirectangular"
    box = bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + words
    box = struct.pack(">I4s", len(box) + 8, b"uuid") + box
    data = path.read_bytes()
    for kind in (b"moov", b"trak"):  # at the end of the file, so that no other place changes
        place = data.index(kind) - 4
        size = int.from_bytes(data[place : place + 4], "big")
        data = data[:place] + struct.pack(">I", size + len(box)) + data[place + 4 :]
    path.write_bytes(data[: place + size] + box + data[place + size :])
    assert "its header says 360 degrees; cut out a pinhole view" in open_source(str(path)).problem


def _joined(path, parts):
    """Write videos that begin at some times (0.1 s), one byte by byte behind the other."""
    data = b""
    for times in parts:
        with av.open(str(path), "w") as container:
            _write(container, _stream(container), times)
        data += path.read_bytes()
    path.write_bytes(data)
    return open_source(str(path))


@pytest.mark.parametrize("suffix", ["mp4", "flv", "asf"])
def test_an_appended_video_is_said(tmp_path, suffix):  # which players pass over
    words = "another video is appended to it, of which nothing is read; join them by ffmpeg -f concat"
    source = _joined(tmp_path / f"v.{suffix}", [range(4), range(4)])
    assert source.count == 4
    assert words in source.problem
    assert words not in _joined(tmp_path / f"w.{suffix}", [range(4)]).problem


@pytest.mark.parametrize(("suffix", "codec"), [("ts", "libx264"), ("mxf", "mpeg2video")])
def test_a_video_that_ends_before_its_sound_has_none_appended(tmp_path, suffix, codec):
    path = tmp_path / f"v.{suffix}"
    with av.open(str(path), "w") as container:
        stream = _stream(container, codec=codec, rate=25)
        sound = container.add_stream("pcm_s16le" if suffix == "mxf" else "mp2", rate=48000)
        sound.layout = "mono" if suffix == "mxf" else "stereo"
        _write(container, stream, range(12), Fraction(1, 25))
        samples = np.zeros((1, 1920 * sound.layout.nb_channels), np.int16)
        for _ in range(12 if suffix == "mxf" else 250):
            frame = av.AudioFrame.from_ndarray(samples, format="s16", layout=sound.layout.name)
            frame.rate = 48000
            container.mux(sound.encode(frame))
        container.mux(sound.encode())
    assert open_source(str(path)).problem == ""


@pytest.mark.parametrize("parts", [[range(20), range(20)], [range(90, 110), range(20)]])
def test_times_that_begin_again_are_said(tmp_path, parts):
    source = _joined(tmp_path / "v.ts", parts)
    assert source.problem.endswith(
        "v.ts: its times begin again, as of files joined byte by byte; is it one drive?"
    )
    frames = list(source)
    assert source.count == len(frames) >= 40
    assert all(frame.dt == pytest.approx(0.1) for frame in frames)
    assert _joined(tmp_path / "w.ts", [range(20), range(20, 40)]).problem == ""


def test_after_times_that_begin_again_the_steps_between_them_count(tmp_path):
    frames = list(_joined(tmp_path / "v.ts", [range(20), range(0, 42, 2)]))  # at first a tenth, as before
    assert [frame.dt for frame in frames[-4:]] == pytest.approx([0.2] * 4)
    assert all(frame.dt > 0 for frame in frames)


def test_times_rounded_to_the_same_tick_do_not_begin_again(tmp_path):  # Matroska's are whole ms
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=2000)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for pts in range(20):
            frame = av.VideoFrame(64, 48, "yuvj420p")
            frame.pts, frame.time_base = pts, Fraction(1, 2000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    source = open_source(str(path))
    assert "begin again" not in source.problem
    assert len(source.times) == source.count == 20


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_gap_of_hours_is_said_and_changes_no_frame_rate(tmp_path, suffix):
    path = tmp_path / f"v.{suffix}"
    with av.open(str(path), "w") as container:
        _write(container, _stream(container), [*range(6), *range(72_000, 72_006)])
    source = open_source(str(path))
    assert "its times jump by 7200 s; is it one drive?" in source.problem
    assert source.fps == 10
    assert source.times[6] == pytest.approx(7200)


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


@pytest.mark.parametrize(("settings", "is_slow"), [({"fps": 1 / 30}, True), ({"fps": 0.5}, False),
                                                   ({"fps": 1 / 30, "stills": True}, False)])  # fmt: skip
def test_frames_that_are_half_a_minute_apart_are_said(tmp_path, settings, is_slow):
    folder = str(_folder(tmp_path / "a", "1.png", "2.png"))
    words = f"{folder}: its frames are 30 s apart; is the frame rate right? if so, use --stills"
    assert make_source(RunConfig(folder, "c", **settings)).problem == (words if is_slow else "")


@pytest.mark.parametrize(
    ("names", "wrong"),
    [
        (["f/1.jpg", "f/10.jpg", "f/2.jpg"], "f/10.jpg"),  # sorted as texts
        (["f/1.jpg", "f/2.jpg", "f/10.jpg"], ""),
        (["v.mp4/000000", "v.mp4/000001", "v.mp4/000002"], ""),
        (["b", "a", "c"], ""),  # of names without numbers nothing is known
    ],
)
def test_lanes_of_a_video_are_in_the_order_of_its_frames(tmp_path, names, wrong):
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as container:
        _write(container, _stream(container), range(3))
    entries = [FrameLines(name, []) for name in names]
    camera = Camera.from_fov(60.0, 64, 48)
    if wrong:
        with pytest.raises(
            ValueError, match=f"expected entries in the order of the frames of .*, got '{wrong}' out"
        ):
            LaneFileObserver(entries, open_source(str(path)), camera)
    else:
        assert LaneFileObserver(entries, open_source(str(path)), camera).matches == [0, 1, 2]


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


def test_lanes_that_a_slow_detector_repeats_are_noticed(tmp_path):
    for number in range(6):
        Image.fromarray(_picture()).save(tmp_path / f"{number}.png")
    source, camera = open_source(str(tmp_path)), Camera.from_fov(60, *_picture().shape[1::-1])
    line = np.array([[0.5, 0.5], [1.0, 1.0]]) * (np.array(_picture().shape[1::-1]) - 1.0)
    remarks = {
        every: LaneFileObserver(
            [FrameLines(f"{i}.png", [LaneLine(line - i // every)]) for i in range(6)], source, camera
        ).remark
        for every in (1, 2, 3, 6)
    }
    assert remarks[1] == remarks[6] == ""  # all the same: nothing moves
    assert remarks[2].startswith("lanes: 3 of 6 frames have the lines of the frame before")
    assert remarks[3].startswith("lanes: 4 of 6 frames have the lines of the frame before")


def test_lanes_of_different_widths_are_noticed(tmp_path):
    Image.fromarray(_picture()).save(tmp_path / "0.png")
    height, width = _picture().shape[:2]
    camera, source = Camera.from_fov(60, width, height), open_source(str(tmp_path))
    rows = np.linspace(0.5 * height, height - 1.0, 20)
    entry = FrameLines(
        "0.png",
        [
            LaneLine(np.stack([0.5 * width + 0.7 * place * (rows - 0.4 * height), rows], axis=-1))
            for place in (-1.85, 1.85, 3.35)
        ],
    )
    assert LaneFileObserver([entry], source, camera).remark.startswith(
        "lanes: one lane is 2.5 times as wide as another, unless the camera is rolled by more than 2 degrees;"
    )
    assert LaneFileObserver([entry], source, camera, stills=True).remark == ""
    equal = entry._replace(lines=entry.lines[:2])
    assert LaneFileObserver([equal], source, camera).remark == ""
    slopes = np.tan(np.arctan(0.7 * 3.7 * np.arange(-2.5, 3.0)) + math.radians(2.0))  # the camera is rolled
    rolled = [LaneLine(np.stack([0.5 * width + slope * (rows - 0.4 * height), rows], -1)) for slope in slopes]
    assert unequal_lanes_remark([entry._replace(lines=rolled)], camera) == ""
    lens = Camera.from_parameters(
        fx=0.55 * width, fy=0.55 * width, cx=0.5 * width, cy=0.5 * height, width=width, height=height,
        distortion=(-0.3, 0.1, 0.0, 0.0, 0.0),
    )  # fmt: skip
    ideal = entry._replace(principal_point=(0.5 * width, 0.5 * height))  # 3D points, projected without it
    assert LaneFileObserver([ideal], source, lens).remark.startswith("lanes: one lane is 2.5 times as wide")


def test_images_without_lanes_are_counted(tmp_path):
    """As where names of lanes begin at 1 and those of images at 0."""
    for number in range(6):
        Image.fromarray(_picture()).save(tmp_path / f"{number}.png")
    camera = Camera.from_fov(60, *_picture().shape[1::-1])
    height, width = _picture().shape[:2]
    line = LaneLine(np.array([[0.5 * width, 0.5 * height], [width - 1.0, height - 1.0]]))
    entries = [FrameLines(f"{number}.png", [line]) for number in range(1, 7)]
    source = open_source(str(tmp_path))
    remark = "lanes: 1 of 6 images have no entry, the first is number 0; 1 entries have no image"
    assert LaneFileObserver(entries, source, camera).remark == remark
    part = replace(source, selection=Selection(0.01))
    assert LaneFileObserver(entries, part, camera).remark == ""
    empty = [entry._replace(lines=[]) for entry in entries]
    assert LaneFileObserver(empty, part, camera).remark == "lanes: none of the entries has a line"
    assert LaneFileObserver(entries[:3], part, camera).remark.endswith(
        "2 of 5 images have no entry, the first is number 4"
    )


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
