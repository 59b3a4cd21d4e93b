"""The measurement of the joint estimators: end points against projected lane boundaries, in pixels.

Boundary k lies on the road at X_k(Z) = x_k + c0 Z²/2 + c1 Z³/6 (flat road, third-order clothoid), with
x_k = offset + (its place in the ego lane's frame). A ray d = road_from_cam K⁻¹ p meets the road at
(X, Z) = h (d_x, d_z) / d_y, so the boundary is the zero of

    G(d) = h d_x - x_k d_y - c0 h² d_z² / (2 d_y) - c1 h³ d_z³ / (6 d_y²),

and G / |∂G/∂p| is the perpendicular distance in pixels: exact for straight boundaries, where G is linear
in p and regular on the horizon; Sampson's first order for curved ones.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.checks import as_lane_width, check_segments, clean_segments
from lanebev.geometry.road import rays_from_pixels
from lanebev.geometry.rotation import road_from_cam
from lanebev.types import LaneSegments

PITCH, YAW, ROLL, HEIGHT, OFFSET, CURVATURE, CURVATURE_RATE = range(7)
NUM_PARAMS = 7
"""Parameters of one frame: pitch, yaw, roll (rad), height, offset (m), c0 (1/m), c1 (1/m²)."""

FARTHEST = 200.0  # m; beyond it a pixel is tens of metres and the flat road is fiction

FOOT_RANGE = 0.02  # of the focal length; a foot point farther off is an outlier's, perhaps above the horizon


class Observations(NamedTuple):
    """Segments made ready: rays once per frame, bad entries at weight zero. M = 2 N end points.

    Attributes:
        rays: (B, 3, M), z = 1; end point e of segment n is entry 2 n + e.
        boundary: (B, N) int64, 0..L-1.
        weight: (B, N) in [0, 1].
        sigma: (B, N) px.
        intrinsics: (B, 3, 3), finite.
    """

    rays: Tensor
    boundary: Tensor
    weight: Tensor
    sigma: Tensor
    intrinsics: Tensor


class Residuals(NamedTuple):
    """Perpendicular distances of end points to their boundaries.

    Attributes:
        distance: (B, N, 2) px, positive right of the boundary.
        jacobian: (B, 7, M) of the distance by the frame's parameters; finite also where not valid.
        valid: (B, N) bool, both end points on the road and nearer than 200 m.
    """

    distance: Tensor
    jacobian: Tensor
    valid: Tensor


def observe(segments: LaneSegments, intrinsics: Tensor, num_boundaries: int) -> Observations:
    """Segments and intrinsics as the joint estimators use them.

    What cannot be used, and every segment of a row without usable intrinsics, gets weight 0 and harmless
    numbers, so that no row or gradient turns NaN.

    Args:
        segments: (B, N) line segments.
        intrinsics: (B, 3, 3).
        num_boundaries: L.

    Returns:
        Rays, indices, weights, sigmas.

    Raises:
        ValueError: shapes that do not fit.
    """
    check_segments(segments, intrinsics)
    segments = clean_segments(segments, num_boundaries)
    camera_ok = intrinsics.isfinite().all(-1).all(-1)
    camera_ok = camera_ok & (intrinsics[:, 0, 0] > 0) & (intrinsics[:, 1, 1] > 0)  # (B,)
    harmless = torch.diag(intrinsics.new_tensor([1000.0, 1000.0, 1.0]))
    matrix = torch.where(camera_ok[:, None, None], intrinsics, harmless)
    rays = rays_from_pixels(segments.endpoints.flatten(1, 2), matrix)
    return Observations(
        rays=rays.mT.contiguous(),
        boundary=segments.boundary,
        weight=segments.weight * camera_ok.unsqueeze(-1),
        sigma=segments.sigma,
        intrinsics=matrix,
    )


def boundary_places(lane_width: float | Tensor, num_boundaries: int, like: Tensor) -> Tensor:
    """X of each boundary from the middle of the ego lane, the lane between boundaries L/2 - 1 and L/2.

    Args:
        lane_width: float, (B,) or (B, L-1) m.
        num_boundaries: L.
        like: (B, ...) tensor that gives batch size, dtype and device.

    Returns:
        (B, L) m.

    Raises:
        ValueError: lane_width of another shape.
    """
    widths = as_lane_width(lane_width, like, num_boundaries)
    edges = torch.cat([torch.zeros_like(widths[:, :1]), widths.cumsum(-1)], dim=-1)
    ego = num_boundaries // 2 - 1
    return edges - 0.5 * (edges[:, ego] + edges[:, ego + 1]).unsqueeze(-1)


def boundary_residuals(params: Tensor, places: Tensor, seen: Observations) -> Residuals:
    """Perpendicular pixel distance of every end point to its boundary, with its Jacobian.

    The Jacobian is taken at the foot point on the boundary, which is the total derivative of G / |∂G/∂p|:
    taken at the noisy point instead, noise and Jacobian correlate and the fit is biased by their product.

    Args:
        params: (B, 7), see ``NUM_PARAMS``.
        places: (B, N) m, X of each segment's boundary at Z = 0 less the offset.
        seen: what was observed.

    Returns:
        Distances, zero where not valid, Jacobian, validity.
    """
    rotation = road_from_cam(*params[:, :HEIGHT].unbind(-1))  # (B, 3, 3)
    direction_by_pixel = rotation @ _ray_by_pixel(seen.intrinsics)  # (B, 3, 2)
    directions, valid = _on_road(rotation @ seen.rays, params)
    x_k = (places + params[:, OFFSET, None]).repeat_interleave(2, dim=-1)  # (B, M)
    value, by_direction, _ = _implicit(directions, x_k, params)
    by_pixel = direction_by_pixel.mT @ by_direction  # (B, 2, M)
    slope = torch.hypot(*by_pixel.unbind(1))
    distance = value / slope

    reach = FOOT_RANGE * seen.intrinsics[:, 0, 0, None]
    near = torch.maximum(torch.minimum(distance, reach), -reach) / slope
    foot, foot_valid = _on_road(directions - direction_by_pixel @ (near.unsqueeze(1) * by_pixel), params)
    foot = torch.where(foot_valid.unsqueeze(1), foot, directions)
    _, by_foot, by_shape = _implicit(foot, x_k, params)
    turning = torch.linalg.cross(by_foot, foot, dim=1)  # ∂G/∂angle = by · (-axis × d) = axis · (by × d)
    jacobian = torch.cat([_axes(rotation, params[:, ROLL]) @ turning, by_shape], dim=1)
    both = valid.unflatten(-1, (-1, 2)).all(-1)
    return Residuals(
        distance=torch.where(both.unsqueeze(-1), distance.unflatten(-1, (-1, 2)), 0.0),
        jacobian=jacobian / slope.unsqueeze(1),
        valid=both,
    )


def boundary_distances(params: Tensor, places: Tensor, seen: Observations) -> tuple[Tensor, Tensor]:
    """The distances alone, for several hypotheses of the places at once.

    Args:
        params: (B, 7).
        places: (H, B, N) m.
        seen: what was observed.

    Returns:
        (H, B, N, 2) px, zero where not valid, and (B, N) bool.
    """
    rotation = road_from_cam(*params[:, :HEIGHT].unbind(-1))
    direction_by_pixel = rotation @ _ray_by_pixel(seen.intrinsics)
    directions, valid = _on_road(rotation @ seen.rays, params)
    x_k = (places + params[:, OFFSET, None]).repeat_interleave(2, dim=-1)  # (H, B, M)
    value, by_direction, _ = _implicit(directions, x_k, params)
    distance = value / torch.hypot(*(direction_by_pixel.mT @ by_direction).unbind(-2))
    both = valid.unflatten(-1, (-1, 2)).all(-1)
    return torch.where(both.unsqueeze(-1), distance.unflatten(-1, (-1, 2)), 0.0), both


def _ray_by_pixel(intrinsics: Tensor) -> Tensor:
    """(B, 3, 2): the first columns of K⁻¹, with skew."""
    fx, fy, skew = intrinsics[:, 0, 0], intrinsics[:, 1, 1], intrinsics[:, 0, 1]
    zero = torch.zeros_like(fx)
    entries = [1 / fx, -skew / (fx * fy), zero, 1 / fy, zero, zero]
    return torch.stack(entries, dim=-1).view(-1, 3, 2)


def _axes(rotation: Tensor, roll: Tensor) -> Tensor:
    """Axes, in the road frame, about which pitch, yaw and roll turn a direction backwards; (B, 3, 3) rows."""
    zero, one = torch.zeros_like(roll), torch.ones_like(roll)
    yaw = torch.stack([roll.sin(), roll.cos(), zero], dim=-1)
    return torch.stack([rotation[:, :, 0], yaw, torch.stack([zero, zero, one], dim=-1)], dim=1)


def _on_road(directions: Tensor, params: Tensor) -> tuple[Tensor, Tensor]:
    """(B, 3, M) directions with d_y kept off zero, and (B, M) bool: they meet the road before FARTHEST."""
    x, down, ahead = directions.unbind(1)
    lowest = ahead * (params[:, HEIGHT, None].clamp(min=0.1) / FARTHEST)
    on_road = (ahead > 1e-3) & (down > lowest)
    down = torch.where(on_road, down, lowest.abs() + 1e-3)
    return torch.stack([x, down, ahead], dim=1), on_road


def _implicit(directions: Tensor, x_k: Tensor, params: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """G, its gradient by the direction (…, B, 3, M), and by (height, offset, c0, c1) (B, 4, M)."""
    x, down, ahead = directions.unbind(1)
    height, _, c0, c1 = params[:, HEIGHT:, None].unbind(1)  # each (B, 1)
    z = height * ahead / down
    heading = z * (c0 + 0.5 * c1 * z)
    bend = z * z * (0.5 * c0 + c1 * z / 6)  # m, of the boundary from its tangent
    out = x_k + bend
    value = height * x - out * down
    across = torch.broadcast_tensors(height, z * heading - out, -height * heading)
    area = -0.5 * down * z * z
    by_shape = torch.stack([x - heading * ahead, -down, area, area * z / 3], dim=1)
    return value, torch.stack(across, dim=-2), by_shape
