"""The vanishing direction of a set of segments: Algorithm 1, batched over rows and hypotheses."""

import math

import torch
from torch import Tensor

from lanebev.batch import order_true_first
from lanebev.geometry.linalg import inverse_spd

SCORE_ANGLE_WEIGHT = 0.8  # λ₁
SCORE_LENGTH_WEIGHT = 0.2  # λ₂
GATE_ANGLE = math.radians(0.7)  # θ_th
_EPS = 1e-12


def segment_angles(endpoints: Tensor, vanishing_points: Tensor) -> Tensor:
    """Compute the angle between each segment and the line from its centre to a vanishing point.

    Source: Rother 2002 as in Fig. 5, θ(v, l).

    Args:
        endpoints: (..., N, 2, 2) px.
        vanishing_points: (..., 3) homogeneous px; infinite ones have a zero third entry.

    Returns:
        (..., N) rad in [0, pi/2].
    """
    first, second = endpoints.unbind(-2)
    along = second - first
    centre = 0.5 * (first + second)
    point = vanishing_points.unsqueeze(-2)
    to_vp = point[..., :2] - point[..., 2:] * centre  # direction only: finite at infinity too
    cross = along[..., 0] * to_vp[..., 1] - along[..., 1] * to_vp[..., 0]
    dot = (along * to_vp).sum(-1)
    return torch.atan2(cross.abs(), dot.abs() + _EPS)


def gate_angles(endpoints: Tensor, sigma: Tensor, gate_sigmas: float) -> Tensor:
    """Compute the largest angle at which a segment still counts as pointing to the vanishing point.

    Source: Sec. III-B, θ_th = 0.7°. Deviation: never less than ``gate_sigmas`` of the angle's own standard
    deviation √2 σ / length, since 0.7° throws away half of the true segments at σ² = 9 (paper.md D10).
    ``gate_sigmas=0`` is the paper.

    Args:
        endpoints: (..., N, 2, 2) px.
        sigma: (..., N) px.
        gate_sigmas: number of standard deviations.

    Returns:
        (..., N) rad.
    """
    spread: Tensor = gate_sigmas * math.sqrt(2.0) * sigma / segment_lengths(endpoints).clamp_min(1e-6)
    return spread.clamp(GATE_ANGLE, math.radians(20.0))


def segment_lengths(endpoints: Tensor) -> Tensor:
    """Compute the lengths of segments (..., N, 2, 2), (..., N) px."""
    squared = (endpoints[..., 1, :] - endpoints[..., 0, :]).square().sum(-1)
    return squared.clamp_min(_EPS).sqrt()


def rother_score(angles: Tensor, gates: Tensor, lengths: Tensor, weight: Tensor) -> Tensor:
    """Compute the score of a vanishing point.

    Source: Eq. (2), Σ λ₁ (1 - θ/θ_th) + λ₂ l / l_m over segments with θ < θ_th.

    Args:
        angles: (..., N) rad.
        gates: (..., N) rad, θ_th.
        lengths: (..., N) px.
        weight: (..., N) in [0, 1].

    Returns:
        (...,).
    """
    longest = (lengths * (weight > 0)).amax(-1, keepdim=True).clamp_min(_EPS)
    score = SCORE_ANGLE_WEIGHT * (1 - angles / gates) + SCORE_LENGTH_WEIGHT * lengths / longest
    return torch.where(angles < gates, weight * score, 0.0).sum(-1)


def segment_pairs(weight: Tensor, draws: Tensor) -> Tensor:
    """Choose pairs of segments to intersect: all pairs if they are few, random pairs otherwise.

    Args:
        weight: (B, N); only segments of positive weight are drawn where a row has two of them.
        draws: (M, 2) in [0, 1), random numbers shared by all rows, so that a row's pairs don't depend on
            its batch.

    Returns:
        (B, M', 2) int64, M' <= M.
    """
    num_segments = weight.shape[-1]
    if num_segments * (num_segments - 1) // 2 <= draws.shape[0]:
        pairs = torch.triu_indices(num_segments, num_segments, 1, device=weight.device).T
        return pairs.expand(weight.shape[0], -1, -1)
    present = weight > 0
    order = order_true_first(present)
    count = present.sum(-1).clamp_min(2)[:, None]  # (B, 1)
    first = (draws[:, 0] * count).long().clamp_max(num_segments - 1)  # (B, M)
    other = (draws[:, 1] * (count - 1)).long().clamp_max(num_segments - 2)
    second = other + (other >= first)  # never the first again
    return torch.stack([order.gather(1, first), order.gather(1, second)], dim=-1)


def line_through(endpoints: Tensor) -> Tensor:
    """Compute the image line through both ends of each segment.

    Args:
        endpoints: (..., 2, 2) px, [end, (x, y)].

    Returns:
        (..., 3) homogeneous lines with (a, b) of unit length, zero where a segment has no length.
    """
    ends = torch.cat([endpoints, torch.ones_like(endpoints[..., :1])], dim=-1)
    lines = torch.linalg.cross(ends[..., 0, :], ends[..., 1, :])
    unit: Tensor = lines / lines[..., :2].norm(dim=-1, keepdim=True).clamp_min(_EPS)
    return unit


def intersect_lines(first: Tensor, second: Tensor) -> Tensor:
    """Compute the intersection of two image lines, a vanishing point hypothesis.

    Source: Eq. (1), v = l_j × l_k.

    Args:
        first: (..., 3) homogeneous line.
        second: (..., 3) homogeneous line.

    Returns:
        (..., 3) homogeneous point; its third entry is zero where the lines are parallel.
    """
    point: Tensor = torch.linalg.cross(first, second)
    return point


def ransac_vanishing_point(
    endpoints: Tensor, weight: Tensor, sigma: Tensor, draws: Tensor, gate_sigmas: float = 3.0
) -> tuple[Tensor, Tensor]:
    """Find the vanishing point hypothesis with the highest score, and the segments that agree with it.

    Source: Algorithm 1 with Eqs. (1), (2).

    Args:
        endpoints: (B, N, 2, 2) px, finite.
        weight: (B, N) in [0, 1].
        sigma: (B, N) px.
        draws: (N_loop, 2) in [0, 1), see :func:`segment_pairs`.
        gate_sigmas: see :func:`gate_angles`.

    Returns:
        (B, 3) homogeneous px of the best hypothesis and (B, N) bool inliers, L_c. No inliers where no
        hypothesis is supported by any segment.
    """
    lines = line_through(endpoints)  # (B, N, 3)
    pairs = segment_pairs(weight, draws)  # (B, M, 2)
    rows = torch.arange(weight.shape[0], device=weight.device)[:, None]
    hypotheses = intersect_lines(lines[rows, pairs[..., 0]], lines[rows, pairs[..., 1]])
    usable = (weight[rows.unsqueeze(-1), pairs] > 0).all(-1) & (hypotheses.abs().amax(-1) > 1e-6)
    lengths, gates = segment_lengths(endpoints), gate_angles(endpoints, sigma, gate_sigmas)
    angles = segment_angles(endpoints.unsqueeze(1), hypotheses)  # (B, M, N)
    scores = rother_score(angles, gates.unsqueeze(1), lengths.unsqueeze(1), weight.unsqueeze(1))
    scores = torch.where(usable, scores, -1.0)
    best = scores.argmax(-1)  # (B,)
    chosen = angles[rows[:, 0], best]
    inliers = (chosen < gates) & (weight > 0) & (scores.amax(-1, keepdim=True) > 0)
    return hypotheses[rows[:, 0], best], inliers


def incidence_noise(rays: Tensor, vanishing_dir: Tensor, sigma: Tensor, intrinsics: Tensor) -> Tensor:
    """Compute the variance of the residual n·v for end points with pixel noise.

    Source: first-order propagation through Eq. (3). Deviation: the paper's Q_PY is one constant, but the
    variance grows as σ² (d₁² + d₂²), d the distances end point to vanishing point (paper.md D9).

    Args:
        rays: (B, N, 2, 3), K⁻¹ p of both end points.
        vanishing_dir: (B, 3), any length.
        sigma: (B, N) px.
        intrinsics: (B, 3, 3).

    Returns:
        (B, N).
    """
    moments = torch.linalg.cross(rays, vanishing_dir[:, None, None, :].expand_as(rays))
    focal = torch.stack([intrinsics[:, 0, 0], intrinsics[:, 1, 1]], dim=-1)[:, None, None, :]
    per_end: Tensor = (moments[..., :2] / focal).square().sum(-1)  # (B, N, 2)
    return sigma.square() * per_end.sum(-1)


def vanishing_dir_least_squares(
    normals: Tensor, noise: Tensor, weight: Tensor, prior_dir: Tensor
) -> tuple[Tensor, Tensor]:
    """Estimate the vanishing direction from great-circle normals, with its covariance.

    Source: Eq. (4), A v = 0. Deviation: solved as 2 × 2 normal equations for v = (x, y, 1) with a weak
    prior instead of an SVD: no sign to guess (paper.md D2), each row weighted by its noise, and value
    and gradient stay finite when the normals don't determine v (paper.md D16).

    Args:
        normals: (B, N, 3), not normalised.
        noise: (B, N) variances of n·v at v_z = 1, > 0 where the weight is.
        weight: (B, N) in [0, 1].
        prior_dir: (B, 3) with z > 0, what to return where nothing is observed; the prior's standard deviation
            is 1 in x/z and y/z.

    Returns:
        (B, 3) direction with z = 1, and (B, 2, 2) covariance of (x, y).
    """
    there = weight > 0
    precision = torch.where(there, weight, 0.0) / torch.where(there, noise, 1.0)
    scaled = normals * precision.unsqueeze(-1)
    moments = scaled.mT @ normals  # (B, 3, 3) Σ n nᵀ / var
    prior = prior_dir[..., :2] / prior_dir[..., 2:]
    eye = torch.eye(2, dtype=normals.dtype, device=normals.device)
    matrix = moments[..., :2, :2] + eye
    vector = prior - moments[..., :2, 2]
    cov = inverse_spd(matrix)
    solution = (cov @ vector.unsqueeze(-1)).squeeze(-1)
    return torch.cat([solution, torch.ones_like(solution[..., :1])], dim=-1), cov
