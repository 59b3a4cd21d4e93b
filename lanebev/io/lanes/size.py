"""Lanes in pixels of images of another size, or of parts of images: converted, or noticed."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lanebev.camera.parameters import are_swapped
from lanebev.io.lanes.parsing import FrameLines
from lanebev.observation.polylines import without_edges

_STATE_SIZE = "state their size with --lanes-size WIDTHxHEIGHT"
_IF_TURNED = "if images are turned by their EXIF orientation, draw lanes on the turned ones"
_OUTSIDE = 0.1  # share of points below or far beside the images, of which more are of another size
_OFF_CENTRE = 0.2  # share of a side, more than a principal point is off the centre
_BESIDE = 0.5  # image widths beside an image that lines are drawn on to
_BEYOND = 0.03  # share of points beyond the right edge alone
_MEET_RIGHT = 0.56  # fraction of the width, right of which lines of wider images meet
_REACHED = 0.8  # lanes reach beyond this fraction of a side, as they leave images at the bottom
_LEFT = 0.42  # fraction of the width; lines of smaller images have their middle left of it
_HIGH_HORIZON = 0.33  # fraction of the height; lines of smaller images meet above it
_REACHED_UNCROPPED = 0.85  # fraction of the height that lanes with a horizon so high must reach
_HIGHEST_HORIZON = 0.28  # fraction of the height above the horizon
_ABOVE, _MOST_ABOVE = 0.1, 0.1  # fraction of the height above the horizon, and of points that lie there
_LOOKED_AT = 50  # frames, for the horizon
_LEAST_SPREAD = 0.01  # sum of squares of the lines' slopes about their mean, px per row
_REACHED_DOWN = 0.55  # lanes reach below this fraction of the height, where the horizon is


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
    return [_moved(frame, scale, 0.5 * scale - 0.5) for frame in frames]


def _moved(frame: FrameLines, scale: NDArray[np.float64], shift: NDArray[np.float64]) -> FrameLines:
    """Return a frame with all pixels p replaced by scale · p + shift, each (2,)."""
    sigmas = [None if line.sigma is None else line.sigma * scale[0] for line in frame.lines]
    lines = [
        line._replace(points=scale * line.points + shift, sigma=sigma)
        for line, sigma in zip(frame.lines, sigmas, strict=True)
    ]
    frame = frame._replace(image_size=None)
    if frame.principal_point is None or frame.focal_length is None:
        return frame._replace(lines=lines)
    x, y = (scale * np.array(frame.principal_point) + shift).tolist()
    focal = float(scale[0]) * frame.focal_length
    return frame._replace(lines=lines, principal_point=(x, y), focal_length=focal)


def lanes_of_whole_images(
    frames: Sequence[FrameLines],
    size: tuple[int, int] | None,
    crop: tuple[int, int, int, int] | None,
    image_size: tuple[int, int],
) -> list[FrameLines]:
    """Convert lanes that were drawn on parts of the images, perhaps resized, to pixels of the whole images.

    Args:
        frames: lanes in pixels of what they were drawn on.
        size: (height, width) px of that; None is the size of the part.
        crop: (top, left, height, width) px of the part; None is all of the images.
        image_size: (height, width) px of the whole images.
    """
    top, left, height, width = crop or (0, 0, *image_size)
    inside = top >= 0 and left >= 0 and top + height <= image_size[0] and left + width <= image_size[1]
    if not (inside and height > 0 and width > 0):
        raise ValueError(
            f"lanes crop: expected a part of the {image_size[1]} x {image_size[0]} px, got {width} x "
            f"{height} at {left}, {top}"
        )
    drawn_on = size or (height, width)
    if doubt := _doubt_of_size(frames, drawn_on):
        raise ValueError(f"lanes, by --lanes-size and --lanes-crop: {doubt.words} leave out what is wrong")
    if are_swapped(drawn_on, (height, width)):
        raise ValueError(
            f"lanes size: expected WIDTHxHEIGHT of images like those of {width} x {height} px, got "
            f"{drawn_on[1]} x {drawn_on[0]}; {_IF_TURNED}"
        )
    resized = resized_lanes(frames, drawn_on, (height, width))
    return [_moved(frame, np.ones(2), np.array([left, top], dtype=np.float64)) for frame in resized]


class SizeDoubt(NamedTuple):
    """A doubt: lanes seem to be in pixels of other images.

    Attributes:
        words: what was found, and a question.
        remedy: what to state at the command line.
        is_outside: whether lanes lie outside the images.
    """

    words: str
    remedy: str
    is_outside: bool = False


def size_remark(frames: Sequence[FrameLines], image_size: tuple[int, int]) -> str:
    """Return a remark if lanes seem to be in pixels of smaller or cropped images; else an empty text.

    Args:
        frames: frames of one drive.
        image_size: (height, width) px of its images.
    """
    doubt = size_doubt(frames, image_size)
    if doubt is None:
        return ""
    words = f"lanes: {doubt.words} {doubt.remedy}"
    if doubt.is_outside:
        raise ValueError(words)
    return words


def size_doubt(frames: Sequence[FrameLines], image_size: tuple[int, int]) -> SizeDoubt | None:
    """Return a doubt if lanes seem to be in pixels of larger, smaller or cropped images; else None.

    Args:
        frames: frames of one drive.
        image_size: (height, width) px of its images.
    """
    return (
        _doubt_of_size(frames, image_size)
        or _doubt_of_camera(frames, image_size)
        or _doubt_of_points(frames, image_size)
    )


def _doubt_of_size(frames: Sequence[FrameLines], image_size: tuple[int, int]) -> SizeDoubt | None:
    """Return a doubt if the lane file states another size of images."""
    others = [frame.image_size for frame in frames if frame.image_size not in (None, image_size)]
    if not others or others[0] is None:
        return None
    (height, width), (rows, columns) = image_size, others[0]
    is_turned = are_swapped(others[0], image_size)
    return SizeDoubt(
        f"expected lanes of images of {width} x {height} px, got {columns} x {rows} in the file;",
        _IF_TURNED if is_turned else _STATE_SIZE.replace("WIDTHxHEIGHT", f"{columns}x{rows}"),
        is_outside=True,
    )


def _doubt_of_camera(frames: Sequence[FrameLines], image_size: tuple[int, int]) -> SizeDoubt | None:
    """Return a doubt if 3D points are of a camera whose principal point is far from the images' middle."""
    height, width = image_size
    centres = [frame.principal_point for frame in frames if frame.principal_point is not None]
    if not centres:
        return None
    x, y = np.median(centres, axis=0)
    if max(abs(x / width - 0.5), abs(y / height - 0.5)) <= _OFF_CENTRE:
        return None
    return SizeDoubt(
        f"expected 3D points of a camera for {width} x {height} px, got one whose principal point is "
        f"{x:.0f}, {y:.0f}; of images of another size?",
        _STATE_SIZE,
        is_outside=True,
    )


def _doubt_of_points(frames: Sequence[FrameLines], image_size: tuple[int, int]) -> SizeDoubt | None:
    """Return a doubt if points in pixels lie outside the images, or leave a large part of them empty."""
    points = _all_points([frame for frame in frames if frame.principal_point is None])
    if not len(points):
        return None
    column, horizon = meeting_point(frames)
    drawn = _all_points([_without_padding(frame, image_size[1]) for frame in frames])
    return (
        _doubt_of_bounds(points, column, image_size)
        or _doubt_of_horizon(drawn, horizon, image_size[0])
        or _doubt_of_empty_part(points, column, horizon, image_size)
    )


def _doubt_of_bounds(
    points: NDArray[np.float64], column: float, image_size: tuple[int, int]
) -> SizeDoubt | None:
    """Return a doubt if points (P, 2) lie outside the images, or all within a pixel."""
    (height, width), (x, y) = image_size, points.T
    outside = (y >= height) | (x < -_BESIDE * width) | (x > (1 + _BESIDE) * width)
    if outside.mean() > _OUTSIDE:
        return SizeDoubt(
            f"expected points in images of {width} x {height} px, got {outside.mean():.0%} outside of them, "
            f"the farthest at {x.max():.0f}, {y.max():.0f}; of images of another size?",
            _STATE_SIZE,
            is_outside=True,
        )
    right = x.min() >= 0 and column > _MEET_RIGHT * width
    if right and (beyond := (x > width).mean()) > _BEYOND:
        return SizeDoubt(
            f"{beyond:.0%} of the points lie beyond the right edge, up to column {x.max():.0f}, and none "
            "beyond the left; of wider images?",
            _STATE_SIZE,
        )
    if points.min() >= 0 and min(x.max(), y.max()) <= 1:
        what = "x" if y.max() > 1 else "y" if x.max() > 1 else "x and y"
        return SizeDoubt(
            f"{what} of all points lie between 0 and 1; are they shares of the sides instead of pixels?",
            "multiply them by the sides",
        )
    return None


def _doubt_of_horizon(points: NDArray[np.float64], horizon: float, height: int) -> SizeDoubt | None:
    """Return a doubt if all or many points lie above the row where lines meet."""
    y = points[:, 1]
    if not len(y):
        return None
    if horizon > y.max():
        return SizeDoubt(
            f"they meet at row {horizon:.0f}, below all of their points; are rows counted from below, or in "
            "another order than the points?",
            "count them from the image's first row",
        )
    if (y < horizon - _ABOVE * height).mean() > _MOST_ABOVE:
        return SizeDoubt(
            f"{(y < horizon).mean():.0%} of the points lie above row {horizon:.0f}, where they meet; are "
            "lines drawn on beyond the road?",
            "leave out what is above it",
        )
    return None


def _doubt_of_empty_part(
    points: NDArray[np.float64], column: float, horizon: float, image_size: tuple[int, int]
) -> SizeDoubt | None:
    """Return a doubt if points leave a part of the images empty that lanes reach."""
    (height, width), (x, y) = image_size, points.T
    centre = float(np.nanmean([column, 0.5 * (x.min() + x.max())]))  # at the left of larger images
    low = y.max() < _REACHED * height and x.max() < _REACHED * width and centre < _LEFT * width
    flat = y.max() < _REACHED_DOWN * height and not horizon >= _HIGH_HORIZON * height
    if low or flat:
        return SizeDoubt(
            f"none of them reaches beyond {x.max():.0f}, {y.max():.0f} in images of {width} x {height} px; "
            "of smaller images?",
            _STATE_SIZE,
        )
    if y.max() >= _REACHED_UNCROPPED * height or not horizon < _HIGHEST_HORIZON * height:
        return None
    rest = height - math.ceil(y.max())
    return SizeDoubt(
        f"none of them reaches below row {y.max():.0f} of {height}, and they meet at row {horizon:.0f}; "
        "of images whose top was cut off?",
        f"state the part with --lanes-crop WIDTHxHEIGHT+LEFT+TOP, such as {width}x{height - rest}+0+{rest}",
    )


def _without_padding(frame: FrameLines, width: int) -> FrameLines:
    """Return a frame without points that are no part of its lines, in images of a width (px)."""
    return frame._replace(lines=[without_edges(line, width) for line in frame.lines])


def meeting_point(frames: Sequence[FrameLines]) -> tuple[float, float]:
    """Return the column and row at which the near parts of lines meet, medians over frames; NaN if none do.

    It is roughly the vanishing point. Of each frame it is the point with the least sum of squared
    horizontal distances from the lines' near two thirds.
    """
    points = [_meeting_point(frame) for frame in frames[:: max(1, len(frames) // _LOOKED_AT)]]
    known = [point for point in points if math.isfinite(point[1])]
    column, row = np.median(known, axis=0).tolist() if known else (math.nan, math.nan)
    return column, row


def _meeting_point(frame: FrameLines) -> tuple[float, float]:
    """Return the column and row of one frame; NaN with fewer than two lines that differ in direction."""
    slopes, offsets = [], []
    for line in frame.lines:
        points = line.points[np.isfinite(line.points).all(-1)]
        near = points[points[:, 1] >= np.quantile(points[:, 1], 1 / 3)] if len(points) else points
        if len(near) >= 2 and np.ptp(near[:, 1]) > 0:
            slope, offset = np.polyfit(near[:, 1], near[:, 0], 1)  # x = slope y + offset
            slopes.append(slope)
            offsets.append(offset)
    spread = np.array(slopes) - np.mean(slopes) if slopes else np.zeros(0)
    variance = float(spread @ spread)
    if not variance > _LEAST_SPREAD:
        return math.nan, math.nan
    row = -float(spread @ np.array(offsets)) / variance
    return float(np.mean(slopes)) * row + float(np.mean(offsets)), row


def _all_points(frames: Sequence[FrameLines]) -> NDArray[np.float64]:
    """Return the points (P, 2) px of all lines."""
    points = [line.points for frame in frames for line in frame.lines]
    together = np.concatenate(points) if points else np.empty((0, 2))
    return together[np.isfinite(together).all(-1)]
