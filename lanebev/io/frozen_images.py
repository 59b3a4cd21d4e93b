"""Notice a camera that gives the same image again and again."""

import math

import numpy as np
from numpy.typing import NDArray

FROZEN = 0.05
"""Grey levels of 255 on average, of a change that no camera's noise leaves."""

STRIDE = 8
"""px, of the pixels of a frame that are compared."""

_LEAST = 10  # frames; a slow camera gives an image a few times


class ImageChanges:
    """Compares each frame of a drive with the one before."""

    def __init__(self) -> None:
        self._before: NDArray[np.int16] | None = None
        self._same = 0

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
        self._same = self._same + 1 if change < FROZEN else 0
        return change

    def remark(self) -> str:
        """Return a remark if many frames up to the last one show the same image; else nothing."""
        if self._same < _LEAST:
            return ""
        return (
            f"the last {self._same + 1} frames show the same image: is the camera frozen? standard "
            "deviations become too small, since the errors are the same"
        )
