"""Cameras and streams: frames as they come; if not all can be processed, the newest is."""

from __future__ import annotations

import threading
import time
import weakref
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from io import FileIO
from pathlib import Path

import av

from lanebev.io.frame_source import DEFAULT_FPS, FrameSource
from lanebev.io.frames import ALL, Frame, Selection
from lanebev.io.rising_clock import RisingClock
from lanebev.io.source_names import PIPE, without_login
from lanebev.io.video.decoding import (
    display_matrix,
    has_times,
    moving_pictures,
    pixel_aspect,
    rgb,
    tell_damage,
    video_stream,
)
from lanebev.pipes import await_bytes, open_pipe

_TIMEOUT = 10.0  # s without a frame, after which a stream has ended
_POLL = 0.05  # s between checks whether to stop
_LOW_DELAY = {"flags": "low_delay", "rtsp_transport": "tcp"}


@dataclass
class LiveFigures:
    """Statistics of a stream's frames.

    Attributes:
        seen: number of frames that were passed on.
        dropped: number of frames that arrived during the processing of an earlier one and were replaced by
            a later one.
        damaged: number of frames that arrived damaged and were left out.
        longest_wait: s from a frame's arrival until it was passed on.
        longest_delay: s from a frame's arrival until the next one was requested.
        end: why the stream ended, empty if it was stopped or ran out.
    """

    seen: int = 0
    dropped: int = 0
    damaged: int = 0
    longest_wait: float = 0.0
    longest_delay: float = 0.0
    end: str = ""

    def words(self) -> str:
        """Return the figures in a sentence."""
        ended = f"; it ended: {self.end}" if self.end else ""
        lost = f"{self.dropped} dropped" + (f", {self.damaged} damaged and left out" if self.damaged else "")
        return (
            f"{self.seen} frames used, {lost}, at most {self.longest_delay:.2f} s from a "
            f"frame's arrival to its result, {self.longest_wait:.2f} s of them waiting{ended}"
        )


@dataclass(frozen=True)
class LiveSource(FrameSource):
    """A stream that is read in its own thread, which keeps the newest frame only.

    Frames' times are those of their arrival. A slow consumer gets the newest frame only, so that the delay
    stays that of one frame. The thread reads from the opening on, also before the first frame is requested,
    so that nothing queues in the network. With ``keep_all`` nothing is dropped, the stream waits instead, and
    times are those that the stream states.

    Attributes:
        slot: place where the thread leaves the frames.
        keep_all: drop no frame; wait for the consumer.
        figures: statistics of the frames.
    """

    slot: _Slot | None = None
    keep_all: bool = False
    figures: LiveFigures = field(default_factory=LiveFigures)

    @property
    def is_live(self) -> bool:
        """Whether frames arrive in real time: yes."""
        return True

    def stop(self) -> None:
        """End the iteration after the frame in hand; signal handlers may call it."""
        self._own_slot().stop()

    def __iter__(self) -> Iterator[Frame]:
        slot = self._own_slot()
        start = before = None
        clock = RisingClock(float(1 / self.fps))
        try:
            while (item := slot.take()) is not None:
                arrival, frame = item
                self.figures.longest_wait = max(self.figures.longest_wait, time.monotonic() - arrival)
                now = float(clock.time(*self._stated(frame))[0]) if self.keep_all else arrival
                start = now if start is None else start
                dt = float(1 / self.fps) if before is None else now - before
                image, problem = self._decoded(rgb, frame, self.matrix)
                yield Frame(self.figures.seen, now - start, dt, "", image, problem)
                before = now
                self.figures.seen += 1
                delay = time.monotonic() - arrival
                self.figures.longest_delay = max(self.figures.longest_delay, delay)
        finally:
            self.stop()

    def _own_slot(self) -> _Slot:
        if self.slot is None:
            raise RuntimeError("a live source is made by open_live")
        return self.slot

    def _stated(self, frame: av.VideoFrame) -> tuple[float | None, float]:
        """Return the time (s) of the next frame by the stream, None if it states none, and by its number."""
        return frame.time if self.has_times else None, float(self.figures.seen / self.fps)


def _whole_frames(
    container: av.container.InputContainer, stream: av.VideoStream, figures: LiveFigures
) -> Iterator[av.VideoFrame]:
    """Yield a stream's frames as they arrive; damaged ones are left out and counted."""
    for packet in container.demux(stream):
        try:
            frames = packet.decode()
        except av.error.InvalidDataError:
            figures.damaged += 1
            continue
        for frame in frames:
            figures.damaged += frame.is_corrupt
            if not frame.is_corrupt:
                yield frame


def _read(
    container: av.container.InputContainer, frames: Iterator[av.VideoFrame], slot: _Slot, figures: LiveFigures
) -> None:
    """Take frames until the stream ends or is stopped."""
    try:
        for frame in frames:
            slot.put(frame)
            if slot.is_stopped:
                break
    except (av.error.FFmpegError, OSError) as error:
        figures.end = error.strerror or str(error)
    finally:
        slot.close()
        container.close()


class _Slot:
    """Place of the newest frame, without a lock that a signal handler could wait for."""

    def __init__(self, waits: bool, figures: LiveFigures) -> None:
        self._waits, self._figures = waits, figures
        self._frames: deque[tuple[float, av.VideoFrame]] = deque(maxlen=1)
        self._came, self._closed, self.is_stopped = threading.Event(), False, False

    def stop(self) -> None:
        self.is_stopped = True

    def put(self, frame: av.VideoFrame) -> None:
        while self._waits and self._frames and not self.is_stopped:
            time.sleep(0.001)
        if self._frames:
            self._figures.dropped += 1
        self._frames.append((time.monotonic(), frame))
        self._came.set()

    def close(self) -> None:
        self._closed = True
        self._came.set()

    def take(self) -> tuple[float, av.VideoFrame] | None:
        """Wait for a frame; None at the end of the stream, or when it is to stop."""
        waited = time.monotonic()
        while not self.is_stopped:
            self._came.clear()
            try:
                return self._frames.popleft()
            except IndexError:
                if self._closed:
                    return None
            if not self._waits and time.monotonic() - waited > _TIMEOUT:
                self._figures.end = f"no frame for {_TIMEOUT:g} s"
                return None
            self._came.wait(_POLL)
        return None


def open_live(
    source: str, fps: Fraction | None = None, keep_all: bool = False, selection: Selection | None = None
) -> LiveSource:
    """Open a camera, a stream or a pipe, and wait for its first frame.

    Args:
        source: see :func:`lanebev.io.source_names.is_live`.
        fps: nominal frame rate, None for what the stream says, else 30.
        keep_all: drop no frame.
        selection: must be None: a stream is taken as it comes.

    Raises:
        ValueError: there is no such device, nothing answers, or no frame comes.
    """
    if selection not in (None, ALL):
        shown = without_login(source)
        raise ValueError(f"source {shown}: expected no --start, --end or --every with a stream, got one")
    name = "standard input" if source == PIPE else without_login(source)
    figures = LiveFigures()
    try:
        container = _opened(source)
    except (av.error.FFmpegError, OSError) as error:
        reason = error.strerror or str(error)
        raise ValueError(f"stream {name}: expected one that opens, got: {reason}") from error
    try:
        if not moving_pictures(container):
            raise ValueError(f"stream {name}: expected a video stream, got none")
        stream = video_stream(container)
        tell_damage(stream.codec_context)
        frames = _whole_frames(container, stream, figures)
        first = next(frames)
        matrix = display_matrix(first)
        size = rgb(first, matrix).shape[:2]
        aspect = pixel_aspect(stream, first, size)
    except (av.error.FFmpegError, StopIteration, OSError) as error:
        container.close()
        got = "damaged ones only" if figures.damaged else "none"
        raise ValueError(f"stream {name}: expected a whole frame, got {got}") from error
    rate = Fraction(fps or stream.average_rate or stream.guessed_rate or DEFAULT_FPS)
    timed, problem = has_times(container), ""
    if keep_all and not timed and fps is None:
        problem = f"stream {name}: it has no times, and is taken for {float(rate):g} frames per second"
    slot = _Slot(keep_all, figures)
    slot.put(first)
    thread = threading.Thread(
        target=_read, args=(container, frames, slot, figures), name="stream", daemon=True
    )
    thread.start()
    live = LiveSource(
        without_login(source), (), rate, 0, size, problem, (), timed, pixel_aspect=aspect, matrix=matrix,
        slot=slot, keep_all=keep_all, figures=figures,
    )  # fmt: skip
    weakref.finalize(live, slot.stop)  # of a run that ended before its first frame
    return live


def _opened(source: str) -> av.container.InputContainer:
    if source == PIPE:  # not by sys.stdin, whose lock a thread that still reads would hold at the end
        return _opened_pipe(open(0, "rb", buffering=0, closefd=False), "standard input")
    if Path(source).is_fifo():
        return _opened_pipe(open_pipe(source), source)
    if source.startswith("/dev/video"):
        return av.open(source, "r", format="v4l2")
    scheme, separator, address = source.partition("://")
    url = f"{scheme.lower()}{separator}{address}"
    return av.open(
        url, "r", options=dict(_LOW_DELAY), timeout=(_TIMEOUT, _TIMEOUT), metadata_errors="replace"
    )


def _opened_pipe(pipe: FileIO, name: str) -> av.container.InputContainer:
    """Open a pipe when something has come through it."""
    if pipe.isatty():
        raise ValueError(f"stream {name}: expected a pipe, as from ffmpeg, got a terminal")
    try:
        await_bytes(pipe)
    except ValueError as error:
        pipe.close()
        raise ValueError(f"stream {name}: expected frames, got {error}") from error
    return av.open(pipe, "r", metadata_errors="replace")
