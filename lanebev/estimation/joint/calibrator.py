"""One filter over the whole pose: every end point a measurement, every boundary told apart."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.batch import flag, may_skip, select_rows
from lanebev.estimation import kalman
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.checks import check_new_state, is_running
from lanebev.estimation.joint.dynamics import (
    NUM_COMMON,
    NUM_POSE,
    STEPS,
    motion,
)
from lanebev.estimation.joint.measurement import (
    CURVATURE,
    HEIGHT,
    KNOT_SPACING,
    NUM_STEPS,
    OFFSET,
    ROLL,
    Observations,
    boundary_places,
    observations,
)
from lanebev.estimation.joint.road import come_nearer
from lanebev.estimation.joint.single_frame import fit_observations
from lanebev.estimation.joint.state import JointConfig, JointState, Reason, begin, held
from lanebev.estimation.joint.support import as_calibration, inequality, judge, opened
from lanebev.estimation.joint.update import (
    Update,
    agreement,
    best_shift,
    evidence_index,
    iterate,
    surprise,
)
from lanebev.observation.segments import LaneSegments
from lanebev.types import Calibration, Status

_NO_BOUNDARY = 0.36  # m out of place, three sigmas of what lanes differ, from which a line bounds no lane


class JointCalibrator(Calibrator[JointState]):
    """Online calibration by one iterated filter, per row of a batch, state in and state out.

    Deviation from the paper: one stage instead of two, so that roll and height profit from what pitch and
    yaw know and the other way round; perpendicular pixel distances with propagated noise instead of
    normals; curved roads, lane changes, unequal lanes.

    Args:
        config: the numbers, or keywords of :class:`JointConfig`.
    """

    state_type = JointState

    def __init__(self, config: JointConfig | None = None, **numbers: object) -> None:
        super().__init__()
        if config is not None and numbers:
            raise ValueError("config: expected either a JointConfig or its keywords, got both")
        self.config = config or JointConfig(**numbers)  # type: ignore[arg-type]
        self.num_boundaries = self.config.num_boundaries

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> JointState:
        """State before the first frame: the prior, UNINITIALISED."""
        check_new_state(batch_size, dtype)
        cfg = self.config
        like = torch.zeros((), dtype=dtype, device=device)
        mean, cov = begin(
            cfg.prior.mean(like).repeat(batch_size, 1),
            cfg.prior.std(like).square().diag().repeat(batch_size, 1, 1),
            cfg,
        )
        none = torch.zeros(batch_size, dtype=torch.int64, device=device)
        zero = torch.zeros(batch_size, dtype=dtype, device=device)
        return JointState(
            mean=mean,
            cov=cov,
            phase=zero.clone(),
            evidence=mean.new_zeros(batch_size, NUM_POSE + 1 + NUM_STEPS + cfg.num_boundaries),
            mimicry=mean.new_zeros(batch_size, NUM_POSE, cfg.num_boundaries),
            early=zero.clone(),
            unseen=zero,
            misfit=zero.clone(),
            status=none + int(Status.UNINITIALISED),
            reasons=none + int(Reason.NO_START),
        )

    def step(
        self,
        segments: LaneSegments,
        intrinsics: Tensor,
        state: JointState,
        dt: Tensor,
        lane_width: Tensor,
    ) -> tuple[Calibration, JointState]:
        """One frame, see :meth:`~lanebev.estimation.calibrator.Calibrator.forward`.

        After a frame that comes late the next dt counts from it. Inliers fit the road; 0 for a boundary too
        far out of place to bound a lane, as the foot of a barrier, be it for long or in this frame.
        """
        cfg = self.config
        if state.mean.shape[-1] != NUM_COMMON + cfg.num_boundaries:
            got = state.mean.shape[-1] - NUM_COMMON
            raise ValueError(f"state: expected one of {cfg.num_boundaries} boundaries, got one of {got}")
        seen = observations(segments, intrinsics)
        positions = boundary_places(lane_width, cfg.num_boundaries, dt)  # (B, L)
        places = positions.gather(1, seen.boundary)  # (B, N)
        step, skip, early, guessed = _elapsed(dt, state, cfg)

        mean, cov, phase = come_nearer(state.mean, state.cov, state.phase, step, cfg.motion)
        moves = motion(step, held(state.reasons), inequality(mean, cfg), cfg.num_boundaries, cfg.motion)
        mean, cov = kalman.predict(mean, cov, *moves)
        predicted = state._replace(mean=mean, cov=cov, phase=phase)
        mean, shift, scale = follow_lane_change(predicted, positions, seen, cfg)
        update, evidence = _update(predicted, mean, scale, places, seen, step, cfg)
        judged, supported = judge(predicted, update, evidence, shift, step, seen, cfg)
        agreed = agreement(judged.mean, update.scale, places, seen, judged.phase)
        after, agreed = _restart(judged, agreed, supported, seen, places, cfg)
        after = after._replace(reasons=after.reasons | flag(guessed, Reason.TIME))

        skipped = state._replace(reasons=state.reasons | int(Reason.TIME), early=early)
        after = select_rows(skip, skipped, after)
        begun = (after.reasons & int(Reason.RESTARTED)) != 0
        now = torch.where(begun.unsqueeze(-1), 0.0, update.apart)
        apart = torch.maximum(after.mean[:, NUM_COMMON:].abs(), now.abs())
        lane = apart < _NO_BOUNDARY  # (B, L)
        inliers = torch.where((seen.weight > 0) & lane.gather(1, seen.boundary), agreed, 0.0)
        return as_calibration(after, inliers, positions, cfg), after

    def curvature(self, state: JointState) -> Tensor:
        """Return the road's curvature at the camera, (B,) 1/m, positive to the right."""
        share = (state.phase / KNOT_SPACING).unsqueeze(-1)
        first, steps = state.mean[:, CURVATURE], state.mean[:, STEPS]
        return first + (share * steps)[:, 0]


def _elapsed(dt: Tensor, state: JointState, cfg: JointConfig) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Time to predict over; whether to skip the frame; how far ahead the state then is; if guessed."""
    due = dt - state.early
    guessed = ~(due > -1.0) | ~dt.isfinite()
    due = torch.where(guessed, cfg.assumed_dt, due)
    skip = (due <= 0) & is_running(state.status)
    return due.clamp(0.0, 60.0), skip, torch.where(skip, -due, 0.0), guessed


def follow_lane_change(
    predicted: JointState, positions: Tensor, seen: Observations, cfg: JointConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Predicted mean, offset and deviations moved by a lane if the indices were; shift; noise scale."""
    ego = cfg.num_boundaries // 2 - 1
    width = positions[:, ego + 1] - positions[:, ego]
    mean = predicted.mean
    shift, scale = best_shift(mean, positions, seen, predicted.phase, width)
    moved = mean.clone()
    moved[:, OFFSET] = mean[:, OFFSET] + shift * width
    own = mean[:, NUM_COMMON:]
    none = torch.zeros_like(own[:, :1])
    right, left = torch.cat([own[:, 1:], none], -1), torch.cat([none, own[:, :-1]], -1)
    shifted = torch.where(shift.unsqueeze(-1) > 0, right, torch.where(shift.unsqueeze(-1) < 0, left, own))
    moved[:, NUM_COMMON:] = shifted
    return moved, shift, scale


def _update(
    predicted: JointState,
    mean: Tensor,
    scale: Tensor,
    places: Tensor,
    seen: Observations,
    step: Tensor,
    cfg: JointConfig,
) -> tuple[Update, Tensor]:
    """Robust update; what contradicts the motion opens its process noise, and the frame is used again."""
    cov, phase = predicted.cov, predicted.phase
    first = iterate(mean, cov, mean, scale, places, seen, phase, cfg.iterations, cov)
    index = evidence_index(cfg.num_boundaries, mean.device)
    fade = (-step / cfg.evidence_time).exp().unsqueeze(-1)
    believed = 2 * (seen.weight * first.trust)
    count = cov.new_zeros(cov.shape[0], cfg.num_boundaries).scatter_add(1, seen.boundary, believed)
    news = surprise(first, index, count)
    slow = predicted.evidence * fade + (1 - fade * fade).clamp(min=1e-12).sqrt() * news
    evidence = torch.cat([news[:, :NUM_POSE], slow[:, NUM_POSE:]], dim=-1)
    cov = cov + opened(evidence, cov, cfg)
    return iterate(mean, cov, first.mean, first.scale, places, seen, phase, 1, first.cov), evidence


def _restart(
    state: JointState,
    agreed: Tensor,
    supported: Tensor,
    seen: Observations,
    places: Tensor,
    cfg: JointConfig,
) -> tuple[JointState, Tensor]:
    """Rows that have nothing, or nothing that fits, start from this frame alone if it allows that."""
    wanted = ~is_running(state.status) | (~supported & (state.misfit > cfg.restart_after))
    wanted = wanted & (seen.weight > 0).any(-1)
    if may_skip(wanted):
        return state, agreed
    fit = fit_observations(seen, places, cfg.prior, iterations=cfg.start_iterations)
    share = (fit.inliers * seen.weight).sum(-1) / seen.weight.sum(-1).clamp(min=1e-6)
    fresh = wanted & fit.valid & (share >= cfg.enter_share)
    mean, cov = begin(fit.params(), fit.covariance, cfg)
    zero = torch.zeros_like(state.unseen)
    begun = JointState(
        mean=mean,
        cov=cov,
        phase=zero,
        evidence=torch.zeros_like(state.evidence),
        mimicry=torch.zeros_like(state.mimicry),
        early=zero,
        unseen=zero,
        misfit=zero,
        status=torch.full_like(state.status, int(Status.TRACKING)),
        reasons=int(Reason.RESTARTED)
        | flag(~fit.observed[:, ROLL], Reason.ROLL_UNSEEN)
        | flag(~fit.observed[:, HEIGHT], Reason.HEIGHT_UNSEEN),
    )
    after = select_rows(fresh, begun, state)
    return after, torch.where(fresh.unsqueeze(-1), fit.inliers, agreed)
