"""The calibration that is given out: the pose, and its covariance with what the filter does not estimate."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.estimation.joint.evidence import EQUAL
from lanebev.estimation.joint.frame_prior import student_density
from lanebev.estimation.joint.layout import POSE, layout
from lanebev.estimation.joint.measurement import HEIGHT, OFFSET, ROLL
from lanebev.estimation.joint.scatter import scatter_variance
from lanebev.estimation.joint.state import JointConfig, JointState
from lanebev.estimation.reasons import Reason
from lanebev.tensors import constant
from lanebev.types import Calibration, Extrinsics

_ONLY_HEIGHT = (0.0, 0.0, 0.0, 1.0)
_FITTED = 3  # boundaries that a pose of equal lanes always fits: by offset, roll and height
_BY_CHANCE = 0.004  # probability that a further boundary is in its place though lanes are unequal
_MORE = 4.0  # factor on the odds that a line bounds no lane, where further lines are on no boundary
_ODD_WITHIN = 3.6  # m, range of such a line's place
_THIRD = 6.0  # sum of squares of (1, -2, 1), in which proportion three boundaries change the roll
_IN_VIEW = 0.015  # rad/m or m/m: change of roll or height by a boundary's deviation from which it counts
_WAY = 15.0  # m along which a boundary keeps a heading of its own
_DOUBTFUL = 0.6  # m out of place, below which a single boundary may stand for several


def single_deviation(deviations: Tensor, cfg: JointConfig) -> Tensor:
    """Compute the variance (B,) m² of any boundary's place if exactly one deviates.

    Source: (J26).

    Args:
        deviations: (B, L) m, by the filter.
        cfg: the numbers.
    """
    size = cfg.open_deviation
    worst = deviations.abs().amax(-1)
    alone = (worst > EQUAL * size) & (worst < _DOUBTFUL)
    return torch.where(alone, worst.clamp(max=size).square(), 0.0)


def unverified_deviation(
    sensitivity: Tensor, deviations: Tensor, of_headings: Tensor, roll: Tensor, cfg: JointConfig
) -> Tensor:
    """Compute the variance (B,) m² of every boundary's place where too few are in view to tell.

    Source: (J26). Three boundaries fit a pose of equal lanes, however unequal the lanes are; a fourth shows
    whether they are, unless it is so far from its place that it bounds no lane.

    Args:
        sensitivity: (B, 4, L) change of the pose per metre of deviation of a boundary; 0 if not in view.
        deviations: (B, L) m, by the filter.
        of_headings: (B,) rad², variance of a boundary's own heading. One that has such a heading gets out of
            its place by as much as it differs over ``_WAY``.
        roll: (B,) rad.
        cfg: the numbers.
    """
    fits = deviations.abs() < _DOUBTFUL
    in_view = (sensitivity[:, ROLL:].abs().amax(1) / _IN_VIEW).clamp(max=1.0) * fits
    further = (in_view.sum(-1) - _FITTED).clamp(min=0.0)
    of_three = (1 - further).clamp(min=0.0)
    share = of_three.maximum(_BY_CHANCE**further)
    if not cfg.lane_deviation_std:
        return torch.zeros_like(share)
    askew = of_headings * _WAY**2
    odd = odd_line_deviation(sensitivity[:, ROLL], roll, ~fits.all(-1), cfg)
    return (cfg.lane_deviation_std**2 + askew) * share + odd * of_three


def odd_line_deviation(by_place: Tensor, roll: Tensor, misfit: Tensor, cfg: JointConfig) -> Tensor:
    """Compute the variance (B,) m² of every boundary's place by the chance that one of three bounds no lane.

    Source: (J26). Such a line, a kerb or the edge of a shoulder, is taken for a boundary by a wrong roll, and
    the larger this roll is, the less probable is it that the camera has it. The result gives the roll the
    variance p r², with p the probability that there is such a line and r the roll beyond its mean.

    Args:
        by_place: (B, L), change of the roll (rad) per metre of deviation of a boundary; 0 if not in view.
        roll: (B,) rad.
        misfit: (B,) bool, other lines are in view that are on no boundary.
        cfg: the numbers.
    """
    total = by_place.square().sum(-1).clamp(min=_IN_VIEW**2)
    beyond = roll - cfg.prior.roll
    by_camera = student_density(beyond / cfg.prior.roll_std, cfg.prior.freedom) / cfg.prior.roll_std
    density = by_camera * (total / _THIRD).sqrt()  # per m of the outer line's place
    odds = cfg.odd_line * torch.where(misfit, _MORE, 1.0) / (_ODD_WITHIN * density)
    return odds / (1 + odds) * beyond.square() / total


def beyond_filter(expected: Tensor, variances: Tensor) -> Tensor:
    """Compute the variance (B,) m² of the boundaries' places that the filter does not have in its covariance.

    Source: (J26). Half of six independent deviations can be observed, so their variances by the filter sum to
    three times that of one.

    Args:
        expected: (B,) m², of any boundary's place.
        variances: (B, L) m², of the deviations by the filter.
    """
    return (expected - 0.5 * variances.sum(-1)).clamp(min=0.0)


def covariance_by_boundaries(state: JointState, cfg: JointConfig) -> Tensor:
    """Compute the covariance (B, 4, 4) of the pose by the boundaries' own places and headings.

    Source: (J26) and (J29).
    """
    own = layout(cfg.num_boundaries).deviations
    deviations, variances = state.mean[:, own], state.cov.diagonal(dim1=1, dim2=2)[:, own]
    of_places, of_headings = scatter_variance(state.scatter).unbind(-1)
    by_place = state.pose_sensitivity[..., : cfg.num_boundaries]
    unverified = unverified_deviation(by_place, deviations, of_headings, state.mean[:, ROLL], cfg)
    expected = single_deviation(deviations, cfg).maximum(unverified)
    each = torch.stack([beyond_filter(expected, variances).maximum(of_places), of_headings], dim=-1)  # (B, 2)
    each = each.repeat_interleave(cfg.num_boundaries, dim=-1).unsqueeze(1)  # (B, 1, 2 L)
    return torch.bmm(each * state.pose_sensitivity, state.pose_sensitivity.mT)


def as_calibration(
    state: JointState, inliers: Tensor, apart: Tensor, positions: Tensor, cfg: JointConfig
) -> Calibration:
    """Make the calibration of a state.

    Its covariance adds what the filter does not estimate: the common scale of the lane widths; places and
    headings of the boundaries that differ from the model's; the difference from a frame that contradicts the
    state; and, if roll is not observed, the second-order effect of its error on the height.
    If the boundaries at x₁ and x₂ stay where they are seen, h'' = -2 (h - x₁ x₂ / h).

    Args:
        state: (B, ...).
        inliers: (B, N).
        apart: (B, 4), pose of a frame that contradicts the state, less the state's; else 0.
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        cfg: the numbers.
    """
    cov = state.cov[:, POSE, POSE]
    height, ego = state.mean[:, HEIGHT], cfg.num_boundaries // 2 - 1
    left, right = (positions[:, ego : ego + 2] + state.mean[:, OFFSET, None]).unbind(-1)
    bend = height - left * right / height.clamp(min=0.1)
    roll_unseen = (state.reasons & int(Reason.ROLL_UNSEEN)) != 0
    more = 3.0 * (bend * cov[:, ROLL, ROLL]).square() * roll_unseen
    width = (positions[:, -1] - positions[:, 0]) / (cfg.num_boundaries - 1)
    more = more + (cfg.lane_width_std / width * height).square()
    only_height = constant(_ONLY_HEIGHT, like=cov)
    cov = cov + covariance_by_boundaries(state, cfg) + apart.unsqueeze(-1) * apart.unsqueeze(-2)
    cov = cov + (only_height * more.unsqueeze(-1)).diag_embed()
    return Calibration(Extrinsics.unstack(state.mean[:, POSE]), cov, state.status, inliers)
