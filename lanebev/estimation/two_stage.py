"""The paper's calibrator: pitch and yaw from the vanishing direction, roll and height from lane widths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lanebev.estimation.checks import as_batch, as_lane_width, calibrates, is_running
from lanebev.estimation.direction_stage import track_direction
from lanebev.estimation.lane_width import boundary_angles
from lanebev.estimation.roll_height_stage import track_roll_height
from lanebev.geometry.road import rays_from_pixels
from lanebev.rows import where
from lanebev.types import NUM_BOUNDARIES, Calibration, Extrinsics, LaneSegments, Status, saved_by_name


@dataclass(frozen=True)
class TwoStageConfig:
    """Numbers of :class:`TwoStageCalibrator`; angles in rad, lengths in m, times in s.

    The paper gives none of Q, W, N_loop or the search range (PAPER_NOTES 13). W here admits ±1.5 deg and
    ±5 cm at 1 Hz.
    """

    num_boundaries: int = NUM_BOUNDARIES
    num_hypotheses: int = 300  # N_loop, at most
    seed: int = 0  # of the hypotheses
    gate_sigmas: float = 3.5  # 0 is the paper's fixed gate of 0.7 deg
    angular_acceleration_density: float = 0.25  # rad² / s³, of pitch, yaw and roll
    height_acceleration_density: float = 1.0  # m² / s³
    initial_pose: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.5)
    initial_pose_std: tuple[float, float, float, float] = (0.1, 0.1, 0.05, 0.5)
    initial_rate_std: tuple[float, float, float, float] = (0.2, 0.2, 0.2, 0.5)  # per second
    min_segments: int = 4  # for a vanishing point to be believed
    min_inlier_share: float = 0.3
    reacquire_after: float = 0.2  # s without support before the search starts over
    reacquire_spread: float = 0.013  # rad, sigma of the predicted direction at which it does, too
    lost_after: float = 1.5  # s without support
    assumed_dt: float = 1 / 30  # s between frames where it is not finite
    lane_noise: float = 0.0  # m, how far single lanes differ from the prior
    lane_width_std: float = 0.0  # m, how far the prior itself may be off: a common scale of height

    def __post_init__(self) -> None:
        if self.num_boundaries < 2:
            raise ValueError(f"num_boundaries: expected at least 2, got {self.num_boundaries}")
        if self.num_hypotheses < 1:
            raise ValueError(f"num_hypotheses: expected at least 1, got {self.num_hypotheses}")


@saved_by_name
class TwoStageState(NamedTuple):
    """Everything the calibrator remembers, tensors only.

    Attributes:
        direction_mean: (B, 4) pitch, yaw and their rates; direction_cov: (B, 4, 4).
        roll_height_mean: (B, 4) roll, height and their rates; roll_height_cov: (B, 4, 4).
        roll_known, height_known: (B,) bool, initialised from lane widths.
        unseen: (B,) s since the vanishing point was last supported.
        status: (B,) int64.
    """

    direction_mean: Tensor
    direction_cov: Tensor
    roll_height_mean: Tensor
    roll_height_cov: Tensor
    roll_known: Tensor
    height_known: Tensor
    unseen: Tensor
    status: Tensor


class TwoStageCalibrator(nn.Module):
    """Online calibration in the paper's two stages, per row of a batch, state in and state out.

    Source: Secs. III and IV. Assumes a straight flat road, parallel boundaries and equal known lane widths:
    at R = 860 m its yaw is 1.3 deg off (PAPER_NOTES 17).

    Args:
        config: the numbers, or keywords of :class:`TwoStageConfig`.
    """

    state_type = TwoStageState

    def __init__(self, config: TwoStageConfig | None = None, **numbers: object) -> None:
        super().__init__()
        if config is not None and numbers:
            raise ValueError("config: expected either a TwoStageConfig or its keywords, got both")
        self.config = config or TwoStageConfig(**numbers)  # type: ignore[arg-type]
        generator = torch.Generator().manual_seed(self.config.seed)
        self.draws: Tensor
        draws = torch.rand(self.config.num_hypotheses, 2, generator=generator, dtype=torch.float64)
        self.register_buffer("draws", draws.float(), persistent=False)  # some devices have no float64

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> TwoStageState:
        """State before the first frame: the initial pose with its uncertainty, UNINITIALISED."""
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
        return TwoStageState(
            direction, direction_cov, roll_height, roll_height_cov, no, no.clone(), unseen, status
        )

    @calibrates
    def forward(
        self,
        segments: LaneSegments,
        intrinsics: Tensor,
        state: TwoStageState,
        dt: float | Tensor,
        lane_width: float | Tensor = 3.7,
    ) -> tuple[Calibration, TwoStageState]:
        """One frame; the results have the state's dtype.

        Args:
            segments: of this frame, N per row; weight 0 is not there, non-finite counts as not there.
            intrinsics: (B, 3, 3) px. A row where they or the widths are not finite and positive sees nothing.
            state: of the frame before, or :meth:`initial_state`.
            dt: s since that frame, float or (B,). A started row skips a frame that is not later (0 or
                negative). Where not finite, an interval is assumed.
            lane_width: m, float, (B,) or (B, L-1) per lane.

        Returns:
            calibration of this frame and the state after it.

        Raises:
            ValueError: a shape that doesn't fit.
        """
        dt = as_batch(dt, segments.sigma)
        dt = torch.where(dt.isfinite(), dt, self.config.assumed_dt)
        before, skip = state, (dt <= 0) & is_running(state.status)
        dt = dt.clamp(0.0, 60.0)
        widths = as_lane_width(lane_width, segments.sigma, self.config.num_boundaries)
        rays = rays_from_pixels(segments.endpoints.flatten(1, 2), intrinsics)
        rays = rays.reshape(*segments.endpoints.shape[:-1], 3)  # (B, N, 2, 3)

        known = state.status != int(Status.UNINITIALISED)
        stale = known & (state.unseen + dt > self.config.lost_after)
        state = state._replace(status=torch.where(stale, int(Status.LOST), state.status))
        one = track_direction(segments, rays, intrinsics, state, dt, self.draws, self.config)
        boundaries = boundary_angles(
            rays,
            segments.boundary,
            segments.weight * one.inliers,
            segments.sigma,
            intrinsics,
            one.mean[:, 0],
            one.mean[:, 1],
            self.config.num_boundaries,
        )
        two = track_roll_height(boundaries, widths, one.cov[:, :2, :2], state, dt, one.fresh, self.config)
        unseen = torch.where(one.seen, 0.0, state.unseen + dt)
        status = _status(state.status, one.seen, unseen, self.config.lost_after)
        after = TwoStageState(one.mean, one.cov, *two, unseen, status)
        state = TwoStageState(*(where(skip, old, new) for old, new in zip(before, after, strict=True)))
        return self._calibration(state, widths, one.inliers), state

    def _calibration(self, state: TwoStageState, lane_width: Tensor, inliers: Tensor) -> Calibration:
        pose = torch.cat([state.direction_mean[:, :2], state.roll_height_mean[:, :2]], dim=-1)
        cov = torch.zeros(*pose.shape, 4, dtype=pose.dtype, device=pose.device)
        upper = torch.cat([state.direction_cov[:, :2, :2], cov[:, :2, 2:]], dim=-1)
        lower = torch.cat([cov[:, 2:, :2], state.roll_height_cov[:, :2, :2]], dim=-1)
        scale = pose[:, 3] * self.config.lane_width_std / lane_width.mean(-1)
        prior = torch.stack([torch.zeros_like(scale)] * 3 + [scale.square()], dim=-1).diag_embed()
        cov = torch.cat([upper, lower], dim=-2) + prior
        return Calibration(Extrinsics.unstack(pose), cov, state.status, inliers)


def _status(before: Tensor, seen: Tensor, unseen: Tensor, lost_after: float) -> Tensor:
    """initialise -> track -> coast -> lost -> re-initialise, per row."""
    coasting = torch.where(unseen > lost_after, int(Status.LOST), int(Status.COASTING))
    idle = (before == int(Status.UNINITIALISED)) | (before == int(Status.LOST))
    unsupported = torch.where(idle, before, coasting)
    return torch.where(seen, int(Status.TRACKING), unsupported)
