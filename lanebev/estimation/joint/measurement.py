"""The measurement of the joint estimators: end points against projected lane boundaries, in pixels.

The equations (J1) to (J30) that this package cites are in docs/method/joint.md.

Boundary k lies on the road at X_k(Z) = b(Z) + x_k (1 + b'(Z)² / 2), with x_k = offset + (its place in
the ego lane's frame): parallel curves, to second order in their heading b'. The bend b is linear in the
shape parameters: c0 Z²/2 + c1 Z³/6 (third-order clothoid), or the double integral of a curvature that is
linear between knots. The road is h + κ Z²/2 below the camera, κ its vertical curvature, positive over a
crest; on a plane road a ray d = road_from_cam K⁻¹ p meets it at (X, Z) = h (d_x, d_z) / d_y. The boundary is
seen where d is parallel to (X_k, h + κ Z²/2, Z), and

    n = (h - κ Z²/2, Z X' - X, κ Z X - (h + κ Z²/2) X')

is the normal of the plane through the camera and the boundary's tangent there. The perpendicular distance in
pixels is that of the end point to this tangent, n·d / |∂(n·d)/∂p|: exact for straight boundaries, of second
order in the distance for curved ones.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.joint.observations import Observations
from lanebev.estimation.joint.road_curve import NUM_STEPS, RoadCurve, road_basis, road_curve
from lanebev.geometry.road_profile import Profile, before_farthest, meet_road, road_profile
from lanebev.geometry.rotation import road_from_cam_and_roll

PITCH, YAW, ROLL, HEIGHT, OFFSET, CURVATURE, CURVATURE_RATE = range(7)
NUM_PARAMS = 7
"""Parameters of one frame: pitch, yaw, roll (rad), height, offset (m), c0 (1/m), c1 (1/m²)."""

NUM_STRAIGHT = 5
"""Those of a straight road."""

NUM_SHAPE = 1 + NUM_STEPS
"""Those of a bend that is a spline: the curvature at the first knot and its steps from knot to knot."""

VERTICAL = NUM_STRAIGHT + NUM_SHAPE
"""Index of the vertical curvature (1/m), the last parameter of a road whose bend is a spline."""

FOOT_RANGE = 0.02  # of the focal length; a foot point farther off is an outlier's, perhaps above the horizon


class Sight(NamedTuple):
    """End points seen from a pose, in the road's axes.

    Attributes:
        rotation: (B, 3, 3), road_from_cam.
        by_roll: (B, 3, 3), its factor R(ψ).
        directions: (B, 3, M), right, down, ahead.
        by_pixel: (B, 3, 2), derivative of a direction by its pixel.
        z: (B, M) m, distance at which the end point meets the road, at most ``FARTHEST``.
        valid: (B, N) bool, both end points meet the road nearer than that.
        profile: of the road.
        curve: (B, M) each, the road's middle line at z.
    """

    rotation: Tensor
    by_roll: Tensor
    directions: Tensor
    by_pixel: Tensor
    z: Tensor
    valid: Tensor
    profile: Profile
    curve: RoadCurve


class Residuals(NamedTuple):
    """Perpendicular distances of end points to their boundaries.

    Attributes:
        distance: (B, N, 2) px, positive right of the boundary.
        jacobian: (B, P, M) of the distance by the frame's parameters; finite also where not valid.
        by_vertical_curvature: (B, M), likewise by the road's vertical curvature.
        z: (B, M) m, distance of the foot points.
        valid: (B, N) bool, both end points on the road and nearer than 200 m.
    """

    distance: Tensor
    jacobian: Tensor
    by_vertical_curvature: Tensor
    z: Tensor
    valid: Tensor


def look(params: Tensor, seen: Observations, phase: Tensor | None = None) -> Sight:
    """Compute rays of the end points in road axes and where they meet the road.

    Args:
        params: as in :func:`boundary_residuals`.
        seen: what was observed.
        phase: likewise.
    """
    rotation, by_roll = road_from_cam_and_roll(params[:, :HEIGHT])
    directions = torch.bmm(rotation, seen.rays)
    profile = _profile(params, phase)
    z, valid = meet_road(directions, profile), before_farthest(directions, profile)
    curve = road_curve(z, _shape(params, phase), phase)
    return Sight(
        rotation, by_roll, directions, torch.bmm(rotation, seen.cam_from_image), z, valid, profile, curve
    )


def every_segment(sight: Sight, stride: int) -> Sight:
    """Keep only every n-th segment."""
    directions = sight.directions.unflatten(-1, (-1, 2))[:, :, ::stride].flatten(2)
    z, *curve = (part.unflatten(-1, (-1, 2))[:, ::stride].flatten(1) for part in (sight.z, *sight.curve))
    return sight._replace(directions=directions, z=z, valid=sight.valid[:, ::stride], curve=RoadCurve(*curve))


def boundary_residuals(
    params: Tensor,
    places: Tensor,
    seen: Observations,
    phase: Tensor | None = None,
    feet: Tensor | None = None,
    sight: Sight | None = None,
) -> Residuals:
    """Compute the perpendicular pixel distance of every end point to its boundary, with its Jacobian.

    Source: (J4) and (J5).

    Both are evaluated at the foot point on the boundary. Evaluated at the noisy point, the Jacobian would be
    correlated with the noise and bias the fit.

    Args:
        params: (B, 7), see ``NUM_PARAMS``, of a plane road; with a phase (B, ``VERTICAL`` + 1), the bend
            being a spline.
        places: (B, N) m, X of each segment's boundary at Z = 0 less the offset.
        seen: what was observed.
        phase: (B,) m, how far the first knot lies behind the camera, 0 to KNOT_SPACING; or None.
        feet: (B, 3, M) rays to the foot points, by :func:`foot_rays` at parameters nearby; None finds them.
        sight: from this pose, if it is known already.

    Returns:
        Distances, zero where not valid, Jacobian, validity.
    """
    sight = look(params, seen, phase) if sight is None else sight
    feet = foot_rays(params, places, seen, sight) if feet is None else feet
    foot, profile = torch.bmm(sight.rotation, feet), sight.profile
    z = meet_road(foot, profile)
    x_k = (places + params[:, OFFSET, None]).repeat_interleave(2, dim=-1)  # (B, M)
    basis, shape = road_basis(z, phase), _shape(params, phase).unsqueeze(1)
    curve = RoadCurve(*(torch.bmm(shape, part).squeeze(1) for part in basis))
    normal, slope = _tangent_plane(z, x_k, profile, curve)
    _, size = _pixel_gradient(normal, sight.by_pixel)  # (B, M)
    distance = (normal * sight.directions).sum(1) / size

    turning = torch.linalg.cross(normal, foot, dim=1)  # ∂(n·d)/∂angle = n · (-axis × d) = axis · (n × d)
    # pitch turns about the camera's x, seen in the road's axes, yaw about the rolled y, roll about z
    axes = torch.cat([sight.rotation[:, :, :1], sight.by_roll[:, :, 1:]], dim=-1).mT
    by_angles = torch.bmm(axes, turning)
    x, down, ahead = foot.unbind(1)
    up = profile.curvature * z * ahead - down  # -n_x of the foot, per metre of Z
    by_height, by_offset = x - slope * ahead, up + 0.5 * up * curve.heading.square()
    by_shape = torch.addcmul(basis[0], (x_k * curve.heading).unsqueeze(1), basis[1]) * up.unsqueeze(1)
    by_vertical = (0.5 * z * z * by_height).unsqueeze(1)  # the road is lower by Z²/2 per unit of it
    by_all = torch.cat([by_angles, torch.stack([by_height, by_offset], dim=1), by_shape, by_vertical], dim=1)
    jacobian = by_all / size.unsqueeze(1)
    given = jacobian[:, :-1] if phase is None else jacobian
    return Residuals(_of_valid(distance, sight.valid), given, jacobian[:, -1], z, sight.valid)


def boundary_distances(
    params: Tensor,
    places: Tensor,
    seen: Observations,
    feet: Tensor,
    phase: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Compute the distances of :func:`boundary_residuals` alone, (B, N, 2) px, and their validity (B, N)."""
    rotation, _ = road_from_cam_and_roll(params[:, :HEIGHT])
    directions, profile = torch.bmm(rotation, seen.rays), _profile(params, phase)
    valid = before_farthest(directions, profile)
    z = meet_road(torch.bmm(rotation, feet), profile)
    x_k = (places + params[:, OFFSET, None]).repeat_interleave(2, dim=-1)
    normal, _ = _tangent_plane(z, x_k, profile, road_curve(z, _shape(params, phase), phase))
    _, size = _pixel_gradient(normal, torch.bmm(rotation, seen.cam_from_image))
    return _of_valid((normal * directions).sum(1) / size, valid), valid


def foot_rays(params: Tensor, places: Tensor, seen: Observations, sight: Sight) -> Tensor:
    """Find the foot point of every end point on its boundary, by one Newton step in the image.

    A foot point is moved by ``FOOT_RANGE`` at most: an end point farther off is an outlier.

    Args:
        params: as in :func:`boundary_residuals`.
        places: likewise.
        seen: likewise.
        sight: with the same parameters.

    Returns:
        (B, 3, M) camera rays, z = 1.
    """
    x_k = (places + params[:, OFFSET, None]).repeat_interleave(2, dim=-1)
    normal, _ = _tangent_plane(sight.z, x_k, sight.profile, sight.curve)
    gradient, size = _pixel_gradient(normal, sight.by_pixel)  # (B, 2, M) 1/px
    reach = (FOOT_RANGE * seen.focal).unsqueeze(-1)
    distance = (normal * sight.directions).sum(1) / size
    step = distance.clamp(-reach, reach) / size
    return torch.baddbmm(seen.rays, seen.cam_from_image, step.unsqueeze(1) * gradient, alpha=-1)


def sampson_distances(params: Tensor, places: Tensor, sight: Sight) -> Tensor:
    """Compute the distances to first order, for several hypotheses of the places at once.

    Source: Sampson 1982, the gradient taken at the end point itself.

    Args:
        params: (B, P), as :func:`boundary_residuals`.
        places: (H, B, N) m.
        sight: with the same parameters.

    Returns:
        (H, B, N, 2) px, zero where not valid.
    """
    x_k = (places + params[:, OFFSET, None]).repeat_interleave(2, dim=-1)  # (H, B, M)
    normal, _ = _tangent_plane(sight.z, x_k, sight.profile, sight.curve)
    _, size = _pixel_gradient(normal, sight.by_pixel)
    distance = (normal * sight.directions).sum(-2) / size
    return _of_valid(distance, sight.valid)


def _of_valid(distance: Tensor, valid: Tensor) -> Tensor:
    """(…, B, M) distances to (…, B, N, 2), zero where not valid."""
    return torch.where(valid.unsqueeze(-1), distance.unflatten(-1, (-1, 2)), 0.0)


def _pixel_gradient(normal: Tensor, by_pixel: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient of n·d by the pixel (…, B, 2, M), and its length (…, B, M), for normals (…, B, 3, M)."""
    gradient = by_pixel.mT @ normal
    return gradient, gradient.square().sum(-2).sqrt()


def _shape(params: Tensor, phase: Tensor | None) -> Tensor:
    """The parameters of the bend, (B, K): a clothoid's, or with a phase a spline's."""
    return params[:, NUM_STRAIGHT : None if phase is None else VERTICAL]


def _profile(params: Tensor, phase: Tensor | None) -> Profile:
    """Height and vertical curvature, 0 for a single frame."""
    height = params[:, HEIGHT, None]
    return road_profile(height, torch.zeros_like(height) if phase is None else params[:, VERTICAL, None])


def _tangent_plane(z: Tensor, x_k: Tensor, profile: Profile, curve: RoadCurve) -> tuple[Tensor, Tensor]:
    """Normal n (…, B, 3, M) of the plane through the camera and a boundary's tangent, and its slope X'(Z).

    Source: (J2) and (J4).

    Args:
        z: (B, M) m.
        x_k: (…, B, M) m.
        profile: of the road.
        curve: at z.
    """
    tilt = x_k * curve.heading
    slope = torch.addcmul(curve.heading, tilt, curve.curvature)
    out = torch.addcmul(x_k + curve.bend, tilt, curve.heading, value=0.5)
    lower = 0.5 * profile.curvature * z * z
    across, deep = profile.height - lower, profile.height + lower
    along = torch.addcmul(profile.curvature * z * out, deep, slope, value=-1)
    return torch.stack([across.expand_as(out), z * slope - out, along], dim=-2), slope
