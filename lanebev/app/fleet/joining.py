"""Long drives, cut into parts that overlap, and their rows joined again."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from lanebev.io.covariances import read_covariances, write_covariances
from lanebev.io.results import ExtrinsicsRow, OutputFolder, read_extrinsics, write_extrinsics

_SAME_TIME = 1e-5  # s: extrinsics.csv has microseconds
_TIME_BASE = 1_000_000  # ticks a second of a container's duration


class Part(NamedTuple):
    """A part of a drive, s in the source.

    Attributes:
        start: of the first frame that is looked at, an overlap before the first that is kept.
        end: before which the last frame is; None is the end of the source.
    """

    start: float
    end: float | None


def parts_of(start: float, end: float, length: float, overlap: float) -> list[Part]:
    """Return parts of about ``length`` s from ``start`` to ``end``, each but the first ``overlap`` s longer.

    A rest of less than half a part belongs to the last one.
    """
    count = max(1, math.floor((end - start) / length + 0.5)) if math.isfinite(end) else 1
    cuts = [start + length * number for number in range(1, count)]
    starts = [start, *(max(start, cut - overlap) for cut in cuts)]
    return [Part(*each) for each in zip(starts, [*cuts, None], strict=True)]


def duration(path: str | Path) -> float:
    """Return how long a video is by its header, s; infinite where it does not say, or is none."""
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            return math.inf if container.duration is None else container.duration / _TIME_BASE
    except (av.error.FFmpegError, OSError):
        return math.inf


def joined_rows(parts: Sequence[Part], rows: Sequence[Sequence[ExtrinsicsRow]]) -> list[tuple[int, int]]:
    """Return which rows of the parts are one drive: the part and the row's place in it, frame by frame.

    What two parts have in common is kept of the earlier one: its filter has seen more.

    Args:
        parts: of the drive.
        rows: of each part, times from its own first frame on.

    Raises:
        ValueError: the parts do not fit together.
    """
    kept = [(0, place) for place in range(len(rows[0]))]
    times = [parts[0].start + row.time_s - rows[0][0].time_s for row in rows[0]]
    for number, (part, own) in enumerate(zip(parts[1:], rows[1:], strict=True), start=1):
        common = len(times) - bisect.bisect_left(times, part.start - _SAME_TIME)
        if not 0 < common <= len(own):
            raise ValueError(f"part {number}: expected frames in common with the part before, got none")
        first = times[-common]
        if abs(first + own[common - 1].time_s - times[-1]) > 2 * _SAME_TIME:
            raise ValueError(
                f"part {number}: expected the times of the part before in the overlap, got others"
            )
        kept += [(number, place) for place in range(common, len(own))]
        times += [first + row.time_s for row in own[common:]]
    return kept


def join_parts(folder: str | Path, parts: Sequence[Part], folders: Sequence[Path]) -> int:
    """Write ``extrinsics.csv`` and ``covariance.csv`` of a drive from those of its parts; how many frames.

    Raises:
        ValueError: a part's files are not there, or the parts do not fit together.
    """
    rows = [read_extrinsics(each / "extrinsics.csv") for each in folders]
    covariances = [read_covariances(each / "covariance.csv") for each in folders]
    kept = joined_rows(parts, rows)
    shifts = np.zeros(len(parts))
    result: list[ExtrinsicsRow] = []
    for frame, (part, place) in enumerate(kept):
        row = rows[part][place]
        if part and shifts[part] == 0.0:
            before = rows[part][place - 1]
            shifts[part] = result[-1].time_s - before.time_s
        result.append(row._replace(frame=frame, time_s=float(row.time_s + shifts[part])))
    found: list[NDArray[np.float64]] = [covariances[part][place] for part, place in kept]
    with OutputFolder(folder) as out:
        write_extrinsics(out / "extrinsics.csv", result)
        write_covariances(out / "covariance.csv", found)
    return len(result)
