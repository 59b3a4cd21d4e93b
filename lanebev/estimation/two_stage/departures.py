"""Departures of the road from the paper's model, and their effect on the covariance of the pose.

The paper's road is straight and plane, with parallel boundaries and lanes of the given widths. On another
road the pose has an error that the end points' noise does not explain and that frames do not average out. The
departures are consider parameters (Schmidt 1966): the pose is not corrected for them and stays the paper's.
The filters' sensitivity to them is followed from frame to frame, and their size is measured by what every
frame's fit leaves.

In this order they are: curvature c and vertical curvature κ of the road (1/m), heading η_k of every
boundary (rad), deviation δ_k of every boundary (m), and the error of a roll that the frame does not determine
(rad). docs/method/paper.md has the equations.
"""

import math

import torch
from torch import Tensor

from lanebev.geometry.linalg import cholesky, inverse_spd, reduced_information, solve_lower
from lanebev.tensors import constant

NUM_SHAPE = 2
"""Departures of the road's shape: curvature and vertical curvature."""

_SHAPE_STD = (0.02, 0.002)  # 1/m, sigmas of the shape before any frame: of R = 50 m and 500 m
_FARTHEST = 200.0  # m
_NOISE_SIGMAS = 3.0  # standard deviations up to about which a residual is noise
_LEAST_DOWN = 1e-3  # tangent of the angle below the horizon
_NOISE_FACTOR = 1.5  # so many times the noise variance is subtracted from a scatter
_LEAST_FREEDOM = 0.01  # squared shares of the departures that remain; fewer are rounding
_ADDED_SHARE = 0.1  # added to the share of the departures that remains, before dividing by it
_FEW_FREEDOM = (2.0, 0.2)  # a variance from n degrees of freedom is multiplied by 1 + 2 / (n + 0.2)
_CHANCE_FIT = 0.004  # probability that boundaries that differ fit by chance, for each degree of freedom
_HEADING_BY_CURVATURE = 25.0  # m, ratio of the sigmas of headings and curvatures: waves of 160 m
_NO_BOUNDARY_ODDS = 0.25  # prior odds that one of three lines bounds no lane
_NO_BOUNDARY_RANGE = 3.6  # m, over which it may be anywhere
_ROLL_PATTERN = 6.0  # sum of squares of (1, -2, 1), the proportion in which three boundaries change roll
_LEAST_SENSITIVITY = 1e-3  # rad/m of the roll, below which no boundary changes it
_LEAST_WEIGHT = 1e-9  # of the frames so far


def foot_points(rays: Tensor, vanishing_dir: Tensor, residual: Tensor, noise: Tensor) -> Tensor:
    """Move both ends of each segment by the least distance after which its line meets the vanishing point.

    Source: one step of Newton's method for the constraint (r₁ × r₂) · v = 0. The noise of the ends would
    correlate distances at the ends themselves with the incidence, and bias the shape of the road. A residual
    that noise does not explain, as in a bend, moves them less.

    Args:
        rays: (B, N, 2, 3) of both ends, z = 1.
        vanishing_dir: (B, 3), v.
        residual: (B, N), (r₁ × r₂) · v.
        noise: (B, N), its variance.

    Returns:
        (B, N, 2, 3) rays, z = 1.
    """
    normals = torch.linalg.cross(rays, vanishing_dir[:, None, None].expand_as(rays))
    first, second = normals[..., :2].unbind(-2)
    gradient = torch.stack([second, -first], dim=-2)  # (B, N, 2, 2) of the residual, by x and y of the ends
    by_noise = residual / (1 + residual.square() / (_NOISE_SIGMAS**2 * noise))
    step = by_noise / gradient.square().sum((-2, -1)).clamp_min(1e-18)
    return torch.cat([rays[..., :2] - step[..., None, None] * gradient, rays[..., 2:]], dim=-1)


def road_distances(rays: Tensor, road_from_cam: Tensor, height: Tensor) -> Tensor:
    """Compute how far ahead the end points are on the plane road, at most 200 m.

    Source: Z = h d_z / d_y of the ray's direction d in road axes.

    Args:
        rays: (B, N, 2, 3) of both ends.
        road_from_cam: (B, 3, 3).
        height: (B,) m.

    Returns:
        (B, N, 2) m.
    """
    directions = rays @ road_from_cam.mT.unsqueeze(1)
    ahead, down = directions[..., 2], directions[..., 1].clamp_min(_LEAST_DOWN)
    return (height[:, None, None] * ahead / down).clamp(0.0, _FARTHEST)


def direction_by_departures(
    jacobian: Tensor, distance: Tensor, boundary: Tensor, num_boundaries: int
) -> Tensor:
    """Compute the derivative of the incidence's innovation by curvatures and headings.

    Source: Eq. (T1). A chord between Z₁ and Z₂ on a curve has the heading c (Z₁ + Z₂)/2 and, over a crest,
    the slope κ (Z₁ + Z₂)/2 downwards; a segment of boundary k has its heading η_k. Each acts as a yaw, the
    slope as a negative pitch, of this segment alone.

    Args:
        jacobian: (B, N, 2) of the incidence by pitch and yaw.
        distance: (B, N, 2) m, of both ends.
        boundary: (B, N) index.
        num_boundaries: L.

    Returns:
        (B, N, 2 + L).
    """
    by_pitch, by_yaw = jacobian.split(1, dim=-1)
    middle = distance.mean(-1, keepdim=True)
    member = boundary.unsqueeze(-1) == torch.arange(num_boundaries, device=boundary.device)
    return torch.cat([by_yaw * middle, -by_pitch * middle, torch.where(member, by_yaw, 0.0)], dim=-1)


def updated_sensitivity(predicted: Tensor, cov: Tensor, matrix: Tensor) -> Tensor:
    """Update the sensitivity of a filter's estimate to the departures with a frame.

    Source: Eq. (T3), S⁺ = S⁻ + P⁺ (HᵀQ⁻¹B − HᵀQ⁻¹H S⁻); Schmidt 1966, and Tapley, Schutz and Born 2004,
    Statistical Orbit Determination, Sec. 6.2. P⁺ HᵀQ⁻¹ is the Kalman gain.

    Args:
        predicted: (B, 4, D), F S of the frame before; 0 in a row that starts.
        cov: (B, 4, 4), P⁺, after the frame.
        matrix: (B, 2 + D, 2 + D), information of the frame on the two observed entries of the state, first in
            it, and on the departures.
    """
    change = matrix[:, :2, 2:] - matrix[:, :2, :2] @ predicted[:, :2]
    return predicted + cov[:, :, :2] @ change


def shape_information(matrix: Tensor, vector: Tensor) -> Tensor:
    """Compute a frame's information on the road's shape, whatever pitch and yaw are.

    Source: Eq. (T4), the Schur complement of pitch and yaw.

    Args:
        matrix: (B, 2 + D, 2 + D), on pitch, yaw and the departures, the shape first.
        vector: (B, 2 + D).

    Returns:
        (B, 2, 3), matrix and vector side by side.
    """
    precision = matrix.new_ones(2)  # sigmas of pitch and yaw of a radian
    shared = 2 + NUM_SHAPE
    return reduced_information(matrix[:, :shared, :shared], vector[:, :shared], precision)


def shape_moment(information: Tensor) -> Tensor:
    """Compute the mean squares (B, 2) 1/m² of curvature and vertical curvature.

    Source: Eq. (T5), the square of the estimate minus its variance, at least 0.

    Args:
        information: (B, 2, 3) of :func:`shape_information`, summed over frames.
    """
    precision = constant(tuple(std**-2 for std in _SHAPE_STD), like=information).diag_embed()
    cov = inverse_spd(information[..., :NUM_SHAPE] + precision)
    found = (cov @ information[..., NUM_SHAPE:]).squeeze(-1)
    return (found.square() - cov.diagonal(dim1=1, dim2=2)).clamp_min(0.0)


def boundary_moments(matrix: Tensor, vector: Tensor, num_shared: int, num_boundaries: int) -> Tensor:
    """Compute a frame's moments of the departures of each boundary, without those common to all.

    Source: Eq. (T6), random effects in a regression and moments for their variance (DerSimonian and Laird
    1986), with Satterthwaite's degrees of freedom.

    Args:
        matrix: (B, M, M), information on the parameters that all boundaries share, first, and on a departure
            of every boundary, last.
        vector: (B, M), likewise.
        num_shared: 2, two entries of the state, or 4, also the road's shape.
        num_boundaries: L.

    Returns:
        (B, 4): sum of squares minus that of noise; share of the variance that remains in it; degrees of
        freedom; and 1, the frame's weight.
    """
    stds = (1.0, 1.0, *_SHAPE_STD)[:num_shared]
    precision = constant(tuple(std**-2 for std in stds), like=matrix).diag_embed()
    both = torch.cat([matrix[..., -num_boundaries:], vector.unsqueeze(-1)], dim=-1)
    known = solve_lower(cholesky(matrix[:, :num_shared, :num_shared] + precision), both[:, :num_shared])
    left = both[:, -num_boundaries:] - known[..., :num_boundaries].mT @ known  # (B, L, L + 1)
    size = both[:, -num_boundaries:].diagonal(dim1=1, dim2=2)
    seen = size > 0
    scale = torch.where(seen, 1.0 / torch.where(seen, size, 1.0), 0.0)
    each = scale.unsqueeze(-1) * left
    own, found = each[..., :num_boundaries], each[..., num_boundaries]
    noise = (scale * own.diagonal(dim1=1, dim2=2)).sum(-1)
    squares = found.square().sum(-1) - _NOISE_FACTOR * noise
    gram = own.mT @ own
    share = gram.diagonal(dim1=1, dim2=2).sum(-1)
    freedom = share.square() / (gram.square().sum((1, 2)) + _LEAST_FREEDOM**2)
    return torch.stack([squares, share, freedom, torch.ones_like(share)], dim=-1)


def faded_sum(now: Tensor, before: Tensor, dt: Tensor, seen: Tensor, memory: float) -> Tensor:
    """Add a frame to the sum of the frames before, which fade; an unused frame changes nothing.

    Source: Eq. (T4), fading memory (Sorenson and Sacks 1971).

    Args:
        now: (B, ...) of this frame.
        before: (B, ...), the sum so far.
        dt: (B,) s since the last frame.
        seen: (B,) bool, whether the frame was used.
        memory: time constant, s.
    """
    rows = (-1, *[1] * (now.ndim - 1))
    fade = (-dt / memory).exp().view(rows)
    return torch.where(seen.view(rows), now + fade * before, before)


def boundary_variance(moments: Tensor, unseen: Tensor) -> Tensor:
    """Compute the variances (B, 2) of a boundary's own heading (rad²) and deviation (m²).

    Source: Eq. (T7). The fewer the degrees of freedom, the larger: departures may be small by chance.

    Args:
        moments: (B, 2, 4) of :func:`boundary_moments`, summed over frames, of headings and of deviations.
        unseen: (B, 2), the variances where nothing shows them, see :func:`unseen_variance`.
    """
    squares, share, freedom, weight = moments.unbind(-1)
    weight = weight.clamp_min(_LEAST_WEIGHT)
    share, freedom = share / weight, freedom / weight
    factor, added = _FEW_FREEDOM
    shown = squares.clamp_min(0.0) / weight / (share + _ADDED_SHARE) * (1 + factor / (freedom + added))
    return shown + unseen * (math.log(_CHANCE_FIT) * freedom).exp()


def unseen_variance(shape: Tensor, spread: Tensor, odd: Tensor, deviation_std: float) -> Tensor:
    """Compute the variances (B, 2) of a boundary's heading and deviation where a frame cannot show them.

    Source: Eq. (T8). Two lines fit parallel boundaries however they converge. If each has a curvature of its
    own, they show a vertical curvature κ, since it curves the image of a boundary at the lateral position X
    as a curvature of κ X / h does.

    Args:
        shape: (B, 2) of :func:`shape_moment`.
        spread: (B,), half a lane's width by the height.
        odd: (B,) m² of :func:`no_boundary_deviation`.
        deviation_std: m, standard deviation of a boundary's deviation.
    """
    heading = shape[:, 1] * (_HEADING_BY_CURVATURE * spread).square()
    return torch.stack([heading, odd + deviation_std**2], dim=-1)


def no_boundary_deviation(roll_by_deviation: Tensor, roll: Tensor, roll_std: float) -> Tensor:
    """Compute the variance (B,) m² of the deviations because one line of three may bound no lane.

    Source: Eq. (T9). A kerb fits as a boundary if the roll is wrong; the larger that roll is, the less
    probable is it for a camera. The result gives roll the variance p r², where p is the probability that
    there is such a line and r the difference of the roll from its prior's mean.

    Args:
        roll_by_deviation: (B, L) rad/m, row of the roll of the sensitivity.
        roll: (B,) rad, minus the prior's mean.
        roll_std: rad, of the prior.
    """
    total = roll_by_deviation.square().sum(-1)
    there = total > _LEAST_SENSITIVITY**2
    total = torch.where(there, total, 1.0)
    density = (-0.5 * (roll / roll_std).square()).exp() / (math.sqrt(2 * math.pi) * roll_std)  # 1/rad
    by_camera = _NO_BOUNDARY_RANGE * density * (total / _ROLL_PATTERN).sqrt()
    probability = _NO_BOUNDARY_ODDS / (_NO_BOUNDARY_ODDS + by_camera)
    return torch.where(there, probability * roll.square() / total, 0.0)


def covariance_by_departures(sensitivity: Tensor, shape: Tensor, own: Tensor, roll: Tensor) -> Tensor:
    """Compute the covariance (B, 4, 4) of the pose by the departures.

    Source: Eq. (T10), S C Sᵀ with the departures' variances C, diagonal. Deviation: the paper's covariance
    contains the noise of the end points only, which is far too little on other roads (paper.md D19).

    Args:
        sensitivity: (B, 4, 3 + 2 L), S.
        shape: (B, 2) 1/m², of curvature and vertical curvature.
        own: (B, 2), of a boundary's heading (rad²) and deviation (m²).
        roll: (B,) rad², of the roll.
    """
    num_boundaries = (sensitivity.shape[-1] - NUM_SHAPE - 1) // 2
    each = torch.cat([shape, own.repeat_interleave(num_boundaries, dim=-1), roll.unsqueeze(-1)], dim=-1)
    return (sensitivity * each.unsqueeze(1)) @ sensitivity.mT
