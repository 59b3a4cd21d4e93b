"""Status and reasons of a frame."""

import torch
from torch import Tensor

from lanebev.batch import flags, has_flag, select_rows
from lanebev.estimation.checks import is_running
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.iterated_update import FrameUpdate
from lanebev.estimation.joint.filter.scatter import remembered_sensitivity
from lanebev.estimation.joint.filter.update import UNSEEN
from lanebev.estimation.joint.layout import POSE
from lanebev.estimation.joint.measurement.observations import Observations
from lanebev.estimation.joint.measurement.residuals import HEIGHT, ROLL
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.reasons import Reason
from lanebev.tensors import constant
from lanebev.types import Status

_NO_WEIGHT = 1e-3  # sum of weights, below which a frame has no segments


def update_track_status(
    predicted: JointState, update: FrameUpdate, dt: Tensor, seen: Observations, cfg: JointConfig
) -> tuple[JointState, Tensor]:
    """Decide whether the frame supports the track, and set status and reasons.

    Args:
        predicted: state without the frame, which stands where the frame does not support it.
        update: by the frame.
        dt: (B,) s since the last frame.
        seen: what was observed.
        cfg: the configuration.

    Returns:
        the state after the frame, before any restart, and (B,) bool: it was supported.
    """
    updated, running = update.state, is_running(predicted.status)
    supported = is_supported(predicted, update, seen, cfg)
    empty = seen.weight.sum(-1) < _NO_WEIGHT
    unseen = torch.where(supported, 0.0, predicted.unseen + dt)
    misfit = torch.where(supported, 0.0, predicted.misfit + torch.where(empty, 0.0, dt))
    coasting = torch.where(unseen > cfg.lost_after, int(Status.LOST), int(Status.COASTING))
    idle = torch.where(running, coasting, predicted.status)
    std = update.single_frame_std[:, POSE]
    blind = ~supported.unsqueeze(-1) | (std > constant(UNSEEN, like=std))
    changed = has_flag(updated.reasons, Reason.LANE_CHANGE)
    sensitivity = remembered_sensitivity(
        updated.pose_sensitivity, predicted.pose_sensitivity, torch.where(changed, torch.inf, dt), cfg
    )
    determined = ~blind.any(-1)[:, None, None]
    after = predicted._replace(
        mean=select_rows(supported, updated.mean, predicted.mean),
        cov=select_rows(supported, updated.cov, predicted.cov),
        motion_scale=select_rows(supported, updated.motion_scale, predicted.motion_scale),
        scatter=select_rows(supported, updated.scatter, predicted.scatter),
        places=select_rows(supported, updated.places, predicted.places),
        vertical=select_rows(supported, updated.vertical, predicted.vertical),
        pose_sensitivity=torch.where(determined, sensitivity, predicted.pose_sensitivity),
        heading_sensitivity=select_rows(
            supported, updated.heading_sensitivity, predicted.heading_sensitivity
        ),
        evidence=select_rows(supported, updated.evidence, torch.zeros_like(updated.evidence)),
        early=torch.zeros_like(unseen),
        unseen=unseen,
        misfit=misfit,
        status=torch.where(supported, int(Status.TRACKING), idle),
        reasons=frame_reasons(running, supported, empty, blind) | torch.where(supported, updated.reasons, 0),
    )
    return after, supported


def is_supported(predicted: JointState, update: FrameUpdate, seen: Observations, cfg: JointConfig) -> Tensor:
    """Return in which rows (B,) enough of a frame's segments fit the state; more must fit after a loss."""
    updated = update.state
    support, total = (seen.weight * update.trust).sum(-1), seen.weight.sum(-1)
    share = support / total.clamp(min=1e-6)
    least = torch.where(predicted.status == int(Status.TRACKING), cfg.min_share, cfg.enter_share)
    sums = updated.mean.sum(-1) + updated.cov.sum((1, 2)) + updated.scatter.sum((1, 2))
    finite = sums.isfinite()  # a sum is not if one of its terms is not
    return is_running(predicted.status) & finite & (support >= cfg.min_support) & (share >= least)


def frame_reasons(running: Tensor, supported: Tensor, empty: Tensor, blind: Tensor) -> Tensor:
    """Compute the flags (B,) of why a frame is not, or not fully, tracked.

    Args:
        running: (B,) bool, there is a state.
        supported: (B,) bool, the frame supports it.
        empty: (B,) bool, the frame has no segments.
        blind: (B, 4) bool, what of pitch, yaw, roll and height the frame does not determine.
    """
    return flags(
        {
            Reason.NO_SEGMENTS: empty,
            Reason.FEW_INLIERS: ~(empty | supported),
            Reason.NO_START: ~running,
            Reason.DIRECTION_UNSEEN: blind[:, :ROLL].any(-1),
            Reason.ROLL_UNSEEN: blind[:, ROLL],
            Reason.HEIGHT_UNSEEN: blind[:, HEIGHT],
        }
    )
