"""The search of a start for the fit of a frame: robust linear fits on a grid of pitch and roll."""

import torch
from torch import Tensor

from lanebev.estimation.joint.frame_prior import FramePrior, student_log
from lanebev.estimation.joint.measurement.observations import Observations, per_end
from lanebev.geometry.linalg import solve_spd
from lanebev.geometry.rotation import pitch_yaw_roll, road_from_cam_and_roll
from lanebev.tensors import constant

LAST_SCALE = 0.02
"""Scale of the last linear fit, of the focal length."""

_ANNEALING = (0.1, 0.06, 0.035, 0.02, LAST_SCALE)  # scales of the linear fits, of the focal length


def spread_subset(seen: Observations, places: Tensor, count: int) -> tuple[Observations, Tensor]:
    """Choose at most ``count`` segments, those with weight first, spread evenly over the list."""
    total = seen.boundary.shape[1]
    if total <= count:
        return seen, places
    order = torch.arange(total, dtype=places.dtype, device=places.device) * 0.6180339887498949 % 1.0
    index = ((seen.weight > 0).to(places.dtype) + order).topk(count, dim=-1).indices  # (B, count)
    ends = torch.cat([index, index + total], dim=-1)  # (B, 2 count)
    picked = seen._replace(
        pixels=seen.pixels.gather(2, ends.unsqueeze(1).expand(-1, 3, -1)),
        boundary=seen.boundary.gather(1, index),
        weight=seen.weight.gather(1, index),
        sigma=seen.sigma.gather(1, index),
    )
    return picked, places.gather(1, index)


def _spread(steps: int, like: Tensor) -> Tensor:
    """Return numbers (steps,) evenly from -1 to 1; 0 if there is but one."""
    end = 1.0 if steps > 1 else 0.0
    return torch.linspace(-end, end, steps, dtype=like.dtype, device=like.device)


def linear_starts(seen: Observations, places: Tensor, prior: FramePrior) -> Tensor:
    """Find the best pitch for every roll of the grid, by robust linear fits.

    With the road's axes right, down, forward for yaw 0, ray·right = a V + g x_k V + t F + b F² / (2 V),
    V = ray·down, F = ray·forward: linear in a = offset / h', g = 1 / h', t = tan(heading), b = c0 h.

    Returns:
        (B, S, 7), S the number of rolls.
    """
    pitch, roll = _grid(prior, places)
    angles = torch.stack([pitch, torch.zeros_like(pitch), roll], dim=-1)
    axes, _ = road_from_cam_and_roll(angles)  # (H, 3, 3) rows right, down, forward
    rays = torch.bmm(seen.cam_from_image, seen.pixels)
    right, below, ahead = torch.einsum("hij,bjm->ibhm", axes, rays).unbind(0)  # each (B, H, M)
    valid = (below > 0.005) & (ahead > 0.1)
    below = torch.where(valid, below, 1.0)
    bend = ahead * ahead / (2 * below)
    place = per_end(places).unsqueeze(1)  # (B, 1, M)
    weight = per_end(seen.weight).unsqueeze(1) * valid
    regressors = torch.stack([below, place * below, ahead, bend], dim=-1)  # (B, H, M, 4)

    mean, std = _linear_prior(prior, places)
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
    hypothesis = best * prior.roll_steps + torch.arange(prior.roll_steps, device=places.device)
    chosen = solution.gather(1, hypothesis.unsqueeze(-1).expand(-1, -1, 4))  # (B, S, 4)
    return _params_from_linear(chosen, axes[hypothesis])


def _grid(prior: FramePrior, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return pitch and roll of the hypotheses, (H,) rad each, roll running first."""
    pitch = prior.pitch + prior.pitch_range * _spread(prior.pitch_steps, like)
    roll = prior.roll + prior.roll_range * _spread(prior.roll_steps, like)
    pitch, roll = (grid.flatten() for grid in torch.meshgrid(pitch, roll, indexing="ij"))
    return pitch, roll


def _linear_prior(prior: FramePrior, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation of the linear solution, (4,) each."""
    mean = constant((0.0, 1.0 / prior.height, 0.0, 0.0), like=like)
    slack = prior.height_std / prior.height / prior.height
    lateral, bent = prior.offset_std / prior.height, prior.curvature_std * prior.height
    return mean, constant((lateral, slack, prior.yaw_std, bent), like=like)


def _params_from_linear(solution: Tensor, axes: Tensor) -> Tensor:
    """Return parameters (…, 7) from the linear solution (…, 4) and the axes (…, 3, 3) it was found in."""
    across, per_metre, tangent, bend = solution.unbind(-1)
    cos = (1 + tangent * tangent).rsqrt().unsqueeze(-1)
    sin = tangent.unsqueeze(-1) * cos
    right, below, ahead = axes.unbind(-2)
    turned = torch.stack([cos * right - sin * ahead, below, cos * ahead + sin * right], dim=-2)
    scale = per_metre.clamp(min=0.2).reciprocal()
    height = (scale * cos.squeeze(-1)).clamp(0.4, 4.0)
    rest = torch.stack([height, across * scale, bend / height, torch.zeros_like(height)], dim=-1)
    return torch.cat([pitch_yaw_roll(turned), rest], dim=-1)
