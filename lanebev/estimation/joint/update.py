"""One frame's update of the joint filter: lane changes, robust iteration, and noise that follows evidence."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.estimation import kalman
from lanebev.estimation.joint.dynamics import MEANS, NUM_COMMON, NUM_POSE, NUM_SEEN, RATES
from lanebev.estimation.joint.measurement import (
    CURVATURE,
    NUM_STRAIGHT,
    OFFSET,
    ROLL,
    Observations,
    boundary_distances,
    boundary_residuals,
)
from lanebev.estimation.joint.robust import inlier_weights, log_likelihood, lowered, noise_scale, start_scale
from lanebev.estimation.joint.single_frame import normal_equations
from lanebev.geometry.linalg import inverse_spd

_LOOSE = (0.3, 0.3, 0.3, 1.0, 2.0)  # rad, m: sigmas before a frame, to ask what it alone determines
_KNOWN = 1e-4  # share of its sigma that roll keeps where it is held: as good as known, yet not singular
_LITTLE = 1e-3  # 1/m², information about a boundary's place that is none
_SHARED = 0.2  # sigmas by which all end points of a boundary may be off alike
UNSEEN = (0.01, 0.01, 0.01, 0.3)
"""Sigmas (rad, m) of the pose from one frame up to which the frame determines it; beyond, roll is held."""


class Update(NamedTuple):
    """What one frame made of a prediction.

    Attributes:
        mean: (B, D); cov: (B, D, D).
        trust: (B, N) in [0, 1].
        scale: (B,) >= 1, of the noise.
        info: (B, D, D) of the frame's observations.
        score: (B, D), P⁻¹ (best - predicted): the pull of the observations on the prediction.
        best_cov: (B, D, D), were roll known where it is held.
        alone: (B, 5) sigmas of pitch, yaw, roll, height and offset from this frame alone.
        mimicry: (B, 4, L) change of the pose fitted to this frame by a metre that a boundary is out of place.
        apart: (B, L) m, how far out of place this frame's believed end points have each boundary; 0: none.
    """

    mean: Tensor
    cov: Tensor
    trust: Tensor
    scale: Tensor
    info: Tensor
    score: Tensor
    best_cov: Tensor
    alone: Tensor
    mimicry: Tensor
    apart: Tensor


def iterate(
    predicted: Tensor,
    cov: Tensor,
    start: Tensor,
    scale: Tensor,
    places: Tensor,
    seen: Observations,
    phase: Tensor,
    iterations: int,
    doubt: Tensor,
) -> Update:
    """Iterated robust update: relinearised and reweighted at each step, the prediction held as it was.

    Source: Bell and Cathey 1993, the iterated Kalman filter as Gauss-Newton; Schmidt 1966 for the roll that
    a frame does not determine: it is considered, not estimated. On one lane roll and offset are the same to
    first order, and what sets them apart is a difference of second order that linearised updates overrate.
    The rest is estimated as if roll were known, so that pitch and yaw do not depend on it.

    Args:
        predicted: (B, D) mean.
        cov: (B, D, D) of the prediction.
        start: (B, D), where to linearise first.
        scale: (B,) noise scale to start with.
        places: (B, N) m, X of each segment's boundary at Z = 0 less offset and deviation.
        seen: what was observed.
        phase: (B,) m, of the knots.
        iterations: steps.
        doubt: (B, D, D), covariance of ``start``: what lies within it is no outlier yet.

    Returns:
        mean and covariance, weights, noise scale and what the observations said.
    """
    num_boundaries = predicted.shape[-1] - NUM_COMMON
    member = torch.nn.functional.one_hot(seen.boundary, num_boundaries).mT.to(places)  # (B, L, N)
    focal = seen.intrinsics[:, 0, 0]
    mean = start
    for _ in range(iterations):
        own = mean[:, NUM_COMMON:].gather(1, seen.boundary)  # (B, N) m
        residuals = boundary_residuals(mean[:, :NUM_SEEN], places + own, seen, phase)
        there = seen.weight * residuals.valid
        by_deviation = member.repeat_interleave(2, dim=-1) * residuals.jacobian[:, OFFSET, None]
        jacobian = torch.cat([residuals.jacobian, by_deviation], dim=1)  # (B, P + L, 2N)
        unsure = _unsure(jacobian, doubt) / scale.unsqueeze(-1).square()
        gate = (seen.sigma.square() + unsure).sqrt()
        trust = inlier_weights(residuals.distance, residuals.valid, gate, scale, focal)
        fitted = noise_scale(residuals.distance, seen.sigma, trust * seen.weight)
        scale = lowered(scale, fitted)
        by_noise = trust * there / (seen.sigma * scale.unsqueeze(-1)).square()
        info, pull = _information(jacobian, residuals.distance, by_noise)
        known = info.diagonal(dim1=1, dim2=2)[:, NUM_COMMON:]
        apart = mean[:, NUM_COMMON:] + pull[:, NUM_COMMON:] / known.clamp(min=_LITTLE)
        apart = torch.where(known > _LITTLE, apart, 0.0)
        pull = pull + (info @ (mean - predicted).unsqueeze(-1)).squeeze(-1)
        alone, mimicry = _alone(info)
        estimated = _estimated(alone, mean)
        free = estimated.clamp(min=_KNOWN)
        best, posterior = kalman.update(predicted, free.unsqueeze(-1) * cov * free.unsqueeze(-2), info, pull)
        mean = predicted + estimated * (best - predicted)
        doubt = posterior
    score = pull - (info @ (best - predicted).unsqueeze(-1)).squeeze(-1)
    after = _consider(cov, posterior, info, estimated)
    return Update(mean, after, trust, scale, info, score, posterior, alone, mimicry, apart)


def agreement(mean: Tensor, scale: Tensor, places: Tensor, seen: Observations, phase: Tensor) -> Tensor:
    """(B, N) in [0, 1], how far each segment lies where the state has it, by its own noise alone.

    An update trusts what the prediction, unsure itself, does not contradict; its result is to be judged by
    what then is left. Arguments as :func:`iterate`, ``mean`` and ``scale`` after the update.
    """
    own = mean[:, NUM_COMMON:].gather(1, seen.boundary)
    distance, valid = boundary_distances(mean[:, :NUM_SEEN], (places + own).unsqueeze(0), seen, phase)
    return inlier_weights(distance[0], valid, seen.sigma, scale, seen.intrinsics[:, 0, 0])


def _consider(cov: Tensor, posterior: Tensor, info: Tensor, estimated: Tensor) -> Tensor:
    """Covariance after an update that leaves the mean's entries where they are not estimated.

    Source: Schmidt 1966; the Joseph form for a gain with rows set to zero.
    """
    gain = estimated.unsqueeze(-1) * posterior
    keep = torch.eye(cov.shape[-1], dtype=cov.dtype, device=cov.device) - gain @ info
    return kalman.symmetrise(keep @ cov @ keep.mT + gain @ info @ gain.mT)


def _alone(info: Tensor) -> tuple[Tensor, Tensor]:
    """Of a straight road's five parameters, from this frame's information (B, D, D) alone.

    Returns:
        (B, 5) sigmas, and (B, 4, L) change of the pose by a metre that a boundary is out of place.
    """
    loose = info.new_tensor(_LOOSE)
    scaled = loose.unsqueeze(-1) * info[:, :NUM_STRAIGHT, :NUM_STRAIGHT] * loose
    eye = torch.eye(NUM_STRAIGHT, dtype=info.dtype, device=info.device)
    cov = loose.unsqueeze(-1) * inverse_spd(scaled + eye) * loose
    return cov.diagonal(dim1=1, dim2=2).sqrt(), cov[:, :NUM_POSE] @ info[:, :NUM_STRAIGHT, NUM_COMMON:]


def _estimated(alone: Tensor, mean: Tensor) -> Tensor:
    """(B, D): 0 for roll, its rate and its slow mean where the frame does not determine roll, else 1."""
    index = torch.arange(mean.shape[-1], device=mean.device)
    about_roll = (index == ROLL) | (index == RATES.start + ROLL) | (index == MEANS.start + ROLL)
    return torch.where(about_roll & (alone[:, ROLL, None] > UNSEEN[ROLL]), 0.0, torch.ones_like(mean))


def _information(jacobian: Tensor, distance: Tensor, by_noise: Tensor) -> tuple[Tensor, Tensor]:
    """Information of a frame in the whole state (B, D, D) and (B, D), rates and means left at zero."""
    info, pull = normal_equations(jacobian, distance, by_noise)
    place = _observable(info.shape[-1], info.device)
    size = info.shape[-1] + NUM_COMMON - NUM_SEEN
    whole = info.new_zeros(info.shape[0], size, info.shape[-1]).index_copy(1, place, info)
    whole = info.new_zeros(info.shape[0], size, size).index_copy(2, place, whole)
    return whole, info.new_zeros(info.shape[0], size).index_copy(1, place, -pull)


def _unsure(jacobian: Tensor, cov: Tensor) -> Tensor:
    """(B, N) px², h P hᵀ of a segment's end points, their mean, for (B, P + L, 2N) and (B, D, D)."""
    place = _observable(jacobian.shape[1], cov.device)
    seen = cov.index_select(1, place).index_select(2, place)
    variance: Tensor = ((seen @ jacobian) * jacobian).sum(1).unflatten(-1, (-1, 2)).mean(-1)
    return variance


def _observable(count: int, device: torch.device) -> Tensor:
    """State entries that segments depend on, (P + L,): all but rates and slow means."""
    own = range(NUM_COMMON, NUM_COMMON + count - NUM_SEEN)
    return torch.tensor([*range(NUM_SEEN), *own], device=device)


def evidence_index(num_boundaries: int, device: torch.device) -> Tensor:
    """State entries whose motion is put in question: pose, shape, deviations."""
    first = [*range(NUM_POSE), *range(CURVATURE, NUM_SEEN)]
    last = range(NUM_COMMON, NUM_COMMON + num_boundaries)
    return torch.tensor([*first, *last], device=device)


def surprise(update: Update, index: Tensor, count: Tensor) -> Tensor:
    """Normalised score of single state entries: N(0, 1) each if the motion is as assumed.

    The score u = P⁻¹ (mean - predicted) has covariance Λ - Λ P⁺ Λ. It is the score test (Rao 1948) for
    more process noise in that entry. Detectors err alike along a boundary, so n end points say no more of
    its place than 1 / (1 / n + ``_SHARED``²) do.

    Args:
        update: of the frame.
        index: (M,) entries, the L deviations last.
        count: (B, L) end points that each boundary was seen with.

    Returns:
        (B, M); 0 where the observations say nothing of an entry.
    """
    seen = update.info - update.info @ update.best_cov @ update.info
    variance = seen.diagonal(dim1=-2, dim2=-1)[:, index]
    known = variance > 1e-3 * update.info.diagonal(dim1=-2, dim2=-1)[:, index]
    shared = torch.ones_like(variance)
    shared[:, -count.shape[-1] :] += _SHARED**2 * count
    variance = variance * shared
    known = known & (variance > 0)
    return torch.where(known, update.score[:, index] * torch.where(known, variance, 1.0).rsqrt(), 0.0)


def best_shift(
    mean: Tensor, positions: Tensor, seen: Observations, phase: Tensor, lane_width: Tensor
) -> tuple[Tensor, Tensor]:
    """Lanes by which the boundary indices moved since the prediction: -1, 0 or 1.

    A shift must explain the frame far better than none: the camera crossed a line, or the detector
    numbers the boundaries anew.

    Args:
        mean: (B, D) predicted.
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        seen: what was observed.
        phase: (B,) m, of the knots.
        lane_width: (B,) m, of the ego lane.

    Returns:
        shift (B,) in the dtype of ``mean``, and (B,) noise scale of the frame's residuals after it.
    """
    focal = seen.intrinsics[:, 0, 0]
    places = (positions + mean[:, NUM_COMMON:]).gather(1, seen.boundary)
    shifts = mean.new_tensor([0.0, -1.0, 1.0])
    moved = places + (shifts[:, None] * lane_width)[:, :, None]  # (3, B, N)
    distance, valid = boundary_distances(mean[:, :NUM_SEEN], moved, seen, phase)
    weight = seen.weight * valid
    scales = torch.stack([start_scale(each, seen.sigma, weight) for each in distance])  # (3, B)
    scores = log_likelihood(distance, valid, weight, seen.sigma, scales.amin(0), focal)  # (3, B)
    clear = scores[1:].amax(0) > 2.0 * scores[0] + 10.0
    best = torch.where(clear, 1 + scores[1:].argmax(0), 0)  # (B,)
    return shifts[best], scales.gather(0, best.unsqueeze(0)).squeeze(0)
