"""Lane boundaries on image rows: what goes between any detector, ``lanes.json`` and the calibrator.

A :class:`BoundaryRows` is in pixels of the image as it came. Whatever drew the lines, a run calibrates on
``segments_from_rows`` of it and writes it to ``lanes.json`` as it is, so the file gives the same calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lanebev.camera.model import Camera
from lanebev.geometry.lens import undistorted_sigma
from lanebev.io.lanes import LaneLine
from lanebev.observation.boundary_order import boundary_indices
from lanebev.observation.lines import NETWORK_CORRELATION
from lanebev.types import NUM_BOUNDARIES, LaneSegments

ROW_STEP = round(NETWORK_CORRELATION)
"""Rows of ``lanes.json`` are this many pixels apart, as far as a network's line errs alike."""

SEGMENTS_PER_BOUNDARY = 30
LINE_SIGMA = 1.5
"""Standard deviation (px) of a line that comes without one: a careful label or a good detector."""

_DIGITS = 3  # of x in lanes.json; rounded here too, so that file and run see the same
_LEAST_WEIGHT = 0.15  # of a segment that counts; what is fainter is a foot of a barrier as often as paint
_LEAST_SIGMA = 0.05  # px
_GAP, _GAP_ROWS = 4.0, 30.0  # between vertices: times the usual distance, and px


class BoundaryRows(NamedTuple):
    """One frame's boundaries on rows of the image as it came.

    Attributes:
        rows: (R,) px, rising.
        x: (L, R) px; NaN where a boundary was not seen.
        sigma: (L, R) px, standard deviation across the line; None if nobody said, then it is LINE_SIGMA.
        fitted: (L, R) px, the same boundaries fitted together; None where they are taken as they came.
        pose_sigma_scale: factor on the standard deviations of the pose estimated from them, see
            :meth:`lanebev.Calibration.with_std_scaled`.
    """

    rows: NDArray[np.float64]
    x: NDArray[np.float64]
    sigma: NDArray[np.float64] | None = None
    fitted: NDArray[np.float64] | None = None
    pose_sigma_scale: float = 1.0


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
    sigma = np.full_like(x, np.nan)
    told = any(line.sigma is not None for line in lines)
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
                said = np.full(len(line.points), LINE_SIGMA) if line.sigma is None else line.sigma
                noise = _on_rows(np.stack([said, line.points[:, 1]], axis=-1), rows)
                sigma[index] = np.where(inside, np.maximum(noise.round(_DIGITS), 10.0**-_DIGITS), np.nan)
    return BoundaryRows(rows, x, sigma if told and np.isfinite(sigma).any() else None)


def rows_from_segments(segments: LaneSegments, camera: Camera) -> BoundaryRows:
    """Sample the vertices of a network's segments on the rows of ``lanes.json``.

    A row lies between two vertices and takes both their errors, its variance by the ratio of rows to
    vertices, so that all rows together say no more and no less than the vertices did.

    Args:
        segments: of batch size 1, in pixels of the image as it came.
        camera: the lens.
    """
    height, width = camera.image_size
    rows = image_rows(height)
    num_boundaries = int(segments.boundary.max()) + 1
    x = np.full((num_boundaries, len(rows)), np.nan)
    sigma = np.full_like(x, np.nan)
    weight = segments.weight[0].double().numpy()
    noise = segments.sigma[0].double().numpy() / np.sqrt(np.maximum(weight, _LEAST_WEIGHT))
    ends = segments.endpoints[0].double().numpy()
    for index in range(num_boundaries):
        mine = (segments.boundary[0].numpy() == index) & (weight > _LEAST_WEIGHT)
        vertices, own = ends[mine].reshape(-1, 2), noise[mine].repeat(2)
        order = np.argsort(vertices[:, 1])
        on_rows = _on_rows(_with_gaps(vertices[order]), rows)
        inside = (on_rows >= 0) & (on_rows <= width - 1)
        count = int(inside.sum())
        if count >= 2:
            between = np.interp(rows, vertices[order, 1], own[order]) * np.sqrt(count / len(own))
            x[index] = np.where(inside, on_rows.round(_DIGITS), np.nan)
            sigma[index] = np.where(inside, np.maximum(between, _LEAST_SIGMA).round(_DIGITS), np.nan)
    return BoundaryRows(rows, x, sigma)


def segments_from_rows(
    frames: Sequence[BoundaryRows],
    camera: Camera,
    sigma: float = LINE_SIGMA,
    per_boundary: int = SEGMENTS_PER_BOUNDARY,
    dtype: torch.dtype = torch.float64,
) -> LaneSegments:
    """Vertices of each boundary, paired to segments, one frame a row of the batch.

    Source: Sects. VI-A and VI-B, representative vertices sampled and paired. Deviation: not at random, which
    uses some vertices often and many never: vertex i goes with vertex i + K/2, each once, so that all
    baselines are long and the end points' errors independent.

    Args:
        frames: B frames.
        camera: the lens that took them; points that it cannot have imaged are left out.
        sigma: px, standard deviation of a vertex across its line where the frame does not know it.
        per_boundary: most segments on one boundary.
        dtype: of the result.

    Returns:
        segments padded to N = L · per_boundary.
    """
    num_boundaries = frames[0].x.shape[0]
    endpoints = np.zeros((len(frames), num_boundaries, per_boundary, 2, 2))
    weight = np.zeros((len(frames), num_boundaries, per_boundary))
    noise = np.full_like(weight, sigma)
    for row, frame in enumerate(frames):
        known = np.full_like(frame.x, sigma) if frame.sigma is None else frame.sigma
        for index, vertices in enumerate(_vertices(frame, known, camera)):
            pairs = paired(vertices, per_boundary)
            endpoints[row, index, : len(pairs)] = pairs[..., :2]
            weight[row, index, : len(pairs)] = 1.0
            noise[row, index, : len(pairs)] = np.sqrt((pairs[..., 2] ** 2).mean(-1))
    boundary = torch.arange(num_boundaries).repeat_interleave(per_boundary).repeat(len(frames), 1)
    return LaneSegments(
        torch.from_numpy(endpoints).flatten(1, 2).to(dtype),
        boundary,
        torch.from_numpy(weight).flatten(1).to(dtype),
        torch.from_numpy(noise).flatten(1).to(dtype),
    )


def paired(vertices: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """(K, D) vertices along a line to (M, 2, D) segments, M = min(K // 2, most), i with i + ceil(K / 2)."""
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


def _with_gaps(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vertices from top to bottom, with a NaN put where something hides the line between two of them."""
    steps = np.diff(vertices[:, 1])
    if not len(steps):
        return vertices
    gaps = np.flatnonzero(steps > max(_GAP * float(np.median(steps)), _GAP_ROWS))
    middle = 0.5 * (vertices[gaps, 1] + vertices[gaps + 1, 1])
    return np.insert(vertices, gaps + 1, np.stack([np.full(len(gaps), np.nan), middle], axis=-1), axis=0)


def _vertices(frame: BoundaryRows, sigma: NDArray[np.float64], camera: Camera) -> list[NDArray[np.float64]]:
    """Vertices (K, 3) of each boundary: undistorted x, y and sigma, px; those the lens can have imaged."""
    on_rows = np.stack([frame.x, np.broadcast_to(frame.rows, frame.x.shape)], axis=-1)
    as_taken = torch.from_numpy(on_rows).flatten(0, 1).to(camera.intrinsics)
    undistorted, valid = camera.undistort_points(as_taken)
    undistorted = undistorted.double().reshape(*frame.x.shape, 2)
    kept, noise = valid.reshape(frame.x.shape), torch.from_numpy(sigma)
    lens = (camera.intrinsics[None].double(), camera.distortion[None].double(), camera.model)
    lines = [points[seen] for points, seen in zip(undistorted, kept, strict=True)]
    along = [torch.gradient(line, dim=0)[0] if len(line) > 1 else torch.zeros_like(line) for line in lines]
    points = torch.cat(lines)
    across = undistorted_sigma(noise[kept][None], points[None], torch.cat(along)[None], *lens)[0]
    vertices = torch.cat([points, across.unsqueeze(-1)], dim=-1).numpy()
    return np.split(vertices, np.cumsum([len(line) for line in lines])[:-1])


def _undistorted(points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """(P, 2) px as taken to those (Q, 2) px undistorted that the lens can have imaged."""
    if not len(points):
        return points
    undistorted, valid = camera.undistort_points(torch.from_numpy(points).to(camera.intrinsics))
    kept: NDArray[np.float64] = undistorted[valid].double().numpy()
    return kept
