"""Number the lines of a frame as semantic boundaries, by their side of the ego lane."""

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lanebev.types import NUM_BOUNDARIES

_SAME_LINE, _NEXT_BUT_ONE = 0.4, 1.75  # gap between neighbours, in typical gaps
_FARTHEST = 20.0  # lateral distance over camera height: beyond it a line crosses the road, as stop lines do
_CENTRED = 0.17  # distance of the camera from the middle of a lane in which it drives, in the lane's widths
_NARROWEST = 0.25  # lane width over camera height: below it two lines are one, or edges of one marking
_WIDEST = 4.2  # the same: above it there are two lanes between two lines, for cameras from 0.9 m on


def boundary_indices(
    lines: Sequence[NDArray[np.float64]], num_boundaries: int = NUM_BOUNDARIES
) -> list[int | None]:
    """Number the lines by boundary: the nearest on the left is L/2 - 1, the nearest on the right L/2.

    The lower half of each line is extended to the bottom of the image, also if the line leaves the image
    sideways, and the lines are counted outwards in that order. Going down, a line runs to its own side of the
    camera, so its slope gives the side at any yaw. A neighbour much nearer than the typical gap, or nearer
    than the narrowest lane, is the other edge of the same marking or the same line drawn twice, and gets
    None; one at twice the typical gap is the next but one.

    The typical gap is that of the lane in whose middle the camera is, unless it is too wide for one lane:
    cars drive in the middle of a lane, not above a boundary. So a car above a boundary that is not seen is
    taken to be in one wide lane. If the camera is in the middle of no lane, the typical gap is the lower
    median. For the narrowest and the widest lane: on a plane, the slopes dx/dy of two boundaries differ by
    their distance over the camera's height, for any pitch, yaw and focal length.

    Args:
        lines: each (P, 2) px, undistorted; P = 0 and 1 get None.
        num_boundaries: L, even.

    Returns:
        for each line its index, or None.
    """
    result: list[int | None] = [None] * len(lines)
    straight = {i: _lower_half(line) for i, line in enumerate(lines) if _has_length(line)}
    slope = {i: found.slope for i, found in straight.items() if abs(found.slope) <= _FARTHEST}
    if not slope:
        return result
    bottom = max(float(lines[i][:, 1].max()) for i in slope)
    crossing = {i: straight[i].at(bottom) for i in slope}
    apart = _longest_of_doubles(sorted(slope, key=crossing.__getitem__), slope, _NARROWEST, lines)
    gaps = np.diff([crossing[i] for i in apart])
    typical = float(np.median(gaps)) if len(gaps) > 1 else 0.0
    kept = _longest_of_doubles(apart, crossing, _SAME_LINE * typical, lines)
    left = sum(slope[i] < 0 for i in kept)
    lanes = [crossing[b] - crossing[a] for a, b in pairwise(kept)]
    in_a_lane = 0 < left < len(kept) and _bound_one_lane(-slope[kept[left - 1]], slope[kept[left]])
    typical = lanes[left - 1] if in_a_lane else _median_gap(lanes)
    position = list(accumulate((1 + (gap > _NEXT_BUT_ONE * typical) for gap in lanes), initial=0))
    first = num_boundaries // 2 - (position[left - 1] + 1 if left else 0)
    for i, place in zip(kept, position, strict=True):
        if 0 <= first + place < num_boundaries:
            result[i] = first + place
    return result


def width_ratios(
    lines: Sequence[NDArray[np.float64]], indices: Sequence[int | None], rolls: Sequence[float]
) -> NDArray[np.float64]:
    """Return the ratio of the widest lane to the narrowest one, for every roll that the camera may have.

    Args:
        lines: each (P, 2) px, undistorted.
        indices: boundary of each, None for a line that is no boundary.
        rolls: (R,) rad, of the camera.

    Returns:
        (R,) ratios; NaN with fewer than three boundaries, or boundaries that cross.
    """
    found = sorted(
        (index, math.atan(_lower_half(line).slope))
        for line, index in zip(lines, indices, strict=True)
        if index is not None and _has_length(line)
    )
    if len(found) < 3:
        return np.full(len(rolls), math.nan)
    numbers, angles = np.array(found).T
    turned = angles - np.array(rolls)[:, None]  # from straight down in an image without roll
    widths = np.diff(np.tan(turned)) / np.diff(numbers)
    possible = (np.abs(turned) < math.pi / 2).all(-1) & (widths > 0).all(-1)
    widths = np.where(possible[:, None], widths, math.nan)
    ratios: NDArray[np.float64] = widths.max(-1) / widths.min(-1)
    return ratios


class _Straight(NamedTuple):
    """A line through (x, y) px with the slope dx/dy."""

    x: float
    y: float
    slope: float

    def at(self, row: float) -> float:
        """Return the x at which it meets a row."""
        return self.x + self.slope * (row - self.y)


def _has_length(points: NDArray[np.float64]) -> bool:
    """Return whether a line has points on different rows."""
    return len(points) > 1 and bool(np.ptp(points[:, 1]) > 0)


def _lower_half(points: NDArray[np.float64]) -> _Straight:
    """Fit a straight line to the lower half of a line, by least squares."""
    lower = points[np.argsort(points[:, 1])][-max(4, len(points) // 2) :]
    x, y = lower.mean(axis=0)
    down = lower[:, 1] - y
    slope = (down * lower[:, 0]).sum() / max((down * down).sum(), 1e-9)
    return _Straight(float(x), float(y), float(slope))


def _longest_of_doubles(
    order: Sequence[int], place: Mapping[int, float], least: float, lines: Sequence[NDArray[np.float64]]
) -> list[int]:
    """Return the lines in order, of neighbours whose places differ by at most ``least`` the longer one."""
    kept: list[int] = []
    for i, before in zip(order, [None, *order], strict=False):
        if before is None or abs(place[i] - place[before]) > least:
            kept.append(i)
        elif np.ptp(lines[i][:, 1]) > np.ptp(lines[kept[-1]][:, 1]):
            kept[-1] = i
    return kept


def _bound_one_lane(from_left: float, from_right: float) -> bool:
    """Return whether the lines to both sides bound one lane, by the camera's distances in camera heights."""
    width = from_left + from_right
    return width < _WIDEST and abs(from_left - from_right) < 2 * _CENTRED * width


def _median_gap(gaps: Sequence[float]) -> float:
    return sorted(gaps)[(len(gaps) - 1) // 2] if gaps else 1.0
