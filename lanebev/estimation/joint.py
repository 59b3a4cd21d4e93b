"""One filter over the whole pose: every end point a measurement, every boundary told apart."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntFlag
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lanebev.estimation import kalman
from lanebev.estimation.checks import as_batch, calibrates, is_running
from lanebev.estimation.joint_filter import (
    UNSEEN,
    Update,
    agreement,
    best_shift,
    evidence_index,
    iterate,
    surprise,
)
from lanebev.estimation.joint_model import (
    CURVATURE,
    HEIGHT,
    KNOT_SPACING,
    NUM_PARAMS,
    NUM_STEPS,
    NUM_STRAIGHT,
    OFFSET,
    ROLL,
    Observations,
    boundary_places,
    observations,
)
from lanebev.estimation.joint_motion import (
    MEANS,
    NUM_COMMON,
    NUM_POSE,
    NUM_SEEN,
    RATES,
    SHAPE,
    SPEED,
    STEPS,
    MotionConfig,
    motion,
)
from lanebev.estimation.joint_road import come_nearer, straight_or_bend
from lanebev.estimation.single_frame import FramePrior, fit_single_frame
from lanebev.rows import flag, where
from lanebev.types import NUM_BOUNDARIES, Calibration, Extrinsics, LaneSegments, Status, saved_by_name

_NO_BOUNDARY = 0.36  # m out of place, three sigmas of what lanes differ, from which a line bounds no lane
_DOUBTFUL = 0.6  # m out of place, below which a boundary let go alone may stand for several


class Reason(IntFlag):
    """Why a row is not (fully) tracking; several may hold at once."""

    NONE = 0
    NO_SEGMENTS = 1  # nothing was seen in this frame
    FEW_INLIERS = 2  # what was seen does not fit the road that is believed
    TIME = 4  # not later than the last frame, and not used; or the time unknown, and one guessed
    NO_START = 8  # no start found yet: pitch and yaw not determined by this frame
    ROLL_UNSEEN = 16  # one lane or less, or the frame was not used: roll holds with growing sigma
    HEIGHT_UNSEEN = 32  # no lane, or not used: height holds with growing sigma
    LANE_CHANGE = 64  # the boundary indices moved by one in this frame
    RESTARTED = 128  # started, or started anew, in this frame
    DIRECTION_UNSEEN = 256  # one boundary or less, or not used: pitch and yaw hold with growing sigma


@dataclass(frozen=True)
class JointConfig:
    """Numbers of :class:`JointCalibrator`; angles in rad, lengths in m, times in s.

    Attributes:
        num_boundaries: L.
        iterations: Gauss-Newton steps a frame.
        start_iterations: likewise of every start that is tried on a first frame.
        lane_width_std: m, sigma of the lane width prior, a common scale of height; 0: as given.
        motion: how the state moves.
        prior: where a start is searched, and what holds before it.
        open_pose: rad (and 10 of these in m of height), jump admitted where one frame contradicts the motion,
            at evidence of ten sigmas; as many times more at more.
        open_curvature, open_step: 1/m, likewise, change of the knots when a bend begins or ends.
        straight: 1/m and 1/m², sigmas of c0 and c1 of a straight road.
        bends: how probable it is that a start is on a bend, one of the curvatures of ``prior``.
        open_deviation: m, sigma of a boundary's deviation on a road of unequal lanes; 0: there are none.
        evidence_time: s over which a bend's or unequal lanes' evidence is summed.
        min_support: inlier segments (weights summed) of a usable frame.
        min_share, enter_share: share of inliers to go on tracking, and to begin again.
        assumed_dt: s between frames where it is not finite, or the clock jumped back by more than a second.
        restart_after: s of segments that don't fit before the search starts over.
        lost_after: s without support.
    """

    num_boundaries: int = NUM_BOUNDARIES
    iterations: int = 2
    start_iterations: int = 8
    lane_width_std: float = 0.0
    motion: MotionConfig = field(default_factory=MotionConfig)
    prior: FramePrior = field(default_factory=FramePrior)
    open_pose: float = 0.01
    open_curvature: float = 3e-4
    open_step: float = 1e-3
    straight: tuple[float, float] = (1e-4, 3e-6)
    bends: float = 0.2
    open_deviation: float = 0.12
    evidence_time: float = 0.15
    min_support: float = 3.0
    min_share: float = 0.15
    enter_share: float = 0.25
    assumed_dt: float = 1 / 30
    restart_after: float = 0.3
    lost_after: float = 5.0

    def __post_init__(self) -> None:
        if self.num_boundaries < 2 or self.num_boundaries % 2:
            raise ValueError(f"num_boundaries: expected an even number >= 2, got {self.num_boundaries}")
        if self.iterations < 1 or self.start_iterations < 1:
            got = min(self.iterations, self.start_iterations)
            raise ValueError(f"iterations: expected at least 1, got {got}")
        bend = (self.prior.curvature_std, self.prior.curvature_rate_std)
        if not all(0 < sharp < wide for sharp, wide in zip(self.straight, bend, strict=True)):
            raise ValueError(
                f"straight: expected sigmas between 0 and those of the prior, {bend}, got {self.straight}"
            )
        if not 0 < self.bends < 1:
            raise ValueError(f"bends: expected a probability between 0 and 1, got {self.bends}")


@saved_by_name
class JointState(NamedTuple):
    """Everything the calibrator remembers, tensors only.

    Attributes:
        mean: (B, D), see ``joint_motion``.
        cov: (B, D, D).
        phase: (B,) m, how far the first knot of the road's curvature lies behind the camera.
        evidence: (B, 10 + L) evidence against the motion, unit variance: the last frame's of the pose, summed
            of shape and deviations.
        mimicry: (B, 4, L) change of the pose by a metre that a boundary is out of place, by the last frame
            that determined the pose.
        early: (B,) s by which the state is ahead of the last frame, which came out of order.
        unseen: (B,) s since the last usable frame.
        misfit: (B,) s for which there were segments that did not fit.
        status: (B,) int64, values of Status.
        reasons: (B,) int64, :class:`Reason` flags of the last frame; those of what is unseen decide how the
            next prediction moves.
    """

    mean: Tensor
    cov: Tensor
    phase: Tensor
    evidence: Tensor
    mimicry: Tensor
    early: Tensor
    unseen: Tensor
    misfit: Tensor
    status: Tensor
    reasons: Tensor


class JointCalibrator(nn.Module):
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

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> JointState:
        """State before the first frame: the prior, UNINITIALISED."""
        cfg = self.config
        like = torch.zeros((), dtype=dtype, device=device)
        mean, cov = self._begin(
            cfg.prior.mean(like).repeat(batch_size, 1),
            cfg.prior.std(like).square().diag().repeat(batch_size, 1, 1),
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

    @calibrates
    def forward(
        self,
        segments: LaneSegments,
        intrinsics: Tensor,
        state: JointState,
        dt: float | Tensor,
        lane_width: float | Tensor = 3.7,
    ) -> tuple[Calibration, JointState]:
        """One frame; the results have the state's dtype.

        Args:
            segments: of this frame, N per row; weight 0 is not there, non-finite counts as not there.
            intrinsics: (B, 3, 3) px. A row where they or the widths are not finite and positive sees nothing.
            state: of the frame before, or :meth:`initial_state`.
            dt: s since that frame, float or (B,). A started row skips a duplicate (0) and a frame that comes
                late (negative; the next dt counts from it). Where not finite, an interval is assumed.
            lane_width: m, float, (B,) or (B, L-1) per lane.

        Returns:
            calibration of this frame and the state after it. Inliers fit the road; 0 for a boundary too far
            out of place to bound a lane, as the foot of a barrier, be it for long or in this frame.

        Raises:
            ValueError: a shape that doesn't fit.
        """
        cfg = self.config
        if state.mean.shape[-1] != NUM_COMMON + cfg.num_boundaries:
            got = state.mean.shape[-1] - NUM_COMMON
            raise ValueError(f"state: expected one of {cfg.num_boundaries} boundaries, got one of {got}")
        seen = observations(segments, intrinsics)
        positions = boundary_places(lane_width, cfg.num_boundaries, seen.sigma)  # (B, L)
        places = positions.gather(1, seen.boundary)  # (B, N)
        step, skip, early, guessed = self._elapsed(as_batch(dt, seen.sigma), state)

        mean, cov, phase = come_nearer(state.mean, state.cov, state.phase, step, cfg.motion)
        moves = motion(step, _held(state.reasons), self._inequality(mean), cfg.num_boundaries, cfg.motion)
        mean, cov = kalman.predict(mean, cov, *moves)
        predicted = state._replace(mean=mean, cov=cov, phase=phase)
        mean, shift, scale = self._follow_lane_change(predicted, positions, seen)
        update, evidence = self._update(predicted, mean, scale, places, seen, step)
        judged, supported = self._judge(predicted, update, evidence, shift, step, seen)
        agreed = agreement(judged.mean, update.scale, places, seen, judged.phase)
        after, agreed = self._restart(judged, agreed, supported, segments, intrinsics, lane_width)
        after = after._replace(reasons=after.reasons | flag(guessed, Reason.TIME))

        skipped = state._replace(reasons=state.reasons | int(Reason.TIME), early=early)
        after = JointState(*(where(skip, old, new) for old, new in zip(skipped, after, strict=True)))
        begun = (after.reasons & int(Reason.RESTARTED)) != 0
        now = torch.where(begun.unsqueeze(-1), 0.0, update.apart)
        apart = torch.maximum(after.mean[:, NUM_COMMON:].abs(), now.abs())
        lane = apart < _NO_BOUNDARY  # (B, L)
        inliers = torch.where((seen.weight > 0) & lane.gather(1, seen.boundary), agreed, 0.0)
        return self._calibration(after, inliers, positions), after

    def curvature(self, state: JointState) -> Tensor:
        """Curvature of the road at the camera, (B,) 1/m, positive to the right."""
        share = (state.phase / KNOT_SPACING).unsqueeze(-1)
        first, steps = state.mean[:, CURVATURE], state.mean[:, STEPS]
        return first + (share * steps)[:, 0]

    def _elapsed(self, dt: Tensor, state: JointState) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Time to predict over; whether to skip the frame; how far ahead the state then is; if guessed."""
        due = dt - state.early
        guessed = ~(due > -1.0) | ~dt.isfinite()
        due = torch.where(guessed, self.config.assumed_dt, due)
        skip = (due <= 0) & is_running(state.status)
        return due.clamp(0.0, 60.0), skip, torch.where(skip, -due, 0.0), guessed

    def _follow_lane_change(
        self, predicted: JointState, positions: Tensor, seen: Observations
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Predicted mean, offset and deviations moved by a lane if the indices were; shift; noise scale."""
        ego = self.config.num_boundaries // 2 - 1
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
        self,
        predicted: JointState,
        mean: Tensor,
        scale: Tensor,
        places: Tensor,
        seen: Observations,
        step: Tensor,
    ) -> tuple[Update, Tensor]:
        """Robust update; what contradicts the motion opens its process noise, and the frame is used again."""
        cfg = self.config
        cov, phase = predicted.cov, predicted.phase
        first = iterate(mean, cov, mean, scale, places, seen, phase, cfg.iterations, cov)
        index = evidence_index(cfg.num_boundaries, mean.device)
        fade = (-step / cfg.evidence_time).exp().unsqueeze(-1)
        believed = 2 * (seen.weight * first.trust)
        count = cov.new_zeros(cov.shape[0], cfg.num_boundaries).scatter_add(1, seen.boundary, believed)
        news = surprise(first, index, count)
        slow = predicted.evidence * fade + (1 - fade * fade).clamp(min=1e-12).sqrt() * news
        evidence = torch.cat([news[:, :NUM_POSE], slow[:, NUM_POSE:]], dim=-1)
        cov = cov + self._opened(evidence, cov)
        return iterate(mean, cov, first.mean, first.scale, places, seen, phase, 1, first.cov), evidence

    def _opened(self, evidence: Tensor, cov: Tensor) -> Tensor:
        """Process noise (B, D, D) that the evidence calls for; next to none while |evidence| < 3.

        Of the boundaries only the one most out of place is let go, and by ``open_deviation`` at most: a
        detector errs on one boundary for seconds, and if all were let go, its error would pass for a road of
        unequal lanes and turn the roll.
        """
        cfg = self.config
        parts = evidence.square().split([NUM_POSE, 1 + NUM_STEPS, cfg.num_boundaries], dim=-1)
        worst = [part.amax(-1, keepdim=True) for part in parts]
        pose, bend, own = (0.01 * torch.sigmoid(0.5 * (most - 25.0)) * most for most in worst)
        jump = evidence.new_tensor([cfg.open_pose] * 3 + [10 * cfg.open_pose, 0.0]).square()
        change = evidence.new_tensor([cfg.open_curvature] + [cfg.open_step] * NUM_STEPS).square()
        rest = evidence.new_zeros(evidence.shape[0], NUM_COMMON - NUM_SEEN)
        room = cfg.open_deviation**2 - cov.diagonal(dim1=1, dim2=2)[:, NUM_COMMON:]
        width = (parts[2] == worst[2]) * own.clamp(max=1.0) * room.clamp(min=0.0)
        return torch.cat([pose * jump, bend * change, rest, width], dim=-1).diag_embed()

    def _inequality(self, mean: Tensor) -> Tensor:
        """(B,) m, sigma that deviations may have, by the second largest of them; 0 on a road of equal lanes.

        One boundary alone out of place is a detector's error. Of six deviations three directions say nothing,
        since offset, height and roll mimic them: there may be three times what is seen.
        """
        size = self.config.open_deviation
        second = mean[:, NUM_COMMON:].abs().topk(2, dim=-1).values[:, 1]
        return torch.where(second > 0.1 * size, (3 * second).clamp(max=size), 0.0)

    def _judge(
        self,
        state: JointState,
        update: Update,
        evidence: Tensor,
        shift: Tensor,
        step: Tensor,
        seen: Observations,
    ) -> tuple[JointState, Tensor]:
        """State after the frame, before any restart, and (B,) bool: the frame supported it.

        Without support the predicted state stands.
        """
        cfg = self.config
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
            mean=where(supported, update.mean, state.mean),
            cov=where(supported, update.cov, state.cov),
            phase=state.phase,
            evidence=where(supported, evidence, torch.zeros_like(evidence)),
            mimicry=where(supported & ~blind.any(-1), update.mimicry, state.mimicry),
            early=torch.zeros_like(unseen),
            unseen=unseen,
            misfit=misfit,
            status=status,
            reasons=reasons,
        )
        return after, supported

    def _restart(
        self,
        state: JointState,
        agreed: Tensor,
        supported: Tensor,
        segments: LaneSegments,
        intrinsics: Tensor,
        lane_width: float | Tensor,
    ) -> tuple[JointState, Tensor]:
        """Rows that have nothing, or nothing that fits, start from this frame alone if it allows that."""
        cfg = self.config
        wanted = ~is_running(state.status) | (~supported & (state.misfit > cfg.restart_after))
        if not torch.compiler.is_compiling() and not bool(wanted.any()):
            return state, agreed  # the same result: every row would discard the search
        fit = fit_single_frame(
            segments,
            intrinsics,
            lane_width,
            cfg.prior,
            cfg.num_boundaries,
            iterations=cfg.start_iterations,
        )
        share = (fit.inliers * segments.weight).sum(-1) / segments.weight.sum(-1).clamp(min=1e-6)
        fresh = wanted & fit.valid & (share >= cfg.enter_share)
        mean, cov = self._begin(fit.params(), fit.covariance)
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
        after = JointState(*(where(fresh, new, old) for new, old in zip(begun, state, strict=True)))
        return after, torch.where(fresh.unsqueeze(-1), fit.inliers, agreed)

    def _begin(self, params: Tensor, param_cov: Tensor) -> tuple[Tensor, Tensor]:
        """State (B, D) and covariance (B, D, D) around one frame's parameters and their covariance."""
        cfg = self.config
        batch, num = params.shape[0], cfg.num_boundaries
        angle, height = (
            density / (4 * cfg.motion.spring**3)
            for density in (cfg.motion.angular_density, cfg.motion.height_density)
        )
        swing = params.new_tensor([angle, angle, angle, height])  # stationary variances
        rates = torch.cat([swing * cfg.motion.spring**2, params.new_tensor([0.5**2])])
        straight, bend = params.new_tensor(cfg.straight), cfg.prior.std(params)[CURVATURE:]
        params, param_cov = straight_or_bend(params, param_cov, straight, bend, cfg.bends)
        spread = params.new_zeros(NUM_SEEN, NUM_PARAMS)  # c0 and c1 to the knots
        spread[:NUM_STRAIGHT, :NUM_STRAIGHT] = torch.eye(NUM_STRAIGHT)
        spread[CURVATURE, CURVATURE] = 1.0
        spread[STEPS, CURVATURE + 1] = KNOT_SPACING
        seen, seen_cov = params @ spread.mT, spread @ param_cov @ spread.mT
        zero, own = params.new_zeros(batch, 5), params.new_zeros(batch, num)
        mean = torch.cat([seen, zero, params[:, :NUM_POSE], own[:, :1], own], dim=-1)
        cov = params.new_zeros(batch, NUM_COMMON + num, NUM_COMMON + num)
        cov[:, :NUM_SEEN, :NUM_SEEN] = seen_cov
        cov[:, :NUM_SEEN, MEANS] = seen_cov[:, :, :NUM_POSE]
        cov[:, MEANS, :NUM_SEEN] = seen_cov[:, :NUM_POSE]
        cov[:, MEANS, MEANS] = param_cov[:, :NUM_POSE, :NUM_POSE] + swing.diag()
        cov[:, RATES, RATES] = rates.diag()
        own_variance = params.new_zeros(NUM_COMMON + num)
        own_variance[SHAPE] = cfg.motion.curvature_step**2
        own_variance[SPEED] = cfg.motion.speed_std**2
        own_variance[NUM_COMMON:] = cfg.motion.deviation_walk**2
        return mean, cov + own_variance.diag()

    def _calibration(self, state: JointState, inliers: Tensor, positions: Tensor) -> Calibration:
        """What goes out: the pose, its covariance, status, inliers.

        To the filter's covariance comes what it does not follow: the lane width's own scale; what any
        boundary may be out of place where one is; and height by the square of an error of roll, where that is
        held. With boundaries at x₁ and x₂ seen as they are, h'' = -2 (h - x₁ x₂ / h).
        """
        cov = state.cov[:, :NUM_POSE, :NUM_POSE]
        height, ego = state.mean[:, HEIGHT], self.config.num_boundaries // 2 - 1
        left, right = (positions[:, ego : ego + 2] + state.mean[:, OFFSET, None]).unbind(-1)
        bend = height - left * right / height.clamp(min=0.1)
        more = 3.0 * (bend * cov[:, ROLL, ROLL]).square() * _held(state.reasons)[:, ROLL]
        width = positions.diff(dim=-1).mean(-1)
        more = more + (self.config.lane_width_std / width * height).square()
        by_lanes = self._one_out_of_place(state.mean)[:, None, None] * state.mimicry
        only_height = torch.arange(NUM_POSE, device=cov.device) == HEIGHT
        cov = cov + by_lanes @ by_lanes.mT + (only_height * more.unsqueeze(-1)).diag_embed()
        return Calibration(Extrinsics.unstack(state.mean[:, :NUM_POSE]), cov, state.status, inliers)

    def _one_out_of_place(self, mean: Tensor) -> Tensor:
        """(B,) m, what any boundary may be out of place where one is, by no more than lanes differ."""
        size = self.config.open_deviation
        worst = mean[:, NUM_COMMON:].abs().amax(-1)
        alone = (worst > 0.1 * size) & (worst < _DOUBTFUL) & (self._inequality(mean) == 0)
        return torch.where(alone, worst.clamp(max=size), 0.0)


def _held(reasons: Tensor) -> Tensor:
    """(B, 4) bool, what of pitch, yaw, roll and height the frame with these reasons did not determine."""
    direction, roll, height = (
        (reasons & int(reason)) != 0
        for reason in (Reason.DIRECTION_UNSEEN, Reason.ROLL_UNSEEN, Reason.HEIGHT_UNSEEN)
    )
    return torch.stack([direction, direction, roll, height], dim=-1)
