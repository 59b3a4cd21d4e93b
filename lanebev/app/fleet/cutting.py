"""Cut long drives into parts that the network processes in parallel."""

import math
from pathlib import Path
from typing import NamedTuple

import av

_TIME_BASE = 1_000_000  # ticks a second of a container's duration


class Part(NamedTuple):
    """A part of a drive; times in s of the source.

    Attributes:
        start: time of its first frame.
        end: before which its last frame is; None is the end of the source.
    """

    start: float
    end: float | None


def parts_of(start: float, end: float, length: float) -> list[Part]:
    """Return parts of about ``length`` s from ``start`` to ``end``, one where the next begins.

    A rest of less than half a part belongs to the last one.
    """
    count = max(1, math.floor((end - start) / length + 0.5)) if math.isfinite(end) else 1
    cuts = [start + length * number for number in range(1, count)]
    return [Part(*each) for each in zip([start, *cuts], [*cuts, None], strict=True)]


def duration(path: str | Path) -> float:
    """Return how long a video is by its header, s; infinite where it does not say, or is none."""
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            return math.inf if container.duration is None else container.duration / _TIME_BASE
    except (av.error.FFmpegError, OSError):
        return math.inf
