"""Scatter of the boundaries about parallel lanes of equal width, and its effect on the pose.

The pose is fitted to a road whose boundaries are parallel and whose lanes have the given widths. On a street,
every boundary has a lateral deviation and a heading of its own. Errors of a detector
that last along a boundary have the same effect. All vertices of the boundary share them, and so do
consecutive frames, so they do not average out as noise does. Their variances are estimated from the residuals
of the last frames' fits: of each, and in their mean, in which noise is small and what lasts remains.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.lane_change import shifted
from lanebev.estimation.joint.layout import NUM_POSE
from lanebev.estimation.joint.measurement.observations import per_end
from lanebev.estimation.joint.measurement.residuals import OFFSET, ROLL, Residuals
from lanebev.geometry.linalg import cholesky, inverse_spd, solve_lower, times_vector
from lanebev.tensors import constant

_PRIOR_STD = (0.05, 0.003)  # m, rad: least prior sigmas of a boundary's own deviation and heading
_NOISE_FACTOR = 1.5  # so many times the noise variance of the estimates is subtracted
_MEAN_NOISE_FACTOR = 3.0  # the same of the averaged estimates, which are as few but less noisy
_ADDED_FREEDOM = 0.2  # degrees of freedom that are added before dividing by them
_FEW_FREEDOM = 2.0  # degrees of freedom at which a variance is doubled, because it may be small by chance
_LEAST_SENSITIVITY = 0.001  # rad/m or m/m of roll or height, below which a boundary is not in view
_BY_FREEDOM = 2.0  # the log of a start's variance falls by this per degree of freedom of a frame
_LEAST_WEIGHT = 1e-9  # of the frames so far; smaller ones are not divided by
_FULL_FREEDOM = 0.5  # a frame with so many degrees of freedom counts fully
_IS_ROLL = tuple(axis == ROLL for axis in range(NUM_POSE))
_SQUARES, _NOISE, _FREEDOM, _WEIGHT = -4, -3, -2, -1  # of the last axis of moments, after the estimates
_BY_HEADINGS = (False, True)  # columns of M: by deviations, by headings


class Scatter(NamedTuple):
    """Information of one frame on its boundaries' own deviations and headings.

    Attributes:
        sensitivity: (B, 4, 2 L), change of the pose by the boundaries' own deviations (per m), then by their
            headings (per rad).
        moments: (B, 2, L + 4), for deviations (m) and headings (rad): the estimates of the L boundaries; the
            sum of their squares minus that of noise; the sum of their noise variances; the degrees of freedom
            that the fit leaves (at most 2 L - 5 together); and 1, the frame's weight.
        places: (B, L, L + 1), information on the deviations if boundaries are parallel, matrix (m⁻²) and
            vector (m⁻¹), whatever the parameters are that all share.
    """

    sensitivity: Tensor
    moments: Tensor
    places: Tensor


def with_headings(
    matrix: Tensor, vector: Tensor, residuals: Residuals, weight: Tensor, member: Tensor
) -> tuple[Tensor, Tensor]:
    """Extend a frame's information (J8) by the headings of the boundaries.

    A heading moves an end point as an offset of Z times the heading does.

    Args:
        matrix: (B, P + L, P + L) of :func:`~lanebev.estimation.joint.filter.update.information`.
        vector: (B, P + L), likewise.
        residuals: distances, their Jacobian (B, P, M), and Z of the foot points.
        weight: (B, N) px⁻², of each segment over its variance.
        member: (B, L, M) of :func:`~lanebev.estimation.joint.filter.update.membership`.

    Returns:
        (B, P + 2 L, P + 2 L) and (B, P + 2 L).
    """
    jacobian, distance = residuals.jacobian, residuals.distance.flatten(1)
    by_heading = jacobian[:, OFFSET] * residuals.z  # (B, M)
    own = member * (per_end(weight) * by_heading).unsqueeze(1)  # (B, L, M)
    shared = torch.bmm(own, jacobian.mT)  # (B, L, P)
    alone, against = times_vector(own, by_heading), times_vector(own, distance)
    across = torch.cat([shared, shared[:, :, OFFSET].diag_embed()], dim=-1)  # (B, L, P + L)
    upper = torch.cat([matrix, across.mT], dim=-1)
    lower = torch.cat([across, alone.diag_embed()], dim=-1)
    return torch.cat([upper, lower], dim=1), torch.cat([vector, -against], dim=-1)


def boundary_scatter(matrix: Tensor, vector: Tensor, precision: Tensor, moments: Tensor) -> Scatter:
    """Estimate each boundary's own deviation and heading in a frame, beside the parameters that all share.

    Source: (J27), random effects of a linear mixed model, and moments for their variances (Henderson 1953).

    Args:
        matrix: (B, P + 2 L, P + 2 L), information of :func:`with_headings`: on the parameters, pose and
            offset first, on the deviations and on the headings.
        vector: (B, P + 2 L), likewise.
        precision: (B, P), of the priors of the parameters.
        moments: (B, 2, L + 4) of the frames before; they decide the prior of the deviations and headings.
    """
    count = precision.shape[-1]
    num = (vector.shape[-1] - count) // 2
    by_own = matrix[:, :count, count:]  # (B, P, 2 L)
    factor = cholesky(matrix[:, :count, :count] + precision.diag_embed())
    across = torch.cholesky_inverse(factor) @ by_own  # change of the common parameters by each boundary's own
    known = solve_lower(factor, torch.cat([by_own, vector[:, :count, None]], dim=-1))
    own_known = known[:, :, :-1].mT
    left = matrix[:, count:, count:] - own_known @ known[:, :, :-1]  # (B, 2 L, 2 L)
    pull = vector[:, count:, None] - own_known @ known[:, :, -1:]

    least = constant(tuple(std**2 for std in _PRIOR_STD), like=left)
    prior = scatter_variance(moments).maximum(least).repeat_interleave(num, dim=-1)  # (B, 2 L)
    own_cov = inverse_spd(left + prior.reciprocal().diag_embed())
    seen = own_cov @ left  # ζ̂ is this times the own deviations and headings, and noise
    found = (own_cov @ pull).squeeze(-1)
    noise = (seen @ own_cov).diagonal(dim1=1, dim2=2).unflatten(-1, (2, num)).sum(-1)
    freedom = seen.square().unflatten(1, (2, num)).unflatten(-1, (2, num)).sum((2, 4))  # (B, 2, 2)
    found = found.unflatten(-1, (2, num))
    squares = found.square().sum(-1) - _NOISE_FACTOR * noise
    sums = torch.stack([squares, noise, freedom.diagonal(dim1=1, dim2=2)], dim=-1)
    moments = pad(torch.cat([found, sums], dim=-1), (0, 1), value=1.0)
    places = torch.cat([left[:, :num, :num], pull[:, :num]], dim=-1)
    return Scatter(across[:, :NUM_POSE], moments, places)


def averaged_moments(now: Tensor, before: Tensor, dt: Tensor, memory: float) -> Tensor:
    """Average the moments (B, 2, L + 4) of scatter over the last frames, as far as a frame tells any.

    The noise variances are those of the averaged estimates, the noise of frames being independent.

    Args:
        now: of this frame.
        before: so far; 0 if no frame has told any.
        dt: (B,) s since the last frame.
        memory: s, time constant.
    """
    told = (now[..., _FREEDOM].sum(-1) / _FULL_FREEDOM).clamp(max=1.0)
    gain = (told * (1 - (-dt / memory).exp()))[:, None, None]
    mean = before + gain * (now - before)
    noise = (1 - gain).square() * before[..., _NOISE, None] + gain.square() * now[..., _NOISE, None]
    return torch.cat([mean[..., :_NOISE], noise, mean[..., _NOISE + 1 :]], dim=-1)


def scatter_variance(moments: Tensor) -> Tensor:
    """Compute the variances (B, 2) of a boundary's own deviation (m²) and heading (rad²) from their moments.

    Source: (J28). The fewer the degrees of freedom, the larger: one deviation may be small by chance.

    Args:
        moments: (B, 2, L + 4), averaged.
    """
    found, (squares, noise, freedom, weight) = moments[..., :_SQUARES], moments[..., _SQUARES:].unbind(-1)
    weight = weight.clamp(min=_LEAST_WEIGHT)
    of_mean = (found.square().sum(-1) - _MEAN_NOISE_FACTOR * noise) / weight.square()
    squares = (squares / weight).maximum(of_mean).clamp(min=0.0)
    freedom = freedom / weight + _ADDED_FREEDOM
    return squares / freedom * (1 + _FEW_FREEDOM / freedom)


def renumbered_moments(moments: Tensor, shift: Tensor) -> Tensor:
    """Shift the estimates of each boundary in moments (B, 2, L + 4) by (B,) lanes, -1, 0 or 1."""
    own = shifted(moments[..., :_SQUARES], shift)
    return torch.cat([own, moments[..., _SQUARES:]], dim=-1)


def summed_places(
    now: Tensor, at: Tensor, before: Tensor, shift: Tensor, dt: Tensor, cfg: JointConfig
) -> Tensor:
    """Sum the information (B, L, L + 1) on the boundaries' deviations from equal lanes over the frames.

    Source: (J35).

    Args:
        now: of this frame, on changes of the deviations.
        at: (B, L) m, the deviations where it was linearised.
        before: so far.
        shift: (B,) lanes, -1, 0 or 1, since then.
        dt: (B,) s since then.
        cfg: the configuration.
    """
    matrix, pull = now[..., :-1], now[..., -1]
    now = torch.cat([matrix, (pull + times_vector(matrix, at)).unsqueeze(-1)], dim=-1)
    rows = shifted(before.mT, shift).mT
    before = torch.cat([shifted(rows[..., :-1], shift), rows[..., -1:]], dim=-1)
    return now + (-dt / cfg.motion.deviation_memory).exp()[:, None, None] * before


def shown_freedom(moments: Tensor) -> Tensor:
    """Return the degrees of freedom (B,) of deviations and headings that the last frames have shown."""
    return moments[..., _FREEDOM].sum(-1)


def start_variance(moments: Tensor, heading_std: float) -> Tensor:
    """Compute the variance (B,) rad² of a boundary's own heading that is left from the start.

    Source: (J28), of a start. The first frames of a street may fit parallel boundaries by chance, and the
    frames after them show the same boundaries. The variance decreases with the degrees of freedom of a frame
    and with the time for which frames have had any; it is 0 before.

    Args:
        moments: (B, 2, L + 4), averaged.
        heading_std: rad, at a start whose frame has no degrees of freedom.
    """
    freedom, weight = shown_freedom(moments), moments[:, 0, _WEIGHT]
    of_frame = freedom / weight.clamp(min=_LEAST_WEIGHT)
    by_time = (1 - weight).clamp(min=_LEAST_WEIGHT).sqrt()  # falls by e in two time constants
    left = by_time * (-_BY_FREEDOM * of_frame).exp()
    return heading_std**2 * torch.where(weight > 0, left, 0.0)


def determined_sensitivity(determined: Tensor, num_boundaries: int) -> Tensor:
    """Return which entries of the sensitivity a frame by itself determines, (B, 4, 2 L) bool.

    All if it determines the whole pose. If it determines all but the roll, as with two boundaries in view,
    those of the other parameters and the headings.

    Args:
        determined: (B, 4) bool, what of the pose the frame determines.
        num_boundaries: L.
    """
    is_roll = constant(_IS_ROLL, like=determined)
    all_but_roll = (determined | is_roll).all(-1)[:, None, None]
    by_headings = constant(_BY_HEADINGS, like=determined).repeat_interleave(num_boundaries)  # (2 L,)
    return determined.all(-1)[:, None, None] | (all_but_roll & by_headings & ~is_roll.unsqueeze(-1))


def updated_sensitivity(predicted: Tensor, gain: Tensor, matrix: Tensor) -> Tensor:
    """Update the change of the state by each boundary's own heading with a frame.

    Source: (J29), S⁺ = S⁻ + G (Λ_xη - Λ S⁻): parameters that are considered and not estimated (Schmidt 1966;
    Tapley, Schutz and Born 2004, Statistical Orbit Determination, Sec. 6.2).

    Args:
        predicted: (B, D, L), S⁻, in the numbering of the frame.
        gain: (B, D, O), G.
        matrix: (B, O + L, O + L) of :func:`with_headings`: Λ and, in the last columns, Λ_xη.

    Returns:
        (B, D, L).
    """
    count = gain.shape[-1]
    by_frame, by_headings = matrix[:, :count, :count], matrix[:, :count, count:]
    change = torch.baddbmm(by_headings, by_frame, predicted[:, :count], alpha=-1)
    return torch.baddbmm(predicted, gain, change)


def remembered_sensitivity(now: Tensor, before: Tensor, dt: Tensor, cfg: JointConfig) -> Tensor:
    """Blend the pose's change by each boundary's own deviation over the last frames.

    Source: M of (J26) and (J29).

    A boundary counts fully after about a second in view. One that has gone has shown where it is, and its
    share decays as deviations do. So the covariance changes gradually when boundaries come and go.

    Args:
        now: (B, 4, L) by this frame.
        before: (B, 4, L); its row of the roll is 0 where no frame has determined the whole pose yet.
        dt: (B,) s since then; inf where the boundaries' numbers have changed.
        cfg: the configuration.
    """
    gone = now[:, ROLL:].abs().amax(1, keepdim=True) < _LEAST_SENSITIVITY
    memory = torch.where(gone, cfg.motion.deviation_memory, cfg.motion.unequal_memory)
    begun = (before[:, ROLL] != 0).any(-1)[:, None, None]
    fade = torch.where(begun, (-dt[:, None, None] / memory).exp(), 0.0)
    return now + fade * (before - now)
