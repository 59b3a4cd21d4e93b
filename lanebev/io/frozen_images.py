"""Notice a camera that gives the same image again and again."""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

FROZEN = 0.05
"""Grey levels of 255 on average, of a change that no camera's noise leaves."""

STRIDE = 8
"""px, of the pixels of a frame that are compared."""

_LOOKED_AT, _MOST = 20, 6  # latest frames, and how many of them may show the image of the one before


class ImageChanges:
    """Compares each frame of a drive with the one before."""

    def __init__(self) -> None:
        self._before: NDArray[np.int16] | None = None
        self._same: deque[bool] = deque(maxlen=_LOOKED_AT)

    def add(self, image: NDArray[np.uint8] | None) -> float:
        """Take each STRIDE-th pixel of the next frame, (h, w, 3); None if it was lost.

        Returns:
            mean absolute difference from the frame before, grey levels; NaN where there is none.
        """
        seen = None if image is None else image.astype(np.int16)
        change = math.nan
        if seen is not None and self._before is not None:
            change = float(np.abs(seen - self._before).mean())
        self._before = seen
        self._same.append(change < FROZEN)
        return change

    def remark(self) -> str:
        """Return a remark if many of the latest frames show the image of the one before; else nothing."""
        if (count := sum(self._same)) <= _MOST:
            return ""
        return (
            f"{count} of the last {len(self._same)} frames show the image of the one before: is the camera "
            "frozen, or slower than the calls? standard deviations become too small; give each image once"
        )
