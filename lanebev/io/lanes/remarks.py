"""Remarks on the lanes of a drive: the order of their numbers, repeated lines, unequal widths."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lanebev.camera.model import Camera
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.lanes.size import meeting_point
from lanebev.observation.polylines import lane_width_ratios

_LEAST_FRAMES = 10  # with lanes, among which each boundary is seen in one
_MOST_REPEATED = 0.3  # fraction of frames with the lanes of the one before; all if nothing moves
_LOOKED_AT = 50  # frames
_LEAST_SMALLER = 3  # frames with lanes of another scale
_SMALLER, _SAME_SCALE = 0.9, 0.1  # ratio of two scales at most; relative, by which ratios of one may differ
_SAME_FOCAL = 0.01  # relative, by which focal lengths of one camera may differ
_UNEQUAL = 1.8  # ratio
_MOST_ROLL = 2  # degrees; with it six boundaries of equally wide lanes look as if of a ratio of up to 2.4


def check_boundary_order(frames: Sequence[FrameLines]) -> None:
    """Raise if the boundary numbers fall from left to right in most pairs of neighbours.

    Two neighbours of a frame that states the numbers are compared on the lowest row that both reach.
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
    return left_out_words(boundary_numbers(frames))


def boundary_numbers(frames: Sequence[FrameLines]) -> set[int]:
    """Return the boundary numbers that the lines of frames state."""
    return {line.boundary for frame in frames for line in frame.lines if line.boundary is not None}


def left_out_words(numbers: set[int]) -> str:
    """Return which number is left out between two boundary numbers; else nothing."""
    skipping = [(left, right) for left, right in pairwise(sorted(numbers)) if right > left + 1]
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


def repeats_remark(frames: Sequence[FrameLines]) -> str:
    """Return how many frames of a drive have the lines of the frame before, if many but not all have."""
    pairs = [(before, frame) for before, frame in pairwise(frames) if frame.lines]
    repeated = sum(_have_the_same_lines(*pair) for pair in pairs)
    if not _MOST_REPEATED * len(pairs) < repeated < len(pairs):
        return ""
    return (
        f"lanes: {repeated} of {len(frames)} frames have the lines of the frame before, to the last digit; "
        "they tell nothing new, but count as if they did: leave repeated lines out"
    )


def _have_the_same_lines(one: FrameLines, other: FrameLines) -> bool:
    first, second = ([line.points for line in frame.lines] for frame in (one, other))
    pairs = zip(first, second, strict=False)
    return len(first) == len(second) and all(np.array_equal(*pair, equal_nan=True) for pair in pairs)


def two_scales_remark(frames: Sequence[FrameLines]) -> str:
    """Return a remark if lanes of some frames are as of smaller images than the others; else nothing.

    Their lowest row, and column and row where they meet, are then smaller by the same factor. A turned camera
    or hidden lanes do not change all three so.
    """
    drawn = [frame for frame in frames if any(len(line.points) for line in frame.lines)]
    lows = np.array([max(line.points[:, 1].max(initial=0) for line in frame.lines) for frame in drawn])
    order = np.argsort(lows, kind="stable")
    if len(drawn) < 2 or not lows.min() > 0:
        return ""
    split = 1 + int(np.argmin(lows[order][:-1] / lows[order][1:]))
    if not _LEAST_SMALLER <= split <= len(drawn) - _LEAST_SMALLER:
        return ""
    parts = order[:split], order[split:]
    smaller, larger = ((np.median(lows[part]), *meeting_point([drawn[i] for i in part])) for part in parts)
    ratios = np.array(smaller) / np.array(larger)
    if not (ratios.max() < _SMALLER and np.ptp(ratios) < _SAME_SCALE * ratios.min()):  # false on NaN
        return ""
    return (
        f"lanes: those of {split} of {len(drawn)} frames are {np.median(ratios):.2g} times as large as the "
        "others, as of smaller images; convert them to pixels of the images"
    )


def other_camera_remark(frames: Sequence[FrameLines], camera: Camera) -> str:
    """Return a remark on 3D points that were projected by a camera of another focal length; else nothing."""
    focals = [frame.focal_length for frame in frames if frame.focal_length is not None]
    own = float(camera.intrinsics[0, 0])
    if not focals or abs(float(np.median(focals)) / own - 1.0) <= _SAME_FOCAL:
        return ""
    return (
        f"lanes: the camera of their 3D points has a focal length of {np.median(focals):.1f} px, that of the "
        f"run {own:.1f} px; give a camera file with the first, since the images are of that camera"
    )


def unequal_lanes_remark(frames: Sequence[FrameLines], camera: Camera) -> str:
    """Return a remark on lanes whose widths differ much for any usual roll of the camera; else nothing.

    Two lanes of any widths look like equal ones to a camera with a certain roll, so that the pose does not
    tell.
    """
    looked_at = frames[:: max(1, len(frames) // _LOOKED_AT)]
    rolls = [0.0, *(math.radians(sign * roll) for roll in range(1, _MOST_ROLL + 1) for sign in (-1, 1))]
    ratios = np.array([lane_width_ratios(frame.lines, camera, rolls) for frame in looked_at])
    known = ratios[np.isfinite(ratios[:, 0])] if len(ratios) else ratios
    if not len(known) or np.median(np.nanmin(known, axis=-1)) < _UNEQUAL:
        return ""
    return (
        f"lanes: one lane is {np.median(known[:, 0]):.1f} times as wide as another, unless the camera is "
        f"rolled by more than {_MOST_ROLL} degrees; if a line bounds no lane, as that of a shoulder, leave "
        "it out, since roll and height suppose equal lanes"
    )
