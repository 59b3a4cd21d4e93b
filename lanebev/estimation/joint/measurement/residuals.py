"""The measurement of the joint estimators: end points against projected lane boundaries, in pixels.

The equations (J1) to (J33) that this package cites are in docs/method/joint.md.

The road's middle line begins below the camera, and its curvature along the arc is given: by a clothoid, or
linear between knots. Boundary k is parallel to it, x_k = offset + (its position from the ego lane's middle)
to the right. An end point is beside the point of the middle line whose perpendicular it lies on. The road is
h + κ Z²/2 below the camera, κ its vertical curvature, positive over a crest; on a plane road the direction
d = road_from_cam K⁻¹ (x, y, 1) of an end point meets it at (X, Z) = h (d_x, d_z) / d_y. With ψ the heading of
the middle line there, the boundary is seen where d is parallel to P = (X_k, h + κ Z²/2, Z), and

    n = P × (sin ψ, κ Z cos ψ, cos ψ)

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
    RoadPoints,
    arc_beside,
    lateral_by_shape,
    road_points,
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
        beside: (B, M) each, the points of the middle line that the end points are beside.
    """

    rotation: Tensor
    by_roll: Tensor
    road_from_image: Tensor
    pixels: Tensor
    z: Tensor
    valid: Tensor
    profile: Profile
    road: Road
    beside: RoadPoints


class Feet(NamedTuple):
    """Foot points of end points on their boundaries.

    Attributes:
        pixels: (B, 3, M) px, (x, y, 1).
        near: points of the road's middle line beside the end points.
    """

    pixels: Tensor
    near: RoadPoints


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
    first = road_points(z, road)
    beside = road_points(arc_beside(_right(directions, z), z, first), road)
    return Sight(rotation, by_roll, road_from_image, seen.pixels, z, valid, profile, road, beside)


def every_segment(sight: Sight, stride: int) -> Sight:
    """Keep only every n-th segment."""
    pixels, z, *beside = (
        by_ends(part)[..., ::stride].flatten(-2) for part in (sight.pixels, sight.z, *sight.beside)
    )
    return sight._replace(pixels=pixels, z=z, valid=sight.valid[:, ::stride], beside=RoadPoints(*beside))


def boundary_residuals(
    params: Tensor,
    places: Tensor,
    seen: Observations,
    phase: Tensor | None = None,
    feet: Feet | None = None,
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
        feet: by :func:`foot_points` at parameters nearby; None finds them.
        sight: from this pose, if it is known already.

    Returns:
        Distances, zero where not valid, Jacobian, validity.
    """
    sight = look(params, seen, phase) if sight is None else sight
    feet = foot_points(params, places, seen, sight) if feet is None else feet
    foot, profile = torch.bmm(sight.road_from_image, feet.pixels), sight.profile
    z, x_k = meet_road(foot, profile), _lateral(params, places)
    at = road_points(arc_beside(_right(foot, z), z, feet.near), sight.road)
    normal = tangent_plane(x_k, profile, at)
    line = torch.bmm(sight.road_from_image.mT, normal)
    per_pixel = _per_pixel(line)
    distance = (line * sight.pixels).sum(1) * per_pixel

    foot = foot * per_pixel.unsqueeze(1)
    x, down, ahead = foot.unbind(1)
    # pitch turns about the camera's x, seen in the road's axes, yaw about the rolled y, roll about z
    axes = torch.cat([sight.rotation[:, :, :1], sight.by_roll[:, :, 1:]], dim=-1).mT
    by_angles = torch.bmm(axes, _cross(normal, foot))  # ∂(n·d)/∂angle = n · (-axis × d) = axis · (n × d)
    by_height = torch.addcmul(x * at.cos, ahead, at.sin, value=-1)
    across = torch.addcmul(-down, profile.curvature * z, ahead).unsqueeze(1)  # per metre across the boundary
    by_shape = across * lateral_by_shape(at, sight.road)
    by_vertical = 0.5 * z * z * by_height  # the road is lower by Z²/2 per unit of it
    jacobian = torch.cat(
        [by_angles, by_height.unsqueeze(1), across, by_shape, by_vertical.unsqueeze(1)], dim=1
    )
    given = jacobian[:, :-1] if phase is None else jacobian
    return Residuals(_of_valid(distance, sight.valid), given, jacobian[:, -1], z, sight.valid)


def boundary_distances(
    params: Tensor,
    places: Tensor,
    seen: Observations,
    feet: Feet,
    phase: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Compute the distances of :func:`boundary_residuals` alone, (B, 2, N) px, and their validity (B, N)."""
    rotation, _ = road_from_cam_and_roll(params[:, :HEIGHT])
    road_from_image, profile = torch.bmm(rotation, seen.cam_from_image), _profile(params, phase)
    valid = before_farthest(torch.bmm(road_from_image, seen.pixels), profile)
    foot, road = torch.bmm(road_from_image, feet.pixels), _road(params, phase)
    z = meet_road(foot, profile)
    at = road_points(arc_beside(_right(foot, z), z, feet.near), road)
    normal = tangent_plane(_lateral(params, places), profile, at)
    line = torch.bmm(road_from_image.mT, normal)
    return _of_valid((line * seen.pixels).sum(1) * _per_pixel(line), valid), valid


def foot_points(params: Tensor, places: Tensor, seen: Observations, sight: Sight) -> Feet:
    """Find the foot point of every end point on its boundary, by one Newton step in the image.

    A foot point is moved by ``FOOT_RANGE`` at most: an end point farther off is an outlier.

    Args:
        params: as in :func:`boundary_residuals`.
        places: likewise.
        seen: likewise.
        sight: with the same parameters.
    """
    normal = tangent_plane(_lateral(params, places), sight.profile, sight.beside)
    line = torch.bmm(sight.road_from_image.mT, normal)
    per_pixel = _per_pixel(line)
    reach = (FOOT_RANGE * seen.focal).unsqueeze(-1)
    distance = (line * sight.pixels).sum(1) * per_pixel
    step = distance.clamp(-reach, reach) * per_pixel
    points = torch.addcmul(sight.pixels[:, :2], step.unsqueeze(1), line[:, :2], value=-1)
    return Feet(pad(points, (0, 0, 0, 1), value=1.0), sight.beside)


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
    normal = tangent_plane(_lateral(params, places), sight.profile, sight.beside)
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


def tangent_plane(x_k: Tensor, profile: Profile, beside: RoadPoints) -> Tensor:
    """Compute the normal n (…, B, 3, M) of the plane through camera and tangent of a boundary.

    Source: (J2) and (J4).

    Args:
        x_k: (…, B, M) m, lateral position of the boundary.
        profile: of the road.
        beside: points of the middle line beside it.
    """
    sin, cos = beside.sin, beside.cos
    x, z = torch.addcmul(beside.x, x_k, cos), torch.addcmul(beside.z, x_k, sin, value=-1)
    climb = profile.curvature * z  # slope of the road, positive downwards
    across, deep = (torch.addcmul(profile.height, climb, z, value=half) for half in (-0.5, 0.5))
    along = torch.addcmul(climb * x * cos, deep, sin, value=-1)
    return torch.stack([across * cos, torch.addcmul(z * sin, x, cos, value=-1), along], dim=-2)


def _right(directions: Tensor, z: Tensor) -> Tensor:
    """Compute X (B, M) m of the points at distances z (B, M) m in directions (B, 3, M)."""
    return z * directions[:, 0] / directions[:, 2].clamp(min=1e-3)
