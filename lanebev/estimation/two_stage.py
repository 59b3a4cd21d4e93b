"""The paper's calibrator: pitch and yaw from the vanishing direction, roll and height from lane widths."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lanebev.estimation import kalman
from lanebev.estimation.checks import as_batch, as_lane_width, check_segments, clean_segments
from lanebev.estimation.lane_width import (
    BoundarySlopes,
    boundary_slopes,
    initial_roll_height,
    measure_widths,
)
from lanebev.estimation.vanishing import (
    gate_angles,
    incidence_noise,
    ransac_vanishing_point,
    segment_angles,
    vanishing_dir_least_squares,
)
from lanebev.geometry.road import rays_from_pixels
from lanebev.geometry.rotation import pitch_yaw_from_vanishing_dir, vanishing_dir_from_pitch_yaw
from lanebev.types import NUM_BOUNDARIES, Calibration, Extrinsics, LaneSegments, Status


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
    reacquire_after: float = 0.2  # s of failing gates before the search starts over
    lost_after: float = 1.5  # s without support
    lane_noise: float = 0.0  # m, how far single lanes differ from the prior
    lane_width_std: float = 0.0  # m, how far the prior itself may be off: a common scale of height

    def __post_init__(self) -> None:
        if self.num_boundaries < 2:
            raise ValueError(f"num_boundaries: expected at least 2, got {self.num_boundaries}")
        if self.num_hypotheses < 1:
            raise ValueError(f"num_hypotheses: expected at least 1, got {self.num_hypotheses}")


class TwoStageState(NamedTuple):
    """Everything the calibrator remembers, tensors only.

    Attributes:
        direction: (B, 4) pitch, yaw and their rates; direction_cov: (B, 4, 4).
        roll_height: (B, 4) roll, height and their rates; roll_height_cov: (B, 4, 4).
        roll_known, height_known: (B,) bool, initialised from lane widths.
        unseen: (B,) s since the vanishing point was last supported.
        status: (B,) int64.
    """

    direction: Tensor
    direction_cov: Tensor
    roll_height: Tensor
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

    def __init__(self, config: TwoStageConfig | None = None, **numbers: object) -> None:
        super().__init__()
        if config is not None and numbers:
            raise ValueError("config: expected either a TwoStageConfig or its keywords, got both")
        self.config = config or TwoStageConfig(**numbers)  # type: ignore[arg-type]
        generator = torch.Generator().manual_seed(self.config.seed)
        draws = torch.rand(self.config.num_hypotheses, 2, generator=generator, dtype=torch.float64)
        self.draws: Tensor
        self.register_buffer("draws", draws, persistent=False)

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

    def forward(
        self,
        segments: LaneSegments,
        intrinsics: Tensor,
        state: TwoStageState,
        dt: float | Tensor,
        lane_width: float | Tensor = 3.7,
    ) -> tuple[Calibration, TwoStageState]:
        """One frame.

        Args:
            segments: of this frame, N per row; weight 0 is not there, non-finite counts as not there.
            intrinsics: (B, 3, 3) px.
            state: of the frame before, or :meth:`initial_state`.
            dt: s since that frame, float or (B,); negative or non-finite counts as 0.
            lane_width: m, float, (B,) or (B, L-1) per lane.

        Returns:
            calibration of this frame and the state after it.

        Raises:
            ValueError: a shape that doesn't fit.
        """
        check_segments(segments, intrinsics)
        segments = clean_segments(segments, self.config.num_boundaries)
        dt = as_batch(dt, segments.sigma).nan_to_num(0.0).clamp(0.0, 60.0)
        widths = as_lane_width(lane_width, segments.sigma, self.config.num_boundaries)
        rays = rays_from_pixels(segments.endpoints.flatten(1, 2), intrinsics)
        rays = rays.reshape(*segments.endpoints.shape[:-1], 3)  # (B, N, 2, 3)

        direction, cov, inliers, seen, fresh = self._direction(segments, rays, intrinsics, state, dt)
        boundaries = boundary_slopes(
            rays,
            segments.boundary,
            segments.weight * inliers,
            segments.sigma,
            intrinsics,
            direction[:, 0],
            direction[:, 1],
            self.config.num_boundaries,
        )
        roll_height, roll_height_cov, roll_known, height_known = self._roll_height(
            boundaries, widths, cov[:, :2, :2], state, dt, fresh
        )
        unseen = torch.where(seen, 0.0, state.unseen + dt)
        status = _status(state.status, seen, unseen, self.config.lost_after)
        state = TwoStageState(
            direction, cov, roll_height, roll_height_cov, roll_known, height_known, unseen, status
        )
        return self._calibration(state, widths, inliers * segments.weight), state

    def _direction(
        self, segments: LaneSegments, rays: Tensor, intrinsics: Tensor, state: TwoStageState, dt: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Stage 1: predict, gate, update; start over where that fails.

        Returns mean (B, 4), covariance (B, 4, 4), inliers (B, N), seen (B,) and freshly started (B,).
        """
        cfg = self.config
        density = dt.new_full((2,), cfg.angular_acceleration_density)
        mean, cov = kalman.predict(
            state.direction, state.direction_cov, *kalman.constant_velocity(dt, density)
        )
        normals = torch.linalg.cross(rays[:, :, 0], rays[:, :, 1])

        residual, jacobian, noise = incidence(mean, normals, rays, segments.sigma, intrinsics)
        there = segments.weight > 0
        gates = gate_angles(segments.endpoints, segments.sigma, cfg.gate_sigmas)
        vanishing = vanishing_dir_from_pitch_yaw(mean[:, 0], mean[:, 1])
        point = (intrinsics @ vanishing.unsqueeze(-1)).squeeze(-1)
        near = segment_angles(segments.endpoints, point) < gates
        if cfg.gate_sigmas > 0:
            near = near | kalman.gate(-residual, jacobian, noise, cov, cfg.gate_sigmas)
        inliers = (near & there).to(mean.dtype)
        supported = self._supported(segments, inliers)

        tracking = (state.status == Status.TRACKING) | (state.status == Status.COASTING)
        start = ~tracking | (~supported & (state.unseen + dt > cfg.reacquire_after))
        started = self._start(segments, rays, normals, intrinsics, mean, start)
        fresh = start & started.supported
        seen = torch.where(start, fresh, supported)
        inliers = torch.where(fresh.unsqueeze(-1), started.inliers, inliers * supported.unsqueeze(-1))

        use = segments.weight * inliers * (seen & ~fresh).unsqueeze(-1)
        updated, updated_cov = kalman.update(mean, cov, *kalman.information(-residual, jacobian, noise, use))
        # A start replaces the state; before the first one the state waits where it is.
        waiting = (state.status == Status.UNINITIALISED) & ~seen
        mean = torch.where(fresh.unsqueeze(-1), started.mean, updated)
        cov = torch.where(fresh[:, None, None], started.cov, updated_cov)
        mean = torch.where(waiting.unsqueeze(-1), state.direction, mean)
        cov = torch.where(waiting[:, None, None], state.direction_cov, cov)
        return mean, cov, inliers, seen, fresh

    def _supported(self, segments: LaneSegments, inliers: Tensor) -> Tensor:
        """(B,) bool: enough segments agree, on two boundaries at least."""
        cfg = self.config
        weight = segments.weight * inliers
        member = torch.nn.functional.one_hot(segments.boundary, cfg.num_boundaries).to(weight.dtype)
        boundaries = ((weight.unsqueeze(1) @ member).squeeze(1) > 0).sum(-1)
        count = (weight > 0).sum(-1)
        share = weight.sum(-1) / segments.weight.sum(-1).clamp_min(1e-9)
        return (count >= cfg.min_segments) & (boundaries >= 2) & (share >= cfg.min_inlier_share)

    def _start(
        self,
        segments: LaneSegments,
        rays: Tensor,
        normals: Tensor,
        intrinsics: Tensor,
        mean: Tensor,
        wanted: Tensor,
    ) -> _Start:
        """Algorithm 1 and the least-squares vanishing direction, Sec. III-B and III-C."""
        cfg = self.config
        if not torch.compiler.is_compiling() and not bool(wanted.any()):
            # Same result, without the search; every row's start is discarded by the caller.
            nothing = torch.zeros_like(segments.weight)
            return _Start(mean, torch.zeros_like(mean).diag_embed(), nothing, torch.zeros_like(wanted))
        _, agree = ransac_vanishing_point(
            segments.endpoints, segments.weight, segments.sigma, self.draws.to(mean.dtype), cfg.gate_sigmas
        )
        inliers = agree.to(mean.dtype)
        weight = segments.weight * inliers
        vanishing = mean.new_tensor([0.0, 0.0, 1.0]).expand(mean.shape[0], 3)
        for _ in range(3):  # the noise depends on where the vanishing point is
            noise = incidence_noise(rays, vanishing, segments.sigma, intrinsics)
            vanishing, plane_cov = vanishing_dir_least_squares(normals, noise, weight, vanishing)
        pitch, yaw = pitch_yaw_from_vanishing_dir(vanishing)
        rates = torch.zeros_like(pitch)
        # d(x, y) of the z = 1 plane to d(yaw, pitch): exact on the axis, cos² of the angle off it.
        angle_cov = plane_cov.flip(-1, -2) * mean.new_tensor([[1.0, -1.0], [-1.0, 1.0]])
        rate_cov = mean.new_tensor(cfg.initial_rate_std[:2]).square().diag().expand_as(angle_cov)
        zero = torch.zeros_like(angle_cov)
        cov = torch.cat([torch.cat([angle_cov, zero], -1), torch.cat([zero, rate_cov], -1)], -2)
        determined = angle_cov.diagonal(dim1=-2, dim2=-1).amax(-1) < math.radians(2.0) ** 2
        return _Start(
            torch.stack([pitch, yaw, rates, rates], dim=-1),
            cov,
            inliers,
            self._supported(segments, inliers) & determined,
        )

    def _roll_height(
        self,
        boundaries: BoundarySlopes,
        lane_width: Tensor,
        direction_cov: Tensor,
        state: TwoStageState,
        dt: Tensor,
        fresh: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Stage 2: predict, start where nothing is known, update; one lane moves height only.

        Returns mean (B, 4), covariance (B, 4, 4), roll_known (B,) and height_known (B,).
        """
        cfg = self.config
        num_lanes = (boundaries.present[:, :-1] & boundaries.present[:, 1:]).sum(-1)
        height_seen, roll_seen = num_lanes >= 1, num_lanes >= 2
        mean, cov = self._predict_roll_height(state, dt, roll_seen, height_seen)

        lost = fresh & (state.status == Status.LOST)
        start_roll = roll_seen & (~state.roll_known | lost)
        start_height = height_seen & (~state.height_known | lost | start_roll)
        roll, height = initial_roll_height(boundaries, lane_width, mean[:, 0])
        started = torch.stack([roll, height, torch.zeros_like(roll), torch.zeros_like(roll)], dim=-1)
        first = torch.stack([start_roll, start_height, start_roll, start_height], dim=-1)
        mean = torch.where(first, started, mean)
        wide = mean.new_tensor([*cfg.initial_pose_std[2:], *cfg.initial_rate_std[2:]]).square().diag()
        cov = torch.where((first.unsqueeze(-1) | first.unsqueeze(-2)), wide, cov)

        measured = measure_widths(boundaries, mean[:, 0], mean[:, 1], direction_cov, cfg.lane_noise)
        whiten = torch.linalg.cholesky_ex(measured.noise).L
        error = torch.where(measured.present, lane_width - measured.widths, 0.0)
        jacobian = torch.where(measured.present.unsqueeze(-1), measured.jacobian, 0.0)
        jacobian = jacobian * torch.stack([roll_seen, height_seen], dim=-1).unsqueeze(1)
        jacobian = torch.cat([jacobian, torch.zeros_like(jacobian)], dim=-1)  # (B, L-1, 4)
        white = torch.linalg.solve_triangular(
            whiten, torch.cat([jacobian, error.unsqueeze(-1)], dim=-1), upper=False
        )
        mean, cov = kalman.update(
            mean, cov, *kalman.information(white[..., -1], white[..., :-1], torch.ones_like(error))
        )
        mean = torch.cat([mean[:, :1], mean[:, 1:2].clamp(0.1, 20.0), mean[:, 2:]], dim=-1)
        return mean, cov, state.roll_known | roll_seen, state.height_known | height_seen

    def _predict_roll_height(
        self, state: TwoStageState, dt: Tensor, roll_seen: Tensor, height_seen: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Constant velocity, but what is not observed in this frame holds still while its sigma grows.

        Deviation: the paper would extrapolate roll on one lane for ever (PAPER_NOTES 6).
        """
        cfg = self.config
        density = dt.new_tensor([cfg.angular_acceleration_density, cfg.height_acceleration_density])
        transition, noise = kalman.constant_velocity(dt, density)
        moving = torch.stack([roll_seen & state.roll_known, height_seen & state.height_known], dim=-1)
        moving = torch.cat([moving, moving], dim=-1)  # (B, 4) of position and rate
        eye = torch.eye(4, dtype=dt.dtype, device=dt.device)
        still = eye * dt.new_tensor([1.0, 1.0, 0.0, 0.0])
        transition = torch.where(moving.unsqueeze(-1), transition, still)
        # What is not known yet stays at its prior; what was known and is not seen forgets at its noise.
        known = torch.stack([state.roll_known, state.height_known] * 2, dim=-1)
        known = known.unsqueeze(-1) & known.unsqueeze(-2)
        mean, cov = kalman.predict(state.roll_height, state.roll_height_cov, transition, noise * known)
        limit = dt.new_tensor([*cfg.initial_pose_std[2:], *cfg.initial_rate_std[2:]]).square()
        cov = _limit_variance(cov, limit)
        rates = torch.where(moving[:, 2:], 0.0, limit[2:])
        cov = cov + torch.cat([torch.zeros_like(rates), rates], dim=-1).diag_embed()
        # Without roll in the measurement, its correlation with height would still move it: cut it.
        together = moving.unsqueeze(-1) == moving.unsqueeze(-2)
        return mean, torch.where(together, cov, 0.0)

    def _calibration(self, state: TwoStageState, lane_width: Tensor, inliers: Tensor) -> Calibration:
        pose = torch.cat([state.direction[:, :2], state.roll_height[:, :2]], dim=-1)
        cov = torch.zeros(*pose.shape, 4, dtype=pose.dtype, device=pose.device)
        upper = torch.cat([state.direction_cov[:, :2, :2], cov[:, :2, 2:]], dim=-1)
        lower = torch.cat([cov[:, 2:, :2], state.roll_height_cov[:, :2, :2]], dim=-1)
        scale = pose[:, 3] * self.config.lane_width_std / lane_width.mean(-1)
        prior = torch.stack([torch.zeros_like(scale)] * 3 + [scale.square()], dim=-1).diag_embed()
        cov = torch.cat([upper, lower], dim=-2) + prior
        return Calibration(Extrinsics.unstack(pose), cov, state.status, inliers)


class _Start(NamedTuple):
    mean: Tensor
    cov: Tensor
    inliers: Tensor
    supported: Tensor


def incidence(
    mean: Tensor, normals: Tensor, rays: Tensor, sigma: Tensor, intrinsics: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """How far each great circle misses the vanishing direction.

    Source: Eq. (14), h = d_Zᵀ R_CWᵀ n, with its derivatives by pitch and yaw.

    Args:
        mean: (B, D), pitch and yaw first.
        normals: (B, N, 3), not normalised.
        rays: (B, N, 2, 3) of the end points.
        sigma: (B, N) px.
        intrinsics: (B, 3, 3).

    Returns:
        residual (B, N), Jacobian (B, N, D), variance (B, N).
    """
    pitch, yaw = mean[:, 0], mean[:, 1]
    sp, cp, sy, cy = pitch.sin(), pitch.cos(), yaw.sin(), yaw.cos()
    direction = vanishing_dir_from_pitch_yaw(pitch, yaw)
    by_pitch = torch.stack([torch.zeros_like(sp), -cp * cy, -sp * cy], dim=-1)
    by_yaw = torch.stack([cy, sp * sy, -cp * sy], dim=-1)
    products = normals @ torch.stack([direction, by_pitch, by_yaw], dim=-1)  # (B, N, 3)
    rest = torch.zeros(*products.shape[:2], mean.shape[-1] - 2, dtype=mean.dtype, device=mean.device)
    jacobian = torch.cat([products[..., 1:], rest], dim=-1)
    noise = incidence_noise(rays, direction, sigma, intrinsics).clamp_min(1e-18)
    return products[..., 0], jacobian, noise


def _status(before: Tensor, seen: Tensor, unseen: Tensor, lost_after: float) -> Tensor:
    """initialise -> track -> coast -> lost -> re-initialise, per row."""
    coasting = torch.where(unseen > lost_after, int(Status.LOST), int(Status.COASTING))
    idle = (before == Status.UNINITIALISED) | (before == Status.LOST)
    unsupported = torch.where(idle, before, coasting)
    return torch.where(seen, int(Status.TRACKING), unsupported)


def _limit_variance(cov: Tensor, limit: Tensor) -> Tensor:
    """Scale a covariance until no variance exceeds its limit: not seeing is never worse than the prior."""
    scale = (limit / cov.diagonal(dim1=-2, dim2=-1).clamp_min(1e-30)).clamp_max(1.0).sqrt()
    return cov * scale.unsqueeze(-1) * scale.unsqueeze(-2)
