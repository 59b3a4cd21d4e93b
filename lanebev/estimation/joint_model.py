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
    """Segments made ready: rays once per frame, bad entries at weight zero.

    Attributes:
        rays: (B, N, 2, 3), z = 1, of both end points.
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
        jacobian: (B, N, 2, 7) of the distance by the frame's parameters.
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
        rays=rays.view(*segments.endpoints.shape[:3], 3),
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
        Distances, Jacobian, validity. Invalid entries are zero.
    """
    pitch, yaw, roll, height = params[:, :OFFSET].unbind(-1)
    rotation = road_from_cam(pitch, yaw, roll)  # (B, 3, 3)
    directions = torch.einsum("bij,bnej->bnei", rotation, seen.rays)  # (B, N, 2, 3)
    x_k = (places + params[:, OFFSET, None]).unsqueeze(-1)  # (B, N, 1)
    directions, valid = _on_road(directions, height)
    value, by_direction, _ = _implicit(directions, x_k, params)
    by_pixel = _pixel_gradient(by_direction, rotation, seen.intrinsics)  # (B, N, 2, 2)
    slope = by_pixel.norm(dim=-1)
    distance = value / slope

    fx, fy, skew = _lens(seen.intrinsics)
    near = distance.clamp(-FOOT_RANGE * fx, FOOT_RANGE * fx)
    step = (near / slope).unsqueeze(-1) * by_pixel  # px, from the foot point to the end point
    step_y = step[..., 1] / fy
    step_x = (step[..., 0] - skew * step_y) / fx
    moved = step_x.unsqueeze(-1) * rotation[:, None, None, :, 0]
    moved = moved + step_y.unsqueeze(-1) * rotation[:, None, None, :, 1]
    foot, foot_valid = _on_road(directions - moved, height)
    foot = torch.where(foot_valid[..., None, None], foot, directions)
    _, by_foot, by_shape = _implicit(foot, x_k, params)
    across = torch.linalg.cross(foot, by_foot)  # ∂G/∂angle = by · (-axis × d) = -axis · (d × by)
    sin, cos = roll.sin(), roll.cos()
    by_pitch = -(across * rotation[:, None, None, :, 0]).sum(-1)
    by_yaw = -(across[..., 0] * sin[:, None, None] + across[..., 1] * cos[:, None, None])
    by_roll = -across[..., 2]
    jacobian = torch.cat([torch.stack([by_pitch, by_yaw, by_roll], dim=-1), by_shape], dim=-1)
    keep = valid.unsqueeze(-1)
    return Residuals(
        distance=torch.where(keep, distance, 0.0),
        jacobian=torch.where(keep.unsqueeze(-1), jacobian / slope.unsqueeze(-1), 0.0),
        valid=valid,
    )


def _on_road(directions: Tensor, height: Tensor) -> tuple[Tensor, Tensor]:
    """Directions with d_y kept off zero, and (B, N) bool: both end points meet the road before FARTHEST."""
    x, down, forward = directions.unbind(-1)
    lowest = height[:, None, None].clamp(min=0.1) / FARTHEST * forward
    on_road = (forward > 1e-3) & (down > lowest)
    down = torch.where(on_road, down, lowest.abs() + 1e-3)
    return torch.stack([x, down, forward], dim=-1), on_road.all(-1)


def _implicit(directions: Tensor, x_k: Tensor, params: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """G, its gradient by the direction (…, 3), and by (height, offset, c0, c1) (…, 4)."""
    x, down, forward = directions.unbind(-1)
    height, _, c0, c1 = params[:, HEIGHT:, None, None].unbind(1)
    z = height * forward / down
    bend = z * z * (c0 / 2 + c1 * z / 6)  # m, of the boundary from its tangent
    heading = z * (c0 + c1 * z / 2)
    value = height * x - (x_k + bend) * down
    by_direction = torch.stack(
        [height.expand_as(x), z * heading - bend - x_k, -height * heading],
        dim=-1,
    )
    by_shape = torch.stack(
        [x - heading * forward, -down, -down * z * z / 2, -down * z * z * z / 6],
        dim=-1,
    )
    return value, by_direction, by_shape


def _lens(intrinsics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """fx, fy, skew, each (B, 1, 1)."""
    return (
        intrinsics[:, 0, 0, None, None],
        intrinsics[:, 1, 1, None, None],
        intrinsics[:, 0, 1, None, None],
    )


def _pixel_gradient(by_direction: Tensor, rotation: Tensor, intrinsics: Tensor) -> Tensor:
    """Gradient by the undistorted pixel (…, 2) from that by the road direction (…, 3)."""
    by_ray = torch.einsum("bji,bnej->bnei", rotation, by_direction)
    fx, fy, skew = _lens(intrinsics)
    by_x = by_ray[..., 0] / fx
    return torch.stack([by_x, (by_ray[..., 1] - skew * by_x) / fy], dim=-1)
