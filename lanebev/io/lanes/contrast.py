"""Lanes that are not where the images show lines."""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

_EDGE = 1 / 400  # fraction of the width, half that of an edge
_WITHIN = 1 / 160  # likewise, by which a line may be beside its edge
_STEP, _STEPS = 0.01, 20  # fraction of the width by which a line is moved, and how often to each side
_CLOSE = 1  # steps, that are not compared
_STRONGEST = 4.0  # times the row's mean, the contrast of an edge that counts
_LEAST_POINTS, _MOST_POINTS = 5, 40  # of a line
_LEAST_PLACES = 10  # to compare it with
_LEAST_LINES = 30  # of all frames
_LEAST_SHARE = 0.7  # labels by day and night have 0.88 or more, lanes of other places about 0.5
_ALL = 20  # frames that are looked at one by one, then ever fewer


class LaneContrast:
    """Notices lanes of other, mirrored or resized images by the contrast along them.

    A boundary is an edge between bright and dark. So the contrast along it is larger than along most lines
    beside it.
    """

    def __init__(self) -> None:
        self._shares: list[float] = []
        self._next = 0

    def add(
        self, number: int, image: NDArray[np.uint8] | None, lines: Iterable[NDArray[np.floating]]
    ) -> None:
        """Take a frame.

        Args:
            number: its number.
            image: (H, W, 3); None if it was lost.
            lines: points (P, 2) px of each of its lines.
        """
        if image is None or number < self._next:
            return
        self._next = number + 1 + number // _ALL
        shares = (
            share_of_less_contrast(image, points[:: 1 + len(points) // _MOST_POINTS]) for points in lines
        )
        self._shares += [share for share in shares if share is not None]

    def remark(self) -> str:
        """Return a remark if lines have hardly more contrast than those beside them; else nothing."""
        if len(self._shares) < _LEAST_LINES or np.mean(self._shares) >= _LEAST_SHARE:
            return ""
        return (
            "the images show no edges along these lines; do the lines belong to other, mirrored or shifted "
            "images, or to images of another size?"
        )


def share_of_less_contrast(image: NDArray[np.uint8], points: NDArray[np.floating]) -> float | None:
    """Compute the share of places to the left and right at which a line would have less contrast.

    Args:
        image: (H, W, 3).
        points: (P, 2) px of the line; some may be NaN.

    Returns:
        0 to 1; None where there is no contrast, or hardly any point in the image.
    """
    height, width = image.shape[:2]
    columns, rows = np.rint(points[np.isfinite(points).all(-1)]).astype(int).T
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    if inside.sum() < _LEAST_POINTS:
        return None
    columns, contrast = columns[inside], _row_contrast(image[rows[inside]].mean(-1, dtype=np.float32))
    moved = columns[:, None] + np.rint(np.arange(-_STEPS, _STEPS + 1) * _STEP * width).astype(int)  # (P, K)
    seen = (moved >= 0) & (moved < width)
    each = np.where(seen, np.take_along_axis(contrast, moved.clip(0, width - 1), 1), 0.0)
    along = each.sum(0) / seen.sum(0).clip(1)  # (K,)
    beside = np.abs(np.arange(-_STEPS, _STEPS + 1)) > _CLOSE
    others = along[beside & (2 * seen.sum(0) >= len(columns))]
    if len(others) < _LEAST_PLACES or not np.ptp(along) > 0:
        return None
    return float((others < along[_STEPS]).mean())


def _row_contrast(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the strongest edge near each pixel of rows (P, W), relative to the mean of its row."""
    width = grey.shape[1]
    edge, within = max(1, round(_EDGE * width)), max(1, round(_WITHIN * width))
    change = np.zeros_like(grey)
    change[:, edge:-edge] = np.abs(grey[:, 2 * edge :] - grey[:, : -2 * edge])
    near = cv2.dilate(change, np.ones((1, 2 * within + 1), np.uint8))
    mean = near.mean(1, keepdims=True)
    relative: NDArray[np.float32] = np.minimum(near / np.maximum(mean, 1.0), _STRONGEST)
    return relative
