"""Measure the bird's-eye view: are boundaries parallel and lanes equally wide?"""

import math
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
_REWEIGHTINGS = 3
_LEAST_SCALE = 1e-6  # smallest scale of the residuals, in sigmas
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
    if not seen.any():
        return RoadBoundaries(np.full(NUM_BOUNDARIES, np.nan), np.full(NUM_BOUNDARIES - 1, np.nan))
    for _ in range(_REWEIGHTINGS):
        line, cov = _fit(x[seen], z[seen], sigma[seen], boundary[seen])
        offset, slope, bend = line[:NUM_BOUNDARIES], line[NUM_BOUNDARIES:-1], float(line[-1])
        residual = (x - offset[boundary] - slope[boundary] * z - bend * z**2) / sigma
        scale = 1.4826 * np.median(np.abs(residual[seen])) + _LEAST_SCALE
        seen &= np.abs(residual) < 3 * scale
    of_each = [z[seen & (boundary == k)] for k in range(NUM_BOUNDARIES)]
    direction = np.where(
        [len(each) >= _MIN_VERTICES for each in of_each], np.arctan(slope + 2 * bend * _NEAR), np.nan
    )
    widths = [_width(k, of_each[k], of_each[k + 1], line, cov) for k in range(NUM_BOUNDARIES - 1)]
    return RoadBoundaries(direction, np.array(widths))


def _width(
    left: int,
    z_left: NDArray[np.float64],
    z_right: NDArray[np.float64],
    line: NDArray[np.float64],
    cov: NDArray[np.float64],
) -> float:
    """Compute the width of a lane in the middle of the stretch that both of its boundaries cover.

    Args:
        left: index of its left boundary.
        z_left: m, distances of that boundary's vertices.
        z_right: m, of the right one's.
        line: (2 L + 1,) parameters of :func:`_fit`.
        cov: (2 L + 1, 2 L + 1), their covariance.

    Returns:
        m, square to the lane; NaN where there is no such stretch or the width is not sure enough.
    """
    if min(len(z_left), len(z_right)) < _MIN_VERTICES:
        return math.nan
    start, end = max(z_left.min(), z_right.min()), min(z_left.max(), z_right.max())
    middle = 0.5 * (start + end)
    both = [left, left + 1, NUM_BOUNDARIES + left, NUM_BOUNDARIES + left + 1]
    by_line = np.zeros(len(line))  # derivative of the width
    by_line[both] = -1.0, 1.0, -middle, middle
    if end <= start or by_line @ cov @ by_line >= _WIDTH_STD**2:
        return math.nan
    heading = 0.5 * (line[both[2]] + line[both[3]]) + 2 * line[-1] * middle
    return float(by_line @ line / np.hypot(1.0, heading))


def spread(values: NDArray[np.float64]) -> float:
    """Compute the largest difference between a frame's directions, or widths; NaN with fewer than two."""
    seen = values[np.isfinite(values)]
    return float(np.ptp(seen)) if len(seen) > 1 else float("nan")


def _long_enough(
    boundary: NDArray[np.int64], z: NDArray[np.float64], rows: NDArray[np.float64], seen: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    enough = np.zeros(NUM_BOUNDARIES, dtype=bool)
    for k in range(NUM_BOUNDARIES):
        of = seen & (boundary == k)
        long = of.sum() >= _MIN_VERTICES and np.ptp(z[of]) >= _MIN_STRETCH
        enough[k] = long and np.ptp(rows[of]) >= _MIN_ROWS
    return enough[boundary]


def _fit(
    x: NDArray[np.float64], z: NDArray[np.float64], sigma: NDArray[np.float64], boundary: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit offsets (L,), slopes (L,) and the common bend by weighted least squares, with their covariance."""
    member = np.eye(NUM_BOUNDARIES)[boundary]
    columns = np.concatenate([member, member * z[:, None], z[:, None] ** 2], axis=1) / sigma[:, None]
    inverse = np.linalg.pinv(columns)
    return inverse @ (x / sigma), inverse @ inverse.T
