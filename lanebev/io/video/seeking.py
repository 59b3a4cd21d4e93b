"""Start a video in its middle with exactly the frames of a decoding from its beginning."""

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from typing import NamedTuple

import av

from lanebev.io.video.decoding import decoded, has_times, open_video, packets, video_stream

_CODECS = ("h264", "hevc", "mpeg4", "mpeg2video", "mjpeg")  # each packet is a frame that is shown
_KEYS_BEFORE = 2  # in an open group, frames just before a key frame may refer to the one before it


class StartedVideo(NamedTuple):
    """A video from some frame on.

    Attributes:
        container: open.
        stream: stream of the frames.
        frames: as of :func:`lanebev.io.video.decoding.decoded`.
        number: number of the first frame in the whole video.
        first: time (s) of the video's first frame as the file has it; None where it is yet to come.
        before: likewise, of the frame before the first of ``frames``.
    """

    container: av.container.InputContainer
    stream: av.VideoStream
    frames: Iterator[tuple[int | None, av.VideoFrame | str]]
    number: int = 0
    first: Fraction | None = None
    before: Fraction | None = None


@contextmanager
def open_at(source: str, start: float) -> Iterator[StartedVideo]:
    """Open a video near the frame of a time, if that surely gives the same frames; else at its first frame.

    Args:
        source: its path.
        start: s since its first frame.
    """
    if start > 0:
        with open_video(source) as container:
            found = _open_at_key_frame(container, start)
            if found is not None:
                yield found
                return
    with open_video(source) as container:
        stream = video_stream(container)
        yield StartedVideo(container, stream, decoded(container, stream))


def _open_at_key_frame(container: av.container.InputContainer, start: float) -> StartedVideo | None:
    """Decode from a key frame to the wanted frame; None unless all in between are whole and as expected."""
    stream = video_stream(container)
    tick = stream.time_base
    sound = has_times(container) and container.format.name != "avi" and stream.codec_context.name in _CODECS
    found = _times_to(container, stream, start) if sound else None
    if found is None or tick is None:
        return None
    times, key = found
    try:
        container.seek(times[key], stream=stream)
    except av.error.FFmpegError:
        return None
    frames = (each for each in decoded(container, stream) if each[0] is None or each[0] >= times[key])
    pts, frame = None, None
    for expected in times[key:]:
        pts, frame = next(frames, (None, None))
        if pts != expected or not isinstance(frame, av.VideoFrame) or frame.is_corrupt:
            return None
    rest = itertools.chain([(pts, frame)], frames)
    return StartedVideo(container, stream, rest, len(times) - 1, times[0] * tick, times[-2] * tick)


def _times_to(
    container: av.container.InputContainer, stream: av.VideoStream, start: float
) -> tuple[list[int], int] | None:
    """Return the times of all frames up to the wanted one, by packets that are not decoded.

    Returns:
        the times (ticks) in order, the last of them the wanted frame's, and the place of the key frame to
        begin with; None where packets do not tell, or the wanted one is near the beginning.
    """
    times: list[int] = []
    keys: list[int] = []
    wanted = math.inf
    for packet in packets(container, stream):
        if packet.pts is None or packet.is_corrupt:
            if packet.size:
                return None
            continue
        if packet.is_discard:
            continue
        times.append(packet.pts)
        if packet.is_keyframe:
            keys.append(packet.pts)
        if packet.pts < wanted and float((packet.pts - times[0]) * stream.time_base) >= start:
            wanted = packet.pts
        if packet.dts is not None and packet.dts > wanted:  # all that are shown up to then have come
            break
    times, keys = sorted(each for each in times if each <= wanted), sorted(k for k in keys if k <= wanted)
    good = math.isfinite(wanted) and len(set(times)) == len(times) and keys[:1] == times[:1]
    if not good or len(keys) <= _KEYS_BEFORE:
        return None
    return times, times.index(keys[-_KEYS_BEFORE])
