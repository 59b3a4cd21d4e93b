"""The measurement of the joint estimators: end points against projected lane boundaries, in pixels.

The equations (J1) to (J33) that this package cites are in docs/method/joint.md.

Boundary k lies on the road at X_k(Z) = b(Z) + x_k (1 + b'(Z)² / 2), with x_k = offset + (its position from
the ego lane's middle): parallel curves, to second order in their heading b'. The bend b is linear in the
shape parameters: c0 Z²/2 + c1 Z³/6 (third-order clothoid), or the double integral of a curvature that is
linear between knots. The road is h + κ Z²/2 below the camera, κ its vertical curvature, positive over a
crest; on a plane road the direction d = road_from_cam K⁻¹ (x, y, 1) of an end point meets it at (X, Z) = h
(d_x, d_z) / d_y. The boundary is seen where d is parallel to (X_k, h + κ Z²/2, Z), and

    n = (h - κ Z²/2, Z X' - X, κ Z X - (h + κ Z²/2) X')

is the normal of the plane through the camera and the boundary's tangent there. The perpendicular distance in
pixels is that of the end point to this tangent, n·d / |∂(n·d)/∂(x, y)|: exact for straight boundaries, of
second order in the distance for curved ones.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.estimation.joint.measurement.observations import Observations, by_ends, per_end
from lanebev.estimation.joint.measurement.road_curve import (
    NUM_STEPS,
    Road,
    RoadCurve,
    curve_by_shape,
    road_curve,
    road_shape,
)
from lanebev.geometry.linalg import times_vector
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

LEAST_HEIGHT = 0.2  # m; the height in a fit of one frame is at least this
FOOT_RANGE = 0.02  # focal lengths from an end point to its foot point, at most: beyond are outliers


class Sight(NamedTuple):
    """End points seen from a pose, in the road's axes.

    Attributes:
        rotation: (B, 3, 3), road_from_cam.
        by_roll: (B, 3, 3), its factor R(ψ).
        road_from_image: (B, 3, 3), from a pixel (x, y, 1) to its direction right, down, ahead.
        pixels: (B, 3, M), (x, y, 1).
        z: (B, M) m, distance at which the end point meets the road, at most ``FARTHEST``.
        valid: (B, N) bool, both end points meet the road nearer than that.
        profile: of the road.
        road: its middle line.
        curve: (B, M) each, the road's middle line at z.
    """

    rotation: Tensor
    by_roll: Tensor
    road_from_image: Tensor
    pixels: Tensor
    z: Tensor
    valid: Tensor
    profile: Profile
    road: Road
    curve: RoadCurve


class Residuals(NamedTuple):
    """Perpendicular distances of end points to their boundaries.

    Attributes:
        distance: (B, 2, N) px, positive right of the boundary.
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
    """Compute where the rays of the end points meet the road.

    Args:
        params: as in :func:`boundary_residuals`.
        seen: what was observed.
        phase: likewise.
    """
    rotation, by_roll = road_from_cam_and_roll(params[:, :HEIGHT])
    road_from_image, profile = torch.bmm(rotation, seen.cam_from_image), _profile(params, phase)
    directions = torch.bmm(road_from_image, seen.pixels)
    z, valid = meet_road(directions, profile), before_farthest(directions, profile)
    road = _road(params, phase)
    curve = road_curve(z, road)
    return Sight(rotation, by_roll, road_from_image, seen.pixels, z, valid, profile, road, curve)


def every_segment(sight: Sight, stride: int) -> Sight:
    """Keep only every n-th segment."""
    pixels, z, *curve = (
        by_ends(part)[..., ::stride].flatten(-2) for part in (sight.pixels, sight.z, *sight.curve)
    )
    return sight._replace(pixels=pixels, z=z, valid=sight.valid[:, ::stride], curve=RoadCurve(*curve))


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
        feet: (B, 3, M) foot points, by :func:`foot_points` at parameters nearby; None finds them.
        sight: from this pose, if it is known already.

    Returns:
        Distances, zero where not valid, Jacobian, validity.
    """
    sight = look(params, seen, phase) if sight is None else sight
    feet = foot_points(params, places, seen, sight) if feet is None else feet
    foot, profile = torch.bmm(sight.road_from_image, feet), sight.profile
    z, x_k = meet_road(foot, profile), _lateral(params, places)
    curve = road_curve(z, sight.road)
    normal, slope = tangent_plane(z, x_k, profile, curve)
    line = torch.bmm(sight.road_from_image.mT, normal)
    per_pixel = _per_pixel(line)
    distance = (line * sight.pixels).sum(1) * per_pixel

    foot = foot * per_pixel.unsqueeze(1)
    x, down, ahead = foot.unbind(1)
    # pitch turns about the camera's x, seen in the road's axes, yaw about the rolled y, roll about z
    axes = torch.cat([sight.rotation[:, :, :1], sight.by_roll[:, :, 1:]], dim=-1).mT
    by_angles = torch.bmm(axes, _cross(normal, foot))  # ∂(n·d)/∂angle = n · (-axis × d) = axis · (n × d)
    up = profile.curvature * z * ahead - down  # -n_x of the foot, per metre of Z
    by_height, by_offset = x - slope * ahead, up + 0.5 * up * curve.heading.square()
    by_shape = curve_by_shape(z, up, up * x_k * curve.heading, sight.road)
    by_vertical = (0.5 * z * z * by_height).unsqueeze(1)  # the road is lower by Z²/2 per unit of it
    jacobian = torch.cat(
        [by_angles, by_height.unsqueeze(1), by_offset.unsqueeze(1), *by_shape, by_vertical], dim=1
    )
    given = jacobian[:, :-1] if phase is None else jacobian
    return Residuals(_of_valid(distance, sight.valid), given, jacobian[:, -1], z, sight.valid)


def boundary_distances(
    params: Tensor,
    places: Tensor,
    seen: Observations,
    feet: Tensor,
    phase: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Compute the distances of :func:`boundary_residuals` alone, (B, 2, N) px, and their validity (B, N)."""
    rotation, _ = road_from_cam_and_roll(params[:, :HEIGHT])
    road_from_image, profile = torch.bmm(rotation, seen.cam_from_image), _profile(params, phase)
    valid = before_farthest(torch.bmm(road_from_image, seen.pixels), profile)
    z = meet_road(torch.bmm(road_from_image, feet), profile)
    curve = road_curve(z, _road(params, phase))
    normal, _ = tangent_plane(z, _lateral(params, places), profile, curve)
    line = torch.bmm(road_from_image.mT, normal)
    return _of_valid((line * seen.pixels).sum(1) * _per_pixel(line), valid), valid


def foot_points(params: Tensor, places: Tensor, seen: Observations, sight: Sight) -> Tensor:
    """Find the foot point of every end point on its boundary, by one Newton step in the image.

    A foot point is moved by ``FOOT_RANGE`` at most: an end point farther off is an outlier.

    Args:
        params: as in :func:`boundary_residuals`.
        places: likewise.
        seen: likewise.
        sight: with the same parameters.

    Returns:
        (B, 3, M) px, (x, y, 1).
    """
    normal, _ = tangent_plane(sight.z, _lateral(params, places), sight.profile, sight.curve)
    line = torch.bmm(sight.road_from_image.mT, normal)
    per_pixel = _per_pixel(line)
    reach = (FOOT_RANGE * seen.focal).unsqueeze(-1)
    distance = (line * sight.pixels).sum(1) * per_pixel
    step = distance.clamp(-reach, reach) * per_pixel
    points = torch.addcmul(sight.pixels[:, :2], step.unsqueeze(1), line[:, :2], value=-1)
    return pad(points, (0, 0, 0, 1), value=1.0)


def normal_equations(jacobian: Tensor, distance: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Compute Jᵀ W J and Jᵀ W r, (B, P, P) and (B, P), from (B, P, 2N), (B, 2, N) and a weight (B, N)."""
    weighted = jacobian * per_end(weight).unsqueeze(1)
    return torch.bmm(weighted, jacobian.mT), times_vector(weighted, distance.flatten(1))


def above_road(params: Tensor) -> Tensor:
    """Limit the height of a frame's parameters (B, 7) to ``LEAST_HEIGHT`` and more."""
    height = params[:, HEIGHT : HEIGHT + 1].clamp(min=LEAST_HEIGHT)
    return torch.cat([params[:, :HEIGHT], height, params[:, HEIGHT + 1 :]], dim=-1)


def sampson_distances(params: Tensor, places: Tensor, sight: Sight) -> Tensor:
    """Compute the distances to first order, for several hypotheses of the places at once.

    Source: Sampson 1982, the gradient taken at the end point itself.

    Args:
        params: (B, P), as :func:`boundary_residuals`.
        places: (H, B, N) m.
        sight: with the same parameters.

    Returns:
        (H, B, 2, N) px, zero where not valid.
    """
    normal, _ = tangent_plane(sight.z, _lateral(params, places), sight.profile, sight.curve)
    line = sight.road_from_image.mT @ normal
    return _of_valid((line * sight.pixels).sum(-2) * _per_pixel(line), sight.valid)


def _of_valid(distance: Tensor, valid: Tensor) -> Tensor:
    """Reshape distances (…, B, M) to (…, B, 2, N), zero where not valid."""
    return torch.where(valid.unsqueeze(-2), by_ends(distance), 0.0)


def _per_pixel(line: Tensor) -> Tensor:
    """Compute 1 / |∂(n·d)/∂p| (…, M) px, of the lines l (…, 3, M) in which planes n appear, l·p = n·d."""
    across, down, _ = line.unbind(-2)
    return torch.addcmul(across * across, down, down).rsqrt()


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Compute a × b, (B, 3, M): (x, y, z) is turned to (y, z, x) three times, which is fast."""
    return torch.addcmul(a * b.roll(-1, 1), a.roll(-1, 1), b, value=-1).roll(-1, 1)


def _lateral(params: Tensor, places: Tensor) -> Tensor:
    """Return X of every end point's boundary at Z = 0, (…, B, M) m, for places (…, B, N) less the offset."""
    return per_end(places + params[:, OFFSET : OFFSET + 1])


def _road(params: Tensor, phase: Tensor | None) -> Road:
    """Return the middle line of the road: a clothoid, or with a phase a spline."""
    return road_shape(params[:, NUM_STRAIGHT : None if phase is None else VERTICAL], phase)


def _profile(params: Tensor, phase: Tensor | None) -> Profile:
    """Return height and vertical curvature, 0 for a single frame."""
    height = params[:, HEIGHT : HEIGHT + 1]
    return road_profile(height, torch.zeros_like(height) if phase is None else params[:, VERTICAL:])


def tangent_plane(z: Tensor, x_k: Tensor, profile: Profile, curve: RoadCurve) -> tuple[Tensor, Tensor]:
    """Compute the normal n (…, B, 3, M) of the plane through camera and tangent of a boundary, and X'(Z).

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
    climb = profile.curvature * z  # slope of the road, positive downwards
    across, deep = (torch.addcmul(profile.height, climb, z, value=half) for half in (-0.5, 0.5))
    along = torch.addcmul(climb * out, deep, slope, value=-1)
    return torch.stack([across.expand_as(out), z * slope - out, along], dim=-2), slope
