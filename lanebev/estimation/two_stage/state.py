"""State and configuration of the paper's calibrator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from lanebev.types import NUM_BOUNDARIES, map_tensors, register_pytree


@dataclass(frozen=True)
class TwoStageConfig:
    """Numbers of :class:`lanebev.TwoStageCalibrator`; angles in rad, lengths in m, times in s.

    The paper gives none of Q, W, N_loop or the search range (paper.md D13). W here admits ±1.5 deg and
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
    min_segments: int = 4  # that must support a vanishing point
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


@register_pytree
class TwoStageState(NamedTuple):
    """State of the calibrator between frames, tensors only.

    Attributes:
        direction_mean: (B, 4) pitch, yaw and their rates; direction_cov: (B, 4, 4).
        roll_height_mean: (B, 4) roll, height and their rates; roll_height_cov: (B, 4, 4).
        roll_known, height_known: (B,) bool, initialised from lane widths.
        unseen: (B,) s since the vanishing point was last supported.
        status: (B,) int64.
        reasons: (B,) int64, :class:`~lanebev.estimation.reasons.Reason` flags of the last frame.
    """

    direction_mean: Tensor
    direction_cov: Tensor
    roll_height_mean: Tensor
    roll_height_cov: Tensor
    roll_known: Tensor
    height_known: Tensor
    unseen: Tensor
    status: Tensor
    reasons: Tensor

    def detach(self) -> TwoStageState:
        """Return the state without the graph that computed it."""
        return map_tensors(Tensor.detach, self)
