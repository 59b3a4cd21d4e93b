"""Status and reasons of a frame."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.batch import flags, has_flag, select_rows
from lanebev.estimation.checks import is_running
from lanebev.estimation.joint.layout import POSE
from lanebev.estimation.joint.measurement import HEIGHT, ROLL
from lanebev.estimation.joint.observations import Observations
from lanebev.estimation.joint.scatter import determined_sensitivity, remembered_sensitivity
from lanebev.estimation.joint.state import JointConfig, JointState
from lanebev.estimation.joint.update import UNSEEN
from lanebev.estimation.reasons import Reason
from lanebev.tensors import constant
from lanebev.types import Status


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
        cfg: the configuration.

    Returns:
        the state after the frame, before any restart, and (B,) bool: it was supported.
    """
    running = is_running(predicted.status)
    support, total = (seen.weight * trust).sum(-1), seen.weight.sum(-1)
    share = support / total.clamp(min=1e-6)
    least = torch.where(predicted.status == int(Status.TRACKING), cfg.min_share, cfg.enter_share)
    sums = updated.mean.sum(-1) + updated.cov.sum((1, 2)) + updated.scatter.sum((1, 2))
    finite = sums.isfinite()  # as the sum of what is not, is not
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
    changed = has_flag(updated.reasons, Reason.LANE_CHANGE)
    sensitivity = remembered_sensitivity(
        updated.pose_sensitivity, predicted.pose_sensitivity, torch.where(changed, torch.inf, step), cfg
    )
    determined = determined_sensitivity(~blind, cfg.num_boundaries)
    after = predicted._replace(
        mean=select_rows(supported, updated.mean, predicted.mean),
        cov=select_rows(supported, updated.cov, predicted.cov),
        motion_scale=select_rows(supported, updated.motion_scale, predicted.motion_scale),
        scatter=select_rows(supported, updated.scatter, predicted.scatter),
        pose_sensitivity=torch.where(determined, sensitivity, predicted.pose_sensitivity),
        evidence=select_rows(supported, updated.evidence, torch.zeros_like(updated.evidence)),
        early=torch.zeros_like(unseen),
        unseen=unseen,
        misfit=misfit,
        status=torch.where(supported, int(Status.TRACKING), idle),
        reasons=flags(conditions) | torch.where(supported, updated.reasons, 0),
    )
    return after, supported
