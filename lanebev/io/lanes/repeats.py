"""Lanes that a detector gave out for several frames, since it is slower than the camera."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from lanebev.io.lanes.parsing import FrameLines

_MOST_REPEATED = 0.3  # fraction of frames with the lanes of the one before; all if nothing moves


def repeats_remark(frames: Sequence[FrameLines]) -> str:
    """Return how many frames have the lines of the frame before, if these are many but not all; else nothing.

    Args:
        frames: lanes of a drive, in order.
    """
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
