"""Frames of a video container in the order in which they are shown, and what is wrong with them."""

import bisect
import contextlib
import math
import os
import re
import struct
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from lanebev.numbers import stand_in

_DRAWN_TEXTS = ("tty", "bin", "xbin", "adf", "idf")  # formats of which ffmpeg draws the letters
_A_TEXT = "a text; images are given as a folder or as a quoted glob"
_RAW_PIXELS = (
    "pixels without their size; convert them: ffmpeg -f rawvideo -pixel_format yuv420p -video_size "
    "WIDTHxHEIGHT -framerate FPS -i FILE drive.mkv"
)
_TEXTS = {  # by their first bytes
    b"#EXTM3U": "a playlist whose files are not all on this machine; give the address of the stream, or a "
    "video",
    b"v=0": "the description of a stream; pipe the stream: ffmpeg -protocol_whitelist file,udp,rtp -i FILE "
    "-c copy -f matroska - | lanebev run -",
}
_MOVING = 0.5  # a stream that lasts for less of the longest one's duration is a picture
_NO_TIMES = 0x80  # AVFMT_NOTIMESTAMPS: raw streams, whose times ffmpeg makes up
_MARKED = "one that the decoder marks as damaged"
_IN_DAMAGE = "one beside data that is missing"
_EARLY = "one before the first key frame"
_OF_MICROSOFT = ("msmpeg4v2", "msmpeg4", "wmv1", "wmv2")
_WITHOUT_KEY_CHECK = (*_OF_MICROSOFT, "mpeg4", "h263", "flv", "mpeg1video")
"""Decoders that show grey frames, or others' remains, before the first key frame of a cut stream."""

_STRICT = {"mjpeg": "explode", "hevc": "explode", **dict.fromkeys(_OF_MICROSOFT, "buffer")}
"""``err_detect`` of decoders that else show garbage without a mark."""

_ONE_THREAD = ("h264", "hevc", "vp9")
"""Decoders that mark no frame as damaged if several threads decode its slices or tiles."""


def open_video(source: str) -> av.container.InputContainer:
    """Open a container that has a video stream."""
    try:
        # abspath: else what precedes a colon is taken for a protocol; titles may be in any encoding
        container = av.open(os.path.abspath(source), metadata_errors="replace")
    except (av.error.FFmpegError, OSError) as error:
        reason = f"{error.strerror or 'unknown format'}; is it a video, and whole?"
        if isinstance(error, av.error.ArgumentError):  # of the reader of .yuv and .rgb
            reason = _RAW_PIXELS
        with contextlib.suppress(OSError), open(source, "rb") as file:
            begin = file.read(100)
            is_invalid = isinstance(error, av.error.InvalidDataError)
            is_text = is_invalid and begin.isascii() and b"\0" not in begin
            text = next((what for first, what in _TEXTS.items() if begin.startswith(first)), _A_TEXT)
            reason = stand_in(begin) or (text if is_text else reason)
        raise ValueError(f"video {source}: expected a video that opens, got: {reason}") from error
    if container.format.name in _DRAWN_TEXTS:
        container.close()
        raise ValueError(f"{source}: expected a video, got {_A_TEXT}")
    for stream in container.streams.video:
        tell_damage(stream.codec_context)
    if not moving_pictures(container):
        container.close()
        raise ValueError(f"video {source}: expected a video stream, got none; is it cut, or sound alone?")
    return container


def tell_damage(decoder: av.VideoCodecContext | None) -> None:
    """Let a decoder report damaged images; None is an unknown codec, which reports none."""
    if decoder is None:
        return
    if decoder.name in _STRICT:
        decoder.options = {"err_detect": _STRICT[decoder.name]}
    if decoder.name in _ONE_THREAD:
        decoder.thread_type = "NONE"


def moving_pictures(container: av.container.InputContainer) -> list[av.VideoStream]:
    """Return the video streams that can be decoded and are no cover or thumbnail.

    Such are marked, or declare a much shorter duration than another stream.
    """
    still = av.stream.Disposition.attached_pic
    known = (stream for stream in container.streams.video if stream.codec_context is not None)
    durations = {stream: declared_duration(stream) for stream in known if not stream.disposition & still}
    least = _MOVING * max(durations.values(), default=0.0)
    return [stream for stream, duration in durations.items() if duration == 0 or duration >= least]


def declared_duration(stream: av.VideoStream) -> float:
    """Return a stream's duration in the header, s; 0 if there is none.

    Matroska has its end, in a tag, beside which ffmpeg may give the duration of the whole file.
    """
    match = re.fullmatch(r"(\d+):(\d\d):(\d\d(?:\.\d+)?)", stream.metadata.get("DURATION", ""))
    if match is None:
        return float((stream.duration or 0) * (stream.time_base or 0))
    hours, minutes, seconds = map(float, match.groups())
    begin = (stream.start_time or 0) * (stream.time_base or 0)
    return 3600 * hours + 60 * minutes + seconds - float(begin)


def video_stream(container: av.container.InputContainer) -> av.VideoStream:
    """Return the video stream of the largest images, the first of equal ones."""
    return max(moving_pictures(container), key=lambda stream: (stream.width or 0) * (stream.height or 0))


def has_times(container: av.container.InputContainer) -> bool:
    """Return whether the container says when its frames are shown; raw streams and piped images do not."""
    return not (int(container.format.flags) & _NO_TIMES or container.format.name.endswith("_pipe"))


def packets(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[av.Packet]:
    """Return the stream's packets, an empty one at the end; a container that breaks off just ends."""
    demuxed = container.demux(stream)
    while True:
        try:
            packet = next(demuxed)
        except StopIteration:
            return
        except av.error.FFmpegError:
            end = av.Packet()
            end.stream = stream
            yield end
            return
        yield packet


def decoded(
    container: av.container.InputContainer, stream: av.VideoStream
) -> Iterator[tuple[int | None, av.VideoFrame | str]]:
    """Return frames as they are shown, with the times that the file gives; of a lost one, what was got.

    A packet that yields no frame is lost if the file is damaged before it; in an undamaged file it shows
    nothing. A frame that the decoder marks as corrupt is lost too, one that it shows in spite of an error in
    its packet, one without a key frame before it, and one in a packet that the container marks, beside which
    others may be missing, unless it is a key frame. AVI has no display times, so the frames of a stream with
    B-frames come with wrong ones: they get the packets' times in order. Frame threads are not used, because
    they drop what follows the last error.
    """
    in_order = container.format.name == "avi" and stream.codec_context.has_b_frames
    due, damage = _DuePackets(), ""
    keyed = stream.codec_context.name not in _WITHOUT_KEY_CHECK
    for packet in packets(container, stream):
        own = due.add(packet)
        if packet.is_corrupt:
            damage = damage or "a damaged one"
        frames: Sequence[av.VideoFrame] = ()
        try:
            frames = packet.decode()
        except av.error.FFmpegError as error:  # one frame lost, the next may be whole
            damage = error.strerror
            if own is not None:
                due.lost.add(own)
            elif packet.size:
                yield None, damage
        for frame in frames:
            pts = frame.pts
            if in_order:
                yield from ((each.pts, damage) for each in due.take_lost())
                pts = due.next_time()
            earlier, shown = due.take(pts)
            yield from ((each.pts, damage) for each in earlier if damage)
            keyed = keyed or frame.key_frame
            in_damage = shown in due.doubted and not frame.key_frame
            yield pts, damage if shown in due.lost else _IN_DAMAGE if in_damage else _if_whole(frame, keyed)
    if damage:
        yield from ((each.pts, damage) for each in due.packets)


class _Due(NamedTuple):
    """A packet whose frame is due.

    Attributes:
        part: number of the part of the file; in the next one times begin again, as in files that were joined.
        pts: its time, ticks.
    """

    part: int
    pts: int


class _DuePackets:
    """Packets whose frames have not come, in the order in which these are shown.

    Attributes:
        packets: the packets.
        lost: those that were not decoded.
        doubted: those that the container marks as damaged.
    """

    def __init__(self) -> None:
        self.packets: list[_Due] = []
        self.lost: set[_Due] = set()
        self.doubted: set[_Due] = set()
        self._part, self._latest = 0, -math.inf

    def add(self, packet: av.Packet) -> _Due | None:
        """Add a packet, unless its frame is not shown; None of one without a time."""
        if packet.pts is None:
            return None
        begins = packet.is_keyframe and packet.pts < self._latest
        self._part += begins
        self._latest = packet.pts if begins else max(self._latest, packet.pts)
        own = _Due(self._part, packet.pts)
        if not packet.is_discard:
            bisect.insort(self.packets, own)
        if packet.is_corrupt:
            self.doubted.add(own)
        return own

    def next_time(self) -> int | None:
        """Return the time of the next packet, ticks; None if there is none."""
        return self.packets[0].pts if self.packets else None

    def take_lost(self) -> Iterator[_Due]:
        """Take the packets before the first one that was decoded."""
        while self.packets and self.packets[0] in self.lost:
            yield self.packets.pop(0)

    def take(self, pts: int | None) -> tuple[list[_Due], _Due | None]:
        """Take a frame's packet, and those that are shown before it.

        Returns:
            those before it, and its own; None for a frame without a time.
        """
        if pts is None:
            return [], None
        known = next((each for each in self.packets if each.pts == pts), None)
        own = known or _Due(self.packets[0].part if self.packets else 0, pts)
        place = bisect.bisect_left(self.packets, own)
        earlier = self.packets[:place]
        del self.packets[: place + (known is not None)]
        return earlier, own


def _if_whole(frame: av.VideoFrame, keyed: bool) -> av.VideoFrame | str:
    """Return a frame, or what is wrong with it; ``keyed`` tells whether a key frame came."""
    if frame.is_corrupt:
        return _MARKED
    return frame if keyed else _EARLY


def display_matrix(frame: av.VideoFrame) -> tuple[int, ...] | None:
    """Return the matrix by which players show a stream's frames, see :func:`displayed`; None if it has none.

    All frames of a stream have the same. It is not asked of each, since a frame that was asked for its side
    data is in a cycle of references, and stays in memory until Python's garbage collector looks for those.
    """
    for data in frame.side_data:
        if data.type.name == "DISPLAYMATRIX":
            return struct.unpack("9i", bytes(data)[:36])
    return None


def pixel_aspect(stream: av.VideoStream, frame: av.VideoFrame, shown: tuple[int, int]) -> Fraction:
    """Return the width of a pixel over its height as the stream states it; 1 if it does not.

    Args:
        stream: of the frame.
        frame: decoded.
        shown: (height, width) px of the frame as shown, perhaps turned.
    """
    stated = stream.sample_aspect_ratio or Fraction(1)
    return stated if shown == (frame.height, frame.width) else 1 / stated


def rgb(frame: av.VideoFrame | str, matrix: Sequence[int] | None) -> NDArray[np.uint8]:
    """Return a frame as (H, W, 3) uint8 RGB, upright as ffmpeg and players show it.

    Args:
        frame: decoded, or what is wrong with a lost one.
        matrix: matrix of the stream, see :func:`display_matrix`.
    """
    if isinstance(frame, str):
        raise ValueError(f"expected a whole frame, got: {frame}")
    image: NDArray[np.uint8] = frame.to_ndarray(format="rgb24")
    return np.ascontiguousarray(image if matrix is None else displayed(image, matrix))


def displayed(image: NDArray[np.uint8], matrix: Sequence[int]) -> NDArray[np.uint8]:
    """Return an image as a display matrix shows it, turned by right angles and mirrored.

    Source: ISO/IEC 14496-12, 8.3.2 (tkhd): with the matrix [a b u; c d v; x y w], a pixel at (p, q) is shown
    at (a p + c q + x, b p + d q + y).

    Args:
        image: (H, W, 3).
        matrix: nine numbers, row by row; other angles are rounded to right ones.

    Returns:
        (H, W, 3) or (W, H, 3).
    """
    a, b, _, c, d, *_ = matrix
    down, right = d < 0, a < 0  # what is mirrored
    if abs(a) + abs(d) < abs(b) + abs(c):
        image = image.transpose(1, 0, 2)
        down, right = b < 0, c < 0
    return image[:: -1 if down else 1, :: -1 if right else 1]
