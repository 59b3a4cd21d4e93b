"""A video from its middle on: the very frames, numbers and times that decoding all of it gives."""

import math

import av
import numpy as np
import pytest

from lanebev.io.frames import Selection
from lanebev.io.opening import open_source
from lanebev.io.video import seeking
from tests.io.video.damaged import write_damaged

COUNT, FPS = 120, 20
CLOSED = {"g": "12", "bf": "3", "b_strategy": "0", "x264-params": "keyint=12:min-keyint=12:bframes=3"}
OPEN = {"x264-params": "open-gop=1:keyint=12:min-keyint=4:bframes=3:b-adapt=0:b-pyramid=normal:ref=4"}
KINDS = {
    "closed.mp4": ("libx264", CLOSED),
    "open.mp4": ("libx264", OPEN),
    "open.mkv": ("libx264", OPEN),
    "refresh.mp4": ("libx264", {"x264-params": "intra-refresh=1:keyint=12:bframes=2"}),
    "one_key.mp4": ("libx264", {"g": "999", "bf": "2"}),
    "intra.mp4": ("libx264", {"g": "1"}),
    "x.ts": ("libx264", CLOSED),
    "x.avi": ("libx264", CLOSED),
    "mpeg4.mp4": ("mpeg4", {"g": "12", "bf": "2"}),
    "hevc.mp4": ("libx265", {"x265-params": "keyint=12:min-keyint=4:bframes=3:open-gop=1:log-level=none"}),
    "x.webm": ("libvpx-vp9", {"lag-in-frames": "8", "g": "12"}),
}


def _write(path, codec, options):
    noise = np.random.default_rng(0).integers(0, 255, (48, 96, 3), dtype=np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS)
        stream.width, stream.height, stream.pix_fmt, stream.options = 64, 48, "yuv420p", options
        for number in range(COUNT):
            image = np.roll(noise, 3 * number, axis=1)[:, :64] // (1 + number // 40)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _frames(path, start, end=math.inf, every=1):
    source = open_source(str(path))
    return list(type(source)(**{**vars(source), "selection": Selection(start, end, every)}))


def _assert_same(found, whole):
    assert [each[:4] + each[5:] for each in found] == [each[:4] + each[5:] for each in whole]
    for one, other in zip(found, whole, strict=True):
        assert (one.image is None) == (other.image is None)
        assert one.image is None or np.array_equal(one.image, other.image)


FAST = ("closed.mp4", "open.mp4")


@pytest.fixture(
    params=[name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in KINDS]
)
def video(request, tmp_path):
    codec, options = KINDS[request.param]
    _write(tmp_path / request.param, codec, options)
    return tmp_path / request.param


def test_frames_are_those_of_decoding_all(video, monkeypatch):
    selections = [(1.23, 1.5, 1), (3.0, 3.6, 1), (4.01, math.inf, 3)]
    found = [_frames(video, *each) for each in selections]
    monkeypatch.setattr(seeking, "_open_at_key_frame", lambda *_: None)
    for one, each in zip(found, selections, strict=True):
        whole = _frames(video, *each)
        assert whole
        _assert_same(one, whole)


@pytest.mark.parametrize("name", ["open.mp4", "open.mkv", "intra.mp4", "mpeg4.mp4", "hevc.mp4"])
def test_what_is_far_before_is_not_decoded(tmp_path, name):
    _write(tmp_path / name, *KINDS[name])
    with seeking.open_at(str(tmp_path / name), 5.0) as video:
        assert video.number == 100
        assert video.first is not None


@pytest.mark.parametrize("spoilt", [(5,), (52,)])
def test_a_damaged_video(tmp_path, monkeypatch, spoilt):
    write_damaged(tmp_path / "v.mp4", spoilt, count=100, bf="3", b_strategy="0", g="10")
    found = _frames(tmp_path / "v.mp4", 2.2)
    monkeypatch.setattr(seeking, "_open_at_key_frame", lambda *_: None)
    _assert_same(found, _frames(tmp_path / "v.mp4", 2.2))
    assert len(found) == 45
