"""Images of two cameras in one frame, side by side, as stereo cameras record them."""

import cv2
import numpy as np
from numpy.typing import NDArray

_ROWS, _COLUMNS = 36, 64  # px of a half, reduced
_SHIFTS = 8  # columns, more than the disparity of what fills the images
_ALIKE = 0.85  # correlation; that of the halves of 155 real street images is 0.58 at most


def halves_remark(image: NDArray[np.uint8]) -> str:
    """Return a remark on an image (H, W, 3) whose halves, left and right, show the same; else nothing."""
    if image.shape[1] < 2 * image.shape[0]:
        return ""
    small = cv2.resize(image, (2 * _COLUMNS, _ROWS), interpolation=cv2.INTER_AREA).mean(-1)
    left, right = small[:, :_COLUMNS], small[:, _COLUMNS:]
    alike = (row_correlation(left[:, shift:], right[:, : _COLUMNS - shift]) for shift in range(_SHIFTS))
    return (
        "its halves show the same, as of two cameras side by side; cut out one" if max(alike) > _ALIKE else ""
    )


def row_correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the correlation of two images (H, W) without their rows' means, as that of sky and road."""
    first, second = (each - each.mean(axis=1, keepdims=True) for each in (first, second))
    norm = np.linalg.norm(first) * np.linalg.norm(second)
    return float((first * second).sum() / norm) if norm else 0.0
