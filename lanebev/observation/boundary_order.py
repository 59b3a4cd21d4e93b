"""Number the lines of a frame as semantic boundaries, by their side of the ego lane."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lanebev.types import NUM_BOUNDARIES

_SAME_LINE, _NEXT_BUT_ONE = 0.4, 1.75  # gap between neighbours, in usual gaps


def boundary_indices(
    lines: Sequence[NDArray[np.float64]], num_boundaries: int = NUM_BOUNDARIES
) -> list[int | None]:
    """Number the lines by boundary: the nearest on the left is L/2 - 1, the nearest on the right L/2.

    The lower half of each line is extended to the bottom of the image; the lines are counted outwards in
    that order, also those that leave the image sideways. A line runs down to its own side of the camera, so
    its slope tells the side at any yaw. A neighbour much nearer than usual is the other edge of the same
    marking and gets None; one twice as far as usual is the next but one.

    Args:
        lines: each (P, 2) px, undistorted; P = 0 and 1 get None.
        num_boundaries: L, even.

    Returns:
        for each line its index, or None.
    """
    result: list[int | None] = [None] * len(lines)
    drawn = [i for i, line in enumerate(lines) if len(line) > 1 and np.ptp(line[:, 1]) > 0]
    if not drawn:
        return result
    bottom = max(float(lines[i][:, 1].max()) for i in drawn)
    crossings, slopes = zip(*(_crossing(lines[i], bottom) for i in drawn), strict=True)
    order = np.argsort(crossings)
    kept = _without_doubles([drawn[k] for k in order], np.asarray(crossings)[order], lines)
    crossing = {i: crossings[k] for k, i in enumerate(drawn)}
    left = sum(slopes[drawn.index(i)] < 0 for i in kept)
    usual = _usual_gap([crossing[b] - crossing[a] for a, b in pairwise(kept)])
    steps = [2 if crossing[b] - crossing[a] > _NEXT_BUT_ONE * usual else 1 for a, b in pairwise(kept)]
    position = np.concatenate([[0], np.cumsum(steps)]).astype(int)
    if left == 0:
        origin = position[0] - num_boundaries // 2
    else:
        origin = position[left - 1] - (num_boundaries // 2 - 1)
    for i, place in zip(kept, position - origin, strict=True):
        if 0 <= place < num_boundaries:
            result[i] = int(place)
    return result


def _crossing(points: NDArray[np.float64], bottom: float) -> tuple[float, float]:
    """Return where the lower half of a line meets the row ``bottom``, and its slope dx/dy there."""
    lower = points[np.argsort(points[:, 1])][-max(4, len(points) // 2) :]
    y = lower[:, 1] - lower[:, 1].mean()
    slope = float((y * lower[:, 0]).sum() / max((y * y).sum(), 1e-9))
    return float(lower[:, 0].mean() + slope * (bottom - lower[:, 1].mean())), slope


def _without_doubles(
    order: list[int], crossings: NDArray[np.float64], lines: Sequence[NDArray[np.float64]]
) -> list[int]:
    gaps = np.diff(crossings)
    if len(gaps) < 2:
        return order
    usual = float(np.median(gaps))
    kept = [order[0]]
    for i, gap in zip(order[1:], gaps, strict=True):
        if gap > _SAME_LINE * usual:
            kept.append(i)
        elif len(lines[i]) > len(lines[kept[-1]]):
            kept[-1] = i
    return kept


def _usual_gap(gaps: Sequence[float]) -> float:
    return sorted(gaps)[(len(gaps) - 1) // 2] if gaps else 1.0
