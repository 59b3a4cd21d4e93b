"""Lane boundaries on image rows: what goes between any detector, ``lanes.json`` and the calibrator.

A :class:`BoundaryRows` is in pixels of the image as it came. Whatever drew the lines, a run calibrates on
``segments_from_rows`` of it and writes it to ``lanes.json`` as it is, so the file gives the same calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lanebev.geometry.camera import Camera
from lanebev.io.lanes import LaneLine
from lanebev.types import NUM_BOUNDARIES, LaneSegments

ROW_STEP = 10
"""Rows of ``lanes.json`` are this many pixels apart."""

SEGMENTS_PER_BOUNDARY = 30
LINE_SIGMA = 1.5
"""Standard deviation (px) of a line that comes without one: a careful label or a good detector."""

_DIGITS = 3  # of x in lanes.json; rounded here too, so that file and run see the same
_SAME_LINE, _NEXT_BUT_ONE = 0.4, 1.75  # gap between neighbours, in usual gaps


class BoundaryRows(NamedTuple):
    """One frame's boundaries on rows of the image as it came.

    Attributes:
        rows: (R,) px, rising.
        x: (L, R) px; NaN where a boundary was not seen.
    """

    rows: NDArray[np.float64]
    x: NDArray[np.float64]


def image_rows(height: int) -> NDArray[np.float64]:
    """(R,) the rows of ``lanes.json`` in an image of this height."""
    return np.arange(0, height, ROW_STEP, dtype=np.float64)


def rows_from_lines(
    lines: Sequence[LaneLine], camera: Camera, num_boundaries: int = NUM_BOUNDARIES
) -> BoundaryRows:
    """Sample a detector's lines on the rows of ``lanes.json``.

    Lines without a boundary index get one by :func:`boundary_indices`; those beyond the outermost boundary,
    and those that cross fewer than two rows, are left out.
    """
    height, width = camera.image_size
    rows = image_rows(height)
    x = np.full((num_boundaries, len(rows)), np.nan)
    if all(line.boundary is not None for line in lines):
        indices: list[int | None] = [line.boundary for line in lines]
    else:
        indices = boundary_indices([_undistorted(line.points, camera) for line in lines], num_boundaries)
    for line, index in zip(lines, indices, strict=True):
        if index is not None and index < num_boundaries:
            on_rows = _on_rows(line.points, rows)
            inside = (on_rows >= 0) & (on_rows <= width - 1)
            if inside.sum() >= 2:
                x[index] = np.where(inside, on_rows.round(_DIGITS), np.nan)
    return BoundaryRows(rows, x)


def boundary_indices(
    lines: Sequence[NDArray[np.float64]], num_boundaries: int = NUM_BOUNDARIES
) -> list[int | None]:
    """Semantic boundary of each line: the nearest on the left is L/2 - 1, the nearest on the right L/2.

    The lower half of each line is extended to the bottom of the image; the lines are counted outwards in
    that order, also those that leave the image sideways. A line runs down to its own side of the camera, so
    its slope tells the side at any yaw. A neighbour much nearer than usual is the other edge of the same
    marking and gets None; one twice as far as usual is the next but one.

    Args:
        lines: each (P, 2) px, undistorted; P = 0 and 1 get None.
        num_boundaries: L, even.

    Returns:
        for each line its index, or None.
    """
    result: list[int | None] = [None] * len(lines)
    drawn = [i for i, line in enumerate(lines) if len(line) > 1 and np.ptp(line[:, 1]) > 0]
    if not drawn:
        return result
    bottom = max(float(lines[i][:, 1].max()) for i in drawn)
    crossings, slopes = zip(*(_crossing(lines[i], bottom) for i in drawn), strict=True)
    order = np.argsort(crossings)
    kept = _without_doubles([drawn[k] for k in order], np.asarray(crossings)[order], lines)
    crossing = {i: crossings[k] for k, i in enumerate(drawn)}
    left = sum(slopes[drawn.index(i)] < 0 for i in kept)
    usual = _usual_gap([crossing[b] - crossing[a] for a, b in pairwise(kept)])
    steps = [2 if crossing[b] - crossing[a] > _NEXT_BUT_ONE * usual else 1 for a, b in pairwise(kept)]
    position = np.concatenate([[0], np.cumsum(steps)]).astype(int)
    if left == 0:
        origin = position[0] - num_boundaries // 2
    else:
        origin = position[left - 1] - (num_boundaries // 2 - 1)
    for i, place in zip(kept, position - origin, strict=True):
        if 0 <= place < num_boundaries:
            result[i] = int(place)
    return result


def segments_from_rows(
    frames: Sequence[BoundaryRows],
    camera: Camera,
    sigma: float = LINE_SIGMA,
    per_boundary: int = SEGMENTS_PER_BOUNDARY,
    dtype: torch.dtype = torch.float64,
) -> LaneSegments:
    """Vertices of each boundary, paired to segments, one frame a row of the batch.

    Source: Sect. III-A, representative vertices sampled and paired. Deviation: not at random, which uses some
    vertices often and many never: vertex i goes with vertex i + K/2, each once, so that all baselines are
    long and the end points' errors independent.

    Args:
        frames: B frames.
        camera: the lens that took them; points that it cannot have imaged are left out.
        sigma: px, standard deviation of a vertex across its line.
        per_boundary: most segments on one boundary.
        dtype: of the result.

    Returns:
        segments padded to N = L · per_boundary.
    """
    num_boundaries = frames[0].x.shape[0]
    endpoints = np.zeros((len(frames), num_boundaries, per_boundary, 2, 2))
    weight = np.zeros((len(frames), num_boundaries, per_boundary))
    for row, frame in enumerate(frames):
        for index, x in enumerate(frame.x):
            seen = np.isfinite(x)
            vertices = _undistorted(np.stack([x[seen], frame.rows[seen]], axis=-1), camera)
            pairs = paired(vertices, per_boundary)
            endpoints[row, index, : len(pairs)] = pairs
            weight[row, index, : len(pairs)] = 1.0
    boundary = torch.arange(num_boundaries).repeat_interleave(per_boundary).repeat(len(frames), 1)
    weights = torch.from_numpy(weight).flatten(1).to(dtype)
    return LaneSegments(
        torch.from_numpy(endpoints).flatten(1, 2).to(dtype),
        boundary,
        weights,
        torch.full_like(weights, sigma),
    )


def paired(vertices: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """(K, 2) vertices along a line to (M, 2, 2) segments, M = min(K // 2, most), i with i + ceil(K / 2)."""
    if len(vertices) > 2 * most:
        vertices = vertices[np.linspace(0, len(vertices) - 1, 2 * most).round().astype(int)]
    count = len(vertices) // 2
    return np.stack([vertices[:count], vertices[len(vertices) - count :]], axis=1)


def _on_rows(points: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """x of a polyline on rows, NaN outside its extent and in its gaps."""
    y, first = np.unique(points[:, 1], return_index=True)
    x = points[first, 0]
    there = np.isfinite(x)
    if not there.any():
        return np.full(len(rows), np.nan)
    between = np.interp(rows, y, there.astype(np.float64), left=0.0, right=0.0)
    return np.where(between == 1.0, np.interp(rows, y[there], x[there]), np.nan)


def _undistorted(points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    if not len(points):
        return points
    undistorted, valid = camera.undistort_points(torch.from_numpy(points).to(camera.intrinsics))
    kept: NDArray[np.float64] = undistorted[valid].double().numpy()
    return kept


def _crossing(points: NDArray[np.float64], bottom: float) -> tuple[float, float]:
    """Where the lower half of a line meets the row ``bottom``, and its slope dx/dy there."""
    lower = points[np.argsort(points[:, 1])][-max(4, len(points) // 2) :]
    y = lower[:, 1] - lower[:, 1].mean()
    slope = float((y * lower[:, 0]).sum() / max((y * y).sum(), 1e-9))
    return float(lower[:, 0].mean() + slope * (bottom - lower[:, 1].mean())), slope


def _without_doubles(
    order: list[int], crossings: NDArray[np.float64], lines: Sequence[NDArray[np.float64]]
) -> list[int]:
    gaps = np.diff(crossings)
    if len(gaps) < 2:
        return order
    usual = float(np.median(gaps))
    kept = [order[0]]
    for i, gap in zip(order[1:], gaps, strict=True):
        if gap > _SAME_LINE * usual:
            kept.append(i)
        elif len(lines[i]) > len(lines[kept[-1]]):
            kept[-1] = i
    return kept


def _usual_gap(gaps: Sequence[float]) -> float:
    return sorted(gaps)[(len(gaps) - 1) // 2] if gaps else 1.0
