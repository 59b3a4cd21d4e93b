"""Measure the bird's-eye view: are boundaries parallel and lanes equally wide?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lanebev.geometry.road import road_from_image_points
from lanebev.observation.segments import LaneSegments
from lanebev.types import NUM_BOUNDARIES, Extrinsics

_MIN_VERTICES = 4
_MIN_ROWS = 50.0  # px of the image that a boundary must cross: on fewer, its errors are correlated
_MIN_STRETCH = 5.0  # m of road that a boundary must cover
_LEAST_SCALE = 1e-6  # of the residuals in sigmas
_NEAR = 5.0  # m, nearest Z that counts
_WIDTH_STD = 0.03  # m; a width with a larger standard deviation is left out


class RoadBoundaries(NamedTuple):
    """One frame's boundaries on the road, X_k(Z) = a_k + b_k Z + c Z² with one c for all.

    Attributes:
        direction: (L,) rad, heading of each boundary at the near end; NaN where it was not seen.
        widths: (L-1,) m between neighbours, mean over the stretch that both cover; NaN where not both seen.
    """

    direction: NDArray[np.float64]
    widths: NDArray[np.float64]


def select_inliers(segments: LaneSegments, inliers: Tensor) -> LaneSegments:
    """Select the inliers of a calibrator, with :attr:`~lanebev.Calibration.inliers` above a half."""
    return segments._replace(weight=torch.where(inliers > 0.5, segments.weight, 0.0))


def measure_boundaries(
    segments: LaneSegments,
    intrinsics: Tensor,
    extrinsics: Extrinsics,
    far: float = 40.0,
    vertical_curvature: Tensor | None = None,
) -> RoadBoundaries:
    """Measure a frame's boundaries in the bird's-eye view that these extrinsics give.

    Only the observed vertices and the pose enter, no model of the lanes: with a wrong pose the lanes fan out
    and the widths are wrong, which is what this is for. Vertices count by what their sigma is worth on the
    road (1 / (σ Z)²); a boundary's vertices off its line by 3 robust sigmas are left out, and so are widths
    that the vertices' sigmas leave open by more than 3 cm.

    Args:
        segments: segments of batch size 1, end points in undistorted pixels.
        intrinsics: (1, 3, 3).
        extrinsics: each (1,).
        far: m, farthest Z that counts.
        vertical_curvature: (1,) 1/m of the road, or None for a plane.
    """
    points, valid = road_from_image_points(
        segments.endpoints.flatten(1, 2), intrinsics, extrinsics, vertical_curvature
    )
    boundary = segments.boundary[0].repeat_interleave(2).numpy()
    seen = (valid[0] & (segments.weight[0] > 0).repeat_interleave(2)).numpy()
    x, z = points[0].double().numpy().T
    seen &= np.isfinite(x) & np.isfinite(z) & (z >= _NEAR) & (z <= far)
    rows = segments.endpoints[0, ..., 1].flatten().double().numpy()
    seen &= _long_enough(boundary, z, rows, seen)
    sigma = segments.sigma[0].repeat_interleave(2).double().numpy() / float(intrinsics[0, 0, 0]) * z  # m
    nothing = RoadBoundaries(np.full(NUM_BOUNDARIES, np.nan), np.full(NUM_BOUNDARIES - 1, np.nan))
    if not seen.any():
        return nothing
    for _ in range(3):
        line, cov = _fit(x[seen], z[seen], sigma[seen], boundary[seen])
        offset, slope, bend = line[:NUM_BOUNDARIES], line[NUM_BOUNDARIES:-1], float(line[-1])
        residual = (x - offset[boundary] - slope[boundary] * z - bend * z**2) / sigma
        scale = 1.4826 * np.median(np.abs(residual[seen])) + _LEAST_SCALE
        seen &= np.abs(residual) < 3 * scale
    present = np.array([(seen & (boundary == k)).sum() >= _MIN_VERTICES for k in range(NUM_BOUNDARIES)])
    direction = np.where(present, np.arctan(slope + 2 * bend * _NEAR), np.nan)
    widths = np.full(NUM_BOUNDARIES - 1, np.nan)
    for k in np.flatnonzero(present[:-1] & present[1:]):
        extents = [(z[seen & (boundary == i)].min(), z[seen & (boundary == i)].max()) for i in (k, k + 1)]
        start, end = max(e[0] for e in extents), min(e[1] for e in extents)
        if end > start:
            middle = 0.5 * (start + end)
            heading = 0.5 * (slope[k] + slope[k + 1]) + 2 * bend * middle
            at = np.zeros(len(line))  # of the width, in the parameters
            at[[k, k + 1, NUM_BOUNDARIES + k, NUM_BOUNDARIES + k + 1]] = -1.0, 1.0, -middle, middle
            if at @ cov @ at < _WIDTH_STD**2:
                widths[k] = at @ line / np.hypot(1.0, heading)  # square to the lane
    return RoadBoundaries(direction, widths)


def spread(values: NDArray[np.float64]) -> float:
    """Compute the largest difference between a frame's directions, or widths; NaN with fewer than two."""
    seen = values[np.isfinite(values)]
    return float(np.ptp(seen)) if len(seen) > 1 else float("nan")


def _long_enough(
    boundary: NDArray[np.int64],
    z: NDArray[np.float64],
    rows: NDArray[np.float64],
    seen: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    enough = np.zeros(NUM_BOUNDARIES, dtype=bool)
    for k in range(NUM_BOUNDARIES):
        of = seen & (boundary == k)
        long = of.sum() >= _MIN_VERTICES and np.ptp(z[of]) >= _MIN_STRETCH
        enough[k] = long and np.ptp(rows[of]) >= _MIN_ROWS
    long_enough: NDArray[np.bool_] = enough[boundary]
    return long_enough


def _fit(
    x: NDArray[np.float64],
    z: NDArray[np.float64],
    sigma: NDArray[np.float64],
    boundary: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit offsets (L,), slopes (L,) and the common bend by weighted least squares, with their covariance."""
    member = np.eye(NUM_BOUNDARIES)[boundary]
    columns = np.concatenate([member, member * z[:, None], z[:, None] ** 2], axis=1) / sigma[:, None]
    inverse = np.linalg.pinv(columns)
    return inverse @ (x / sigma), inverse @ inverse.T
