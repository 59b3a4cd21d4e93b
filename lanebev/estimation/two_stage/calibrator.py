"""The paper's calibrator: pitch and yaw from the vanishing direction, roll and height from lane widths."""

from collections.abc import Callable
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.batch import flag, select_rows
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.checks import check_new_state, is_running, unused_frame
from lanebev.estimation.reasons import Reason
from lanebev.estimation.two_stage.departures import (
    NUM_SHAPE,
    boundary_moments,
    boundary_variance,
    covariance_by_departures,
    faded_sum,
    no_boundary_deviation,
    shape_information,
    shape_moment,
    unseen_variance,
)
from lanebev.estimation.two_stage.direction import (
    DirectionDepartures,
    DirectionStep,
    FrameRays,
    follow_departures,
    track_direction,
)
from lanebev.estimation.two_stage.lane_width import boundary_angles
from lanebev.estimation.two_stage.roll_height import RollHeightStep, SeenLanes, track_roll_height
from lanebev.estimation.two_stage.state import TwoStageConfig, TwoStageState
from lanebev.geometry.road import segment_rays
from lanebev.observation.segments import LaneSegments
from lanebev.types import Calibration, Extrinsics, Status, config_of


class TwoStageCalibrator(Calibrator[TwoStageState]):
    """Online calibration in the paper's two stages, per row of a batch, state in and state out.

    Source: Secs. III and IV. Assumes a straight flat road, parallel boundaries and equal known lane widths:
    at R = 860 m its yaw is 1.3 deg off (paper.md D17). It is called as
    :meth:`~lanebev.estimation.calibrator.Calibrator.forward` says: ``calibration, state =
    calibrator(segments, intrinsics, state, dt, lane_width)``.

    Args:
        config: the configuration, or keywords of :class:`TwoStageConfig`.
    """

    state_type = TwoStageState
    still_passes = 4  # it starts from a guess of roll and height, and its linearisation must converge

    def __init__(self, config: TwoStageConfig | None = None, **numbers: object) -> None:
        super().__init__()
        self.config = config_of(TwoStageConfig, config, numbers)
        self.num_boundaries = self.config.num_boundaries
        self.lane_width_std = self.config.lane_width_std
        self.draws: Tensor
        self.register_buffer("draws", self._drawn(torch.get_default_device()), persistent=False)

    def _drawn(self, device: torch.device) -> Tensor:
        """Draw the numbers (num_hypotheses, 2) in [0, 1), on the CPU if the device has no numbers."""
        generator, count = torch.Generator().manual_seed(self.config.seed), self.config.num_hypotheses
        draws = torch.rand(count, 2, generator=generator, dtype=torch.float64, device="cpu")
        return draws.float().to("cpu" if device.type == "meta" else device)  # some devices have no float64

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Apply what moves or casts a module, and draw again what ``to_empty`` and ``half`` would lose."""
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        if not self.draws.is_meta:
            self.draws = self._drawn(self.draws.device)
        return self

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> TwoStageState:
        """Return the state before the first frame: the initial pose with its uncertainty, UNINITIALISED.

        See :meth:`~lanebev.estimation.calibrator.Calibrator.initial_state` for arguments and errors.
        """
        check_new_state(batch_size, dtype)
        cfg = self.config
        pose, pose_std = cfg.initial_pose, cfg.initial_pose_std
        rate_std = cfg.initial_rate_std

        def part(indices: tuple[int, int]) -> tuple[Tensor, Tensor]:
            mean = torch.tensor([pose[i] for i in indices] + [0.0, 0.0], dtype=dtype, device=device)
            std = [pose_std[i] for i in indices] + [rate_std[i] for i in indices]
            cov = torch.diag(torch.tensor(std, dtype=dtype, device=device).square())
            return mean.repeat(batch_size, 1), cov.repeat(batch_size, 1, 1)

        direction, direction_cov = part((0, 1))
        roll_height, roll_height_cov = part((2, 3))
        no = torch.zeros(batch_size, dtype=torch.bool, device=device)
        unseen = torch.zeros(batch_size, dtype=dtype, device=device)
        status = torch.full((batch_size,), int(Status.UNINITIALISED), dtype=torch.int64, device=device)
        reasons = torch.full_like(status, int(Reason.NO_START))
        filters = (direction, direction_cov, roll_height, roll_height_cov, no, no.clone())
        nothing = (
            direction.new_zeros(batch_size, 8, NUM_SHAPE + 2 * self.num_boundaries + 1),
            direction.new_zeros(batch_size, 2, 3),
            direction.new_zeros(batch_size, 2, 4),
        )
        return TwoStageState(*filters, unseen, *nothing, status, reasons)

    def step(
        self, segments: LaneSegments, intrinsics: Tensor, state: TwoStageState, dt: Tensor, lane_width: Tensor
    ) -> tuple[Calibration, TwoStageState]:
        """Process one frame, see :meth:`~lanebev.estimation.calibrator.Calibrator.forward`."""
        guessed = ~dt.isfinite()
        dt = torch.where(guessed, self.config.assumed_dt, dt)
        before, skip = state, (dt <= 0) & is_running(state.status)
        dt = dt.clamp(0.0, 60.0)
        rays = segment_rays(segments.endpoints, intrinsics)  # (B, N, 2, 3)

        known = state.status != int(Status.UNINITIALISED)
        stale = known & (state.unseen + dt > self.config.lost_after)
        state = state._replace(status=torch.where(stale, int(Status.LOST), state.status))
        frame = FrameRays(segments, rays, intrinsics)
        one = track_direction(frame, state, dt, self.draws, self.config)
        inliers = segments._replace(weight=segments.weight * one.inliers)
        pitch, yaw = one.mean[:, 0], one.mean[:, 1]
        of_one = follow_departures(one, frame, state)
        boundaries = boundary_angles(
            inliers, rays, intrinsics, pitch, yaw, self.num_boundaries, of_one.distance
        )
        lanes = SeenLanes(boundaries, lane_width, one.cov[:, :2, :2], of_one.sensitivity[:, :2])
        two = track_roll_height(lanes, state, dt, one.fresh, self.config)
        unseen = torch.where(one.seen, 0.0, state.unseen + dt)
        status = _status(state.status, one.seen, unseen, self.config.lost_after)
        reasons = _reasons(segments, one, two, status) | flag(guessed, Reason.TIME)
        departures = self._departures(state, dt, one.seen, of_one, two)
        after = TwoStageState(one.mean, one.cov, *two[:4], unseen, *departures, status, reasons)
        skipped = before._replace(reasons=before.reasons | int(Reason.TIME))
        state = select_rows(skip, skipped, after)
        return unused_frame(self._calibration(state, lane_width, one.inliers), skip), state

    def pitch_and_yaw(self, state: TwoStageState) -> tuple[Tensor, Tensor]:
        """Return pitch and yaw of a state, (B, 2) rad, and their variances (B, 2)."""
        return state.direction_mean[:, :2], state.direction_cov[:, :2, :2].diagonal(dim1=-2, dim2=-1)

    def _departures(
        self, state: TwoStageState, dt: Tensor, seen: Tensor, one: DirectionDepartures, two: RollHeightStep
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return sensitivity, shape and scatter of the state after a frame."""
        num, memory = self.num_boundaries, self.config.departure_memory
        sensitivity = torch.cat([pad(one.sensitivity, (0, num + 1)), two.sensitivity], dim=1)
        headings = boundary_moments(one.matrix, one.vector, 2 + NUM_SHAPE, num)
        deviations = boundary_moments(two.matrix, two.vector, 2, num)
        shape = faded_sum(shape_information(one.matrix, one.vector), state.shape, dt, seen, memory)
        scatter = faded_sum(torch.stack([headings, deviations], 1), state.scatter, dt, seen, memory)
        return sensitivity, shape, scatter

    def _covariance_by_departures(self, state: TwoStageState, lane_width: Tensor) -> Tensor:
        """Return the covariance (B, 4, 4) of the pose by the road's departures from the model."""
        cfg, first = self.config, NUM_SHAPE + self.num_boundaries
        sensitivity = torch.cat([state.sensitivity[:, :2], state.sensitivity[:, 4:6]], dim=1)
        roll, height = state.roll_height_mean[:, 0], state.roll_height_mean[:, 1]
        odd = no_boundary_deviation(
            sensitivity[:, 2, first:-1], roll - cfg.initial_pose[2], cfg.initial_pose_std[2]
        )
        shape = shape_moment(state.shape)
        spread = 0.5 * lane_width.mean(-1) / height
        own = boundary_variance(state.scatter, unseen_variance(shape, spread, odd, cfg.lane_deviation_std))
        return covariance_by_departures(sensitivity, shape, own, state.roll_height_cov[:, 0, 0])

    def _calibration(self, state: TwoStageState, lane_width: Tensor, inliers: Tensor) -> Calibration:
        pose = torch.cat([state.direction_mean[:, :2], state.roll_height_mean[:, :2]], dim=-1)
        cov = torch.zeros(*pose.shape, 4, dtype=pose.dtype, device=pose.device)
        upper = torch.cat([state.direction_cov[:, :2, :2], cov[:, :2, 2:]], dim=-1)
        lower = torch.cat([cov[:, 2:, :2], state.roll_height_cov[:, :2, :2]], dim=-1)
        scale = pose[:, 3] * self.config.lane_width_std / lane_width.mean(-1)
        prior = torch.stack([torch.zeros_like(scale)] * 3 + [scale.square()], dim=-1).diag_embed()
        cov = torch.cat([upper, lower], dim=-2) + prior
        if self.config.departures:
            cov = cov + self._covariance_by_departures(state, lane_width)
        return Calibration(Extrinsics.unstack(pose), cov, state.status, inliers)


def _status(before: Tensor, seen: Tensor, unseen: Tensor, lost_after: float) -> Tensor:
    """Update the status of each row: initialise -> track -> coast -> lost -> re-initialise."""
    coasting = torch.where(unseen > lost_after, int(Status.LOST), int(Status.COASTING))
    idle = (before == int(Status.UNINITIALISED)) | (before == int(Status.LOST))
    unsupported = torch.where(idle, before, coasting)
    return torch.where(seen, int(Status.TRACKING), unsupported)


def _reasons(
    segments: LaneSegments, direction: DirectionStep, roll_height: RollHeightStep, status: Tensor
) -> Tensor:
    """Return flags (B,) int64 of :class:`Reason` for a frame that was not skipped."""
    empty = ~(segments.weight > 0).any(-1)
    idle = (status == int(Status.UNINITIALISED)) | (status == int(Status.LOST))
    return (
        flag(empty, Reason.NO_SEGMENTS)
        | flag(~empty & ~direction.seen, Reason.FEW_INLIERS)
        | flag(~direction.seen, Reason.DIRECTION_UNSEEN)
        | flag(~(direction.seen & roll_height.roll_seen), Reason.ROLL_UNSEEN)
        | flag(~(direction.seen & roll_height.height_seen), Reason.HEIGHT_UNSEEN)
        | flag(direction.fresh, Reason.RESTARTED)
        | flag(idle, Reason.NO_START)
    )
