"""The measurement of the joint estimators: end points against projected lane boundaries, in pixels.

Boundary k lies on the flat road at X_k(Z) = b(Z) + x_k (1 + b'(Z)² / 2), with x_k = offset + (its place in
the ego lane's frame): parallel curves, to second order in their heading b'. The bend b is linear in the
shape parameters: c0 Z²/2 + c1 Z³/6 (third-order clothoid), or the double integral of a curvature that is
linear between knots. A ray d = road_from_cam K⁻¹ p meets the road at (X, Z) = h (d_x, d_z) / d_y, so the
boundary is the zero of

    G(d) = h d_x - X_k(h d_z / d_y) d_y,

and G / |∂G/∂p| is the perpendicular distance in pixels: exact for straight boundaries, where G is linear
in p and regular on the horizon; Sampson's first order for curved ones.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.checks import as_lane_width, check_segments, mask_invalid_rows
from lanebev.geometry.lens import cam_from_image
from lanebev.geometry.road import rays_from_pixels
from lanebev.geometry.rotation import road_from_cam
from lanebev.observation.segments import LaneSegments

PITCH, YAW, ROLL, HEIGHT, OFFSET, CURVATURE, CURVATURE_RATE = range(7)
NUM_PARAMS = 7
"""Parameters of one frame: pitch, yaw, roll (rad), height, offset (m), c0 (1/m), c1 (1/m²)."""

NUM_STRAIGHT = 5
"""Those of a straight road."""

KNOT_SPACING = 10.0  # m
NUM_STEPS = 5
"""Steps of curvature between knots, where the shape is a spline: c at the first knot and these, 1/m."""

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
        jacobian: (B, P, M) of the distance by the frame's parameters; finite also where not valid.
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
    anything = intrinsics.new_ones(intrinsics.shape[0], 1)  # lane widths don't matter here
    return observations(*mask_invalid_rows(segments, intrinsics, anything, num_boundaries)[:2])


def observations(segments: LaneSegments, intrinsics: Tensor) -> Observations:
    """Of segments and intrinsics that are :func:`~lanebev.estimation.checks.mask_invalid_rows`."""
    rays = rays_from_pixels(segments.endpoints.flatten(1, 2), intrinsics)
    return Observations(
        rays=rays.mT.contiguous(),
        boundary=segments.boundary,
        weight=segments.weight,
        sigma=segments.sigma,
        intrinsics=intrinsics,
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


def boundary_residuals(
    params: Tensor, places: Tensor, seen: Observations, phase: Tensor | None = None
) -> Residuals:
    """Perpendicular pixel distance of every end point to its boundary, with its Jacobian.

    The Jacobian is taken at the foot point on the boundary, which is the total derivative of G / |∂G/∂p|:
    taken at the noisy point instead, noise and Jacobian correlate and the fit is biased by their product.

    Args:
        params: (B, 7), see ``NUM_PARAMS``; with a phase (B, 6 + NUM_STEPS), the shape being a spline.
        places: (B, N) m, X of each segment's boundary at Z = 0 less the offset.
        seen: what was observed.
        phase: (B,) m, how far the first knot lies behind the camera, 0 to KNOT_SPACING; or None.

    Returns:
        Distances, zero where not valid, Jacobian, validity.
    """
    rotation = road_from_cam(*params[:, :HEIGHT].unbind(-1))  # (B, 3, 3)
    direction_by_pixel = rotation @ cam_from_image(seen.intrinsics)[..., :2]  # (B, 3, 2)
    directions, valid = _on_road(rotation @ seen.rays, params)
    x_k = (places + params[:, OFFSET, None]).repeat_interleave(2, dim=-1)  # (B, M)
    value, by_direction, _ = _implicit(directions, x_k, params, phase)
    by_pixel = direction_by_pixel.mT @ by_direction  # (B, 2, M)
    slope = torch.hypot(*by_pixel.unbind(1))
    distance = value / slope

    reach = FOOT_RANGE * seen.intrinsics[:, 0, 0, None]
    near = torch.maximum(torch.minimum(distance, reach), -reach) / slope
    foot, foot_valid = _on_road(directions - direction_by_pixel @ (near.unsqueeze(1) * by_pixel), params)
    foot = torch.where(foot_valid.unsqueeze(1), foot, directions)
    _, by_foot, bend = _implicit(foot, x_k, params, phase)
    turning = torch.linalg.cross(by_foot, foot, dim=1)  # ∂G/∂angle = by · (-axis × d) = axis · (by × d)
    by_angles = _axes(rotation, params[:, ROLL]) @ turning
    jacobian = torch.cat([by_angles, _by_shape(foot, bend)], dim=1)
    both = valid.unflatten(-1, (-1, 2)).all(-1)
    return Residuals(
        distance=torch.where(both.unsqueeze(-1), distance.unflatten(-1, (-1, 2)), 0.0),
        jacobian=jacobian / slope.unsqueeze(1),
        valid=both,
    )


def boundary_distances(
    params: Tensor, places: Tensor, seen: Observations, phase: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The distances alone, for several hypotheses of the places at once.

    Args:
        params: (B, P), as :func:`boundary_residuals`.
        places: (H, B, N) m.
        seen: what was observed.
        phase: (B,) or None, likewise.

    Returns:
        (H, B, N, 2) px, zero where not valid, and (B, N) bool.
    """
    rotation = road_from_cam(*params[:, :HEIGHT].unbind(-1))
    direction_by_pixel = rotation @ cam_from_image(seen.intrinsics)[..., :2]
    directions, valid = _on_road(rotation @ seen.rays, params)
    x_k = (places + params[:, OFFSET, None]).repeat_interleave(2, dim=-1)  # (H, B, M)
    value, by_direction, _ = _implicit(directions, x_k, params, phase)
    distance = value / torch.hypot(*(direction_by_pixel.mT @ by_direction).unbind(-2))
    both = valid.unflatten(-1, (-1, 2)).all(-1)
    return torch.where(both.unsqueeze(-1), distance.unflatten(-1, (-1, 2)), 0.0), both


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


class _Bend(NamedTuple):
    """Where directions meet the road, and what the bend does there."""

    heading: Tensor  # (B, M)
    tilt: Tensor  # (…, B, M) m, x_k times the heading
    slope: Tensor  # (…, B, M) dX_k / dZ
    basis: tuple[Tensor, Tensor, Tensor]  # (B, K, M) bend, heading, curvature by shape parameter


def _implicit(
    directions: Tensor, x_k: Tensor, params: Tensor, phase: Tensor | None
) -> tuple[Tensor, Tensor, _Bend]:
    """G (…, B, M), its gradient by the direction (…, B, 3, M), and the bend for :func:`_by_shape`."""
    x, down, ahead = directions.unbind(1)
    height, shape = params[:, HEIGHT, None], params[:, None, NUM_STRAIGHT:]  # (B, 1), (B, 1, K)
    z = height * ahead / down
    basis = _polynomial(z) if phase is None else _spline(z, phase)
    bend, heading, curvature = ((shape @ part).squeeze(1) for part in basis)
    tilt = x_k * heading
    out = x_k + bend + 0.5 * tilt * heading
    slope = heading + tilt * curvature
    across = torch.broadcast_tensors(height, z * slope - out, -height * slope)
    return height * x - out * down, torch.stack(across, dim=-2), _Bend(heading, tilt, slope, basis)


def _by_shape(directions: Tensor, bend: _Bend) -> Tensor:
    """Gradient of G by height, offset and shape, (B, 2 + K, M)."""
    x, down, ahead = directions.unbind(1)
    straight = torch.stack([x - bend.slope * ahead, -down * (1 + 0.5 * bend.heading * bend.heading)], dim=1)
    shape = bend.basis[0] + bend.tilt.unsqueeze(1) * bend.basis[1]
    return torch.cat([straight, -down.unsqueeze(1) * shape], dim=1)


def _polynomial(z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Bend, heading and curvature at (B, M) for unit c0 and unit c1, each (B, 2, M)."""
    half = 0.5 * z * z
    bend, heading = torch.stack([half, half * z / 3], 1), torch.stack([z, half], 1)
    return bend, heading, torch.stack([torch.ones_like(z), z], 1)


def _spline(z: Tensor, phase: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Bend, heading and curvature at (B, M) for a unit curvature and unit steps, each (B, 1 + NUM_STEPS, M).

    A step rises from 0 at its knot to 1 at the next. Bend and heading are zero at Z = 0.
    """
    knots = KNOT_SPACING * torch.arange(NUM_STEPS, dtype=z.dtype, device=z.device) - phase.unsqueeze(-1)
    past = z.unsqueeze(1) - knots.unsqueeze(-1)  # (B, NUM_STEPS, M)
    rise = (past / KNOT_SPACING).clamp(0.0, 1.0)
    beyond = (past - KNOT_SPACING).clamp(min=0.0)
    heading = KNOT_SPACING * 0.5 * rise * rise + beyond
    bend = KNOT_SPACING**2 / 6 * rise**3 + 0.5 * beyond * (beyond + KNOT_SPACING)
    first = (phase / KNOT_SPACING)[:, None, None]  # what lies behind the camera, of the first step only
    turned = 0.5 * KNOT_SPACING * first * first
    behind = KNOT_SPACING**2 / 6 * first**3 + turned * z.unsqueeze(1)
    head_bend, head_heading = bend[:, :1] - behind, heading[:, :1] - turned
    one = z.unsqueeze(1)
    return (
        torch.cat([0.5 * one * one, head_bend, bend[:, 1:]], 1),
        torch.cat([one, head_heading, heading[:, 1:]], 1),
        torch.cat([torch.ones_like(one), rise], 1),
    )
