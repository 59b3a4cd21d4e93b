"""Frames from videos, folders, globs and single images; H.264 out; work side by side."""

import gc
import io
import os
import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from lanebev import Camera
from lanebev.io.images.names import natural_order
from lanebev.io.images.pixels import read_image, write_png
from lanebev.io.lanes import read_lanes
from lanebev.io.opening import open_source
from lanebev.io.video.writer import VideoWriter
from tests.io.video.damaged import packets_of, write_damaged


def _picture(value, height=48, width=64):
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = value
    image[: height // 2, :, 2] = 255
    return image


def _folder(path, names):
    for i, name in enumerate(names):
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(_picture(10 * i)).save(path / name)
    return path


def _video(path, count=5, fps=25, height=48, width=64):
    with VideoWriter(path, Fraction(fps)) as writer:
        for i in range(count):
            writer.write(_picture(40 * i, height, width))
    return path


def test_folder_frames_come_in_natural_order(tmp_path):
    _folder(tmp_path, ["2.png", "10.png", "1.png"])
    (tmp_path / "notes.txt").write_text("no image")
    source = open_source(str(tmp_path), Fraction(10))
    frames = list(source)
    assert [frame.name for frame in frames] == [str(tmp_path / f"{i}.png") for i in (1, 2, 10)]
    assert [frame.time for frame in frames] == [0.0, 0.1, 0.2]
    assert [frame.dt for frame in frames] == [0.1] * 3
    assert [frame.number for frame in frames] == [0, 1, 2]
    assert not source.is_video
    assert not source.is_single
    np.testing.assert_array_equal(frames[2].image, _picture(10))


def test_frames_are_shown_at_their_times(tmp_path):
    times = [0.0, 0.033, 0.033, 4.0, 9.0]  # one given again, a late gap
    with VideoWriter(tmp_path / "x.mp4", Fraction(30)) as writer:
        for i, time in enumerate(times):
            writer.write(_picture(40 * i), time)
        writer.write(_picture(0))
    shown = [frame.time for frame in open_source(str(tmp_path / "x.mp4"))]
    assert shown == pytest.approx([*times, 9.0 + 1 / 30], abs=1e-3)
    assert np.diff(shown).min() > 0
    with av.open(str(tmp_path / "x.mp4")) as container:
        stream = container.streams.video[0]
        assert float(stream.duration * stream.time_base) == pytest.approx(9.0 + 2 / 30, abs=0.05)


def test_decoded_frames_are_given_up_at_once(tmp_path):
    """Not when the garbage collector comes, which may be a thousand frames later."""
    source = open_source(str(_video(tmp_path / "video.mp4")))
    gc.collect()
    gc.disable()
    try:
        before = sum(type(each) is av.VideoFrame for each in gc.get_objects())
        assert sum(frame.image is not None for frame in source) == 5
        assert sum(type(each) is av.VideoFrame for each in gc.get_objects()) == before
    finally:
        gc.enable()


def test_frames_of_an_avi_are_evenly_spaced(tmp_path):
    """It keeps no times of display, and B-frames come with another's."""
    with av.open(str(tmp_path / "x.avi"), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.options = 64, 48, "yuv420p", {"bf": "2"}
        for i in range(20):
            container.mux(
                stream.encode(av.VideoFrame.from_ndarray(np.roll(_picture(99), i, 1), format="rgb24"))
            )
        container.mux(stream.encode())
    assert min(frame.dt for frame in open_source(str(tmp_path / "x.avi"))) > 0


def test_hidden_files_are_no_frames(tmp_path):
    _folder(tmp_path, ["1.png", "._1.png", ".2.jpg"])
    assert [frame.name for frame in open_source(str(tmp_path))] == [str(tmp_path / "1.png")]
    assert open_source(str(tmp_path / ".2.jpg")).is_single  # asked for by its name
    assert len(open_source(f"{tmp_path}/.*.jpg").paths) == 1


@pytest.mark.parametrize(("name", "codec"), [("raw.h264", "libx264"), ("x.webm", "libvpx")])
def test_frames_are_counted_where_packets_do_not_tell(tmp_path, name, codec):
    """Raw streams have no times, and VP8 has packets that show nothing."""
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        if codec == "libvpx":
            stream.options = {"auto-alt-ref": "1", "lag-in-frames": "16"}
        for i in range(40):
            frame = av.VideoFrame.from_ndarray(np.roll(_picture(200), i, axis=1), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    source = open_source(str(tmp_path / name))
    assert source.count == len(list(source)) == 40


def test_an_image_of_floating_point_is_refused(tmp_path):
    Image.fromarray(np.full((48, 64), 0.5, np.float32)).save(tmp_path / "x.tif")
    with pytest.raises(ValueError, match="floating point, expected 8 or 16 bits"):
        read_image(tmp_path / "x.tif")


def test_recursive_glob(tmp_path):
    _folder(tmp_path, ["a/1/20.png", "a/2/20.png", "b/20.jpg"])
    source = open_source(f"{tmp_path}/**/*.png")
    assert source.paths == (f"{tmp_path}/a/1/20.png", f"{tmp_path}/a/2/20.png")
    assert list(open_source(f"{tmp_path}/**/*.png"))[1].name == source.paths[1]


def test_single_image(tmp_path):
    _folder(tmp_path, ["[1].png"])
    source = open_source(str(tmp_path / "[1].png"))
    assert source.is_single
    assert source.image_size == (48, 64)


def test_video_round_trip(tmp_path):
    source = open_source(str(_video(tmp_path / "v.mp4")))
    assert source.is_video
    assert (source.fps, source.count, source.image_size) == (25, 5, (48, 64))
    for _ in range(2):  # as often as wanted
        frames = list(source)
        assert [frame.number for frame in frames] == list(range(5))
        np.testing.assert_allclose([frame.time for frame in frames], np.arange(5) / 25, atol=1e-9)
        assert {frame.dt for frame in frames} == {0.04}
        for i, frame in enumerate(frames):
            assert abs(float(frame.image[24:, :, 0].mean()) - 40 * i) < 4  # RGB: red is first
            assert frame.image[10, 10, 2] > 200


@pytest.mark.parametrize("pause", [3599.0, 30 * 3600.0])
def test_of_a_long_pause_an_hour_is_written(tmp_path, pause):
    with VideoWriter(tmp_path / "v.mp4", Fraction(10)) as writer:
        for time in (0, 0.1, 0.1 + pause, 0.2 + pause):
            writer.write(np.zeros((16, 16, 3), np.uint8), time)
    shown = min(pause, 3600.1)  # MP4 cannot have 7 hours between two frames
    expected = [0, 0.1, 0.1 + shown, 0.2 + shown]
    assert list(open_source(str(tmp_path / "v.mp4")).times) == pytest.approx(expected)


def test_writer_makes_what_browsers_play(tmp_path):
    path = _video(tmp_path / "v.mp4", height=47, width=63)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.height, stream.width) == (48, 64)
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # plays before it is fully loaded


def test_a_damaged_image_in_a_drive_is_a_frame_without_image(tmp_path):
    _folder(tmp_path, ["1.jpg", "2.jpg", "3.jpg"])
    data = (tmp_path / "2.jpg").read_bytes()
    (tmp_path / "2.jpg").write_bytes(data[: len(data) // 2])
    (tmp_path / "1.jpg").write_bytes(b"")
    frames = list(open_source(str(tmp_path)))
    assert [frame.image is None for frame in frames] == [True, True, False]
    problems = [frame.problem for frame in frames]
    assert "1.jpg" in problems[0]
    assert "truncated" in problems[1].lower()
    assert all("\n" not in problem for problem in problems)


def test_an_image_of_another_size_is_a_frame_without_image(tmp_path):
    _folder(tmp_path, ["1.png", "2.png"])
    Image.fromarray(_picture(0, 32, 40)).save(tmp_path / "2.png")
    first, second = open_source(str(tmp_path))
    assert first.image is not None
    assert second.image is None
    assert second.problem == "expected 64 x 48 like the other frames, got 40 x 32"


def test_a_damaged_stretch_of_a_video_does_not_end_it(tmp_path):
    path = tmp_path / "v.mp4"
    noise = np.random.default_rng(0)
    with VideoWriter(path, Fraction(25)) as writer:
        for _ in range(30):
            writer.write(noise.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + len(data) // 3
    data[start : start + 3000] = bytes(3000)
    path.write_bytes(data)
    frames = list(open_source(str(path)))
    assert len(frames) >= 20
    assert [frame.number for frame in frames] == list(range(len(frames)))


@pytest.mark.parametrize(
    ("spoilt", "options"),
    [
        *[(spoilt, {"g": "1"}) for spoilt in ((5,), (0,), (14, 15), (3, 4, 9))],
        *[(spoilt, {"bf": "3", "b_strategy": "0"}) for spoilt in ((5,), (14, 15), (3, 4, 9))],
    ],
)
def test_every_frame_of_a_damaged_video_has_its_row_and_time(tmp_path, spoilt, options):
    numbers = write_damaged(tmp_path / "v.mp4", spoilt, **options)
    source = open_source(str(tmp_path / "v.mp4"))
    frames = list(source)
    assert source.count == len(frames) == 16
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(16) / 25, atol=1e-9)
    assert numbers == [frame.number for frame in frames if frame.image is None]
    for frame in frames:
        assert frame.problem.startswith("expected a whole frame, got: ") == (frame.number in numbers)


@pytest.mark.parametrize("suffix", ["avi", "mov", "mkv"])
def test_half_a_jpeg_in_a_video_is_a_frame_without_image(tmp_path, suffix):
    noise = np.random.default_rng(0)
    with av.open(str(tmp_path / f"v.{suffix}"), "w") as container:
        stream = container.add_stream("mjpeg", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for number in range(6):
            file = io.BytesIO()
            Image.fromarray(noise.integers(0, 255, (48, 64, 3), dtype=np.uint8)).save(file, "JPEG")
            data = file.getvalue()
            packet = av.Packet(data[: len(data) // 2] if number in (0, 3) else data)
            packet.pts = packet.dts = number
            packet.time_base, packet.stream, packet.is_keyframe = Fraction(1, 10), stream, True
            container.mux(packet)
    frames = list(open_source(str(tmp_path / f"v.{suffix}")))
    assert [frame.number for frame in frames if frame.image is None] == [0, 3]
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(6) / 10, atol=1e-3)


def _cut(path, rest):
    """A video of 20 frames without what follows the twelfth and some bytes."""
    write_damaged(path, (), count=20)
    assert open_source(str(path)).problem == ""
    packet = packets_of(path)[11]
    os.truncate(path, packet.pos + packet.size + rest)
    return open_source(str(path))


def test_a_cut_video_says_so(tmp_path):
    source = _cut(tmp_path / "v.mp4", 5)
    frames = list(source)
    assert source.problem.endswith("expected 0.80 s as it declares, got 0.52 s; is it cut?")
    assert source.count == len(frames) == 13
    assert [frame.number for frame in frames if frame.image is None] == [12]


def test_a_cut_matroska_says_so(tmp_path):
    source = _cut(tmp_path / "v.mkv", 20)
    assert source.problem.endswith("expected 0.80 s as it declares, got 0.48 s; is it cut?")
    assert source.count == len(list(source)) == 12


def test_uneven_frame_times_are_no_damage(tmp_path):
    path, times = tmp_path / "v.mp4", [0, 1, 2, 7, 8, 30, 31]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for pts in times:
            frame = av.VideoFrame.from_ndarray(_picture(pts), format="rgb24")
            frame.pts, frame.time_base = pts, Fraction(1, 25)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    source = open_source(str(path))
    frames = list(source)
    np.testing.assert_allclose([frame.time for frame in frames], np.array(times) / 25, atol=1e-9)
    assert all(frame.image is not None for frame in frames)
    assert source.problem == ""


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.mp4", None, "expected a video, an image, a folder or a glob of images, got nothing there"),
        ("v.mp4", b"no\0 video", "expected a video that opens, got: Invalid data"),
        ("v.ffconcat", b"ffconcat version 1.0\nfile a.mp4\n", "got: No such file or directory"),
        ("v.mp4", b"", "expected a video that opens, got: an empty file"),
        (
            "v.mp4",
            b"<!DOCTYPE html><html>",
            "got: a web page; download the file again$",
        ),
        ("v.mp4", LFS, "got: a pointer of Git LFS; fetch the file by git lfs pull"),
        ("i.jpg", LFS, "got: a pointer of Git LFS; fetch the file by git lfs pull"),
        ("i.png", b"\x89PNG\r\n\x1a\n", "expected a whole image, got"),
        ("i.jpg", b"", "expected a whole image, got: an empty file"),
        ("i.jpg", b"none", "no image, one whose header is cut, or other pixels"),
        ("*.jpg", None, "expected images that match, got none"),
    ],
)
def test_bad_sources_are_one_clear_line(tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as error:
        open_source(str(path))
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("read", [Camera.from_file, read_lanes])
def test_a_pointer_of_git_lfs_is_said(tmp_path, read):
    (tmp_path / "f.json").write_bytes(LFS)
    with pytest.raises(ValueError, match=r"f\.json: expected a readable .* got: a pointer of Git LFS"):
        read(tmp_path / "f.json")


def test_cut_video(tmp_path):
    path = _video(tmp_path / "v.mp4")
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ValueError, match=r"v\.mp4: expected"):
        open_source(str(path))


def test_images_and_videos_that_are_left_out_of_a_folder_are_said(tmp_path):
    for name in ("1.png", "2.png"):
        Image.new("RGB", (64, 48), "grey").save(tmp_path / name)
    for name in ("1.json", "bev.mp4", "._3.HEIC"):
        (tmp_path / name).touch()
    assert open_source(str(tmp_path)).problem == ""
    for name in ("3.HEIC", "drive.MP4"):
        (tmp_path / name).touch()
    source = open_source(str(tmp_path))
    assert source.count == 2
    assert "2 pictures or videos beside the images are left out, such as 3.HEIC;" in source.problem
    assert open_source(f"{tmp_path}/*.png").problem == ""


def test_links_of_folders_lead_to_no_image_twice(tmp_path):
    (tmp_path / "a").mkdir()
    for name in ("1.png", "2.png"):
        Image.new("RGB", (64, 48), "grey").save(tmp_path / "a" / name)
    (tmp_path / "a" / "loop").symlink_to(".")
    (tmp_path / "latest").symlink_to("a")
    (tmp_path / "a" / "3.png").symlink_to("2.png")  # a frame that was repeated
    names = [f"{tmp_path}/a/{i}.png" for i in (1, 2, 3)]
    assert open_source(f"{tmp_path}/**/*.png").paths == tuple(names)


def test_a_list_of_images_is_no_video(tmp_path):  # of which ffmpeg draws the letters
    (tmp_path / "train.txt").write_text("".join(f"images/{i:04d}.jpg\n" for i in range(100)))
    with pytest.raises(ValueError, match=r"train\.txt: expected a video, got a text; images are given"):
        open_source(str(tmp_path / "train.txt"))


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        (
            "list.txt",
            b"images/1.jpg\nimages/2.jpg\n",
            "a text; images are given as a folder or as a quoted glob",
        ),
        ("live.m3u8", b"#EXTM3U\nhttp://camera/1.ts\n", "a playlist whose files are not all .* or a video"),
        ("cam.sdp", b"v=0\nm=video 5004 RTP/AVP 96\n", "the description of a stream; pipe .* lanebev run -"),
        ("raw.yuv", bytes(9999), "pixels without their size; convert them: ffmpeg -f rawvideo .* drive.mkv"),
        ("images.zip", b"PK\x03\x04" + bytes(99), "a ZIP archive, .* save the sheet as CSV"),
        ("frames.npy", b"\x93NUMPY" + bytes(99), "an array of NumPy; write numbers .*, images as PNG"),
    ],
)
def test_other_files_in_place_of_a_video_are_named(tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=f"{name}: expected a video that opens, got: {words}$"):
        open_source(str(tmp_path / name))


def test_folder_without_images_suggests_a_glob(tmp_path):
    _folder(tmp_path, ["a/1.png"])
    with pytest.raises(ValueError, match=r"quoted glob such as '.*/\*\*/\*\.jpg'"):
        open_source(str(tmp_path))
    (tmp_path / "0001").touch()
    with pytest.raises(ValueError, match=r"its files have no endings, images with \.jpg"):
        open_source(str(tmp_path))


def test_write_png(tmp_path):
    write_png(tmp_path / "a.png", _picture(7))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), _picture(7))


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_16_bit_grey_keeps_its_scale(tmp_path, suffix):
    values = np.array([[0, 257, 25700, 65535]], np.uint16).repeat(2, axis=0)
    Image.fromarray(values).save(tmp_path / f"a.{suffix}")
    expected = np.array([0, 1, 100, 255], np.uint8)[None, :, None]
    np.testing.assert_array_equal(read_image(tmp_path / f"a.{suffix}"), np.broadcast_to(expected, (2, 4, 3)))


def test_natural_order():
    assert sorted(["a/10.jpg", "a/9.jpg", "b/1.jpg", "a/x.jpg"], key=natural_order)[:2] == [
        "a/9.jpg",
        "a/10.jpg",
    ]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_upright_as_opencv_reads_them(tmp_path, orientation):
    image = Image.fromarray(_picture(200))
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "a.png"
    image.save(path, exif=exif)
    np.testing.assert_array_equal(read_image(path), cv2.imread(str(path), cv2.IMREAD_COLOR_RGB))
    assert open_source(str(path)).image_size == ((64, 48) if orientation > 4 else (48, 64))


@pytest.mark.parametrize("matrix", [(0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0)])
def test_videos_are_upright_as_opencv_reads_them(tmp_path, matrix):
    path = _video(tmp_path / "v.mp4", count=2)
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44  # of the track's display matrix, 16.16 but its last column
    a, b, c, d = (value << 16 for value in matrix)
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    source = open_source(str(path))
    _, expected = cv2.VideoCapture(str(path)).read()
    frames = list(source)
    assert source.image_size == frames[0].image.shape[:2] == expected.shape[:2]
    np.testing.assert_allclose(frames[0].image, expected[..., ::-1], atol=12)
    torch.from_numpy(frames[0].image)  # of no negative strides


def test_a_colon_in_a_videos_name_is_no_protocol(tmp_path, monkeypatch):
    _video(tmp_path / "2024-01-01T10:00:00.mp4")
    monkeypatch.chdir(tmp_path)
    assert open_source("2024-01-01T10:00:00.mp4").count == 5
