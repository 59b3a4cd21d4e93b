"""Measurement update of the joint filter: linearise, weigh, update."""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.joint.layout import NUM_COMMON, layout
from lanebev.estimation.joint.measurement.observations import Observations, by_ends, per_end
from lanebev.estimation.joint.measurement.residuals import NUM_STRAIGHT, OFFSET, ROLL, Residuals
from lanebev.estimation.joint.measurement.robust import (
    inlier_weights,
    reweigh,
    scaled_variance,
    squared_distance,
)
from lanebev.estimation.kalman import symmetrise
from lanebev.geometry.linalg import cholesky, inverse_spd, solve_lower, times_vector
from lanebev.tensors import constant, identity

UNSEEN = (0.01, 0.01, 0.01, 0.3)
"""Standard deviations (rad, m) of the pose from one frame alone, above which it is not determined."""

_WIDE_PRIOR = (0.3, 0.3, 0.3, 1.0, 2.0)  # rad, m: prior of pose and offset when a frame is judged alone
_FIXED = 1e-4  # factor on roll's prior sigma where roll is not estimated; 0 would be singular
_OFFSET_ALONE = tuple(float(entry == OFFSET) for entry in range(NUM_COMMON))
_NO_INFORMATION = 1e-3  # 1/m², information about a boundary's place below which there is none


class FrameInformation(NamedTuple):
    """Information of one frame on the O observed entries of the state, linearised.

    Attributes:
        matrix: (B, O, O), Λ = Hᵀ Q⁻¹ H.
        vector: (B, O), Hᵀ Q⁻¹ y at the point of linearisation.
        trust: (B, N) in [0, 1], weights of the segments.
        weight: (B, N) px⁻², of every end point in these sums: the diagonal of Q⁻¹.
        scale: (B,) >= 1, of the noise.
        residuals: at the point of linearisation.
    """

    matrix: Tensor
    vector: Tensor
    trust: Tensor
    weight: Tensor
    scale: Tensor
    residuals: Residuals


class Step(NamedTuple):
    """A Gauss-Newton step of the O observed entries.

    Attributes:
        mean: (B, O) after it.
        cov: (B, O, O), roll taken as known where it is not estimated.
        pull: (B, O), Hᵀ Q⁻¹ y of the linearisation, seen from the prediction.
    """

    mean: Tensor
    cov: Tensor
    pull: Tensor


def membership(boundary: Tensor, num_boundaries: int, like: Tensor) -> Tensor:
    """Return which end points are on which boundary, (B, L, M) of 1 and 0, from that of segments (B, N)."""
    numbers = torch.arange(num_boundaries, device=boundary.device).unsqueeze(-1)
    return per_end((boundary.unsqueeze(1) == numbers).to(like.dtype))


def frame_information(
    residuals: Residuals, scale: Tensor, at_cov: Tensor, seen: Observations, member: Tensor
) -> FrameInformation:
    """Weigh a frame's linearised measurements and sum them up.

    Args:
        residuals: at the point of linearisation.
        scale: (B,) noise scale so far; it is lowered.
        at_cov: (B, O, O), covariance of the point of linearisation. A residual within it is not an outlier.
        seen: what was observed.
        member: (B, L, M) of :func:`membership`.
    """
    by_state = _predicted_variance(residuals.jacobian, at_cov, seen.boundary)
    trust, scale = reweigh(squared_distance(residuals.distance), residuals.valid, seen, scale, by_state)
    weight = trust * seen.weight / scaled_variance(seen.sigma, scale)
    return FrameInformation(*information(residuals, weight, member), trust, weight, scale, residuals)


def information(residuals: Residuals, weight: Tensor, member: Tensor) -> tuple[Tensor, Tensor]:
    """Sum up Λ (B, O, O) and Hᵀ Q⁻¹ y (B, O) of the common entries and the deviations.

    Source: (J8). A deviation moves the end points of its own boundary, as the offset does. No end point is on
    two boundaries, so that the block of the deviations is diagonal.

    Args:
        residuals: with the Jacobian (B, P, M) by the common entries.
        weight: (B, N) px⁻², the diagonal of Q⁻¹.
        member: (B, L, M) of :func:`membership`.
    """
    jacobian, distance = residuals.jacobian, residuals.distance.flatten(1)
    weighted = jacobian * per_end(weight).unsqueeze(1)  # (B, P, M)
    own = member * weighted[:, OFFSET : OFFSET + 1]  # (B, L, M)
    shared = torch.bmm(own, jacobian.mT)  # (B, L, P)
    common = torch.cat([torch.bmm(weighted, jacobian.mT), shared], dim=1)
    deviations = torch.cat([shared.mT, shared[:, :, OFFSET].diag_embed()], dim=1)
    against = torch.cat([times_vector(weighted, distance), times_vector(own, distance)], dim=1)
    return torch.cat([common, deviations], dim=-1), -against


def observed_step(
    predicted: Tensor, cov: Tensor, at: Tensor, frame: FrameInformation, estimated: Tensor
) -> Step:
    """Update the observed entries of a prediction by one frame; the prediction stays the prior.

    Source: Bell and Cathey 1993, the iterated Kalman filter as Gauss-Newton; Schmidt 1966 for roll that a
    frame does not determine: its uncertainty is considered, but it is not estimated. On one lane roll and
    offset have the same effect to first order; they differ to second order only, which a linearised update
    overestimates. The other entries are estimated as if roll were known. G of (J9) is here the updated
    covariance.

    Args:
        predicted: (B, O) mean.
        cov: (B, O, O) of the prediction.
        at: (B, O), where the frame was linearised.
        frame: its information.
        estimated: (B, O), shares of :func:`estimated_entries`.
    """
    moved = (at - predicted).unsqueeze(-1)
    pull = torch.baddbmm(frame.vector.unsqueeze(-1), frame.matrix, moved)
    free = estimated.clamp(min=_FIXED)
    known = updated_covariance(free.unsqueeze(-1) * cov * free.unsqueeze(-2), frame.matrix)
    mean = predicted + estimated * torch.bmm(known, pull).squeeze(-1)
    return Step(mean, known, pull.squeeze(-1))


def kalman_gain(cov: Tensor, step: Step, frame: FrameInformation, estimated: Tensor) -> Tensor:
    """Compute G (B, D, O) of (J9); the Kalman gain is G Hᵀ Q⁻¹. Its rows are multiplied by their shares.

    Args:
        cov: (B, D, D) of the prediction.
        step: the last.
        frame: its information.
        estimated: (B, D), shares of :func:`estimated_entries`.
    """
    count = frame.vector.shape[-1]
    free = estimated[:, :count].clamp(min=_FIXED)
    prior = cov[:, :, :count] * free.unsqueeze(1)  # (B, D, O)
    known = torch.bmm(prior, frame.matrix)
    return estimated.unsqueeze(-1) * torch.baddbmm(prior, known, step.cov, alpha=-1)


def updated_covariance(cov: Tensor, matrix: Tensor) -> Tensor:
    """Compute (P⁻¹ + Λ)⁻¹ without inverting P: L (I + Lᵀ Λ L)⁻¹ Lᵀ for P = L Lᵀ.

    Source: (J9).

    Args:
        cov: (B, O, O), P, positive definite.
        matrix: (B, O, O), Λ.
    """
    root = cholesky(cov)
    eye = identity(cov.shape[-1], cov.dtype, cov.device)
    factor = cholesky(torch.baddbmm(eye, torch.bmm(root.mT, matrix), root))
    half = solve_lower(factor, root.mT)
    return torch.bmm(half.mT, half)


def innovation_score(cov: Tensor, matrix: Tensor, vector: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the score Hᵀ S⁻¹ y (B, O) of the innovation and its variance, the diagonal of Hᵀ S⁻¹ H.

    Source: (J14). With P = L Lᵀ and I + Lᵀ Λ L = F Fᵀ, Hᵀ S⁻¹ [H, y] is [Λ, λ] - Λ L (F Fᵀ)⁻¹ Lᵀ [Λ, λ].

    Args:
        cov: (B, O, O), P, positive definite.
        matrix: (B, O, O), Λ.
        vector: (B, O), λ.
    """
    root = cholesky(cov)
    eye = identity(cov.shape[-1], cov.dtype, cov.device)
    seen = torch.bmm(root.mT, torch.cat([matrix, vector.unsqueeze(-1)], dim=-1))  # (B, O, O + 1)
    factor = cholesky(torch.baddbmm(eye, seen[:, :, :-1], root))
    white = solve_lower(factor, seen)
    known, pull = white[:, :, :-1], white[:, :, -1:]
    score = torch.baddbmm(vector.unsqueeze(-1), known.mT, pull, alpha=-1).squeeze(-1)
    return score, matrix.diagonal(dim1=1, dim2=2) - known.square().sum(1)


def posterior_covariance(cov: Tensor, matrix: Tensor, gain: Tensor) -> Tensor:
    """Compute the covariance after an update whose gain may have rows of zero.

    Source: (J10), the Joseph form, (I - K H) P (I - K H)ᵀ + K Q Kᵀ, with K H = G Λ and K Q Kᵀ = G Λ Gᵀ.

    Args:
        cov: (B, D, D) of the prediction.
        matrix: (B, O, O), Λ.
        gain: (B, D, O), G.
    """
    count = matrix.shape[-1]
    seen = torch.bmm(matrix, cov[:, :count])  # (B, O, D)
    inner = torch.baddbmm(matrix, seen[:, :, :count], matrix)
    less = torch.baddbmm(seen, inner, gain.mT, beta=2.0, alpha=-1)
    return symmetrise(torch.baddbmm(cov, gain, less, alpha=-1))  # the terms of (J10), of which two are equal


def wide_precision(like: Tensor) -> Tensor:
    """Return the precisions (B, 5) of the prior of pose and offset when a frame is judged alone."""
    return constant(tuple(std**-2 for std in _WIDE_PRIOR), like=like).expand(like.shape[0], -1)


def single_frame_std(matrix: Tensor) -> Tensor:
    """Compute the standard deviations (B, 5) of pose and offset by a frame alone, on a straight road.

    Args:
        matrix: (B, O, O), its information.
    """
    cov = inverse_spd(matrix[:, :NUM_STRAIGHT, :NUM_STRAIGHT] + wide_precision(matrix).diag_embed())
    return cov.diagonal(dim1=1, dim2=2).sqrt()


def estimated_entries(single_frame_std: Tensor, of_speed: Tensor, num_boundaries: int) -> Tensor:
    """Return the shares (B, D) by which entries are estimated: 1, or less of what is considered only.

    Args:
        single_frame_std: (B, 5) of :func:`single_frame_std`. Where the frame leaves roll open, roll, its
            derivatives and slow mean have 0.
        of_speed: (B,), that of the speed, see :func:`lanebev.estimation.joint.motion.road.speed_share`.
        num_boundaries: L.
    """
    others = constant(_all_but_roll(num_boundaries), single_frame_std)
    shares = torch.where(single_frame_std[:, ROLL, None] > UNSEEN[ROLL], others, 1.0)
    place = layout(num_boundaries).speed
    return torch.cat([shares[:, :place], of_speed.unsqueeze(-1), shares[:, place + 1 :]], dim=-1)


@lru_cache(maxsize=16)
def _all_but_roll(num_boundaries: int) -> tuple[float, ...]:
    """Return D numbers: 0 for roll, its derivatives and slow mean, else 1."""
    place = layout(num_boundaries)
    roll = place.chain(ROLL)
    return tuple(float(entry not in roll) for entry in range(place.size))


def boundary_deviation(mean: Tensor, frame: FrameInformation) -> Tensor:
    """Compute each boundary's deviation (B, L) m by this frame alone, the rest as in ``mean``; 0: unseen."""
    known = frame.matrix.diagonal(dim1=1, dim2=2)[:, NUM_COMMON:]
    own = mean[:, NUM_COMMON : NUM_COMMON + known.shape[-1]]
    moved = own + frame.vector[:, NUM_COMMON:] / known.clamp(min=_NO_INFORMATION)
    return torch.where(known > _NO_INFORMATION, moved, 0.0)


def agreement(frame: FrameInformation, moved: Tensor, seen: Observations) -> Tensor:
    """Compute each segment's inlier probability (B, N) by its own noise, at a state near the linearisation.

    The update's weights allow for the uncertainty of the prediction; these do not.

    Args:
        frame: linearised nearby.
        moved: (B, O), the state less that at which the frame was linearised.
        seen: what was observed.
    """
    jacobian = frame.residuals.jacobian
    common, own = moved[:, :NUM_COMMON], moved[:, NUM_COMMON:].gather(1, seen.boundary)
    change = by_ends(torch.bmm(common.unsqueeze(1), jacobian).squeeze(1))  # (B, 2, N)
    change = torch.addcmul(change, by_ends(jacobian[:, OFFSET]), own.unsqueeze(1))
    squared = squared_distance(frame.residuals.distance + change)
    variance = scaled_variance(seen.sigma, frame.scale)
    return inlier_weights(squared, frame.residuals.valid, variance, seen.focal)


def _predicted_variance(jacobian: Tensor, cov: Tensor, boundary: Tensor) -> Tensor:
    """Compute h P hᵀ of a segment's end points, their mean, (B, N) px².

    A row h has the derivatives g by the common entries and, by the deviation of its boundary k, that by the
    offset, g_o. So h P hᵀ is g P gᵀ + g_o (2 P_k g + P_kk g_o), with P_k the row of the deviation.

    Args:
        jacobian: (B, 12, M).
        cov: (B, O, O), P.
        boundary: (B, N), k.
    """
    common, by_own = cov[:, :NUM_COMMON, :NUM_COMMON], cov[:, NUM_COMMON:, :NUM_COMMON]
    own = cov.diagonal(dim1=1, dim2=2)[:, NUM_COMMON:, None] * constant(_OFFSET_ALONE, like=cov)
    spread = torch.bmm(common, jacobian).mul_(jacobian).sum(1)  # in place: a copy takes longer
    more = torch.bmm(torch.add(own, by_own, alpha=2.0), jacobian)  # (B, L, M)
    more = more.gather(1, per_end(boundary).unsqueeze(1)).squeeze(1)
    return by_ends(torch.addcmul(spread, more, jacobian[:, OFFSET])).mean(1)
