"""The mount of a camera over all its drives: its mean between two moves of the camera, and its drift.

A run keeps the mount's evidence as blocks of some seconds. The mount estimator takes the blocks of one drive
after those of another, as if they were one long drive, and says where the camera was moved. Between two
moves, drives are averaged.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lanebev.batch import has_flag
from lanebev.estimation.mount import MountCalibration, MountEstimator, MountReason, MountState
from lanebev.types import Calibration, Extrinsics, Status

_DAY = 86_400.0  # s


class DriveMount(NamedTuple):
    """The mount of a camera as estimated from one drive.

    Attributes:
        name: name of the drive.
        time: beginning of the drive in ISO 8601; empty if unknown.
        pose: (4,) rad, rad, rad, m, of this drive alone; NaN on an axis without evidence.
        std: (4,) its standard deviation.
        moved: (4,) whether the camera was moved in this drive or since the one before, axis by axis.
    """

    name: str
    time: str
    pose: NDArray[np.float64]
    std: NDArray[np.float64]
    moved: NDArray[np.bool_]


@dataclass(frozen=True)
class Stretch:
    """Drives between two moves of the camera.

    Attributes:
        first, last: names of drives.
        drives: how many.
        pose, std: (4,) weighted mean and its standard deviation; NaN on an axis without evidence.
        drift, drift_std: (4,) rad or m per day; NaN where times are not known or span less than a day.
    """

    first: str
    last: str
    drives: int
    pose: NDArray[np.float64]
    std: NDArray[np.float64]
    drift: NDArray[np.float64]
    drift_std: NDArray[np.float64]


def drive_mounts(states: Sequence[tuple[str, str, MountState]]) -> list[DriveMount]:
    """Return the mount estimate of each drive of one camera, and where the camera was moved.

    Args:
        states: name, time and the mount's state at the end of each drive, in order of time.
    """
    estimator = MountEstimator()
    running = estimator.initial_state(1, dtype=torch.float64)
    found = []
    for name, time, state in states:
        moved = torch.zeros(4, dtype=torch.bool)
        alone = estimator.initial_state(1, dtype=torch.float64)
        mount: MountCalibration | None = None
        for calibration, seconds in block_calibrations(state, estimator.config.block_time):
            so_far, running = estimator(calibration, running, seconds)
            moved |= has_flag(so_far.axis_reasons[0], MountReason.MOVED)
            mount, alone = estimator(calibration, alone, seconds)
        found.append(DriveMount(name, time, *_pose_and_std(mount), moved.numpy()))
    return found


def block_calibrations(state: MountState, block_time: float) -> list[tuple[Calibration, float]]:
    """Return the blocks of a state, of batch size 1, as calibrations and seconds, the oldest first."""
    blocks = []
    for block in reversed(range(state.blocks.shape[1])):
        there = state.filled[0, block] > 0
        if bool(there.any()):
            blocks.append(
                (_calibration(state.blocks[0, block], state.variances[0, block], there), block_time)
            )
    seconds = state.seconds[0]
    if bool((seconds > 0).any()):  # the block that was not full at the end
        time = seconds.clamp(min=1e-9)
        part = _calibration(state.pose_sum[0] / time, state.variance_sum[0] / time, seconds > 0)
        blocks.append((part, float(seconds.max())))
    return blocks


def stretches(mounts: Sequence[DriveMount]) -> list[Stretch]:
    """Return the drives of a camera between its moves; a drive in which it was moved begins a new stretch."""
    starts = [place for place, mount in enumerate(mounts) if place == 0 or mount.moved.any()]
    ends = [*starts[1:], len(mounts)] if mounts else []
    return [_stretch(mounts[start:end]) for start, end in zip(starts, ends, strict=True)]


def weighted_mean(values: NDArray[np.float64], stds: NDArray[np.float64]) -> tuple[float, float]:
    """Return the mean weighted by 1 / variance, and its standard deviation; NaN of nothing.

    Source: Birge ratio (R. T. Birge 1932, Phys. Rev. 40, 207): the standard deviation is enlarged where the
    values scatter more than theirs explain, as another load of the vehicle makes them.
    """
    known = np.isfinite(values) & np.isfinite(stds)
    if not known.any():
        return math.nan, math.nan
    value, weight = values[known], stds[known] ** -2.0
    mean = float((weight * value).sum() / weight.sum())
    chi_squared = float((weight * (value - mean) ** 2).sum())
    ratio = max(1.0, chi_squared / (len(value) - 1)) if len(value) > 1 else 1.0
    return mean, math.sqrt(ratio / float(weight.sum()))


def weighted_slope(
    times: NDArray[np.float64], values: NDArray[np.float64], stds: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the slope of the weighted least-squares line and its standard deviation.

    NaN with fewer than three known values, or times that span less than 1. The standard deviation is
    enlarged by the Birge ratio as in :func:`weighted_mean`.
    """
    known = np.isfinite(times) & np.isfinite(values) & np.isfinite(stds)
    if known.sum() < 3 or float(np.ptp(times[known])) < 1.0:
        return math.nan, math.nan
    time, value, weight = times[known], values[known], stds[known] ** -2.0
    centred = time - (weight * time).sum() / weight.sum()
    spread = float((weight * centred**2).sum())
    slope = float((weight * centred * value).sum()) / spread
    middle = float((weight * value).sum() / weight.sum())
    chi_squared = float((weight * (value - middle - slope * centred) ** 2).sum())
    ratio = max(1.0, chi_squared / (len(value) - 2))
    return slope, math.sqrt(ratio / spread)


def days(time: str) -> float:
    """Return days since 1970 of a time as in ISO 8601; NaN where it is not known."""
    if not time:
        return math.nan
    parsed = datetime.fromisoformat(time)
    since = parsed.replace(tzinfo=None) - (parsed.utcoffset() or datetime.min - datetime.min)
    return (since - datetime(1970, 1, 1)).total_seconds() / _DAY


def _stretch(mounts: Sequence[DriveMount]) -> Stretch:
    pose, std = np.stack([each.pose for each in mounts]), np.stack([each.std for each in mounts])
    times = np.array([days(each.time) for each in mounts])
    means = np.array([weighted_mean(pose[:, axis], std[:, axis]) for axis in range(4)])
    slopes = np.array([weighted_slope(times, pose[:, axis], std[:, axis]) for axis in range(4)])
    names = mounts[0].name, mounts[-1].name
    return Stretch(*names, len(mounts), means[:, 0], means[:, 1], slopes[:, 0], slopes[:, 1])


def _calibration(pose: torch.Tensor, variances: torch.Tensor, there: torch.Tensor) -> Calibration:
    """Return a calibration of batch size 1 of which only the axes that are ``there`` (4,) are used."""
    variance = torch.where(there, variances, torch.inf)
    status = torch.tensor([int(Status.TRACKING)])
    return Calibration(
        Extrinsics.unstack(pose[None]), torch.diag(variance)[None], status, pose.new_zeros(1, 0)
    )


def _pose_and_std(mount: MountCalibration | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pose and standard deviation of a drive, NaN where an axis has no evidence."""
    if mount is None:
        return np.full(4, np.nan), np.full(4, np.nan)
    known = (mount.axis_progress[0] > 0).numpy()
    pose = mount.extrinsics.stack()[0].double().numpy()
    std = mount.covariance[0].diagonal().clamp(min=0).sqrt().double().numpy()
    return np.where(known, pose, np.nan), np.where(known, std, np.nan)
