"""Convert polylines of any lane detector, in pixels as taken, to boundary vertices and back."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from lanebev.camera.model import Camera, check_camera
from lanebev.geometry.lens import normalise_points
from lanebev.numbers import shown
from lanebev.observation.boundary_order import boundary_indices, width_ratios
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.types import NUM_BOUNDARIES, check_pixels

ROW_STEP = 10
"""px between the rows on which a polyline is sampled: neighbours on one row err alike, and say so once."""

LINE_SIGMA = 1.5
"""Standard deviation (px) of a line that comes without one: a careful label or a good detector."""

VERTICES_PER_LINE = 60
"""At most; more do not make a frame's pose better, only slower."""

_MOST_TURNS = 0.25  # fraction of a line's steps; points that turn in more of them are in no order
_BESIDE_EDGE = 3.0  # px from an edge, where points of the same x were moved to it
_EVEN = 0.01  # px, by which evenly spaced rows may differ
_ROUNDED = 3.0  # px, by which whole numbers move at most in a row before rounding repeats one
_ABRUPT = 0.7  # of a step, from which a curve does not become vertical in the next
_GAP, _GAP_ROWS = 4.0, 30.0  # between vertices: times the median distance, and px


class LaneLine(NamedTuple):
    """One line as a detector or a person drew it.

    Attributes:
        points: (P, 2) px, (x, y) of the image as taken; x is NaN in a gap of the line.
        boundary: index of the semantic boundary if the source states it, else None.
        sigma: (P,) px, standard deviation of each point across the line if the source states it, else None.
        weight: (P,) in [0, 1], confidence in each point, if the points are vertices with independent errors;
            None for a polyline, which is sampled on rows.
    """

    points: NDArray[np.float64]
    boundary: int | None = None
    sigma: NDArray[np.float64] | None = None
    weight: NDArray[np.float64] | None = None


class BoundaryRows(NamedTuple):
    """One frame's boundaries on rows of the image as taken.

    Attributes:
        rows: (R,) px, rising.
        x: (L, R) px; NaN where a boundary is not there.
    """

    rows: NDArray[np.float64]
    x: NDArray[np.float64]


def image_rows(height: int) -> NDArray[np.float64]:
    """Return the rows of ``lanes.json`` in an image of this height, (R,)."""
    return np.arange(0, height, ROW_STEP, dtype=np.float64)


def vertices_from_lines(
    lines: Sequence[LaneLine], camera: Camera, num_boundaries: int = NUM_BOUNDARIES
) -> BoundaryVertices:
    """Convert one frame's lines to boundary vertices.

    Lines without a boundary index get one by :func:`boundary_indices`; those beyond the outermost boundary,
    and those that cross fewer than two rows, are left out. So are several points of a line with the same x at
    the left or the right edge of the image: some detectors move points to the edge that are outside of it,
    or write 0 where they see no line. So are those that repeat the x of a line's end on rows beyond it.

    Args:
        lines: lines of one frame.
        camera: the lens.
        num_boundaries: L.

    Returns:
        (1, L, VERTICES_PER_LINE) in double precision, boundary 0..L-1.
    """
    check_camera(camera)
    shape = (1, num_boundaries, VERTICES_PER_LINE)
    points, weight, sigma = np.zeros((*shape, 2)), np.zeros(shape), np.ones(shape)
    lines = [without_edges(line, camera.image_size[1]) for line in lines]
    for line, index in zip(lines, _indices(lines, camera, num_boundaries), strict=True):
        if index is not None and index < num_boundaries:
            found = _line_vertices(line, camera.image_size)
            if len(found) >= 2:
                kept = found[_spread(len(found), VERTICES_PER_LINE)]
                points[0, index, : len(kept)] = kept[:, :2]
                sigma[0, index, : len(kept)], weight[0, index, : len(kept)] = kept[:, 2:].T
    parts = map(torch.from_numpy, (points, weight, sigma))
    return BoundaryVertices._make([*parts, torch.arange(num_boundaries)[None]])


def lane_width_ratios(
    lines: Sequence[LaneLine], camera: Camera, rolls: Sequence[float] = (0.0,)
) -> NDArray[np.float64]:
    """Return the ratios (R,) of the widths of a frame's lanes for rolls (R,) rad of the camera.

    See :func:`lanebev.observation.boundary_order.width_ratios`.
    """
    lines = [without_edges(line, camera.image_size[1]) for line in lines]
    ideal = [_undistorted(line.points, camera) for line in lines]
    return width_ratios(ideal, _indices(lines, camera, NUM_BOUNDARIES), rolls)


def lines_from_polylines(
    polylines: Sequence[ArrayLike | Tensor] | Mapping[int, ArrayLike | Tensor],
    sigma: float = LINE_SIGMA,
    num_boundaries: int = NUM_BOUNDARIES,
) -> list[LaneLine]:
    """Check one frame's polylines, see :meth:`lanebev.LaneSegments.from_polylines`."""
    if not isinstance(polylines, (Mapping, Iterable)) or isinstance(polylines, str):
        got = type(polylines).__qualname__
        raise TypeError(f"polylines: expected a list of (P, 2) px, or a dict by boundary, got {got}")
    if not sigma > 0:
        raise ValueError(f"sigma: expected more than 0 px, got {sigma}")
    named = isinstance(polylines, Mapping)
    lines = []
    for key, given in polylines.items() if isinstance(polylines, Mapping) else enumerate(polylines):
        if isinstance(given, Tensor) and given.is_floating_point():
            check_pixels(f"polylines[{key}]", given)
        try:
            listed = given.tolist() if isinstance(given, Tensor) else given
            points = np.ma.array(listed, dtype=np.float64, copy=True).filled(np.nan)  # of masked ones too
        except (TypeError, ValueError) as error:
            raise ValueError(f"polylines[{key}]: expected (P, 2) px, got {shown(given)}") from error
        if points.shape == (0,):  # an empty list, of a line that is not seen
            points = points.reshape(0, 2)
        if points.ndim != 2 or points.shape[1] != 2:
            raise ValueError(f"polylines[{key}]: expected (P, 2) px, got shape {points.shape}")
        points = _with_rows(points)
        if named and not (isinstance(key, (int, np.integer)) and 0 <= key < num_boundaries):
            raise ValueError(f"polylines: expected boundaries 0 to {num_boundaries - 1}, got {key!r}")
        lines.append(LaneLine(points, key if named else None, np.full(len(points), float(sigma))))
    return lines


def _with_rows(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (P, 2) with finite y; one without y, as at the end of a padded array, is missing."""
    index = np.arange(len(points))
    known = np.flatnonzero(np.isfinite(points[:, 1]))
    if len(known) == len(points) or not len(known):
        return points[known]
    x = np.where(np.isfinite(points[:, 1]), points[:, 0], np.nan)
    y = np.interp(index, known, points[known, 1])
    return np.column_stack([x, y])[known[0] : known[-1] + 1]


def distorted_line(line: LaneLine, camera: Camera) -> LaneLine:
    """Return a line of undistorted pixels in pixels as taken; NaN where the lens images nothing."""
    if not camera.distortion.shape[-1]:
        return line
    points = torch.from_numpy(line.points).to(camera.intrinsics)
    imaged = normalise_points(points, camera.intrinsics).norm(dim=-1, keepdim=True) < camera.max_radius
    taken: NDArray[np.float64] = camera.distort_points(points).where(imaged, torch.nan).double().numpy()
    return line._replace(points=taken)


def rows_from_vertices(vertices: BoundaryVertices, image_size: tuple[int, int]) -> BoundaryRows:
    """Interpolate the boundaries of one frame on rows of the image; a gap stays a gap.

    Args:
        vertices: vertices of batch size 1, boundary 0..L-1.
        image_size: (height, width) px.
    """
    rows = image_rows(image_size[0])
    x = np.full((vertices.weight.shape[1], len(rows)), np.nan)
    for own, points, weight in zip(x, vertices.points[0], vertices.weight[0], strict=True):
        seen = points[weight > 0].double().numpy()
        on_rows = _on_rows(_with_gaps(seen[np.argsort(seen[:, 1])]), rows)
        inside = _inside(on_rows, image_size[1])
        if inside.sum() >= 2:
            own[inside] = on_rows[inside]
    return BoundaryRows(rows, x)


def without_edges(line: LaneLine, width: int) -> LaneLine:
    """Return a polyline with NaN for points that were moved to an edge of the image or repeat an end of it.

    Vertices stay.
    """
    if line.weight is not None:
        return line
    x = line.points[:, 0]
    at_edge = x[(x < _BESIDE_EDGE) | (x > width - 1 - _BESIDE_EDGE)]
    values, counts = np.unique(at_edge, return_counts=True)
    moved = np.isin(x, values[counts > 1]) | (line.points == 0).all(-1) | _repeats_end(line.points)
    return line._replace(points=np.column_stack([np.where(moved, np.nan, x), line.points[:, 1]]))


def _repeats_end(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points (P, 2) repeat the x of a line's end on rows beyond it, as from ``numpy.interp``.

    They are two or more of one x on evenly spaced rows, along which the line would move by more than a pixel
    if it went on as before; a curve becomes vertical by and by, and a line on a grid is so elsewhere too. Of
    whole numbers, which rounding repeats, they are three or more and it moves so from row to row, or two and
    it moves by more than three, or many and it would move by ten along them (:func:`_moves_on`).
    """
    found = np.zeros(len(points), dtype=bool)
    there = np.flatnonzero(np.isfinite(points).all(-1))
    whole = not (points[there, 0] % 1).any()
    for own in (there, there[::-1]):
        steps, rows = np.abs(np.diff(points[own], axis=0)).T
        same = int(np.argmax([*(steps > 0), True]))  # steps of 0 at this end
        if not 0 < same < len(steps) - 1 or not np.ptp(rows[: same + 2]) < _EVEN < rows[0]:
            continue
        before, earlier = steps[same : same + 2]
        least = _ROUNDED if whole and same == 1 else 1.0
        is_fast = before * (1 if whole else same) > least and before > _ABRUPT * earlier > 0
        if is_fast or (whole and _moves_on(points[own, 0], same)):
            found[own[: same + 1]] = True
    return found


def _moves_on(x: NDArray[np.float64], same: int) -> bool:
    """Return whether whole numbers would move by 10 px along their first steps, as they do behind these.

    A curve that becomes vertical there would move by 2 to 8 px, one that is so for longer moves ever faster.

    Args:
        x: px, in order from an end of the line.
        same: number of steps of 0 at this end.
    """
    count = min(same, (len(x) - 1 - same) // 2)
    if count < 1:
        return False
    first, second = np.abs(np.diff(x[[same, same + count, same + 2 * count]]))
    return bool(first >= 5.0 and first * same >= 10.0 * count and first > _ABRUPT * second)


def _indices(lines: Sequence[LaneLine], camera: Camera, num_boundaries: int) -> list[int | None]:
    """Return the boundary of each line: as stated, or counted if one line does not state it."""
    if all(line.boundary is not None for line in lines):
        return [line.boundary for line in lines]
    return boundary_indices([_undistorted(line.points, camera) for line in lines], num_boundaries)


def _line_vertices(line: LaneLine, image_size: tuple[int, int]) -> NDArray[np.float64]:
    """Return (K, 4) x, y, sigma and weight of a line's vertices, or of a polyline on rows."""
    said = np.full(len(line.points), LINE_SIGMA) if line.sigma is None else line.sigma
    if line.weight is not None:
        return np.column_stack([line.points, said, line.weight])
    rows = image_rows(image_size[0])
    part = _one_way(line.points)
    x = _on_rows(line.points[part], rows)
    sigma = _on_rows(np.column_stack([said, line.points[:, 1]])[part], rows)
    return np.column_stack([x, rows, sigma, np.ones(len(rows))])[_inside(x, image_size[1])]


def _inside(x: NDArray[np.float64], width: int) -> NDArray[np.bool_]:
    return (x >= 0) & (x <= width - 1)


def _spread(count: int, most: int) -> NDArray[np.int64]:
    """Return at most ``most`` indices of 0..count-1, evenly spread."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def _one_way(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the points of the longest part of a line that goes only up or only down; all if it has no order.

    Where a road turns away, its far end may come down again in the image: two points on a row. Missing points
    are no part of the way, since some detectors write (0, 0) for them.
    """
    there, y = np.flatnonzero(np.isfinite(points).all(-1)), points[:, 1]
    signs = np.sign(np.diff(y[there]))
    moves = np.flatnonzero(signs)
    turns = moves[1:][np.diff(signs[moves]) != 0]
    if not 0 < len(turns) <= _MOST_TURNS * len(moves):
        return np.flatnonzero(np.isfinite(y))
    parts = [there[[first, last]] for first, last in pairwise([0, *turns.tolist(), len(there) - 1])]
    first, last = max(parts, key=lambda ends: float(np.ptp(y[ends])))
    return np.arange(first, last + 1)[np.isfinite(y[first : last + 1])]


def _on_rows(points: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x of a polyline on rows, NaN outside its extent and in its gaps.

    Points that are missing between all others are no gaps: a detector that looks at every second or third row
    writes them so.
    """
    y, first = np.unique(points[:, 1], return_index=True)
    x = points[first, 0]
    there = np.isfinite(x)
    if not there.any():
        return np.full(len(rows), np.nan)
    known = np.flatnonzero(there)
    if len(known) > 2:
        step = int(np.gcd.reduce(np.diff(known)))
        x, y, there = (each[known[0] % step :: step] for each in (x, y, there))
    between = np.interp(rows, y, there.astype(np.float64), left=0.0, right=0.0)
    return np.where(between == 1.0, np.interp(rows, y[there], x[there]), np.nan)


def _with_gaps(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vertices from top to bottom, with a NaN where something hides the line between two of them."""
    steps = np.diff(vertices[:, 1])
    if not len(steps):
        return vertices
    gaps = np.flatnonzero(steps > max(_GAP * float(np.median(steps)), _GAP_ROWS))
    middle = 0.5 * (vertices[gaps, 1] + vertices[gaps + 1, 1])
    return np.insert(vertices, gaps + 1, np.stack([np.full(len(gaps), np.nan), middle], axis=-1), axis=0)


def _undistorted(points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Convert pixels as taken (P, 2) to undistorted ones (Q, 2), those that the lens can have imaged."""
    if not len(points):
        return points
    undistorted, valid = camera.undistort_points(torch.from_numpy(points).to(camera.intrinsics))
    return undistorted[valid].double().numpy()
