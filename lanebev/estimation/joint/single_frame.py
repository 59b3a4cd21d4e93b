"""Joint fit of pose, lateral offset and curvature to all boundaries of one frame, without a start value.

A nonlinear fit from one start can end in a local minimum. So pitch and roll are searched on a grid, with a
robust linear fit of u = a_k V + u0 + b / V, V below the horizon, at each of its points. The best pitch for
every roll is the start of robust Gauss-Newton steps on perpendicular pixel distances, with an annealed noise
scale.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.checks import as_lane_width, check_segments, mask_invalid_rows
from lanebev.estimation.joint.measurement import (
    HEIGHT,
    NUM_PARAMS,
    OFFSET,
    Observations,
    boundary_places,
    boundary_residuals,
    observations,
)
from lanebev.estimation.joint.robust import anneal_scale, inlier_weights, log_likelihood, noise_scale
from lanebev.geometry.linalg import inverse_spd, solve_spd
from lanebev.geometry.precision import full_precision
from lanebev.geometry.rotation import pitch_yaw_roll, road_from_cam_and_roll
from lanebev.observation.segments import LaneSegments
from lanebev.tensors import constant
from lanebev.types import NUM_BOUNDARIES, Extrinsics, map_tensors

_ANNEALING = (0.1, 0.06, 0.035, 0.02, 0.02)  # scales of the linear fits, of the focal length
_BODY_STD = (0.003, 0.015, 0.008, 0.03)  # rad, rad, rad, m of a frame's pose about the mount
_MOUNT_FREEDOM = 30.0  # degrees of freedom of a frame's pose about a mount that is known
_OBSERVED = 0.2  # a parameter is observed if its sigma fell below this part of the prior's


@dataclass(frozen=True)
class FramePrior:
    """Prior of a single frame, as Student's t distributions, and the start of the search.

    The heavy tails allow a camera rolled by 20 deg. The prior matters only for what the observations leave
    open (roll on one lane, all but two numbers on one boundary). About a known mount it is nearly Gaussian: a
    vehicle's body does not lean by many of its standard deviations.

    Attributes:
        pitch, yaw, roll: means, rad.
        height: mean, m.
        pitch_std, yaw_std, roll_std: standard deviations, rad.
        height_std: standard deviation, m.
        offset_std: standard deviation of the ego lane's middle from the camera, m.
        curvature_std: standard deviation of c0, 1/m.
        curvature_rate_std: standard deviation of c1, 1/m².
        freedom: degrees of freedom of all of them.
        pitch_range, roll_range: half widths of the search about the means, rad.
        pitch_steps, roll_steps: number of values searched in each; 1 is the mean alone.
    """

    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0
    height: float = 1.5
    pitch_std: float = 0.12
    yaw_std: float = 0.15
    roll_std: float = 0.05
    height_std: float = 0.5
    offset_std: float = 1.5
    curvature_std: float = 2e-3
    curvature_rate_std: float = 2e-5
    freedom: float = 4.0
    pitch_range: float = 0.24
    roll_range: float = 0.4
    pitch_steps: int = 13
    roll_steps: int = 9

    def __post_init__(self) -> None:
        for part in fields(self):
            value = getattr(self, part.name)
            if not math.isfinite(value):
                raise ValueError(f"{part.name}: expected a finite number, got {value}")
            if part.name.endswith(("_std", "freedom")) and value <= 0:
                raise ValueError(f"{part.name}: expected more than 0, got {value}")
            if part.name.endswith("_steps") and value < 1:
                raise ValueError(f"{part.name}: expected at least 1, got {value}")
        if self.height <= 0:
            raise ValueError(f"height: expected more than 0 m, got {self.height}")

    def mean(self, like: Tensor) -> Tensor:
        """Return the means (7,), in the order of ``measurement``."""
        return constant((self.pitch, self.yaw, self.roll, self.height, 0.0, 0.0, 0.0), like=like)

    def std(self, like: Tensor) -> Tensor:
        """(7,) in the order of ``joint_model``."""
        angles = (self.pitch_std, self.yaw_std, self.roll_std)
        shape = (self.curvature_std, self.curvature_rate_std)
        return constant((*angles, self.height_std, self.offset_std, *shape), like=like)


def prior_of_mount(pose: Sequence[float], std: Sequence[float]) -> FramePrior:
    """Make the prior of a frame from the camera's mount.

    ``_BODY_STD`` is added to the mount's own standard deviations, because the vehicle's body moves on its
    suspension, has a heading in its lane and stands on a road with a crossfall. The range of the search
    follows the prior.

    Args:
        pose: pitch, yaw, roll (rad) and height (m) of the mount.
        std: their standard deviations; infinite for unknown axes, whose prior is that without a mount.
    """
    usual = FramePrior()
    names = ("pitch", "yaw", "roll", "height")
    known = [name for name, sigma in zip(names, std, strict=True) if math.isfinite(sigma)]
    means = {name: value for name, value in zip(names, pose, strict=True) if name in known}
    wide = zip(names, std, _BODY_STD, strict=True)
    spread = {f"{name}_std": math.hypot(sigma, body) for name, sigma, body in wide if name in known}
    search = {
        f"{name}_range": min(3.0 * spread[f"{name}_std"], getattr(usual, f"{name}_range"))
        for name in ("pitch", "roll")
        if name in known
    }
    freedom = {"freedom": _MOUNT_FREEDOM} if known else {}
    changes: dict[str, Any] = {**means, **spread, **search, **freedom}
    return replace(usual, **changes)


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
        """(B, 7) vector of parameters."""
        return torch.cat([self.extrinsics.stack(), self.offset.unsqueeze(-1), self.curvature], dim=-1)


@full_precision
def fit_single_frame(
    segments: LaneSegments,
    intrinsics: Tensor,
    lane_width: float | Tensor = 3.7,
    prior: FramePrior | None = None,
    num_boundaries: int = NUM_BOUNDARIES,
    start_segments: int = 96,
    iterations: int = 8,
) -> SingleFrameFit:
    """Compute the robust maximum a posteriori fit of one frame, for each row of the batch.

    It works with 50 % gross outliers and 5 % wrong boundary indices. What the visible boundaries do not
    determine keeps the mean and covariance of the prior. It never raises on contents: a row without usable
    data has ``valid`` false and the prior's numbers.

    Only the likeliest reading is fitted, and ``covariance`` assumes that it is right:

    * lanes have the width ``lane_width``. Height is proportional to it. If two lanes differ by half a metre,
      roll is wrong by up to some degrees, many times its sigma;
    * every boundary bounds a lane and has the given index. What fits no lane is an outlier, but a kerb or an
      arrow in the place of a boundary is not recognised;
    * roll is observed with two lanes or more, height with one, pitch and yaw with two boundaries. The rest is
      that of the prior, see ``observed``.

    ``calibrate_still`` with the joint calibrator averages over other readings, and its sigmas contain the
    differences between them (:mod:`lanebev.estimation.joint.averaging`).

    Args:
        segments: (B, N) line segments.
        intrinsics: (B, 3, 3).
        lane_width: float, (B,) or (B, L-1) m.
        prior: means, sigmas and search range; default :class:`FramePrior`.
        num_boundaries: L, the ego lane being between L/2 - 1 and L/2.
        start_segments: segments used to choose the start.
        iterations: Gauss-Newton steps of every start.

    Returns:
        The fit. Gradients flow through the last two Gauss-Newton steps, which are all of it at the optimum.

    Raises:
        ValueError: shapes that do not fit.
    """
    check_segments(segments, intrinsics)
    widths = as_lane_width(lane_width, intrinsics, num_boundaries)
    segments, intrinsics, widths = mask_invalid_rows(segments, intrinsics, widths, num_boundaries)
    seen = observations(segments, intrinsics)
    places = boundary_places(widths, num_boundaries, intrinsics).gather(1, seen.boundary)  # (B, N)
    return fit_observations(seen, places, prior or FramePrior(), start_segments, iterations)


def fit_observations(
    seen: Observations, places: Tensor, prior: FramePrior, start_segments: int = 96, iterations: int = 8
) -> SingleFrameFit:
    """As :func:`fit_single_frame`, of segments made ready and places (B, N) of their boundaries, m."""
    fixed, fixed_places = map_tensors(Tensor.detach, seen), places.detach()
    fewer, fewer_places = spread_subset(fixed, fixed_places, start_segments)
    starts = linear_starts(fewer, fewer_places, prior)  # (B, S, 7)
    params, scale = _best_start(starts, fewer, fewer_places, prior, iterations)
    params, scale, _ = refine(params, scale, fixed_places, fixed, prior, iterations=3)
    params, scale, information = refine(params, scale, places, seen, prior, iterations=2)

    residuals = boundary_residuals(params, places, seen)
    trust = inlier_weights(residuals.distance, residuals.valid, seen.sigma, scale, seen.focal)
    covariance = inverse_spd(information)
    precision = residuals.valid * trust * seen.weight / (seen.sigma * scale.unsqueeze(-1)).square()
    along = residuals.by_vertical_curvature * precision.repeat_interleave(2, dim=1)
    by_vertical = covariance @ residuals.jacobian @ along.unsqueeze(-1)
    std = covariance.diagonal(dim1=-2, dim2=-1)[:, :OFFSET].sqrt()
    usual = FramePrior().std(params)[:OFFSET]
    observed = std < _OBSERVED * torch.maximum(prior.std(params)[:OFFSET], usual)
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
    """Reweighted Gauss-Newton on perpendicular distances, the noise scale falling by half at most each step.

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
    for _ in range(iterations):
        residuals = boundary_residuals(params, places, seen)
        sigma = (seen.sigma.square() + (blur / scale).square().unsqueeze(-1)).sqrt()
        trust = inlier_weights(residuals.distance, residuals.valid, sigma, scale, focal) * seen.weight
        fitted = noise_scale(residuals.distance, seen.sigma, trust)
        scale = anneal_scale(scale, fitted)
        by_noise = trust / ((seen.sigma * scale.unsqueeze(-1)).square() + blur.square().unsqueeze(-1))
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


def normal_equations(jacobian: Tensor, distance: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Compute Jᵀ W J and Jᵀ W r, (B, P, P) and (B, P), from (B, P, 2N), (B, N, 2) and a weight (B, N)."""
    weighted = jacobian * weight.repeat_interleave(2, dim=1).unsqueeze(1)
    return weighted @ jacobian.mT, (weighted @ distance.flatten(1).unsqueeze(-1)).squeeze(-1)


def student_weight(squared: Tensor, freedom: float) -> Tensor:
    """Compute the weight of a prior, Student's t, at a squared normalised distance.

    It is 1 at the mean, not 1 + 1 / ``freedom``: near the mean the prior is Gaussian with the given sigma.
    """
    return (1 + squared / freedom).reciprocal()


def student_log(squared: Tensor, freedom: float) -> Tensor:
    """Compute its log density, (…, P) to (…), the constant left out."""
    return -0.5 * (freedom + 1) * (squared / freedom).log1p().sum(-1)


def spread_subset(seen: Observations, places: Tensor, count: int) -> tuple[Observations, Tensor]:
    """Choose at most ``count`` segments, those with weight first, spread evenly over the list."""
    total = seen.boundary.shape[1]
    if total <= count:
        return seen, places
    order = torch.arange(total, dtype=places.dtype, device=places.device) * 0.6180339887498949 % 1.0
    index = ((seen.weight > 0).to(places.dtype) + order).topk(count, dim=-1).indices  # (B, count)
    ends = torch.stack([2 * index, 2 * index + 1], dim=-1).flatten(1)  # (B, 2 count)
    picked = seen._replace(
        rays=seen.rays.gather(2, ends.unsqueeze(1).expand(-1, 3, -1)),
        boundary=seen.boundary.gather(1, index),
        weight=seen.weight.gather(1, index),
        sigma=seen.sigma.gather(1, index),
    )
    return picked, places.gather(1, index)


def _spread(steps: int, like: Tensor) -> Tensor:
    """(steps,) evenly from -1 to 1; 0 where there is but one."""
    end = 1.0 if steps > 1 else 0.0
    return torch.linspace(-end, end, steps, dtype=like.dtype, device=like.device)


def linear_starts(seen: Observations, places: Tensor, prior: FramePrior) -> Tensor:
    """Find the best pitch for every roll of the grid, by robust linear fits.

    With the road's axes right, down, forward for yaw 0, ray·right = a V + g x_k V + t F + b F² / (2 V),
    V = ray·down, F = ray·forward: linear in a = offset / h', g = 1 / h', t = tan(heading), b = c0 h.

    Returns:
        (B, S, 7), S the number of rolls.
    """
    like = places
    pitch = prior.pitch + prior.pitch_range * _spread(prior.pitch_steps, like)
    roll = prior.roll + prior.roll_range * _spread(prior.roll_steps, like)
    pitch, roll = (grid.flatten() for grid in torch.meshgrid(pitch, roll, indexing="ij"))  # (H,)
    angles = torch.stack([pitch, torch.zeros_like(pitch), roll], dim=-1)
    axes, _ = road_from_cam_and_roll(angles)  # (H, 3, 3) rows right, down, forward
    right, below, ahead = torch.einsum("hij,bjm->ibhm", axes, seen.rays).unbind(0)  # each (B, H, M)
    valid = (below > 0.005) & (ahead > 0.1)
    below = torch.where(valid, below, 1.0)
    bend = ahead * ahead / (2 * below)
    place = places.repeat_interleave(2, dim=1).unsqueeze(1)  # (B, 1, M)
    weight = seen.weight.repeat_interleave(2, dim=1).unsqueeze(1) * valid
    regressors = torch.stack([below, place * below, ahead, bend], dim=-1)  # (B, H, M, 4)

    mean = constant((0.0, 1.0 / prior.height, 0.0, 0.0), like=like)
    slack = prior.height_std / prior.height / prior.height
    lateral, bent = prior.offset_std / prior.height, prior.curvature_std * prior.height
    std = constant((lateral, slack, prior.yaw_std, bent), like=like)
    precision = (std / 0.02).square().reciprocal()
    solution = mean.expand(*right.shape[:2], 4)
    for scale in _ANNEALING:
        residual = right - (regressors @ solution.unsqueeze(-1)).squeeze(-1)
        across = solution[..., :1] + solution[..., 1:2] * place  # (B, H, M) slope of the boundary
        residual = residual * (1 + across * across).rsqrt()  # rad, perpendicular
        trust = weight * (1 + (residual / scale).square()).square().reciprocal()
        weighted = (regressors * (trust / (1 + across * across)).unsqueeze(-1)).mT  # (B, H, 4, M)
        information = weighted @ regressors + precision.diag()
        gradient = (weighted @ right.unsqueeze(-1)).squeeze(-1) + precision * mean
        solution = solve_spd(information, gradient.unsqueeze(-1)).squeeze(-1)
    squared = (residual / _ANNEALING[-1]).square()
    cost = 1 - weight + weight * squared / (1 + squared)  # 1 for what is not explained at all
    away = torch.stack([(pitch - prior.pitch) / prior.pitch_std, (roll - prior.roll) / prior.roll_std], -1)
    of_prior = student_log(((solution - mean) / std).square(), prior.freedom)
    total = cost.sum(-1) - of_prior - student_log(away.square(), prior.freedom)

    best = total.view(-1, prior.pitch_steps, prior.roll_steps).argmin(1)  # (B, S)
    hypothesis = best * prior.roll_steps + torch.arange(prior.roll_steps, device=like.device)
    chosen = solution.gather(1, hypothesis.unsqueeze(-1).expand(-1, -1, 4))  # (B, S, 4)
    return _params_from_linear(chosen, axes[hypothesis])


def _params_from_linear(solution: Tensor, axes: Tensor) -> Tensor:
    """(…, 7) parameters from the linear solution (…, 4) and the axes (…, 3, 3) it was found in."""
    across, per_metre, tangent, bend = solution.unbind(-1)
    cos = (1 + tangent * tangent).rsqrt().unsqueeze(-1)
    sin = tangent.unsqueeze(-1) * cos
    right, below, ahead = axes.unbind(-2)
    turned = torch.stack([cos * right - sin * ahead, below, cos * ahead + sin * right], dim=-2)
    scale = per_metre.clamp(min=0.2).reciprocal()
    height = (scale * cos.squeeze(-1)).clamp(0.4, 4.0)
    rest = torch.stack([height, across * scale, bend / height, torch.zeros_like(height)], dim=-1)
    return torch.cat([pitch_yaw_roll(turned), rest], dim=-1)


def _best_start(
    starts: Tensor, seen: Observations, places: Tensor, prior: FramePrior, iterations: int
) -> tuple[Tensor, Tensor]:
    """Refine (B, S, 7) starts and keep the likeliest: (B, 7), and its noise scale (B,)."""
    batch, count, _ = starts.shape
    many = Observations(*(tensor.repeat_interleave(count, dim=0) for tensor in seen))
    many_places = places.repeat_interleave(count, dim=0)
    focal = many.focal
    sigma = (many.sigma * many.weight).sum(-1) / many.weight.sum(-1).clamp(min=1e-3)
    scale = (_ANNEALING[-1] * focal / sigma.clamp(min=1e-3)).clamp(min=1.0)
    blur = _ANNEALING[-1] * focal
    params, scale, _ = refine(starts.flatten(0, 1), scale, many_places, many, prior, iterations, blur)
    residuals = boundary_residuals(params, many_places, many)
    score = log_likelihood(residuals.distance, residuals.valid, many.weight, many.sigma, scale, focal)
    away = (params - prior.mean(params)) / prior.std(params)
    score = score + student_log(away.square(), prior.freedom)
    score = torch.where(params.isfinite().all(-1), score, -torch.inf)
    best = score.view(batch, count).argmax(-1) + count * torch.arange(batch, device=score.device)
    return params[best], scale[best]
