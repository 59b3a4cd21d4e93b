"""The pose of a single image, averaged over its readings.

Every reading (:mod:`lanebev.estimation.joint.readings`) is fitted with a deviation and a heading of its own
for each boundary, Gaussian about the road's, and weighted by its evidence (Laplace's approximation). Source:
Bayesian model averaging (Hoeting et al. 1999) with Occam's window (Madigan and Raftery 1994) and tempered
evidence, since no model is exactly right (Grünwald and van Ommen 2017).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import one_hot, softplus

from lanebev.batch import select_rows
from lanebev.estimation.checks import is_running
from lanebev.estimation.joint.layout import STEPS
from lanebev.estimation.joint.measurement import (
    HEIGHT,
    NUM_PARAMS,
    OFFSET,
    PITCH,
    ROLL,
    Observations,
    boundary_places,
    boundary_residuals,
    foot_rays,
    look,
    observations,
)
from lanebev.estimation.joint.readings import (
    ReadingConfig,
    Readings,
    log_prior,
    log_prior_of_half,
    readings,
)
from lanebev.estimation.joint.road import straight_log_odds, straight_or_bend
from lanebev.estimation.joint.road_curve import KNOT_SPACING
from lanebev.estimation.joint.robust import (
    anneal_scale,
    inlier_log_odds,
    inlier_weights,
    noise_scale,
    start_scale,
)
from lanebev.estimation.joint.single_frame import (
    FramePrior,
    linear_starts,
    spread_subset,
    student_log,
    student_weight,
)
from lanebev.estimation.joint.state import JointConfig
from lanebev.geometry.linalg import cholesky, inverse_spd, solve_spd
from lanebev.geometry.road import lane_width_covariance
from lanebev.observation.segments import LaneSegments
from lanebev.types import Calibration, Extrinsics

_START_STEPS, _STEPS = 6, 5  # Gauss-Newton steps of the start and of every reading
_SEGMENTS = 192  # that are fitted
_ANGLES = [PITCH, ROLL]
_KEEP = 3.0  # sigmas from the average within which the likeliest reading stands
_FARTHER = 0.5  # sigmas by which it may be farther from the prior than the average is
_POSE = slice(0, HEIGHT + 1)


class AveragedPose(NamedTuple):
    """A frame's pose over all readings.

    Attributes:
        mean: (B, 4) rad and m.
        covariance: (B, 4, 4), within the readings and between them.
        bounds_lane: (B, L) probability of each line that it bounds a lane.
    """

    mean: Tensor
    covariance: Tensor
    bounds_lane: Tensor


class _Model(NamedTuple):
    """R fits to compute: rows of observations and the assumptions of each.

    Attributes:
        seen: observations of R rows.
        member: (R, M, L) one-hot boundary of each end point.
        places: (R, L) m, of the boundaries from the ego lane's middle.
        std: (R, 2 L + 1) of their deviations (m), headings (rad), and of the road's vertical curvature (1/m).
        prior: prior of the frame.
    """

    seen: Observations
    member: Tensor
    places: Tensor
    std: Tensor
    prior: FramePrior


class _Linear(NamedTuple):
    """A fit linearised: distances (R, N, 2) px, Jacobian (R, 7 + 2 L + 1, M), validity (R, N)."""

    distance: Tensor
    jacobian: Tensor
    valid: Tensor


class _Fits(NamedTuple):
    """R fits: params (R, 7), own (R, 2 L + 1), covariance (R, 7, 7) of params, log evidence (R,)."""

    params: Tensor
    own: Tensor
    covariance: Tensor
    evidence: Tensor


def weigh_readings(
    calibration: Calibration,
    mean: Tensor,
    segments: LaneSegments,
    intrinsics: Tensor,
    lane_width: Tensor,
    cfg: JointConfig,
) -> Calibration:
    """Average the pose of every row that has started over all readings of its image.

    Args:
        calibration: calibration of the likeliest reading.
        mean: (B, D) of the filter's state with that frame.
        segments: segments of the frame, usable.
        intrinsics: (B, 3, 3) px.
        lane_width: (B, L-1) m.
        cfg: the numbers.

    Returns:
        the calibration; a segment is an inlier as far as its line bounds a lane.
    """
    seen = observations(segments, intrinsics)
    positions = boundary_places(lane_width, cfg.num_boundaries, mean)
    start = torch.cat([mean[:, : OFFSET + 2], mean[:, STEPS.start, None] / KNOT_SPACING], dim=-1)
    found = average_readings(start, seen, positions, cfg.prior, cfg.straight, cfg.bends, cfg.readings)
    scale = lane_width_covariance(found.mean[:, HEIGHT], cfg.lane_width_std / lane_width.mean(-1))
    begun = is_running(calibration.status)
    pose = calibration.extrinsics.stack()
    inliers = calibration.inliers * found.bounds_lane.gather(1, seen.boundary).to(pose)
    return calibration._replace(
        extrinsics=Extrinsics.unstack(select_rows(begun, found.mean.to(pose), pose)),
        covariance=select_rows(begun, (found.covariance + scale).to(pose), calibration.covariance),
        inliers=select_rows(begun, inliers, calibration.inliers),
    )


def average_readings(
    start: Tensor,
    seen: Observations,
    positions: Tensor,
    prior: FramePrior,
    straight: tuple[float, float],
    bends: float,
    cfg: ReadingConfig,
) -> AveragedPose:
    """Average a frame's pose over all readings.

    The mean uses the evidence itself. If the pose of ``start`` is within ``_KEEP`` sigmas of the mean, and no
    farther from the prior, it is kept instead, since averaging readings that agree only adds noise. The
    covariance about it uses the evidence to a power below 1, which keeps more readings.

    Args:
        start: (B, 7) parameters near the likeliest reading.
        seen: what was observed.
        positions: (B, L) m, of the boundaries from the ego lane's middle, by the lane widths.
        prior: prior of the frame.
        straight: 1/m and 1/m², sigmas of c0 and c1 of a straight road.
        bends: how probable a bend is; its sigmas are those of ``prior``.
        cfg: the numbers of the readings.
    """
    (batch, num), like = positions.shape, positions
    seen, places = spread_subset(seen, positions.gather(1, seen.boundary), _SEGMENTS)
    at_level = replace(prior, roll_steps=1)
    starts = torch.cat([start.unsqueeze(1), linear_starts(seen, places, at_level)], dim=1)  # (B, S, 7)
    ways = readings(num, cfg, like)
    kinds, count, tries = len(cfg.unequal), len(ways.kind), starts.shape[1]
    alike = Readings(*(part[:kinds] for part in ways))

    model = _model(seen, positions, alike, tries, prior)
    begun = _fit(starts.repeat(1, kinds, 1).flatten(0, 1), model, _START_STEPS)
    likeliest = begun.evidence.view(-1, tries).argmax(-1)
    best = likeliest + tries * torch.arange(batch * kinds, device=like.device)
    begin = begun.params[best].view(batch, kinds, -1)[:, ways.kind].flatten(0, 1)
    fits = _fit(begin, _model(seen, positions, ways, 1, prior), _STEPS)

    bend = prior.std(like)[OFFSET + 1 :]
    shape = (fits.params, fits.covariance, like.new_tensor(straight), bend, bends)
    params, covariance = straight_or_bend(*shape)
    evidence = (fits.evidence + softplus(straight_log_odds(*shape))).view(batch, count)
    there = ((seen.weight > 0).unsqueeze(-1) & one_hot(seen.boundary, num).bool()).any(1)  # (B, L)
    before, half = log_prior(ways, there, cfg), log_prior_of_half(there, cfg)

    pose, cov = params[:, _POSE].unflatten(0, (batch, count)), covariance[:, _POSE, _POSE]
    cov = cov.unflatten(0, (batch, count))
    likely, doubted = (window(power * evidence + before, cfg.least) for power in (1.0, cfg.information))
    mean, _ = mixture_moments(*_with_half(pose, cov, likely, prior, half, cfg.least))
    centre, spread = mixture_moments(*_with_half(pose, cov, doubted, prior, half, cfg.least))
    level = prior.mean(like)[_ANGLES]
    farther = (start[:, _ANGLES] - level).abs() - (mean[:, _ANGLES] - level).abs()
    farther = (farther / prior.std(like)[_ANGLES]).amax(-1)
    keep = (distance(start[:, _POSE] - centre, spread) < _KEEP) & (farther < _FARTHER)
    mean = select_rows(keep, start[:, _POSE], mean)
    apart = centre - mean
    wrong = likely @ ways.wrong.to(like)
    return AveragedPose(mean, spread + apart.unsqueeze(-1) * apart.unsqueeze(-2), 1 - wrong)


def window(log_weight: Tensor, least: float) -> Tensor:
    """Normalise weights (B, C) and leave out those below a share of the largest.

    Source: Occam's window (Madigan and Raftery 1994).
    """
    weight = log_weight.softmax(-1)
    weight = torch.where(weight < least * weight.amax(-1, keepdim=True), 0.0, weight)
    total: Tensor = weight / weight.sum(-1, keepdim=True)
    return total


def mixture_moments(mean: Tensor, cov: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Compute mean (B, P) and covariance (B, P, P) of a mixture of C Gaussians.

    Source: the law of total covariance: the mean of the covariances and the covariance of the means.

    Args:
        mean: (B, C, P).
        cov: (B, C, P, P).
        weight: (B, C), of sum 1.
    """
    total = (weight.unsqueeze(-1) * mean).sum(1)
    apart = mean - total.unsqueeze(1)
    spread = cov + apart.unsqueeze(-1) * apart.unsqueeze(-2)
    return total, (weight[..., None, None] * spread).sum(1)


def distance(apart: Tensor, cov: Tensor) -> Tensor:
    """Compute the Mahalanobis distance (B,) of deviations (B, P), per root of P."""
    squared = (apart * solve_spd(cov, apart.unsqueeze(-1)).squeeze(-1)).mean(-1)
    return squared.clamp(min=0.0).sqrt()


def _with_half(
    mean: Tensor, cov: Tensor, weight: Tensor, prior: FramePrior, odds: Tensor, least: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Add to (B, C) poses those at half the height, over lines that are half a lane apart.

    The image is the same: only the prior of the height and that of such lines decide.
    """
    height = mean[..., HEIGHT]
    away = (torch.stack([0.5 * height, height], dim=-1) - prior.height) / prior.height_std
    of_half, of_whole = student_log(away.square().unsqueeze(-1), prior.freedom).unbind(-1)
    half = (odds.to(mean).unsqueeze(-1) + of_half - of_whole).sigmoid()
    half = torch.where(half < least, 0.0, half)
    halve = mean.new_tensor([1.0, 1.0, 1.0, 0.5])
    return (
        torch.cat([mean, mean * halve], dim=1),
        torch.cat([cov, cov * halve.unsqueeze(-1) * halve], dim=1),
        torch.cat([weight * (1 - half), weight * half], dim=1),
    )


def _model(seen: Observations, positions: Tensor, ways: Readings, repeats: int, prior: FramePrior) -> _Model:
    """Make the rows of C readings and of as many repeats of each, for B frames."""
    num, ego = positions.shape[-1], positions.shape[-1] // 2 - 1
    width = positions[:, ego + 1] - positions[:, ego]
    places = positions.unsqueeze(1) + ways.shift * width[:, None, None]  # (B, C, L)
    own = [ways.place_std, ways.heading_std, ways.profile_std.unsqueeze(-1)]
    std = torch.cat(own, dim=-1).expand(len(positions), -1, -1)
    many = Observations(*(part.repeat_interleave(places.shape[1] * repeats, dim=0) for part in seen))
    return _Model(
        seen=many,
        member=one_hot(many.boundary, num).to(positions).repeat_interleave(2, dim=1),
        places=places.repeat_interleave(repeats, dim=1).flatten(0, 1),
        std=std.repeat_interleave(repeats, dim=1).flatten(0, 1),
        prior=prior,
    )


def _linearise(params: Tensor, own: Tensor, model: _Model) -> _Linear:
    """Linearise the distances by parameters, deviations, headings and the road's profile.

    A boundary at heading η is at x_k + η Z: to first order its end points move as the offset moves them, η Z.
    A road that falls by κ Z² / 2 is as far below the camera as if the height were greater by that. Z is that
    of the foot point: at the noisy end point the derivatives would correlate with the noise.
    """
    seen, num = model.seen, model.places.shape[-1]
    places = (model.places + own[:, :num]).gather(1, seen.boundary)
    sight = look(params, seen)
    feet = foot_rays(params, places, seen, sight)
    at = boundary_residuals(params, places, seen, feet=feet, sight=sight)
    by_place = at.jacobian[:, OFFSET].unsqueeze(-1) * model.member  # (R, M, L)
    by_heading = by_place * at.z.unsqueeze(-1)
    by_rest = torch.cat([by_heading, at.by_vertical_curvature.unsqueeze(-1)], dim=-1)
    moved = (by_rest @ own[:, num:].unsqueeze(-1)).squeeze(-1).unflatten(-1, (-1, 2))
    distance = at.distance + moved * at.valid.unsqueeze(-1)
    return _Linear(distance, torch.cat([at.jacobian, by_place.mT, by_rest.mT], dim=1), at.valid)


def _own_lines(params: Tensor, model: _Model) -> Tensor:
    """Fit all but the parameters, (R, 2 L + 1), all segments believed: no line begins as an outlier."""
    none = torch.zeros_like(model.std)
    at = _linearise(params, none, model)
    jacobian = at.jacobian[:, NUM_PARAMS:]
    weighted = jacobian * _per_end(at.valid * model.seen.weight / model.seen.sigma.square())
    information = weighted @ jacobian.mT + model.std.square().reciprocal().diag_embed()
    return -solve_spd(information, weighted @ at.distance.flatten(1).unsqueeze(-1)).squeeze(-1)


def _fit(params: Tensor, model: _Model, steps: int) -> _Fits:
    """Robust maximum a posteriori fit of every row, with its evidence."""
    seen, prior = model.seen, model.prior
    mean, std = prior.mean(params), prior.std(params)
    at_prior = torch.cat([mean.expand_as(params), torch.zeros_like(model.std)], dim=-1)
    own = _own_lines(params, model)
    at = _linearise(params, own, model)
    scale = start_scale(at.distance, seen.sigma, seen.weight * at.valid)
    for step in range(steps + 1):
        trust = inlier_weights(at.distance, at.valid, seen.sigma, scale, seen.focal) * seen.weight
        scale = anneal_scale(scale, noise_scale(at.distance, seen.sigma, trust))
        weighted = at.jacobian * _per_end(at.valid * trust / (seen.sigma * scale.unsqueeze(-1)).square())
        away = ((params - mean) / std).square()
        of_prior = student_weight(away, prior.freedom) / std.square()
        held = torch.cat([of_prior, model.std.square().reciprocal()], dim=-1)
        information = weighted @ at.jacobian.mT + held.diag_embed()
        if step == steps:
            break
        found = torch.cat([params, own], dim=-1)
        gradient = (weighted @ at.distance.flatten(1).unsqueeze(-1)).squeeze(-1) + held * (found - at_prior)
        change = solve_spd(information, gradient.unsqueeze(-1)).squeeze(-1)
        too_far = (change[:, :NUM_PARAMS] / std).abs().amax(-1, keepdim=True)
        found = found - change / too_far.clamp(min=1.0)
        params, own = found[:, :NUM_PARAMS], found[:, NUM_PARAMS:]
        height = params[:, HEIGHT : HEIGHT + 1].clamp(min=0.2)
        params = torch.cat([params[:, :HEIGHT], height, params[:, HEIGHT + 1 :]], dim=-1)
        at = _linearise(params, own, model)
    odds = inlier_log_odds(at.distance, seen.sigma, scale, seen.focal)
    likelihood = (seen.weight * torch.where(at.valid, softplus(odds), 0.0)).sum(-1)
    of_lines = -0.5 * (own / model.std).square().sum(-1) - model.std.log().sum(-1)
    evidence = likelihood + student_log(away, prior.freedom) + of_lines - _half_log_det(information)
    good = evidence.isfinite() & params.isfinite().all(-1)
    return _Fits(
        params=torch.where(good.unsqueeze(-1), params, mean),
        own=own,
        covariance=inverse_spd(information)[:, :NUM_PARAMS, :NUM_PARAMS],
        evidence=torch.where(good, evidence, -1e30),
    )


def _per_end(weight: Tensor) -> Tensor:
    """(R, N) of segments to (R, 1, M) of their end points."""
    return weight.repeat_interleave(2, dim=1).unsqueeze(1)


def _half_log_det(matrix: Tensor) -> Tensor:
    """Half the log determinant (R,) of positive definite matrices, scaled to a unit diagonal meanwhile."""
    size = matrix.diagonal(dim1=1, dim2=2).sqrt()
    factor = cholesky(matrix / (size.unsqueeze(-1) * size.unsqueeze(-2)))
    return (factor.diagonal(dim1=1, dim2=2).log() + size.log()).sum(-1)
