"""The slow calibration behind the fast pose: how the camera is mounted in the vehicle.

The fast pose is the mount plus what the suspension and the driver's heading add. Accepted frames are
averaged in blocks of some seconds, blocks in a running estimate whose uncertainty is their scatter. The
blocks, limits and gates are those of openpilot's calibrationd; hysteresis and reasons are ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lanebev.batch import flag, where
from lanebev.estimation.checks import as_batch, check_state
from lanebev.types import Calibration, Extrinsics, Status, saved_by_name


class MountStatus(IntEnum):
    """What the mount estimate is worth. A new meaning is a new value."""

    UNCALIBRATED = 0  # not enough blocks yet
    CALIBRATED = 1
    INVALID = 2  # enough blocks, but outside the limits: mount the camera anew
    RECALIBRATING = 3  # the camera was moved; begun anew from the recent blocks


class MountReason(IntFlag):
    """Why the estimate is not (yet) valid, or this frame was not used; several may hold at once."""

    NONE = 0
    NOT_TRACKING = 1  # the fast calibration had no support in this frame
    UNSURE = 2  # its sigma was too large
    SLOW = 4  # the vehicle was too slow to follow the lane
    TURNING = 8  # yaw rate or curvature too high
    FEW_BLOCKS = 16  # progress below 100 %
    PITCH_LIMIT = 32
    YAW_LIMIT = 64
    ROLL_LIMIT = 128
    HEIGHT_LIMIT = 256
    SUSPECT = 512  # the last block contradicts the estimate
    MOVED = 1024  # the camera was moved: begun anew in this frame
    TIME = 2048  # dt not positive or not finite


@dataclass(frozen=True)
class MountConfig:
    """Numbers of :class:`MountEstimator`; rad, m, s, in the order pitch, yaw, roll, height.

    Attributes:
        block_time: s of accepted frames in a block.
        num_blocks: kept.
        needed: blocks for a valid estimate.
        lower, upper: validity limits of the mount.
        margin: hysteresis of the limits.
        largest_std: of the fast pose, for a frame to be used.
        block_std: expected scatter of blocks, worth ``prior_blocks`` blocks of evidence.
        prior_blocks: see above.
        block_correlation: of neighbouring blocks, which slow motion shares.
        prior_pose, prior_std: before anything is seen.
        moved_least: smallest change that counts as a moved camera.
        moved_sigmas: and it must exceed so many sigmas of a block.
        moved_blocks: in so many blocks in a row that agree.
        blend_steps: accepted frames over which a new estimate takes over from the old.
        min_speed: m/s.
        max_yaw_rate: rad/s.
        max_curvature: 1/m.
    """

    block_time: float = 4.0
    num_blocks: int = 50
    needed: int = 5
    lower: tuple[float, float, float, float] = (-0.09, -0.07, -0.35, 0.4)
    upper: tuple[float, float, float, float] = (0.17, 0.07, 0.35, 4.0)
    margin: tuple[float, float, float, float] = (0.003, 0.003, 0.005, 0.02)
    largest_std: tuple[float, float, float, float] = (0.01, 0.01, 0.02, 0.1)
    block_std: tuple[float, float, float, float] = (0.004, 0.006, 0.004, 0.01)
    prior_blocks: float = 4.0
    block_correlation: float = 0.2
    prior_pose: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.5)
    prior_std: tuple[float, float, float, float] = (0.12, 0.15, 0.05, 0.5)
    moved_least: tuple[float, float, float, float] = (0.015, 0.02, 0.02, 0.06)
    moved_sigmas: float = 5.0
    moved_blocks: int = 3
    blend_steps: int = 10
    min_speed: float = 6.7
    max_yaw_rate: float = 0.035
    max_curvature: float = 1e-3

    def __post_init__(self) -> None:
        if not 1 <= self.moved_blocks < self.needed <= self.num_blocks:
            raise ValueError(
                "moved_blocks, needed, num_blocks: expected 1 <= moved_blocks < needed <= num_blocks, got "
                f"{self.moved_blocks}, {self.needed}, {self.num_blocks}"
            )
        if not self.block_time > 0:
            raise ValueError(f"block_time: expected a positive time in s, got {self.block_time}")


@saved_by_name
class MountState(NamedTuple):
    """Everything the estimator remembers, tensors only. K blocks, the newest first.

    Attributes:
        blocks: (B, K, 4) mean pose of each.
        variances: (B, K, 4) mean variance of the fast pose in each.
        filled: (B, K) 1 where there is a block.
        pose_sum: (B, 4) of the current block, times seconds.
        variance_sum: (B, 4) likewise.
        seconds: (B,) in the current block.
        suspect: (B,) int64, newest blocks that contradict the others.
        former: (B, 4) estimate before the last restart.
        blend: (B,) in [0, 1], its share in what is given out.
        status: (B,) int64, values of MountStatus.
        reasons: (B,) int64, MountReason flags of the last frame.
    """

    blocks: Tensor
    variances: Tensor
    filled: Tensor
    pose_sum: Tensor
    variance_sum: Tensor
    seconds: Tensor
    suspect: Tensor
    former: Tensor
    blend: Tensor
    status: Tensor
    reasons: Tensor


@saved_by_name
class MountCalibration(NamedTuple):
    """The mount as it is known now.

    Attributes:
        extrinsics: pitch, yaw, roll, height of the camera in the vehicle, each (B,).
        covariance: (B, 4, 4).
        status: (B,) int64, values of :class:`MountStatus`.
        progress: (B,) per cent of the blocks needed.
        reasons: (B,) int64, :class:`MountReason` flags.
    """

    extrinsics: Extrinsics
    covariance: Tensor
    status: Tensor
    progress: Tensor
    reasons: Tensor


class MountEstimator(nn.Module):
    """Running estimate of the mount from the fast calibration, per row of a batch, state in and state out.

    Args:
        config: the numbers, or keywords of :class:`MountConfig`.
    """

    def __init__(self, config: MountConfig | None = None, **numbers: object) -> None:
        super().__init__()
        if config is not None and numbers:
            raise ValueError("config: expected either a MountConfig or its keywords, got both")
        self.config = config or MountConfig(**numbers)  # type: ignore[arg-type]

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> MountState:
        """State before the first frame: no blocks, UNCALIBRATED."""
        num = self.config.num_blocks
        zero = torch.zeros(batch_size, dtype=dtype, device=device)
        none = torch.zeros(batch_size, dtype=torch.int64, device=device)
        return MountState(
            blocks=zero.new_zeros(batch_size, num, 4),
            variances=zero.new_zeros(batch_size, num, 4),
            filled=zero.new_zeros(batch_size, num),
            pose_sum=zero.new_zeros(batch_size, 4),
            variance_sum=zero.new_zeros(batch_size, 4),
            seconds=zero,
            suspect=none,
            former=zero.new_zeros(batch_size, 4),
            blend=zero.clone(),
            status=none + int(MountStatus.UNCALIBRATED),
            reasons=none + int(MountReason.FEW_BLOCKS),
        )

    def forward(
        self,
        calibration: Calibration,
        state: MountState,
        dt: float | Tensor,
        speed: Tensor | None = None,
        yaw_rate: Tensor | None = None,
        curvature: Tensor | None = None,
    ) -> tuple[MountCalibration, MountState]:
        """One frame, computed in the state's dtype.

        Args:
            calibration: of this frame, from any calibrator.
            state: of the frame before, or :meth:`initial_state`.
            dt: s since that frame, float or (B,).
            speed: (B,) m/s of the vehicle, or None if not known.
            yaw_rate: (B,) rad/s of the vehicle, or None.
            curvature: (B,) 1/m of the road, or None.

        Returns:
            the mount and the state after the frame.

        Raises:
            ValueError: a shape that doesn't fit, or another estimator's state.
        """
        pose = calibration.extrinsics.stack()
        pose = pose.to(check_state(state, MountState, pose.shape[0]).dtype)
        variance = calibration.covariance.diagonal(dim1=-2, dim2=-1).to(pose.dtype)
        step = as_batch(dt, pose)
        why = self._gates(calibration.status, pose, variance, step, speed, yaw_rate, curvature)
        used = why == 0
        state = _add(state, used, pose, variance, step.clamp(max=self.config.block_time))
        state, moved = self._close_block(state)
        faded = (state.blend - 1 / self.config.blend_steps).clamp(min=0.0)
        state = state._replace(blend=torch.where(used & ~moved, faded, state.blend))

        mean, var, count = self._estimate(state)
        limits, outside = self._limits(mean, state.status == int(MountStatus.INVALID))
        enough = count >= self.config.needed
        again = moved | (state.status == int(MountStatus.RECALIBRATING))
        waiting = torch.where(again, int(MountStatus.RECALIBRATING), int(MountStatus.UNCALIBRATED))
        valid = torch.where(outside, int(MountStatus.INVALID), int(MountStatus.CALIBRATED))
        status = torch.where(enough, valid, waiting)
        why = why | flag(~enough, MountReason.FEW_BLOCKS) | torch.where(enough, limits, 0)
        why = why | flag(state.suspect > 0, MountReason.SUSPECT) | flag(moved, MountReason.MOVED)
        state = state._replace(status=status, reasons=why)

        share = state.blend.unsqueeze(-1)
        shown = share * state.former + (1 - share) * mean
        var = var + (shown - mean).square()  # a blended estimate is wrong by what is not yet handed over
        progress = 100 * (count / self.config.needed).clamp(max=1.0)
        return MountCalibration(Extrinsics.unstack(shown), var.diag_embed(), status, progress, why), state

    def _gates(
        self,
        status: Tensor,
        pose: Tensor,
        variance: Tensor,
        step: Tensor,
        speed: Tensor | None,
        yaw_rate: Tensor | None,
        curvature: Tensor | None,
    ) -> Tensor:
        """(B,) flags of what speaks against using this frame."""
        cfg = self.config
        finite = pose.isfinite().all(-1) & variance.isfinite().all(-1)
        sure = finite & (variance < variance.new_tensor(cfg.largest_std).square()).all(-1)
        tracking = status == int(Status.TRACKING)
        why = flag(~tracking, MountReason.NOT_TRACKING) | flag(~sure, MountReason.UNSURE)
        why = why | flag(~(step.isfinite() & (step > 0)), MountReason.TIME)
        if speed is not None:
            why = why | flag(~(as_batch(speed, pose, "speed") >= cfg.min_speed), MountReason.SLOW)
        turns = (("yaw_rate", yaw_rate, cfg.max_yaw_rate), ("curvature", curvature, cfg.max_curvature))
        for name, turn, most in turns:
            if turn is not None:
                why = why | flag(~(as_batch(turn, pose, name).abs() <= most), MountReason.TURNING)
        return why

    def _close_block(self, state: MountState) -> tuple[MountState, Tensor]:
        """Push a full block, judge it by the others, and begin anew where the camera was moved."""
        cfg = self.config
        full = state.seconds >= cfg.block_time - 1e-4  # rounding of the summed steps
        time = torch.where(full, state.seconds, 1.0).unsqueeze(-1)
        block, noise = state.pose_sum / time, state.variance_sum / time

        mean, scatter, count = self._scatter(state)
        least = block.new_tensor(cfg.moved_least)
        bound = torch.maximum(least, cfg.moved_sigmas * (scatter + noise).sqrt())
        against = ((block - mean).abs() > bound).any(-1) & (count >= cfg.moved_blocks)
        agrees = ((block - state.blocks[:, 0]).abs() <= bound).all(-1)
        suspect = torch.where(agrees, state.suspect + 1, 1)
        suspect = torch.where(full, torch.where(against, suspect, 0), state.suspect)
        moved = full & (suspect >= cfg.moved_blocks)

        # blocks that were suspected and then not confirmed are dropped
        index = torch.arange(cfg.num_blocks, device=block.device)
        dropped = full & (suspect <= 1) & (state.suspect > 0)
        kept = torch.where(dropped.unsqueeze(-1) & (index < state.suspect.unsqueeze(-1)), 0.0, state.filled)
        filled = torch.cat([torch.ones_like(kept[:, :1]), kept[:, :-1]], dim=-1)
        filled = torch.where(moved.unsqueeze(-1) & (index >= cfg.moved_blocks), 0.0, filled)
        shown, _, _ = self._estimate(state)
        empty = torch.where(full, 0.0, 1.0)
        return state._replace(
            blocks=where(full, torch.cat([block.unsqueeze(1), state.blocks[:, :-1]], 1), state.blocks),
            variances=where(
                full, torch.cat([noise.unsqueeze(1), state.variances[:, :-1]], 1), state.variances
            ),
            filled=where(full, filled, state.filled),
            pose_sum=state.pose_sum * empty.unsqueeze(-1),
            variance_sum=state.variance_sum * empty.unsqueeze(-1),
            seconds=state.seconds * empty,
            suspect=torch.where(moved, 0, suspect),
            former=where(moved, shown, state.former),
            blend=torch.where(moved, 1.0, state.blend),
        ), moved

    def _scatter(self, state: MountState) -> tuple[Tensor, Tensor, Tensor]:
        """Mean (B, 4) of the trusted blocks, variance (B, 4) of one block about it, and their number (B,)."""
        cfg = self.config
        index = torch.arange(cfg.num_blocks, device=state.filled.device)
        trusted = (state.filled * (index >= state.suspect.unsqueeze(-1))).unsqueeze(-1)  # (B, K, 1)
        count = trusted.sum(1)  # (B, 1)
        mean = (trusted * state.blocks).sum(1) / count.clamp(min=1.0)
        squared = (trusted * (state.blocks - mean.unsqueeze(1)).square()).sum(1)
        prior = cfg.prior_blocks * mean.new_tensor(cfg.block_std).square()
        return mean, (squared + prior) / (count - 1 + cfg.prior_blocks), count.squeeze(-1)

    def _estimate(self, state: MountState) -> tuple[Tensor, Tensor, Tensor]:
        """Mean (B, 4), variance (B, 4) and number of blocks (B,), the current one counted in part."""
        cfg = self.config
        mean, scatter, count = self._scatter(state)
        part = torch.where(state.suspect > 0, 0.0, state.seconds / cfg.block_time)
        some = (count + part).unsqueeze(-1)
        now = state.pose_sum * torch.where(state.suspect > 0, 0.0, 1 / cfg.block_time).unsqueeze(-1)
        noise_now = state.variance_sum / state.seconds.clamp(min=1e-6).unsqueeze(-1)
        index = torch.arange(cfg.num_blocks, device=mean.device)
        trusted = (state.filled * (index >= state.suspect.unsqueeze(-1))).unsqueeze(-1)
        noise = (trusted * state.variances).sum(1) + part.unsqueeze(-1) * noise_now
        safe = some.clamp(min=1e-3)
        prior, prior_var = mean.new_tensor(cfg.prior_pose), mean.new_tensor(cfg.prior_std).square()
        both = (count.unsqueeze(-1) * mean + now) / safe
        # errors of the fast pose are common to all blocks (lane width), so they do not average out
        variance = (1 + 2 * cfg.block_correlation) * scatter / safe + noise / safe
        return (
            torch.where(some > 1e-3, both, prior),
            torch.where(some > 1e-3, torch.minimum(variance, prior_var), prior_var),
            count + part,
        )

    def _limits(self, mean: Tensor, invalid: Tensor) -> tuple[Tensor, Tensor]:
        """Flags (B,) of limits that are broken and (B,) bool: any is; the margin keeps it from flickering."""
        cfg = self.config
        lower, upper, margin = (mean.new_tensor(v) for v in (cfg.lower, cfg.upper, cfg.margin))
        slack = torch.where(invalid.unsqueeze(-1), -margin, margin)
        broken = (mean < lower - slack) | (mean > upper + slack)  # (B, 4)
        names = (
            MountReason.PITCH_LIMIT,
            MountReason.YAW_LIMIT,
            MountReason.ROLL_LIMIT,
            MountReason.HEIGHT_LIMIT,
        )
        flags = torch.tensor([int(name) for name in names], device=mean.device)
        return (broken * flags).sum(-1), broken.any(-1)


def _add(state: MountState, used: Tensor, pose: Tensor, variance: Tensor, step: Tensor) -> MountState:
    """Frames that are used go into the current block, weighted by their time."""
    time = torch.where(used, step, 0.0)
    part = time.unsqueeze(-1)
    keep = used.unsqueeze(-1)
    return state._replace(
        pose_sum=state.pose_sum + part * torch.where(keep, pose, 0.0),
        variance_sum=state.variance_sum + part * torch.where(keep, variance, 0.0),
        seconds=state.seconds + time,
    )
