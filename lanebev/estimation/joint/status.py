"""Status and reasons of a frame, and the resulting calibration."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.batch import flags, select_rows
from lanebev.estimation.checks import is_running
from lanebev.estimation.joint.evidence import EQUAL
from lanebev.estimation.joint.layout import POSE, layout
from lanebev.estimation.joint.measurement import HEIGHT, OFFSET, ROLL
from lanebev.estimation.joint.observations import Observations
from lanebev.estimation.joint.state import JointConfig, JointState
from lanebev.estimation.joint.update import UNSEEN
from lanebev.estimation.reasons import Reason
from lanebev.tensors import constant
from lanebev.types import Calibration, Extrinsics, Status

_ONLY_HEIGHT = (0.0, 0.0, 0.0, 1.0)
_FITTED = 3  # boundaries that a pose of equal lanes always fits: by offset, roll and height
_IN_VIEW = 0.015  # rad/m or m/m: change of roll or height by a boundary's deviation from which it counts
_GONE = 0.001  # likewise, below which it is not in view
_DOUBTFUL = 0.6  # m out of place, below which a single boundary may stand for several


def update_track_status(
    predicted: JointState,
    updated: JointState,
    trust: Tensor,
    single_frame_std: Tensor,
    step: Tensor,
    seen: Observations,
    cfg: JointConfig,
) -> tuple[JointState, Tensor]:
    """Decide whether the frame supports the track, and set status and reasons.

    Args:
        predicted: state without the frame, which stands where the frame does not support it.
        updated: state with the frame.
        trust: (B, N), weights of the segments.
        single_frame_std: (B, 5) of pose and offset by the frame alone.
        step: (B,) s since the last frame.
        seen: what was observed.
        cfg: the numbers.

    Returns:
        the state after the frame, before any restart, and (B,) bool: it was supported.
    """
    running = is_running(predicted.status)
    support, total = (seen.weight * trust).sum(-1), seen.weight.sum(-1)
    share = support / total.clamp(min=1e-6)
    least = torch.where(predicted.status == int(Status.TRACKING), cfg.min_share, cfg.enter_share)
    finite = (updated.mean.sum(-1) + updated.cov.sum((1, 2))).isfinite()  # as the sum of what is not, is not
    supported = running & finite & (support >= cfg.min_support) & (share >= least)
    empty = total < 1e-3
    unseen = torch.where(supported, 0.0, predicted.unseen + step)
    misfit = torch.where(supported, 0.0, predicted.misfit + torch.where(empty, 0.0, step))
    coasting = torch.where(unseen > cfg.lost_after, int(Status.LOST), int(Status.COASTING))
    idle = torch.where(running, coasting, predicted.status)
    blind = ~supported.unsqueeze(-1) | (single_frame_std[:, POSE] > constant(UNSEEN, like=single_frame_std))
    conditions = {
        Reason.NO_SEGMENTS: empty,
        Reason.FEW_INLIERS: ~(empty | supported),
        Reason.NO_START: ~running,
        Reason.DIRECTION_UNSEEN: blind[:, :ROLL].any(-1),
        Reason.ROLL_UNSEEN: blind[:, ROLL],
        Reason.HEIGHT_UNSEEN: blind[:, HEIGHT],
    }
    known = supported & ~blind.any(-1)
    changed = (updated.reasons & int(Reason.LANE_CHANGE)) != 0
    sensitivity = remembered_sensitivity(
        updated.pose_sensitivity, predicted.pose_sensitivity, torch.where(changed, torch.inf, step), cfg
    )
    after = predicted._replace(
        mean=select_rows(supported, updated.mean, predicted.mean),
        cov=select_rows(supported, updated.cov, predicted.cov),
        motion_scale=select_rows(supported, updated.motion_scale, predicted.motion_scale),
        pose_sensitivity=select_rows(known, sensitivity, predicted.pose_sensitivity),
        evidence=select_rows(supported, updated.evidence, torch.zeros_like(updated.evidence)),
        early=torch.zeros_like(unseen),
        unseen=unseen,
        misfit=misfit,
        status=torch.where(supported, int(Status.TRACKING), idle),
        reasons=flags(conditions) | torch.where(supported, updated.reasons, 0),
    )
    return after, supported


def remembered_sensitivity(now: Tensor, before: Tensor, step: Tensor, cfg: JointConfig) -> Tensor:
    """Blend the pose's change per metre of deviation of each boundary, M of (J26), over the last frames.

    A boundary counts fully after about a second in view. One that has gone has shown where it is, and its
    share decays as deviations do. So the covariance changes gradually when boundaries come and go.

    Args:
        now: (B, 4, L) by this frame.
        before: (B, 4, L); 0 where no frame has determined the pose yet.
        step: (B,) s since then; inf where the boundaries' numbers have changed.
        cfg: the numbers.
    """
    gone = now[:, ROLL:].abs().amax(1, keepdim=True) < _GONE
    memory = torch.where(gone, cfg.motion.deviation_memory, cfg.motion.unequal_memory)
    fade = torch.where(
        (before != 0).any(-1).any(-1)[:, None, None], (-step[:, None, None] / memory).exp(), 0.0
    )
    return now + fade * (before - now)


def single_deviation(deviations: Tensor, variances: Tensor, cfg: JointConfig) -> Tensor:
    """Compute how far (B,) m any boundary may deviate if exactly one does.

    Source: (J26).

    The filter's own variance of the deviations is subtracted, so that the sum is right while lanes turn out
    to be unequal. Half of six independent deviations can be observed, so their variances sum to three times
    that of one.

    Args:
        deviations: (B, L) m.
        variances: (B, L) m², of these by the filter.
        cfg: the numbers.
    """
    size = cfg.open_deviation
    worst = deviations.abs().amax(-1)
    alone = (worst > EQUAL * size) & (worst < _DOUBTFUL)
    return _beyond_filter(torch.where(alone, worst.clamp(max=size).square(), 0.0), variances)


def unverified_deviation(
    sensitivity: Tensor, deviations: Tensor, variances: Tensor, cfg: JointConfig
) -> Tensor:
    """Compute how far (B,) m every boundary may deviate where too few are in view to show that any does.

    Source: (J26). Three boundaries fit a pose of equal lanes, however unequal the lanes are; a fourth shows
    whether they are, unless it is so far from its place that it bounds no lane. As in
    :func:`single_deviation`, what the filter has in its own variances is subtracted.

    Args:
        sensitivity: (B, 4, L) change of the pose per metre of deviation of a boundary; 0 if not in view.
        deviations: (B, L) m.
        variances: (B, L) m², of the deviations by the filter.
        cfg: the numbers.
    """
    in_view = (sensitivity[:, ROLL:].abs().amax(1) / _IN_VIEW).clamp(max=1.0) * (deviations.abs() < _DOUBTFUL)
    further = (in_view.sum(-1) - _FITTED).clamp(0.0, 1.0)
    return _beyond_filter(cfg.lane_deviation_std**2 * (1 - further), variances)


def _beyond_filter(expected: Tensor, variances: Tensor) -> Tensor:
    """Return the root (B,) of a variance less half of the sum of the filter's own (B, L), at least 0."""
    missing = expected - 0.5 * variances.sum(-1)
    left = missing > 0
    return torch.where(left, torch.where(left, missing, 1.0).sqrt(), 0.0)


def as_calibration(
    state: JointState, inliers: Tensor, apart: Tensor, positions: Tensor, cfg: JointConfig
) -> Calibration:
    """Make the calibration of a state.

    Its covariance adds what the filter does not estimate: the common scale of the lane widths; the deviation
    of one unknown boundary, and of all where too few are in view to show it; the difference from a frame that
    contradicts the state; and, if roll is not observed, the second-order effect of its error on the height.
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
    own = layout(cfg.num_boundaries).deviations
    variances = state.cov.diagonal(dim1=1, dim2=2)[:, own]
    single = single_deviation(state.mean[:, own], variances, cfg)
    deviation = torch.maximum(
        single, unverified_deviation(state.pose_sensitivity, state.mean[:, own], variances, cfg)
    )
    by_lanes = deviation[:, None, None] * state.pose_sensitivity
    only_height = constant(_ONLY_HEIGHT, like=cov)
    added = torch.cat([by_lanes, apart.unsqueeze(-1)], dim=-1)
    cov = torch.baddbmm(cov, added, added.mT) + (only_height * more.unsqueeze(-1)).diag_embed()
    return Calibration(Extrinsics.unstack(state.mean[:, POSE]), cov, state.status, inliers)
