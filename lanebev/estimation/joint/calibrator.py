"""One filter over the whole pose, with every end point as a measurement."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from lanebev.batch import flag, in_blocks, select_rows
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.checks import (
    as_lane_width,
    check_new_state,
    is_running,
    mask_invalid_rows,
    unused_frame,
)
from lanebev.estimation.joint.averaging import weigh_readings
from lanebev.estimation.joint.dynamics import RoadMotion, motion
from lanebev.estimation.joint.evidence import (
    accumulate_evidence,
    adapt_motion_scale,
    adaptive_process_noise,
    deviation_prior_std,
    hill_variance,
    normalized_score,
)
from lanebev.estimation.joint.lane_change import best_shift, renumber
from lanebev.estimation.joint.layout import NUM_COMMON, NUM_POSE, POSE, SHAPE, STEPS, layout
from lanebev.estimation.joint.measurement import (
    CURVATURE,
    NUM_STRAIGHT,
    VERTICAL,
    boundary_distances,
    boundary_residuals,
    foot_points,
    look,
)
from lanebev.estimation.joint.observations import Observations, boundary_places, observations, per_end
from lanebev.estimation.joint.output import as_calibration
from lanebev.estimation.joint.restart import restart
from lanebev.estimation.joint.road import propagate_road_shape
from lanebev.estimation.joint.road_curve import KNOT_SPACING
from lanebev.estimation.joint.scatter import Scatter, averaged_moments, boundary_scatter, with_headings
from lanebev.estimation.joint.state import JointConfig, JointState, state_from_fit, unobserved_mask
from lanebev.estimation.joint.status import update_track_status
from lanebev.estimation.joint.tempering import temper_frame
from lanebev.estimation.joint.update import (
    FrameInformation,
    agreement,
    boundary_deviation,
    estimated_entries,
    frame_information,
    kalman_gain,
    membership,
    observed_step,
    posterior_covariance,
    single_frame_std,
    wide_precision,
)
from lanebev.estimation.kalman import predict
from lanebev.estimation.reasons import Reason
from lanebev.geometry.precision import autocast_off, cast_floating, widest_dtype
from lanebev.observation.segments import LaneSegments
from lanebev.tensors import constant
from lanebev.types import Calibration, Extrinsics, Status, check_type

_NO_BOUNDARY_DEVIATION = 0.36  # m, from which a line bounds no lane: three sigmas of `open_deviation`


class JointCalibrator(Calibrator[JointState]):
    """Online calibration by one iterated filter, per row of a batch, state in and state out.

    Deviation from the paper: one stage instead of two, so that all axes use all information; perpendicular
    pixel distances with propagated noise instead of normals; curved roads, lane changes, unequal lanes. It is
    called as :meth:`~lanebev.estimation.calibrator.Calibrator.forward` says: ``calibration, state =
    calibrator(segments, intrinsics, state, dt, lane_width)``. docs/method/joint.md defines it.

    Args:
        config: the configuration, or keywords of :class:`JointConfig`.
    """

    state_type = JointState

    def __init__(self, config: JointConfig | None = None, **numbers: object) -> None:
        super().__init__()
        check_type("config", config, JointConfig)
        if config is not None and numbers:
            raise ValueError("config: expected either a JointConfig or its keywords, got both")
        self.config = config or JointConfig(**numbers)  # type: ignore[arg-type]
        self.num_boundaries = self.config.num_boundaries
        self.lane_width_std = self.config.lane_width_std

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> JointState:
        """Return the state before the first frame: the prior, UNINITIALISED."""
        check_new_state(batch_size, dtype)
        cfg = self.config
        like = torch.zeros((), dtype=dtype, device=device)
        params = cfg.prior.mean(like).repeat(batch_size, 1)
        with autocast_off(like.device, like.dtype):
            spread = cfg.prior.std(like).square().diag().repeat(batch_size, 1, 1)
            mean, cov = state_from_fit(params, spread, torch.zeros_like(params), cfg)
        none = torch.zeros(batch_size, dtype=torch.int64, device=device)
        zero = torch.zeros(batch_size, dtype=dtype, device=device)
        return JointState(
            mean=mean,
            cov=cov,
            phase=zero.clone(),
            evidence=mean.new_zeros(batch_size, NUM_POSE + NUM_COMMON - CURVATURE + cfg.num_boundaries),
            pose_sensitivity=mean.new_zeros(batch_size, NUM_POSE, 2 * cfg.num_boundaries),
            scatter=mean.new_zeros(batch_size, 2, 3),
            motion_scale=mean.new_ones(batch_size, NUM_POSE),
            hills=zero.clone(),
            early=zero.clone(),
            unseen=zero,
            misfit=zero.clone(),
            doubt=zero.clone(),
            contrary=zero.clone(),
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
        """Process one frame, see :meth:`~lanebev.estimation.calibrator.Calibrator.forward`.

        After a late frame the next dt counts from it. Inliers fit the road; a boundary that deviates too much
        to bound a lane, such as the foot of a barrier, has 0, whether for long or in this frame only.
        """
        cfg, place = self.config, layout(self.config.num_boundaries)
        if state.mean.shape[-1] != place.size:
            got = state.mean.shape[-1] - layout(0).size
            raise ValueError(f"state: expected one of {cfg.num_boundaries} boundaries, got one of {got}")
        seen = observations(segments, intrinsics)
        positions = boundary_places(lane_width, cfg.num_boundaries, dt)  # (B, L)
        step, skip, early, guessed = elapsed(dt, state, cfg)

        predicted = predict_state(state, step, cfg)
        numbers = 6 * place.size**2 + NUM_COMMON * seen.pixels.shape[-1]  # above all the Jacobian
        updated, trust, agreed, alone = in_blocks(
            numbers, partial(update_state, cfg=cfg), predicted, positions, seen, step
        )
        after, supported = update_track_status(predicted, updated, trust, alone, step, seen, cfg)
        after, agreed, apart = restart(after, agreed, supported, seen, positions, cfg)
        after = after._replace(reasons=after.reasons | flag(guessed, Reason.TIME))

        skipped = state._replace(reasons=state.reasons | int(Reason.TIME), early=early)
        after = select_rows(skip, skipped, after)
        apart = torch.where(skip.unsqueeze(-1), 0.0, apart)
        calibration = as_calibration(after, agreed, apart, positions, cfg)
        return unused_frame(calibration, skip), after

    def weigh_still(
        self,
        calibration: Calibration,
        state: JointState,
        segments: LaneSegments,
        intrinsics: Tensor,
        lane_width: float | Tensor,
    ) -> Calibration:
        """Average a started row's pose over all ways to read its image, see :mod:`averaging`."""
        like = state.mean.to(widest_dtype(state.mean.device))
        segments, intrinsics = cast_floating(segments, like.dtype), cast_floating(intrinsics, like.dtype)
        widths = as_lane_width(lane_width, like, self.num_boundaries)
        segments, intrinsics, widths = mask_invalid_rows(segments, intrinsics, widths, self.num_boundaries)
        with autocast_off(like.device, like.dtype):
            weighed = weigh_readings(calibration, like, segments, intrinsics, widths, self.config)
        return cast_floating(weighed, calibration.covariance.dtype)

    def scale_still(self, calibration: Calibration, factor: float) -> Calibration:
        """Multiply the standard deviations of a single image's information by a factor, not the prior's."""
        given = calibration.covariance
        like = given.to(widest_dtype(given.device))
        pose = calibration.extrinsics.stack().to(like)
        with autocast_off(like.device, like.dtype):
            tempered = temper_frame(pose, like, self.config.prior, factor)
        begun = is_running(calibration.status)
        pose, covariance = (select_rows(begun, *both) for both in zip(tempered, (pose, like), strict=True))
        scaled = calibration._replace(extrinsics=Extrinsics.unstack(pose), covariance=covariance)
        return cast_floating(scaled, given.dtype)

    def curvature(self, state: JointState) -> Tensor:
        """Return the road's curvature at the camera, (B,) 1/m, positive to the right."""
        share = (state.phase / KNOT_SPACING).unsqueeze(-1)
        first, steps = state.mean[:, CURVATURE], state.mean[:, STEPS]
        return first + (share * steps)[:, 0]

    def vertical_curvature(self, state: JointState) -> Tensor:
        """Return the road's vertical curvature κ of (J1), (B,) 1/m, positive over a crest."""
        return state.mean[:, VERTICAL]

    def pitch_and_yaw(self, state: JointState) -> tuple[Tensor, Tensor]:
        """Return pitch and yaw of a state, (B, 2) rad, and their variances (B, 2)."""
        return state.mean[:, :2], state.cov[:, :2, :2].diagonal(dim1=-2, dim2=-1)


def elapsed(dt: Tensor, state: JointState, cfg: JointConfig) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute the time to predict over; whether to skip the frame; how far ahead the state is; if guessed."""
    due = dt - state.early
    guessed = ~((due > -1.0) & (due < torch.inf))
    due = torch.where(guessed, cfg.assumed_dt, due)
    skip = (due <= 0) & is_running(state.status)
    return due.clamp(0.0, 60.0), skip, torch.where(skip, -due, 0.0), guessed


def predict_state(state: JointState, dt: Tensor, cfg: JointConfig) -> JointState:
    """Predict mean, covariance and phase over dt (B,) s."""
    road, transition, noise = state_motion(state, dt, cfg)
    mean, cov = predict(state.mean, state.cov, transition, noise)
    mean = torch.cat([mean[:, :CURVATURE], road.shape, mean[:, SHAPE.stop :]], dim=-1)
    return state._replace(mean=mean, cov=cov, phase=road.phase, hills=hill_variance(state, dt, cfg))


def state_motion(state: JointState, dt: Tensor, cfg: JointConfig) -> tuple[RoadMotion, Tensor, Tensor]:
    """Compute how a state moves over dt (B,) s: its road; F (B, D, D); W (B, D, D)."""
    place = layout(cfg.num_boundaries)
    road = propagate_road_shape(state.mean, state.cov[:, SHAPE, SHAPE], state.phase, dt, place, cfg.motion)
    scale = state.motion_scale.sqrt()
    unobserved = unobserved_mask(state.reasons)
    scale = torch.where(unobserved, scale.clamp(min=cfg.motion.unobserved_scale), scale)
    unequal = deviation_prior_std(state.mean[:, place.deviations], cfg)
    vertical = (cfg.motion.vertical_curvature_std**2 + hill_variance(state, dt, cfg)).sqrt()
    return road, *motion(dt, scale, unequal, vertical, road, place, cfg.motion)


def update_state(
    predicted: JointState, positions: Tensor, seen: Observations, step: Tensor, cfg: JointConfig
) -> tuple[JointState, Tensor, Tensor, Tensor]:
    """Update a prediction by a frame: lane change, iterated robust update, adaptive process noise.

    After the first iteration, evidence against the motion raises the process noise for the others.

    Args:
        predicted: state.
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        seen: what was observed.
        step: (B,) s since the last frame.
        cfg: the configuration.

    Returns:
        the state with the frame; weights of the segments (B, N); inliers (B, N); standard deviations (B, 5)
        of pose and offset by this frame alone.
    """
    place, num = layout(cfg.num_boundaries), cfg.num_boundaries
    ego = num // 2 - 1
    width = positions[:, ego + 1] - positions[:, ego]
    sight = look(predicted.mean[:, :NUM_COMMON], seen, predicted.phase)
    shift, scale = best_shift(predicted.mean, positions, seen, sight, width)
    prior, cov = renumber(predicted.mean, shift, width, num), predicted.cov
    places = positions.gather(1, seen.boundary)  # (B, N)
    member = membership(seen.boundary, num, like=places)
    before = prior[:, place.observed]
    at, doubt = before, cov[:, place.observed, place.observed]
    for iteration in range(cfg.iterations):
        params, own = at[:, :NUM_COMMON], at[:, NUM_COMMON:].gather(1, seen.boundary)
        if iteration == 0:
            feet = foot_points(params, places + own, seen, sight)
            residuals = boundary_residuals(params, places + own, seen, predicted.phase, feet, sight)
        else:  # the Jacobian stays
            distance, valid = boundary_distances(params, places + own, seen, feet, predicted.phase)
            residuals = residuals._replace(distance=distance, valid=valid)
        frame = frame_information(residuals, scale, doubt, seen, member)
        alone = single_frame_std(frame.matrix)
        estimated = estimated_entries(alone, num)
        moved = observed_step(
            before, cov[:, place.observed, place.observed], at, frame, estimated[:, place.observed]
        )
        used = cov
        if iteration == 0:
            support = torch.bmm(member, per_end(frame.trust * seen.weight).unsqueeze(-1)).squeeze(-1)
            score = normalized_score(doubt, frame, support, seen.weight)
            evidence, motion_scale = with_evidence(predicted, score, estimated[:, POSE] > 0, step, cfg)
            noise = adaptive_process_noise(evidence, doubt, cfg)
            cov = cov + torch.nn.functional.pad(noise, (0, place.size - noise.shape[-1])).diag_embed()
        last, at, doubt, scale = at, moved.mean, moved.cov, frame.scale
    scatter = scatter_of_frame(frame, cov, member, predicted.scatter)
    gain = kalman_gain(used, moved, frame, estimated)
    updated = predicted._replace(
        mean=torch.baddbmm(prior.unsqueeze(-1), gain, moved.pull.unsqueeze(-1)).squeeze(-1),
        cov=posterior_covariance(cov, frame.matrix, gain),
        evidence=evidence,
        pose_sensitivity=scatter.sensitivity,
        scatter=averaged_moments(scatter.moments, predicted.scatter, step, cfg.scatter_memory),
        motion_scale=motion_scale,
        reasons=flag(shift != 0, Reason.LANE_CHANGE),
    )
    agreed = agreement(frame, at - last, seen)
    apart = torch.maximum(at[:, NUM_COMMON:].abs(), boundary_deviation(last, frame).abs())
    lane = (apart < _NO_BOUNDARY_DEVIATION).gather(1, seen.boundary)
    return updated, frame.trust, torch.where((seen.weight > 0) & lane, agreed, 0.0), alone


def with_evidence(
    predicted: JointState, score: Tensor, pose_told: Tensor, step: Tensor, cfg: JointConfig
) -> tuple[Tensor, Tensor]:
    """Add a frame's scores to the evidence against the motion, and adapt the scale of the motion to them.

    Args:
        predicted: state.
        score: (B, 11 + L), of :func:`~lanebev.estimation.joint.evidence.normalized_score`.
        pose_told: (B, 4) bool, what of the pose the frame determines; the scale of the rest decays.
        step: (B,) s since the last frame.
        cfg: the configuration.

    Returns:
        evidence (B, 11 + L) and scale (B, 4).
    """
    evidence = accumulate_evidence(predicted.evidence, score, step, cfg.evidence_time)
    scored = torch.where(pose_told, score[:, POSE], 1.0)  # 1 is the score that is expected
    return evidence, adapt_motion_scale(predicted.motion_scale, scored, step, cfg)


def scatter_of_frame(frame: FrameInformation, cov: Tensor, member: Tensor, moments: Tensor) -> Scatter:
    """Estimate the scatter of the boundaries beside pose, offset and vertical curvature.

    Args:
        frame: its information, near the state.
        cov: (B, D, D), of the state before the frame.
        member: (B, L, M), boundary of each end point.
        moments: (B, 2, 3) of the frames before.
    """
    matrix, vector = with_headings(frame.matrix, frame.vector, frame.residuals, frame.weight, member)
    kept = constant((*range(NUM_STRAIGHT), *range(VERTICAL, vector.shape[-1])), matrix, torch.int64)
    matrix, vector = matrix.index_select(1, kept).index_select(2, kept), vector.index_select(1, kept)
    of_vertical = cov[:, VERTICAL, VERTICAL, None].reciprocal()
    precision = torch.cat([wide_precision(cov), of_vertical], dim=-1)
    return boundary_scatter(matrix, vector, precision, moments)
