"""What a frame's evidence says of the state, and what of the state goes out."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.batch import flag, select_rows
from lanebev.estimation.checks import is_running
from lanebev.estimation.joint.dynamics import NUM_COMMON, NUM_POSE, NUM_SEEN
from lanebev.estimation.joint.measurement import HEIGHT, NUM_STEPS, OFFSET, ROLL, Observations
from lanebev.estimation.joint.state import JointConfig, JointState, Reason, held
from lanebev.estimation.joint.update import UNSEEN, Update
from lanebev.types import Calibration, Extrinsics, Status

_DOUBTFUL = 0.6  # m out of place, below which a boundary let go alone may stand for several


def opened(evidence: Tensor, cov: Tensor, cfg: JointConfig) -> Tensor:
    """Process noise (B, D, D) that the evidence calls for; next to none while |evidence| < 3.

    Of the boundaries only the one most out of place is let go, and by ``open_deviation`` at most: a
    detector errs on one boundary for seconds, and if all were let go, its error would pass for a road of
    unequal lanes and turn the roll.
    """
    parts = evidence.square().split([NUM_POSE, 1 + NUM_STEPS, cfg.num_boundaries], dim=-1)
    worst = [part.amax(-1, keepdim=True) for part in parts]
    pose, bend, own = (0.01 * torch.sigmoid(0.5 * (most - 25.0)) * most for most in worst)
    jump = evidence.new_tensor([cfg.open_pose] * 3 + [10 * cfg.open_pose, 0.0]).square()
    change = evidence.new_tensor([cfg.open_curvature] + [cfg.open_step] * NUM_STEPS).square()
    rest = evidence.new_zeros(evidence.shape[0], NUM_COMMON - NUM_SEEN)
    room = cfg.open_deviation**2 - cov.diagonal(dim1=1, dim2=2)[:, NUM_COMMON:]
    width = (parts[2] == worst[2]) * own.clamp(max=1.0) * room.clamp(min=0.0)
    return torch.cat([pose * jump, bend * change, rest, width], dim=-1).diag_embed()


def inequality(mean: Tensor, cfg: JointConfig) -> Tensor:
    """(B,) m, sigma that deviations may have, by the second largest of them; 0 on a road of equal lanes.

    One boundary alone out of place is a detector's error. Of six deviations three directions say nothing,
    since offset, height and roll mimic them: there may be three times what is seen.
    """
    size = cfg.open_deviation
    second = mean[:, NUM_COMMON:].abs().topk(2, dim=-1).values[:, 1]
    return torch.where(second > 0.1 * size, (3 * second).clamp(max=size), 0.0)


def one_out_of_place(mean: Tensor, cfg: JointConfig) -> Tensor:
    """(B,) m, what any boundary may be out of place where one is, by no more than lanes differ."""
    size = cfg.open_deviation
    worst = mean[:, NUM_COMMON:].abs().amax(-1)
    alone = (worst > 0.1 * size) & (worst < _DOUBTFUL) & (inequality(mean, cfg) == 0)
    return torch.where(alone, worst.clamp(max=size), 0.0)


def judge(
    state: JointState,
    update: Update,
    evidence: Tensor,
    shift: Tensor,
    step: Tensor,
    seen: Observations,
    cfg: JointConfig,
) -> tuple[JointState, Tensor]:
    """State after the frame, before any restart, and (B,) bool: the frame supported it.

    Without support the predicted state stands.
    """
    running = is_running(state.status)
    support = (seen.weight * update.trust).sum(-1)
    total = seen.weight.sum(-1)
    share = support / total.clamp(min=1e-6)
    least = torch.where(state.status == int(Status.TRACKING), cfg.min_share, cfg.enter_share)
    finite = update.mean.isfinite().all(-1) & update.cov.isfinite().all(-1).all(-1)
    supported = running & finite & (support >= cfg.min_support) & (share >= least)
    empty = total < 1e-3
    unseen = torch.where(supported, 0.0, state.unseen + step)
    misfit = torch.where(supported, 0.0, state.misfit + torch.where(empty, 0.0, step))
    coasting = torch.where(unseen > cfg.lost_after, int(Status.LOST), int(Status.COASTING))
    status = torch.where(supported, int(Status.TRACKING), torch.where(running, coasting, state.status))
    reasons = flag(empty, Reason.NO_SEGMENTS) | flag(~empty & ~supported, Reason.FEW_INLIERS)
    reasons = reasons | flag(supported & (shift != 0), Reason.LANE_CHANGE)
    reasons = reasons | flag(~running, Reason.NO_START)
    blind = ~supported.unsqueeze(-1) | (update.alone[:, :NUM_POSE] > update.alone.new_tensor(UNSEEN))
    reasons = reasons | flag(blind[:, :ROLL].any(-1), Reason.DIRECTION_UNSEEN)
    reasons = reasons | flag(blind[:, ROLL], Reason.ROLL_UNSEEN)
    reasons = reasons | flag(blind[:, HEIGHT], Reason.HEIGHT_UNSEEN)
    after = JointState(
        mean=select_rows(supported, update.mean, state.mean),
        cov=select_rows(supported, update.cov, state.cov),
        phase=state.phase,
        evidence=select_rows(supported, evidence, torch.zeros_like(evidence)),
        mimicry=select_rows(supported & ~blind.any(-1), update.mimicry, state.mimicry),
        early=torch.zeros_like(unseen),
        unseen=unseen,
        misfit=misfit,
        status=status,
        reasons=reasons,
    )
    return after, supported


def as_calibration(state: JointState, inliers: Tensor, positions: Tensor, cfg: JointConfig) -> Calibration:
    """What goes out: the pose, its covariance, status, inliers.

    To the filter's covariance comes what it does not follow: the lane width's own scale; what any
    boundary may be out of place where one is; and height by the square of an error of roll, where that is
    held. With boundaries at x₁ and x₂ seen as they are, h'' = -2 (h - x₁ x₂ / h).
    """
    cov = state.cov[:, :NUM_POSE, :NUM_POSE]
    height, ego = state.mean[:, HEIGHT], cfg.num_boundaries // 2 - 1
    left, right = (positions[:, ego : ego + 2] + state.mean[:, OFFSET, None]).unbind(-1)
    bend = height - left * right / height.clamp(min=0.1)
    more = 3.0 * (bend * cov[:, ROLL, ROLL]).square() * held(state.reasons)[:, ROLL]
    width = positions.diff(dim=-1).mean(-1)
    more = more + (cfg.lane_width_std / width * height).square()
    by_lanes = one_out_of_place(state.mean, cfg)[:, None, None] * state.mimicry
    only_height = torch.arange(NUM_POSE, device=cov.device) == HEIGHT
    cov = cov + by_lanes @ by_lanes.mT + (only_height * more.unsqueeze(-1)).diag_embed()
    return Calibration(Extrinsics.unstack(state.mean[:, :NUM_POSE]), cov, state.status, inliers)
