"""One filter over the whole pose, with every end point as a measurement."""

from functools import partial

import torch
from torch import Tensor

from lanebev.batch import flag, in_blocks, may_skip, select_rows
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.checks import (
    FEW_SEGMENTS,
    as_batch,
    as_lane_width,
    check_new_state,
    harmless_widths,
    is_running,
    mask_invalid_rows,
    unused_frame,
    usable_widths,
)
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.iterated_update import update_state
from lanebev.estimation.joint.filter.prediction import elapsed, predict_state
from lanebev.estimation.joint.filter.restart import restart
from lanebev.estimation.joint.filter.speed import update_by_speed
from lanebev.estimation.joint.filter.start import new_state, start_moments
from lanebev.estimation.joint.filter.status import update_track_status
from lanebev.estimation.joint.filter.usual_pose import compare_with_usual
from lanebev.estimation.joint.frame.averaging import weigh_readings
from lanebev.estimation.joint.frame_prior import temper_frame
from lanebev.estimation.joint.layout import NUM_COMMON, STEPS, layout
from lanebev.estimation.joint.measurement.observations import boundary_places, observations
from lanebev.estimation.joint.measurement.residuals import CURVATURE, VERTICAL
from lanebev.estimation.joint.measurement.road_curve import KNOT_SPACING
from lanebev.estimation.joint.output import as_calibration, scaled_covariance
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.reasons import Reason
from lanebev.geometry.precision import autocast_off, cast_floating, widest_dtype
from lanebev.observation.segments import LaneSegments
from lanebev.tensors import one_thread_if_small
from lanebev.types import Calibration, Extrinsics, Status, config_of


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
        self.config = config_of(JointConfig, config, numbers)
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
            mean, cov = start_moments(params, spread, torch.zeros_like(params), cfg)
        none = torch.zeros(batch_size, dtype=torch.int64, device=device)
        return new_state(mean, cov, Status.UNINITIALISED, none + int(Reason.NO_START))

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
        cfg, indices = self.config, layout(self.config.num_boundaries)
        if state.mean.shape[-1] != indices.size:
            got = state.mean.shape[-1] - layout(0).size
            raise ValueError(f"state: expected one of {cfg.num_boundaries} boundaries, got one of {got}")
        seen = observations(segments, intrinsics)
        positions = boundary_places(lane_width, cfg.num_boundaries, dt)  # (B, L)
        time = elapsed(dt, state, cfg)

        predicted = predict_state(state, time.dt, cfg).state
        numbers = 6 * indices.size**2 + NUM_COMMON * seen.pixels.shape[-1]  # above all the Jacobian
        update = in_blocks(numbers, partial(update_state, cfg=cfg), predicted, positions, seen, time.dt)
        after, supported = update_track_status(predicted, update, time.dt, seen, cfg)
        after, inliers = restart(after, update.inliers, supported, seen, positions, cfg)
        after = compare_with_usual(state, after, seen, inliers, time.dt, cfg)
        after = after._replace(reasons=after.reasons | flag(time.guessed, Reason.TIME))

        if not may_skip(time.skip):
            skipped = state._replace(reasons=state.reasons | int(Reason.TIME), early=time.early)
            after = select_rows(time.skip, skipped, after)
        calibration = as_calibration(after, inliers, positions, cfg)
        return unused_frame(calibration, time.skip), after

    def with_speed(self, state: JointState, speed: float | Tensor) -> JointState:
        """Update a state by the vehicle's speed, at which the camera passes the road's bends.

        Without it the speed is a prior, which a bend that moves through the view corrects; on slow, winding
        roads that is not enough. Its standard deviation is ``MotionConfig.measured_speed_std``.

        Raises:
            ValueError: a speed of another shape.
        """
        like = state.mean.to(widest_dtype(state.mean.device))
        with autocast_off(like.device, like.dtype):
            updated = update_by_speed(
                cast_floating(state, like.dtype), as_batch(speed, like, "speed"), self.config
            )
        return cast_floating(updated, state.mean.dtype)

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
        with autocast_off(like.device, like.dtype), one_thread_if_small(segments.weight, FEW_SEGMENTS):
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

    def scale_drive(
        self, calibration: Calibration, state: JointState, factor: float, lane_width: float | Tensor = 3.7
    ) -> Calibration:
        """Multiply the standard deviations of a drive's pose, except the part for unverified lanes (J36)."""
        if factor == 1:
            return calibration
        given = calibration.covariance
        like = given.to(widest_dtype(given.device))
        widths = as_lane_width(lane_width, like, self.num_boundaries)
        positions = boundary_places(harmless_widths(widths, usable_widths(widths)), self.num_boundaries, like)
        with autocast_off(like.device, like.dtype):
            known = cast_floating(state, like.dtype)
            scaled = scaled_covariance(like, known, positions, self.config, factor)
        return cast_floating(calibration._replace(covariance=scaled), given.dtype)

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
