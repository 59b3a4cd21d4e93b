"""Lanes in pixels of images of another size: brought to the right one, or noticed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lanebev.io.lanes import FrameLines

_OUTSIDE = 0.1  # share of points below or far beside the images, of which more are of another size
_BESIDE = 0.5  # image widths beside an image that lines are drawn on to
_REACHED = 0.8  # of both sides, one of which a drive's lanes reach: they leave images at the bottom
_REACHED_DOWN = 0.55  # of the height, likewise; what is higher is the horizon


def resized_lanes(
    frames: Sequence[FrameLines], size: tuple[int, int], image_size: tuple[int, int]
) -> list[FrameLines]:
    """Return the lanes of images resized from ``size`` to ``image_size``, pixel centres at integers.

    Args:
        frames: lanes in pixels of images of ``size``.
        size: (height, width) px.
        image_size: (height, width) px of the result.
    """
    scale = np.array([image_size[1] / size[1], image_size[0] / size[0]])  # of x and y
    return [
        frame._replace(
            lines=[
                line._replace(
                    points=(line.points + 0.5) * scale - 0.5,
                    sigma=None if line.sigma is None else line.sigma * scale[0],
                )
                for line in frame.lines
            ]
        )
        for frame in frames
    ]


def size_remark(frames: Sequence[FrameLines], image_size: tuple[int, int]) -> str:
    """Return what speaks for lanes in pixels of smaller images; empty if nothing does.

    Args:
        frames: frames of one drive.
        image_size: (height, width) px of its images.

    Raises:
        ValueError: lanes lie outside the images, so that they are in pixels of larger ones.
    """
    points = _all_points(frames)
    if not len(points):
        return ""
    height, width = image_size
    x, y = points.T
    outside = (y >= height) | (x < -_BESIDE * width) | (x > (1 + _BESIDE) * width)
    if outside.mean() > _OUTSIDE:
        raise ValueError(
            f"lanes: expected points in images of {width} x {height} px, got {outside.mean():.0%} outside of "
            f"them, the farthest at {x.max():.0f}, {y.max():.0f}; of images of another size? state it "
            "with --lanes-size WIDTHxHEIGHT"
        )
    low = y.max() < _REACHED * height and x.max() < _REACHED * width
    if low or y.max() < _REACHED_DOWN * height:
        return (
            f"lanes: none of them reaches beyond {x.max():.0f}, {y.max():.0f} in images of "
            f"{width} x {height} px; of smaller images? state their size with --lanes-size WIDTHxHEIGHT"
        )
    return ""


def _all_points(frames: Sequence[FrameLines]) -> NDArray[np.float64]:
    """Return the points (P, 2) px of all lines."""
    points = [line.points for frame in frames for line in frame.lines]
    together = np.concatenate(points) if points else np.empty((0, 2))
    there: NDArray[np.float64] = together[np.isfinite(together).all(-1)]
    return there
