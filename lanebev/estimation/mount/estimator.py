"""Estimate the camera's mount in the vehicle from the poses of frames.

The pose of a frame is the mount plus the motion on the suspension and the vehicle's heading. Accepted frames
are averaged in blocks of some seconds, and blocks in a running estimate whose uncertainty is their scatter.
Each axis has its own blocks, so that an axis that the road does not determine does not delay the others. The
blocks, limits and gates are those of openpilot's calibrationd; axes, hysteresis, ageing and reasons are new.
"""

import torch
from torch import Tensor, nn

from lanebev.batch import flag
from lanebev.estimation.checks import as_batch, check_new_state, check_state
from lanebev.estimation.mount.blocks import add_frame, block_index, newest_age, push_block
from lanebev.estimation.mount.config import MountConfig
from lanebev.estimation.mount.results import (
    LIMIT_REASONS,
    MountCalibration,
    MountReason,
    MountState,
    MountStatus,
)
from lanebev.tensors import constant
from lanebev.types import Calibration, Extrinsics, Status, check_calibration, config_of

_HOUR = 3600.0  # s


class MountEstimator(nn.Module):
    """Estimate the mount from the poses of frames, per row of a batch and axis by axis.

    Args:
        config: the configuration, or keywords of :class:`MountConfig`.
    """

    def __init__(self, config: MountConfig | None = None, **numbers: object) -> None:
        super().__init__()
        self.config = config_of(MountConfig, config, numbers)

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> MountState:
        """Return the state before the first frame: no blocks, UNCALIBRATED.

        See :meth:`~lanebev.estimation.calibrator.Calibrator.initial_state` for arguments and errors.
        """
        check_new_state(batch_size, dtype)
        zero = torch.zeros(batch_size, 4, dtype=dtype, device=device)
        blocks = torch.zeros(batch_size, self.config.num_blocks, 4, dtype=dtype, device=device)
        none = torch.zeros(batch_size, 4, dtype=torch.int64, device=device)
        return MountState(
            blocks=blocks,
            variances=blocks.clone(),
            filled=blocks.clone(),
            ages=blocks.clone(),
            pose_sum=zero,
            variance_sum=zero.clone(),
            seconds=zero.clone(),
            begun=zero.clone(),
            suspect=none,
            contradicted=zero.clone(),
            former=zero.clone(),
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
        """Process one frame, in the state's dtype.

        Args:
            calibration: calibration of this frame, from any calibrator.
            state: state of the frame before, or :meth:`initial_state`.
            dt: s since that frame, float or (B,).
            speed: speed of the vehicle, (B,) m/s, or None if unknown.
            yaw_rate: yaw rate of the vehicle, (B,) rad/s, or None.
            curvature: curvature of the road, (B,) 1/m, or None.

        Returns:
            the mount and the state after the frame.

        Raises:
            TypeError: no :class:`Calibration`.
            ValueError: a shape that doesn't fit, or another estimator's state.
        """
        cfg = self.config
        check_calibration(calibration)
        pose = calibration.extrinsics.stack()
        pose = pose.to(check_state(state, MountState, pose.shape[0]).dtype)
        variance = calibration.covariance.diagonal(dim1=-2, dim2=-1).to(pose.dtype)
        interval = as_batch(dt, pose)
        frame_why = self._frame_gates(calibration.status, pose, interval, speed, yaw_rate, curvature)
        known = pose.isfinite().all(-1, keepdim=True) & variance.isfinite() & (variance >= 0)
        sure = known & (variance < constant(cfg.largest_std, variance).square())
        why = frame_why.unsqueeze(-1) | flag(~sure, MountReason.UNSURE)  # (B, 4)

        used = why == 0
        elapsed = torch.where(interval.isfinite() & (interval > 0), interval, 0.0).unsqueeze(-1)  # (B, 1)
        state = add_frame(state, used, pose, variance, elapsed, cfg.block_time)
        doubtful = (frame_why == 0).unsqueeze(-1) & known & ~sure
        state = self._time_contradictions(state, doubtful, used, pose, variance, elapsed)
        shown_before, *_ = self._estimate(state)
        state, moved = self._close_blocks(state)
        state, withdrawn = self._withdraw(state, moved)
        faded = (state.blend - 1 / cfg.blend_steps).clamp(min=0.0)
        state = state._replace(
            former=torch.where(moved | withdrawn, shown_before, state.former),
            blend=torch.where(moved | withdrawn, 1.0, torch.where(used, faded, state.blend)),
        )

        mean, var, count = self._estimate(state)
        status, of_axes = self._axis_status(state, mean, count, moved, withdrawn)
        why = why | of_axes
        state = state._replace(status=status, reasons=why)

        shown = state.blend * state.former + (1 - state.blend) * mean
        var = var + (shown - mean).square()  # the part of the change that is not yet blended in
        progress = 100 * (count / cfg.needed).clamp(max=1.0)
        return _mount_calibration(shown, var, status, progress, why), state

    def _frame_gates(
        self,
        status: Tensor,
        pose: Tensor,
        interval: Tensor,
        speed: Tensor | None,
        yaw_rate: Tensor | None,
        curvature: Tensor | None,
    ) -> Tensor:
        """Return the reasons (B,), as flags, not to use this frame on any axis."""
        cfg = self.config
        why = flag(status != int(Status.TRACKING), MountReason.NOT_TRACKING)
        why = why | flag(~(interval.isfinite() & (interval > 0)), MountReason.TIME)
        if speed is not None:
            why = why | flag(~(as_batch(speed, pose, "speed") >= cfg.min_speed), MountReason.SLOW)
        turns = (("yaw_rate", yaw_rate, cfg.max_yaw_rate), ("curvature", curvature, cfg.max_curvature))
        for name, turn, most in turns:
            if turn is not None:
                why = why | flag(~(as_batch(turn, pose, name).abs() <= most), MountReason.TURNING)
        return why

    def _bound(self, scatter: Tensor, noise: Tensor) -> Tensor:
        """Return the deviation (B, 4) from the estimate that counts as a moved camera."""
        least = constant(self.config.moved_least, scatter)
        return torch.maximum(least, self.config.moved_sigmas * (scatter + noise).sqrt())

    def _time_contradictions(
        self,
        state: MountState,
        doubtful: Tensor,
        used: Tensor,
        pose: Tensor,
        variance: Tensor,
        elapsed: Tensor,
    ) -> MountState:
        """Count the time for which frames too unsure to be used contradict the estimate by many sigmas."""
        mean, scatter, count = self._scatter(state)
        far = (pose - mean).abs() > self._bound(scatter, variance)
        against = doubtful & far & (count >= self.config.moved_blocks)
        agrees = (doubtful & ~far) | used  # the blocks judge the frames that are used
        seconds = torch.where(against, state.contradicted + elapsed, state.contradicted)
        return state._replace(contradicted=torch.where(agrees, 0.0, seconds))

    def _close_blocks(self, state: MountState) -> tuple[MountState, Tensor]:
        """Append full blocks and compare them with the others; (B, 4) bool: the camera was moved."""
        cfg = self.config
        full = state.seconds >= cfg.block_time - 1e-4  # rounding of the summed steps
        time = torch.where(full, state.seconds, 1.0)
        block, noise = state.pose_sum / time, state.variance_sum / time

        mean, scatter, count = self._scatter(state)
        bound = self._bound(scatter, noise)
        against = ((block - mean).abs() > bound) & (count >= cfg.moved_blocks)
        agrees = (block - state.blocks[:, 0]).abs() <= bound
        suspect = torch.where(agrees, state.suspect + 1, 1)
        suspect = torch.where(full, torch.where(against, suspect, 0), state.suspect)
        moved = full & (suspect >= cfg.moved_blocks)

        # blocks that were suspected and then not confirmed are dropped
        index = block_index(state)
        dropped = full & (suspect <= 1) & (state.suspect > 0)
        kept = torch.where(dropped.unsqueeze(1) & (index < state.suspect.unsqueeze(1)), 0.0, state.filled)
        state = state._replace(filled=torch.where(full.unsqueeze(1), kept, state.filled))
        empty = torch.where(full, 0.0, 1.0)
        return state._replace(
            blocks=push_block(state.blocks, block, full),
            variances=push_block(state.variances, noise, full),
            filled=push_block(state.filled, torch.ones_like(block), full),
            ages=push_block(state.ages, state.begun, full),
            pose_sum=state.pose_sum * empty,
            variance_sum=state.variance_sum * empty,
            seconds=state.seconds * empty,
            begun=state.begun * empty,
            suspect=torch.where(moved, 0, suspect),
        ), moved

    def _withdraw(self, state: MountState, moved: Tensor) -> tuple[MountState, Tensor]:
        """Drop what dates from before a move, on every axis, and what unsure frames contradicted for long.

        Returns:
            the state and (B, 4) bool, axes other than the moved ones that lost blocks.
        """
        cfg = self.config
        recent = state.ages[:, cfg.moved_blocks - 1]  # (B, 4) s since the first block after a move
        window = torch.where(moved, recent, 0.0).amax(-1, keepdim=True).unsqueeze(1)  # (B, 1, 1)
        before = (state.ages > window + 1e-6) & moved.any(-1)[:, None, None]
        contradicted = state.contradicted >= cfg.moved_blocks * cfg.block_time
        gone = (before | contradicted.unsqueeze(1)) & (state.filled > 0)
        withdrawn = gone.any(1) & ~moved
        return state._replace(
            filled=torch.where(gone, 0.0, state.filled),
            suspect=torch.where(withdrawn, 0, state.suspect),
            contradicted=torch.where(contradicted | moved, 0.0, state.contradicted),
        ), withdrawn

    def _trusted(self, state: MountState) -> Tensor:
        """Return the weights (B, K, 4) of the blocks that nothing contradicts."""
        return state.filled * (block_index(state) >= state.suspect.unsqueeze(1))

    def _scatter(self, state: MountState) -> tuple[Tensor, Tensor, Tensor]:
        """Return the mean of the trusted blocks, one block's variance about it, their number, (B, 4) each."""
        cfg = self.config
        trusted = self._trusted(state)
        count = trusted.sum(1)
        mean = (trusted * state.blocks).sum(1) / count.clamp(min=1.0)
        squared = (trusted * (state.blocks - mean.unsqueeze(1)).square()).sum(1)
        prior = cfg.prior_blocks * constant(cfg.block_std, mean).square()
        return mean, (squared + prior) / (count - 1 + cfg.prior_blocks), count

    def _estimate(self, state: MountState) -> tuple[Tensor, Tensor, Tensor]:
        """Return mean, variance and number of blocks, (B, 4) each, the current one counted in part."""
        cfg = self.config
        mean, scatter, count = self._scatter(state)
        clean = torch.where(state.suspect > 0, 0.0, 1 / cfg.block_time)
        part, now = state.seconds * clean, state.pose_sum * clean
        some = count + part
        noise_now = state.variance_sum / state.seconds.clamp(min=1e-6)
        noise = (self._trusted(state) * state.variances).sum(1) + part * noise_now
        safe = some.clamp(min=1e-3)
        prior, prior_var = constant(cfg.prior_pose, mean), constant(cfg.prior_std, mean).square()
        both = (count * mean + now) / safe
        # errors of the fast pose are common to all blocks (lane width), so they do not average out
        variance = (1 + 2 * cfg.block_correlation) * scatter / safe + noise / safe
        variance = variance + constant(cfg.drift_std, mean).square() * newest_age(state) / _HOUR
        return (
            torch.where(some > 1e-3, both, prior),
            torch.where(some > 1e-3, torch.minimum(variance, prior_var), prior_var),
            some,
        )

    def _axis_status(
        self, state: MountState, mean: Tensor, count: Tensor, moved: Tensor, withdrawn: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the status of every axis, and the flags of the reasons for it, (B, 4) int64 each."""
        limits, outside = self._limits(mean, state.status == int(MountStatus.INVALID))
        enough = count >= self.config.needed
        again = moved | withdrawn | (state.status == int(MountStatus.RECALIBRATING))
        waiting = torch.where(again, int(MountStatus.RECALIBRATING), int(MountStatus.UNCALIBRATED))
        valid = torch.where(outside, int(MountStatus.INVALID), int(MountStatus.CALIBRATED))
        why = flag(~enough, MountReason.FEW_BLOCKS) | torch.where(enough, limits, 0)
        why = why | flag((state.suspect > 0) | (state.contradicted > 0), MountReason.SUSPECT)
        why = why | flag(moved, MountReason.MOVED) | flag(withdrawn, MountReason.WITHDRAWN)
        why = why | flag(newest_age(state) > self.config.stale_time, MountReason.STALE)
        return torch.where(enough, valid, waiting), why

    def _limits(self, mean: Tensor, invalid: Tensor) -> tuple[Tensor, Tensor]:
        """Return flags and bools (B, 4) of limits that are broken; the margin keeps them from flickering."""
        cfg = self.config
        lower, upper, margin = (constant(v, mean) for v in (cfg.lower, cfg.upper, cfg.margin))
        slack = torch.where(invalid, -margin, margin)
        broken = (mean < lower - slack) | (mean > upper + slack)
        flags = constant(LIMIT_REASONS, mean, torch.int64)
        return broken * flags, broken


def _mount_calibration(
    pose: Tensor, variance: Tensor, status: Tensor, progress: Tensor, why: Tensor
) -> MountCalibration:
    """Summarise the axes: calibrated if all are, otherwise the most severe status of any."""
    calibrated = status == int(MountStatus.CALIBRATED)
    whole = torch.where(calibrated.any(-1), int(MountStatus.PARTIAL), int(MountStatus.UNCALIBRATED))
    for severe in (MountStatus.RECALIBRATING, MountStatus.INVALID):
        whole = torch.where((status == int(severe)).any(-1), int(severe), whole)
    whole = torch.where(calibrated.all(-1), int(MountStatus.CALIBRATED), whole)
    reasons = why[:, 0] | why[:, 1] | why[:, 2] | why[:, 3]
    return MountCalibration(
        extrinsics=Extrinsics.unstack(pose),
        covariance=variance.diag_embed(),
        status=whole,
        progress=progress.amin(-1),
        reasons=reasons,
        axis_status=status,
        axis_progress=progress,
        axis_reasons=why,
    )
