"""Robust fits of an image's readings, each with its own deviations and headings of the boundaries."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from lanebev.estimation.joint.frame.readings import Readings
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.joint.measurement.observations import Observations, by_ends, ego_lane_width, per_end
from lanebev.estimation.joint.measurement.residuals import (
    NUM_PARAMS,
    OFFSET,
    above_road,
    boundary_residuals,
    foot_points,
    look,
    normal_equations,
)
from lanebev.estimation.joint.measurement.robust import (
    log_likelihood,
    reweigh,
    scaled_variance,
    squared_distance,
    start_scale,
)
from lanebev.geometry.linalg import cholesky, inverse_spd, solve_spd


class Model(NamedTuple):
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


class Linear(NamedTuple):
    """A fit linearised: distances (R, 2, N) px, Jacobian (R, 7 + 2 L + 1, M), validity (R, N)."""

    distance: Tensor
    jacobian: Tensor
    valid: Tensor


class Fits(NamedTuple):
    """R fits: params (R, 7), own (R, 2 L + 1), covariance (R, 7, 7) of params, log evidence (R,)."""

    params: Tensor
    own: Tensor
    covariance: Tensor
    evidence: Tensor


def reading_model(
    seen: Observations, positions: Tensor, ways: Readings, repeats: int, prior: FramePrior
) -> Model:
    """Make the rows of C readings and of as many repeats of each, for B frames."""
    places = positions.unsqueeze(1) + ways.shift * ego_lane_width(positions)[:, None, None]  # (B, C, L)
    own = [ways.deviation_std, ways.heading_std, ways.vertical_curvature_std.unsqueeze(-1)]
    std = torch.cat(own, dim=-1).expand(len(positions), -1, -1)
    many = seen.repeated(places.shape[1] * repeats)
    return Model(
        seen=many,
        member=one_hot(per_end(many.boundary), positions.shape[-1]).to(positions),
        places=places.repeat_interleave(repeats, dim=1).flatten(0, 1),
        std=std.repeat_interleave(repeats, dim=1).flatten(0, 1),
        prior=prior,
    )


def linearise(params: Tensor, own: Tensor, model: Model) -> Linear:
    """Linearise the distances by parameters, deviations, headings and the road's profile.

    Source: (J23).

    A boundary at heading η is at x_k + η Z: to first order its end points move as the offset moves them, η Z.
    A road that falls by κ Z² / 2 is as far below the camera as if the height were greater by that. Z is that
    of the foot point: at the noisy end point the derivatives would correlate with the noise.
    """
    seen, num = model.seen, model.places.shape[-1]
    places = (model.places + own[:, :num]).gather(1, seen.boundary)
    sight = look(params, seen)
    feet = foot_points(params, places, seen, sight)
    at = boundary_residuals(params, places, seen, feet=feet, sight=sight)
    by_place = at.jacobian[:, OFFSET].unsqueeze(-1) * model.member  # (R, M, L)
    by_heading = by_place * at.z.unsqueeze(-1)
    by_rest = torch.cat([by_heading, at.by_vertical_curvature.unsqueeze(-1)], dim=-1)
    moved = by_ends((by_rest @ own[:, num:].unsqueeze(-1)).squeeze(-1))
    distance = at.distance + moved * at.valid.unsqueeze(-2)
    return Linear(distance, torch.cat([at.jacobian, by_place.mT, by_rest.mT], dim=1), at.valid)


def _own_lines(params: Tensor, model: Model) -> Tensor:
    """Fit all but the parameters, (R, 2 L + 1), all segments believed: no line begins as an outlier."""
    none = torch.zeros_like(model.std)
    at = linearise(params, none, model)
    jacobian = at.jacobian[:, NUM_PARAMS:]
    weight = at.valid * model.seen.weight / model.seen.sigma.square()
    information, gradient = normal_equations(jacobian, at.distance, weight)
    information = information + model.std.square().reciprocal().diag_embed()
    return -solve_spd(information, gradient.unsqueeze(-1)).squeeze(-1)


def fit_readings(params: Tensor, model: Model, steps: int) -> Fits:
    """Compute the robust maximum a posteriori fit of every row, with its evidence."""
    seen, prior = model.seen, model.prior
    std = prior.std(params)
    own = _own_lines(params, model)
    at = linearise(params, own, model)
    scale = start_scale(at.distance, seen.sigma, seen.weight * at.valid)
    for _ in range(steps):
        information, gradient, scale = _posterior_equations(params, own, at, scale, model)
        change = solve_spd(information, gradient.unsqueeze(-1)).squeeze(-1)
        too_far = (change[:, :NUM_PARAMS] / std).abs().amax(-1, keepdim=True)
        found = torch.cat([params, own], dim=-1) - change / too_far.clamp(min=1.0)
        params, own = above_road(found[:, :NUM_PARAMS]), found[:, NUM_PARAMS:]
        at = linearise(params, own, model)
    information, _, scale = _posterior_equations(params, own, at, scale, model)
    squared, variance = squared_distance(at.distance), scaled_variance(seen.sigma, scale)
    likelihood = log_likelihood(squared, at.valid, seen.weight, variance, seen.focal)
    of_lines = -0.5 * (own / model.std).square().sum(-1) - model.std.log().sum(-1)
    evidence = likelihood + prior.log_density(params) + of_lines - _half_log_det(information)
    good = evidence.isfinite() & params.isfinite().all(-1)
    return Fits(
        params=torch.where(good.unsqueeze(-1), params, prior.mean(params)),
        own=own,
        covariance=inverse_spd(information)[:, :NUM_PARAMS, :NUM_PARAMS],
        evidence=torch.where(good, evidence, -1e30),
    )


def _posterior_equations(
    params: Tensor, own: Tensor, at: Linear, scale: Tensor, model: Model
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the reweighted information and gradient of parameters and lines, priors included.

    Returns:
        (R, 7 + 2 L + 1, 7 + 2 L + 1), (R, 7 + 2 L + 1), and (R,) noise scale.
    """
    seen, prior = model.seen, model.prior
    trust, scale = reweigh(squared_distance(at.distance), at.valid, seen, scale)
    weight = at.valid * trust * seen.weight / scaled_variance(seen.sigma, scale)
    information, gradient = normal_equations(at.jacobian, at.distance, weight)
    precision = torch.cat([prior.precision(params), model.std.square().reciprocal()], dim=-1)
    away = torch.cat([params - prior.mean(params), own], dim=-1)
    return information + precision.diag_embed(), gradient + precision * away, scale


def _half_log_det(matrix: Tensor) -> Tensor:
    """Compute half the log determinant (R,) of positive definite matrices, scaled to a unit diagonal."""
    size = matrix.diagonal(dim1=1, dim2=2).sqrt()
    factor = cholesky(matrix / (size.unsqueeze(-1) * size.unsqueeze(-2)))
    return (factor.diagonal(dim1=1, dim2=2).log() + size.log()).sum(-1)
