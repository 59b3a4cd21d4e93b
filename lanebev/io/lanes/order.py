"""Lanes whose boundary numbers run the wrong way or leave one out."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lanebev.io.lanes.parsing import FrameLines

_LEAST_FRAMES = 10  # with lanes, among which each boundary is seen in one


def check_boundary_order(frames: Sequence[FrameLines]) -> None:
    """Raise if the boundary numbers fall from left to right in most pairs of neighbours.

    Two neighbours of a frame that states the numbers are compared on the lowest row that both reach.

    Raises:
        ValueError: they fall.
    """
    rising = [rises for frame in frames for rises in _rising(frame)]
    if 2 * sum(rising) < len(rising):
        raise ValueError(
            "lanes: expected boundary numbers that rise from left to right, got falling ones in "
            f"{len(rising) - sum(rising)} of {len(rising)} pairs of neighbours; number them in that order"
        )


def left_out_remark(frames: Sequence[FrameLines]) -> str:
    """Return which boundary number no frame has between two that some have; else nothing.

    Numbers of classes may leave one out, and the lane between the two is taken for two lanes. In a few frames
    a boundary may just not be seen.
    """
    if sum(bool(frame.lines) for frame in frames) < _LEAST_FRAMES:
        return ""
    numbers = sorted({line.boundary for frame in frames for line in frame.lines if line.boundary is not None})
    skipping = [(left, right) for left, right in pairwise(numbers) if right > left + 1]
    if not skipping:
        return ""
    left, right = skipping[0]
    return (
        f"lanes: no frame has boundary {left + 1}, so that {left} and {right} are taken to have "
        f"{right - left} lanes between them; if it is one, number its boundaries one after the other"
    )


def _rising(frame: FrameLines) -> list[bool]:
    """Return of each pair of boundaries with neighbouring numbers whether the higher one is on the right."""
    numbered = sorted(
        ((line.boundary, _upwards(line.points)) for line in frame.lines if line.boundary is not None),
        key=lambda each: each[0],
    )
    found = []
    for (_, left), (_, right) in pairwise(each for each in numbered if len(each[1])):
        row = min(left[-1, 1], right[-1, 1])
        if row >= max(left[0, 1], right[0, 1]):
            x, other = (float(np.interp(row, points[:, 1], points[:, 0])) for points in (left, right))
            found.append(x < other)
    return found


def _upwards(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the known points (P, 2) of a line in order of rising rows."""
    known = points[np.isfinite(points).all(-1)]
    return known[np.argsort(known[:, 1], kind="stable")]
