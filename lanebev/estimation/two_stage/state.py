"""State and configuration of the paper's calibrator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from lanebev.tensors import map_tensors
from lanebev.torch_internals import register_pytree
from lanebev.types import NUM_BOUNDARIES


@dataclass(frozen=True)
class TwoStageConfig:
    """Configuration of :class:`lanebev.TwoStageCalibrator`; angles in rad, lengths in m, times in s.

    The paper gives none of Q, W, N_loop or the search range (paper.md D13). W here admits ±1.5 deg and
    ±5 cm at 1 Hz.

    Attributes:
        num_boundaries: L.
        num_hypotheses: largest number of vanishing point hypotheses, N_loop.
        seed: seed of the hypotheses.
        gate_sigmas: number of standard deviations up to which a segment is an inlier; 0 is the paper's fixed
            gate of 0.7 deg.
        angular_acceleration_density: spectral density of the acceleration of pitch, yaw and roll, rad²/s³.
        height_acceleration_density: the same of the height, m²/s³.
        initial_pose: pose before the first frame: pitch, yaw, roll (rad), height (m).
        initial_pose_std: standard deviations of this pose.
        initial_rate_std: standard deviations of its rates, per s.
        min_segments: number of segments that must support a vanishing point.
        min_inlier_share: fraction of the segments that must support it.
        reacquire_after: time without support after which the search starts again, s.
        reacquire_spread: standard deviation of the predicted direction, rad, above which it also starts.
        lost_after: time without support after which the status is LOST, s.
        assumed_dt: time between frames, s, where it is not finite.
        lane_noise: standard deviation of each lane's width about the prior, m.
        lane_width_std: standard deviation of the prior itself, m: a common scale of the height.
        lane_deviation_std: standard deviation of each boundary's deviation from its place, m, as far as too
            few boundaries are in view to show it; in the covariance only.
        departures: whether the covariance contains the effect of the road's departures from the model; else
            it is that of the filters.
        departure_memory: time constant over which the road's departures from the model are measured, s.
    """

    num_boundaries: int = NUM_BOUNDARIES
    num_hypotheses: int = 300
    seed: int = 0
    gate_sigmas: float = 3.5
    angular_acceleration_density: float = 0.25
    height_acceleration_density: float = 1.0
    initial_pose: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.5)
    initial_pose_std: tuple[float, float, float, float] = (0.1, 0.1, 0.05, 0.5)
    initial_rate_std: tuple[float, float, float, float] = (0.2, 0.2, 0.2, 0.5)
    min_segments: int = 4
    min_inlier_share: float = 0.3
    reacquire_after: float = 0.2
    reacquire_spread: float = 0.013
    lost_after: float = 1.5
    assumed_dt: float = 1 / 30
    lane_noise: float = 0.0
    lane_width_std: float = 0.0
    lane_deviation_std: float = 0.05
    departures: bool = True
    departure_memory: float = 1.0

    def __post_init__(self) -> None:
        if self.num_boundaries < 2:
            raise ValueError(f"num_boundaries: expected at least 2, got {self.num_boundaries}")
        if self.num_hypotheses < 1:
            raise ValueError(f"num_hypotheses: expected at least 1, got {self.num_hypotheses}")
        for name in ("lane_noise", "lane_width_std", "lane_deviation_std"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a finite number, at least 0, got {getattr(self, name)}")
        if not 0 < self.departure_memory < math.inf:
            raise ValueError(
                f"departure_memory: expected a finite number, more than 0, got {self.departure_memory}"
            )


@register_pytree
class TwoStageState(NamedTuple):
    """State of the calibrator between frames, tensors only.

    Attributes:
        direction_mean: (B, 4) pitch, yaw and their rates; direction_cov: (B, 4, 4).
        roll_height_mean: (B, 4) roll, height and their rates; roll_height_cov: (B, 4, 4).
        roll_known, height_known: (B,) bool, initialised from lane widths.
        unseen: (B,) s since the vanishing point was last supported.
        sensitivity: (B, 8, 3 + 2 L) of direction_mean and roll_height_mean to the road's departures from the
            model, see :mod:`lanebev.estimation.two_stage.departures`.
        shape: (B, 2, 3), information on the road's curvature and vertical curvature.
        scatter: (B, 2, 4), moments of the boundaries' own headings and deviations.
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
    sensitivity: Tensor
    shape: Tensor
    scatter: Tensor
    status: Tensor
    reasons: Tensor

    def detach(self) -> TwoStageState:
        """Return the state without the graph that computed it."""
        return map_tensors(Tensor.detach, self)
