"""Joint fit of pose, lateral offset and curvature to all boundaries of one frame, without a start value.

A nonlinear fit from one start can end in a local minimum. So pitch and roll are searched on a grid, with a
robust linear fit of u = a_k V + u0 + b / V, V below the horizon, at each of its points. The best pitch for
every roll is the start of robust Gauss-Newton steps on perpendicular pixel distances, with an annealed noise
scale.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.checks import FEW_SEGMENTS, as_lane_width, check_segments, mask_invalid_rows
from lanebev.estimation.joint.frame.start_search import LAST_SCALE, linear_starts, spread_subset
from lanebev.estimation.joint.frame_prior import FramePrior, student_log, student_weight
from lanebev.estimation.joint.measurement.observations import (
    Observations,
    boundary_places,
    observations,
    per_end,
)
from lanebev.estimation.joint.measurement.residuals import (
    HEIGHT,
    NUM_PARAMS,
    OFFSET,
    boundary_residuals,
    normal_equations,
)
from lanebev.estimation.joint.measurement.robust import (
    anneal_scale,
    inlier_weights,
    log_likelihood,
    noise_scale,
    scaled_variance,
    squared_distance,
)
from lanebev.geometry.linalg import inverse_spd, solve_spd
from lanebev.geometry.precision import full_precision
from lanebev.observation.segments import LaneSegments
from lanebev.tensors import map_tensors, one_thread_if_small
from lanebev.types import NUM_BOUNDARIES, Extrinsics

_START_SEGMENTS = 96  # segments by which the start is chosen, at most
_OBSERVED = 0.2  # a parameter is observed if its sigma is below this fraction of the prior's


class SingleFrameFit(NamedTuple):
    """One frame's fit. Parameters: pitch, yaw, roll, height, offset, c0 (1/m), c1 (1/m²).

    Attributes:
        extrinsics: each (B,).
        offset: (B,) m, X of the ego lane's middle, positive right of the camera.
        curvature: (B, 2), c0 (1/m, positive to the right) and c1 (1/m²) of X(Z) = x_k + c0 Z²/2 + c1 Z³/6.
        covariance: (B, 7, 7) of all parameters, prior included, noise scaled to the residuals.
        by_vertical_curvature: (B, 7), change of the parameters per 1/m of vertical curvature of the road,
            which the fit takes as plane.
        inliers: (B, N) in [0, 1]; 0 for padding.
        scale: (B,) >= 1, factor by which residuals exceed the given sigmas.
        observed: (B, 4) bool, of pitch, yaw, roll, height: determined by the frame rather than by the prior,
            or by a prior that is as sharp as a frame could be.
        valid: (B,) bool: enough inlier segments, pitch and yaw observed.
    """

    extrinsics: Extrinsics
    offset: Tensor
    curvature: Tensor
    covariance: Tensor
    by_vertical_curvature: Tensor
    inliers: Tensor
    scale: Tensor
    observed: Tensor
    valid: Tensor

    def params(self) -> Tensor:
        """Return the vector of parameters (B, 7)."""
        return torch.cat([self.extrinsics.stack(), self.offset.unsqueeze(-1), self.curvature], dim=-1)


@full_precision
def fit_single_frame(
    segments: LaneSegments,
    intrinsics: Tensor,
    lane_width: float | Tensor = 3.7,
    prior: FramePrior | None = None,
    num_boundaries: int = NUM_BOUNDARIES,
    iterations: int = 8,
) -> SingleFrameFit:
    """Compute the robust maximum a posteriori fit of one frame, for each row of the batch.

    It works with 50 % gross outliers and 5 % wrong boundary indices. What the visible boundaries do not
    determine keeps the mean and covariance of the prior. It never raises on contents: a row without usable
    data has ``valid`` false and the prior's numbers.

    Only the likeliest reading is fitted, and ``covariance`` assumes that it is right:

    * lanes have exactly the width ``lane_width``, also the default. Height is proportional to it; for an
      uncertain width add :func:`~lanebev.geometry.road.lane_width_covariance` to ``covariance``. If two lanes
      differ by half a metre, roll is wrong by up to some degrees, many times its sigma;
    * every boundary bounds a lane and has the given index. What fits no lane is an outlier, but a kerb or an
      arrow in the place of a boundary is not recognised;
    * roll is observed with two lanes or more, height with one, pitch and yaw with two boundaries. The rest is
      that of the prior, see ``observed``.

    ``calibrate_still`` with the joint calibrator averages over other readings, and its sigmas contain the
    differences between them (:mod:`lanebev.estimation.joint.frame.averaging`).

    Args:
        segments: (B, N) line segments.
        intrinsics: (B, 3, 3).
        lane_width: float, (B,) or (B, L-1) m.
        prior: means, sigmas and search range; default :class:`FramePrior`.
        num_boundaries: L, the ego lane being between L/2 - 1 and L/2.
        iterations: Gauss-Newton steps of every start.

    Returns:
        The fit. Gradients flow through the last two Gauss-Newton steps, which are all of it at the optimum.

    Raises:
        ValueError: shapes that do not fit.
    """
    check_segments(segments, intrinsics)
    widths = as_lane_width(lane_width, intrinsics, num_boundaries)
    segments, intrinsics, widths = mask_invalid_rows(segments, intrinsics, widths, num_boundaries)
    with one_thread_if_small(segments.weight, FEW_SEGMENTS):
        seen = observations(segments, intrinsics)
        places = boundary_places(widths, num_boundaries, intrinsics).gather(1, seen.boundary)  # (B, N)
        return fit_observations(seen, places, prior or FramePrior(), iterations)


def fit_observations(
    seen: Observations, places: Tensor, prior: FramePrior, iterations: int = 8
) -> SingleFrameFit:
    """Fit as :func:`fit_single_frame`, from prepared segments and places (B, N) m of their boundaries."""
    fixed, fixed_places = map_tensors(Tensor.detach, seen), places.detach()
    fewer, fewer_places = spread_subset(fixed, fixed_places, _START_SEGMENTS)
    starts = linear_starts(fewer, fewer_places, prior)  # (B, S, 7)
    params, scale = _best_start(starts, fewer, fewer_places, prior, iterations)
    params, scale, _ = refine(params, scale, fixed_places, fixed, prior, iterations=3)
    params, scale, information = refine(params, scale, places, seen, prior, iterations=2)

    residuals = boundary_residuals(params, places, seen)
    squared, variance = squared_distance(residuals.distance), scaled_variance(seen.sigma, scale)
    trust = inlier_weights(squared, residuals.valid, variance, seen.focal)
    covariance = inverse_spd(information)
    precision = residuals.valid * trust * seen.weight / variance
    along = residuals.by_vertical_curvature * per_end(precision)
    by_vertical = covariance @ residuals.jacobian @ along.unsqueeze(-1)
    std = covariance.diagonal(dim1=-2, dim2=-1)[:, :OFFSET].sqrt()
    default = FramePrior().std(params)[:OFFSET]
    observed = std < _OBSERVED * torch.maximum(prior.std(params)[:OFFSET], default)
    support = (trust * seen.weight).sum(-1)
    valid = (support >= 2.5) & observed[:, :2].all(-1) & params.isfinite().all(-1)
    return SingleFrameFit(
        extrinsics=Extrinsics.unstack(params[:, :OFFSET]),
        offset=params[:, OFFSET],
        curvature=params[:, OFFSET + 1 :],
        covariance=covariance,
        by_vertical_curvature=by_vertical.squeeze(-1),
        inliers=torch.where(seen.weight > 0, trust, 0.0),
        scale=scale,
        observed=observed,
        valid=valid,
    )


def refine(
    params: Tensor,
    scale: Tensor,
    places: Tensor,
    seen: Observations,
    prior: FramePrior,
    iterations: int,
    blur: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Take reweighted Gauss-Newton steps on perpendicular distances; the noise scale falls by half at most.

    Args:
        params: (B, 7) start.
        scale: (B,) noise scale to start with.
        places: (B, N) m, see :func:`boundary_residuals`.
        seen: what was observed.
        prior: prior.
        iterations: number of steps.
        blur: (B,) px or None, of a start that is not good yet: added to every segment's noise, sharp or
            vague, and halved each step.

    Returns:
        params (B, 7), scale (B,), and the information matrix (B, 7, 7) at the last step.
    """
    mean, precision = prior.mean(params), prior.std(params).square().reciprocal()
    largest_step = prior.std(params)
    focal = seen.focal
    blur = torch.zeros_like(focal) if blur is None else blur
    information = precision.diag().expand(*params.shape, NUM_PARAMS)  # overwritten unless iterations == 0
    # In one function: with those of the readings (reweigh, above_road, FramePrior.precision) the joint
    # calibrator could not be compiled (torch 2.13).
    for _ in range(iterations):
        residuals = boundary_residuals(params, places, seen)
        blurred = scaled_variance(seen.sigma, scale) + blur.square().unsqueeze(-1)
        squared = squared_distance(residuals.distance)
        trust = inlier_weights(squared, residuals.valid, blurred, focal) * seen.weight
        fitted = noise_scale(squared, seen.sigma, trust)
        scale = anneal_scale(scale, fitted)
        by_noise = trust / (scaled_variance(seen.sigma, scale) + blur.square().unsqueeze(-1))
        blur = 0.5 * blur
        information, gradient = normal_equations(
            residuals.jacobian, residuals.distance, by_noise * residuals.valid
        )
        held = precision * student_weight((params - mean).square() * precision, prior.freedom)
        information = information + held.diag_embed()
        gradient = gradient + held * (params - mean)
        step = solve_spd(information, gradient.unsqueeze(-1)).squeeze(-1)
        params = params - torch.maximum(torch.minimum(step, largest_step), -largest_step)
        height = params[:, HEIGHT : HEIGHT + 1].clamp(min=0.2)
        params = torch.cat([params[:, :HEIGHT], height, params[:, HEIGHT + 1 :]], dim=-1)
    return params, scale, information


def _best_start(
    starts: Tensor, seen: Observations, places: Tensor, prior: FramePrior, iterations: int
) -> tuple[Tensor, Tensor]:
    """Refine (B, S, 7) starts and keep the likeliest: (B, 7), and its noise scale (B,)."""
    batch, count, _ = starts.shape
    many = Observations(*(tensor.repeat_interleave(count, dim=0) for tensor in seen))
    many_places = places.repeat_interleave(count, dim=0)
    focal = many.focal
    sigma = (many.sigma * many.weight).sum(-1) / many.weight.sum(-1).clamp(min=1e-3)
    scale = (LAST_SCALE * focal / sigma.clamp(min=1e-3)).clamp(min=1.0)
    blur = LAST_SCALE * focal
    params, scale, _ = refine(starts.flatten(0, 1), scale, many_places, many, prior, iterations, blur)
    residuals = boundary_residuals(params, many_places, many)
    squared = squared_distance(residuals.distance)
    variance = scaled_variance(many.sigma, scale)
    score = log_likelihood(squared, residuals.valid, many.weight, variance, focal)
    away = (params - prior.mean(params)) / prior.std(params)
    score = score + student_log(away.square(), prior.freedom)
    score = torch.where(params.isfinite().all(-1), score, -torch.inf)
    best = score.view(batch, count).argmax(-1) + count * torch.arange(batch, device=score.device)
    return params[best], scale[best]
