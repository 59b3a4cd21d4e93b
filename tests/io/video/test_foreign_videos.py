"""Videos as more recorders leave them, each after a public report."""

import math
import struct
from dataclasses import replace
from fractions import Fraction

import av
import numpy as np
import pytest

from lanebev import Camera
from lanebev.app.config import RunConfig
from lanebev.app.drive.build import make_camera
from lanebev.app.drive.observers import LaneFileObserver
from lanebev.io.frames import Selection
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.opening import open_source

SIZE = (48, 64)
MILLISECOND = Fraction(1, 1000)


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


def _source(path, times, tick=Fraction(1, 10), own_tick=None, metadata=(), **options):
    """Write a video of one stream, whose codec may have a tick of its own too, and open it."""
    with av.open(str(path), "w") as container:
        stream = _stream(container, **options)
        stream.metadata.update(metadata)
        if own_tick is not None:
            stream.codec_context.time_base = own_tick
        _write(container, stream, times, tick)
    return open_source(str(path))


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
    source = _source(tmp_path / "v.mkv", range(0, 1200, 100), MILLISECOND, rate=1000)
    assert source.fps == 10
    assert source.problem.endswith("v.mkv: it states 1000 frames per second, they come at 10")
    np.testing.assert_allclose([frame.dt for frame in source], 0.1, atol=1e-3)


@pytest.mark.parametrize("times", [[0, 1, 2, 3, 9, 10, 11, 30], [0, 1, 2, 3, 4, 5000, 5001, 5002]])
def test_gaps_do_not_make_the_stated_rate_wrong(tmp_path, times):
    source = _source(tmp_path / "v.mkv", times)
    assert source.fps == 10
    assert "frames per second" not in source.problem
    np.testing.assert_allclose([frame.time for frame in source], np.array(times) / 10, atol=1e-3)


@pytest.mark.parametrize("times", [[0, 58, 91, 150, 200, 270, 290, 333], [0, 33, 66, 4000, 4033, 4066, 4100]])
@pytest.mark.parametrize("suffix", ["mkv", "mp4"])
def test_the_number_of_frames_that_are_taken_is_exact_where_times_vary(tmp_path, times, suffix):
    source = _source(tmp_path / f"v.{suffix}", times, MILLISECOND, MILLISECOND, rate=30)
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
    times = [-100 + 33 * i for i in range(20)]
    source = _source(tmp_path / "v.mp4", times, MILLISECOND, MILLISECOND, rate=30)
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


@pytest.mark.parametrize(("codec", "suffix"), [("mpeg4", "mkv"), ("msmpeg4", "mkv"), ("flv1", "flv")])
def test_a_decoder_that_shows_frames_before_the_first_key_frame_is_not_believed(tmp_path, codec, suffix):
    path, cut = tmp_path / f"v.{suffix}", tmp_path / f"cut.{suffix}"
    with av.open(str(path), "w") as container:
        stream = _stream(container, codec=codec)
        stream.gop_size, stream.codec_context.options = 12, {"sc_threshold": "1000000000"}
        _write(container, stream, range(20))
    _cut(path, cut, 5)
    source = open_source(str(cut))
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
    source = _source(tmp_path / "v.mkv", range(4), metadata={"stereo_mode": "left_right"})
    assert "its header says that frames have the images of two cameras" in source.problem


def test_videos_of_360_degrees_are_said(tmp_path):
    """Google's box for spherical videos, as cameras and YouTube's injector write it into the track."""
    path = tmp_path / "v.mp4"
    _source(path, range(4))
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
        _source(path, times)
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
    assert source.count == len(frames) == 40
    assert all(frame.dt == pytest.approx(0.1) for frame in frames)
    lost = [frame.number for frame in frames if frame.image is None]
    assert len(lost) <= 1  # where the first file ends, the container marks a packet as damaged
    levels = [0 if frame.image is None else round(frame.image.mean()) for frame in frames]
    assert all(abs(levels[20 + i] - levels[i]) <= 1 for i in range(20) if i not in lost)
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


def test_a_transport_stream_of_varying_times_states_no_rate(tmp_path):
    tick = Fraction(1, 90_000)
    times = [3000 * i + i % 3 * 450 for i in range(24)]
    source = _source(tmp_path / "v.ts", times, tick, tick, rate=25)
    assert (len(list(source)), source.problem) == (24, "")


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_gap_of_hours_is_said_and_changes_no_frame_rate(tmp_path, suffix):
    source = _source(tmp_path / f"v.{suffix}", [*range(6), *range(72_000, 72_006)])
    assert "its times jump by 7200 s; is it one drive?" in source.problem
    assert source.fps == 10
    assert source.times[6] == pytest.approx(7200)
