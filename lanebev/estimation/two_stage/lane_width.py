"""Roll and height from the equality of lane widths."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import masked_median
from lanebev.geometry.linalg import solve_spd
from lanebev.geometry.rotation import cam_from_world
from lanebev.observation.segments import LaneSegments

_MIN_RADIUS = 1e-3  # a ray closer than 0.06 deg to the vanishing direction has no information
_MIN_COSINE = 0.02  # 1.1 deg: a boundary plane closer to the road's own has no foot on it
_SEARCH_RANGE, _SEARCH_STEPS = math.radians(30.0), 121  # rolls to either side of the guess, rad


class BoundaryAngles(NamedTuple):
    """Angle of each boundary's plane around the vanishing direction.

    Attributes:
        angles: (B, L) rad, α of Fig. 6(c), positive left of the camera; beyond ±pi/2 where roll lifts a
            boundary above the level.
        noise: (B, L) rad², variances from the pixels.
        jacobian: (B, L, 2), by pitch and yaw.
        present: (B, L) bool.
        by_shape: (B, L, 2) rad m, by curvature and vertical curvature of the road.
    """

    angles: Tensor
    noise: Tensor
    jacobian: Tensor
    present: Tensor
    by_shape: Tensor


def line_angles(rays: Tensor) -> Tensor:
    """Compute the angles of boundary planes from the camera's vertical, seen along the lanes.

    Source: Fig. 6(c), α. Deviation: of the plane through the vanishing direction and a ray, both in the frame
    of the vanishing direction, and positive to the left; only so is Eq. (18) exact (paper.md D3).

    Args:
        rays: (..., 3) in the lane-aligned frame without roll, R_WC r.

    Returns:
        (...,) rad in (-pi, pi], beyond ±pi/2 above the level.
    """
    return torch.atan2(-rays[..., 0], rays[..., 1])


def lane_widths(line_angles: Tensor, roll: Tensor, height: Tensor) -> Tensor:
    """Compute the widths of lanes, the distances between adjacent boundaries on the road.

    Source: Eq. (18), w = h (tan(α_L - ψ) - tan(α_R - ψ)). Deviation: adjacent boundary indices instead of
    any two sides, since a missed boundary would double the width (paper.md D7).

    Args:
        line_angles: (B, L) rad, left to right.
        roll: (B,) rad.
        height: (B,) m.

    Returns:
        (B, L-1) m, positive.
    """
    tangents = (line_angles - roll.unsqueeze(-1)).tan()
    return height.unsqueeze(-1) * (tangents[..., :-1] - tangents[..., 1:])


def width_residuals(widths: Tensor, lane_width: Tensor, present: Tensor) -> Tensor:
    """Compute by how much observed lane widths differ from the prior.

    Source: Eq. (20), C = w_p - w(ψ, h).

    Args:
        widths: (..., L-1) m, from :func:`lane_widths`.
        lane_width: (..., L-1) m, the prior.
        present: (..., L-1) bool; a lane that is not there has residual 0.

    Returns:
        (..., L-1) m.
    """
    return torch.where(present, lane_width - widths, 0.0)


def width_energy(residuals: Tensor) -> Tensor:
    """Compute the energy that roll and height minimise.

    Source: Eq. (19), E_RH = Σ C. Deviation: a sum of squares, as a sum of signed residuals has no minimum
    (paper.md D4).

    Args:
        residuals: (..., L-1) m, from :func:`width_residuals`.

    Returns:
        (...,) m².
    """
    return residuals.square().sum(-1)


def boundary_angles(
    segments: LaneSegments,
    rays: Tensor,
    intrinsics: Tensor,
    pitch: Tensor,
    yaw: Tensor,
    num_boundaries: int,
    distance: Tensor | None = None,
) -> BoundaryAngles:
    """Compute one angle α per boundary from all its segments, with variance and Jacobian.

    Source: Eq. (18) takes α of single line pairs. Deviation: one α per boundary, the least-squares plane
    through the vanishing direction and the boundary's end points, as pairs that share a segment are not
    independent and a single segment's own direction ignores the known vanishing point. Segments off their
    boundary's median by more than 4 sigma and a degree are left out.

    Args:
        segments: (B, N).
        rays: (B, N, 2, 3) of both end points.
        intrinsics: (B, 3, 3) px.
        pitch: (B,) rad.
        yaw: (B,) rad.
        num_boundaries: L.
        distance: (B, N, 2) m ahead of both ends on the road, for the derivative by its shape; None is 0.

    Returns:
        angles with noise, Jacobian and presence.
    """
    _, boundary, weight, sigma = segments
    world = rays @ cam_from_world(pitch, yaw).unsqueeze(1)  # (B, N, 2, 3)
    far = (world[..., :2].square().sum(-1) > _MIN_RADIUS**2).all(-1) & (weight > 0)  # (B, N)
    world = torch.where(far[..., None, None], world, world.new_tensor([0.0, 1.0, 1.0]))
    angle, by_pose, pull = _segment_angles(world, yaw)
    by_shape = torch.zeros_like(by_pose) if distance is None else angles_by_shape(world, distance)
    focal = 0.5 * (intrinsics[:, 0, 0] + intrinsics[:, 1, 1]).unsqueeze(-1)
    variance = (sigma / focal).square() / pull
    index = torch.arange(num_boundaries, device=boundary.device)[:, None]
    member = (boundary.unsqueeze(1) == index) & far.unsqueeze(1)  # (B, L, N)
    centre = masked_median(angle.unsqueeze(1).expand(member.shape), member)
    off = (angle.unsqueeze(1) - centre.unsqueeze(-1)).abs()
    member = member & (off < 4.0 * variance.sqrt().unsqueeze(1) + math.radians(1.0))
    precision = torch.where(member, (weight / variance).unsqueeze(1), 0.0)
    total = precision.sum(-1)
    present = total > 0
    share = precision / torch.where(present, total, 1.0).unsqueeze(-1)
    angles = (share @ angle.unsqueeze(-1)).squeeze(-1)
    noise = 1.0 / torch.where(present, total, 1.0)
    return BoundaryAngles(angles, noise, share @ by_pose, present, share @ by_shape)


def _segment_angles(world: Tensor, yaw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the angle of each segment's plane, its derivative by pitch and yaw, and its information.

    The information is how strongly the ends of a segment fix the angle: that of unit noise of a ray.

    Args:
        world: (B, N, 2, 3), rays to the end points in the lane-aligned frame.
        yaw: (B,) rad.

    Returns:
        (B, N) rad, (B, N, 2), (B, N).
    """
    x, y, z = world.unbind(-1)
    radius = x * x + y * y
    pull = radius.sum(-1)
    angle = (radius * line_angles(world)).sum(-1) / pull
    # As the camera pitches and yaws, d(R_WC r) is -(cosφ, 0, sinφ) × and -(0, 1, 0) ×.
    sy, cy = yaw.sin()[:, None, None], yaw.cos()[:, None, None]
    by_pitch = (x * (cy * z - sy * x) - sy * y * y).sum(-1) / pull
    by_yaw = (z * y).sum(-1) / pull
    return angle, torch.stack([by_pitch, by_yaw], dim=-1), pull


def angles_by_shape(world: Tensor, distance: Tensor) -> Tensor:
    """Compute the derivative of each segment's angle by curvature and vertical curvature of the road.

    Source: Eq. (T2). At the distance Z a curvature moves a boundary to the right by c Z²/2, and a
    vertical curvature moves the road down by κ Z²/2.

    Args:
        world: (B, N, 2, 3), rays to the end points in the lane-aligned frame without roll.
        distance: (B, N, 2) m, Z.

    Returns:
        (B, N, 2) rad m.
    """
    x, y, z = world.unbind(-1)
    half = 0.5 * z * distance  # lateral shift of a ray, per unit of curvature
    moved = torch.stack([-(y * half).sum(-1), (x * half).sum(-1)], dim=-1)
    return moved / (x * x + y * y).sum(-1, keepdim=True)


class WidthMeasurement(NamedTuple):
    """Lane widths, linearised in (roll, height).

    Attributes:
        widths: (B, L-1) m.
        jacobian: (B, L-1, 2), by roll and height.
        noise: (B, L-1, L-1) m², identity where a lane is not there.
        present: (B, L-1) bool.
        by_angle: (B, L-1, L) m, by the boundaries' angles.
    """

    widths: Tensor
    jacobian: Tensor
    noise: Tensor
    present: Tensor
    by_angle: Tensor


def measure_widths(
    boundaries: BoundaryAngles,
    roll: Tensor,
    height: Tensor,
    direction_cov: Tensor | None = None,
    lane_noise: float = 0.0,
) -> WidthMeasurement:
    """Compute the widths of the lanes whose two boundaries are present, with Jacobian and covariance.

    Source: Eq. (18) and its derivatives.

    Args:
        boundaries: from :func:`boundary_angles`.
        roll: (B,) rad.
        height: (B,) m.
        direction_cov: (B, 2, 2) of pitch and yaw, or None where they are exact.
        lane_noise: m, standard deviation of a lane's width about the prior.

    Returns:
        the measurement.
    """
    relative = boundaries.angles - roll.unsqueeze(-1)
    facing = boundaries.present & (relative.cos() > _MIN_COSINE)
    relative = torch.where(facing, relative, 0.0)
    tangents, h = relative.tan(), height.unsqueeze(-1)
    present = facing[..., :-1] & facing[..., 1:]
    widths = lane_widths(relative, torch.zeros_like(roll), height)
    by_roll = h * (tangents[..., 1:].square() - tangents[..., :-1].square())
    jacobian = torch.stack([by_roll, widths / h], dim=-1)

    by_angle = h * (1 + tangents.square())  # (B, L)
    eye = torch.eye(widths.shape[-1] + 1, dtype=widths.dtype, device=widths.device)
    difference = (eye[:-1] - eye[1:]) * by_angle.unsqueeze(1)  # (B, L-1, L) d widths / d angles
    noise = difference @ (boundaries.noise.unsqueeze(-1) * difference.mT)
    if direction_cov is not None:
        by_direction = difference @ boundaries.jacobian  # (B, L-1, 2)
        noise = noise + by_direction @ direction_cov @ by_direction.mT
    both = present.unsqueeze(-1) & present.unsqueeze(-2)
    lanes = eye[:-1, :-1]
    noise = torch.where(both, noise + lane_noise**2 * lanes, lanes)
    return WidthMeasurement(widths, jacobian, noise, present, difference)


def initial_roll_height(
    boundaries: BoundaryAngles, lane_width: Tensor, roll_guess: Tensor, num_iterations: int = 5
) -> tuple[Tensor, Tensor]:
    """Find the roll and height of least :func:`width_energy`.

    Source: Sec. IV-A, Eqs. (18)-(20): exhaustive search, then Gauss-Newton. Deviation: for each roll of the
    search the best height is in closed form; with one lane roll stays at the guess (paper.md D6).

    Args:
        boundaries: from :func:`boundary_angles`.
        lane_width: (B, L-1) m, the prior.
        roll_guess: (B,) rad, the middle of the search, and the answer where roll is not observable.
        num_iterations: number of Gauss-Newton steps.

    Returns:
        roll (B,) rad and height (B,) m. Height is 1 where no lane is present.
    """
    ends = (-_SEARCH_RANGE, _SEARCH_RANGE, _SEARCH_STEPS)
    rolls = torch.linspace(*ends, dtype=lane_width.dtype, device=lane_width.device)
    rolls = roll_guess.unsqueeze(-1) + rolls  # (B, G)
    repeated = BoundaryAngles(*(part.repeat_interleave(_SEARCH_STEPS, 0) for part in boundaries))
    unit = measure_widths(repeated, rolls.flatten(), torch.ones_like(rolls.flatten()))
    shape = (*rolls.shape, -1)
    widths, present = unit.widths.reshape(shape), unit.present.reshape(shape)  # (B, G, L-1) at height 1
    prior = lane_width.unsqueeze(1)
    widths = torch.where(present, widths, 0.0)
    heights = (widths * prior).sum(-1) / widths.square().sum(-1).clamp_min(1e-9)
    residuals = width_residuals(heights.unsqueeze(-1) * widths, prior, present)
    possible = (present.sum(-1) == present.sum(-1).amax(-1, keepdim=True)) & (heights > 0)
    energy = torch.where(possible, width_energy(residuals), torch.inf)
    best = energy.argmin(-1, keepdim=True)
    observable = present.sum(-1).amax(-1) >= 2
    middle = torch.full_like(best, _SEARCH_STEPS // 2)
    best = torch.where(observable.unsqueeze(-1), best, middle)
    roll, height = rolls.gather(-1, best).squeeze(-1), heights.gather(-1, best).squeeze(-1)
    height = torch.where(height > 0, height, 1.0)
    for _ in range(num_iterations):
        roll, height = _gauss_newton_step(boundaries, lane_width, roll, height, observable)
    return roll, height


def _gauss_newton_step(
    boundaries: BoundaryAngles, lane_width: Tensor, roll: Tensor, height: Tensor, observable: Tensor
) -> tuple[Tensor, Tensor]:
    measured = measure_widths(boundaries, roll, height)
    there = measured.present.unsqueeze(-1)
    jacobian = torch.where(there, measured.jacobian, 0.0)
    observed = torch.stack([observable, torch.ones_like(observable)], dim=-1)  # roll only where it shows
    jacobian = jacobian * observed.unsqueeze(1)
    error = width_residuals(measured.widths, lane_width, measured.present).unsqueeze(-1)
    eye = torch.eye(2, dtype=roll.dtype, device=roll.device)
    normal = jacobian.mT @ jacobian + 1e-9 * eye
    step = solve_spd(normal, jacobian.mT @ error).squeeze(-1)
    return roll + step[..., 0].clamp(-0.1, 0.1), (height + step[..., 1]).clamp(0.1, 10.0)
