"""Stage 2: roll and height from lane widths, by EKF."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import may_skip
from lanebev.estimation import kalman
from lanebev.estimation.two_stage.departures import updated_sensitivity
from lanebev.estimation.two_stage.lane_width import (
    BoundaryAngles,
    WidthMeasurement,
    initial_roll_height,
    measure_widths,
    width_residuals,
)
from lanebev.estimation.two_stage.state import TwoStageConfig, TwoStageState
from lanebev.geometry.linalg import cholesky, solve_lower
from lanebev.types import Status

_NUM_LINEARISATIONS = 2
LARGEST_ROLL = 0.8  # rad
LEAST_HEIGHT, LARGEST_HEIGHT = 0.1, 20.0  # m


class RollHeightStep(NamedTuple):
    """Stage 2 after a frame.

    Attributes:
        mean: (B, 4) roll, height and their rates; cov: (B, 4, 4).
        roll_known: (B,) bool; height_known: (B,) bool.
        roll_seen: (B,) bool, two lanes or more in this frame; height_seen: (B,) bool, one lane or more.
        sensitivity: (B, 4, 3 + 2 L) of the state to the road's departures from the model.
        matrix: (B, 2 + 2 + 2 L, 2 + 2 + 2 L), information of the frame on roll, height and these departures
            without the last, the roll's own.
        vector: (B, 2 + 2 + 2 L), likewise.
    """

    mean: Tensor
    cov: Tensor
    roll_known: Tensor
    height_known: Tensor
    roll_seen: Tensor
    height_seen: Tensor
    sensitivity: Tensor
    matrix: Tensor
    vector: Tensor


class SeenLanes(NamedTuple):
    """The information of a frame on roll and height.

    Attributes:
        boundaries: angles about the direction of stage 1.
        lane_width: (B, L-1) m, the prior.
        direction_cov: (B, 2, 2) of pitch and yaw.
        direction_sensitivity: (B, 2, 2 + L) of pitch and yaw to curvatures and headings.
    """

    boundaries: BoundaryAngles
    lane_width: Tensor
    direction_cov: Tensor
    direction_sensitivity: Tensor


def track_roll_height(
    lanes: SeenLanes, state: TwoStageState, dt: Tensor, fresh: Tensor, cfg: TwoStageConfig
) -> RollHeightStep:
    """Predict and update roll and height, or start them; one lane alone updates height only.

    Source: Sec. IV-B, state of Eqs. (21)-(22), measurement of Eq. (20). Deviation: a roll or height that no
    car has (``LARGEST_ROLL``, ``LEAST_HEIGHT``, ``LARGEST_HEIGHT``) is back at the prior and unknown.

    Args:
        lanes: those of the frame.
        state: state of the frame before.
        dt: (B,) s.
        fresh: (B,) bool, stage 1 started over.
        cfg: the configuration.

    Returns:
        the step.
    """
    boundaries, lane_width = lanes.boundaries, lanes.lane_width
    num_lanes = (boundaries.present[:, :-1] & boundaries.present[:, 1:]).sum(-1)
    height_seen, roll_seen = num_lanes >= 1, num_lanes >= 2
    mean, cov, transition = predict_roll_height(state, dt, roll_seen, height_seen, cfg)

    lost = fresh & (state.status == int(Status.LOST))
    start_roll = roll_seen & (~state.roll_known | lost)
    start_height = height_seen & (~state.height_known | lost | start_roll)
    first = torch.stack([start_roll, start_height, start_roll, start_height], dim=-1)
    if not may_skip(first):
        roll, height = initial_roll_height(boundaries, lane_width, mean[:, 0])
        started = torch.stack([roll, height, torch.zeros_like(roll), torch.zeros_like(roll)], dim=-1)
        mean = torch.where(first, started, mean)
    wide = mean.new_tensor([*cfg.initial_pose_std[2:], *cfg.initial_rate_std[2:]]).square().diag()
    cov = torch.where((first.unsqueeze(-1) | first.unsqueeze(-2)), wide, cov)

    seen = torch.stack([roll_seen, height_seen], dim=-1)
    mean, cov, measured = update_by_widths(lanes, mean, cov, seen, cfg.lane_noise)
    matrix, vector = departure_information(lanes, measured, seen)
    sensitivity = torch.where(first.unsqueeze(-1), 0.0, transition @ state.sensitivity[:, 4:])
    sensitivity = updated_sensitivity(sensitivity, cov, matrix)
    # Widths of wrong boundaries can lead anywhere: impossible values start again.
    possible = (mean[:, 0].abs() < LARGEST_ROLL) & (mean[:, 1] > LEAST_HEIGHT) & (mean[:, 1] < LARGEST_HEIGHT)
    prior = torch.cat([mean.new_tensor(cfg.initial_pose[2:]), mean.new_zeros(2)])
    mean = torch.where(possible.unsqueeze(-1), mean, prior)
    cov = torch.where(possible[:, None, None], cov, wide)
    sensitivity = torch.where(possible[:, None, None], sensitivity, 0.0)
    roll_known = (state.roll_known | roll_seen) & possible
    height_known = (state.height_known | height_seen) & possible
    information = matrix[:, :-1, :-1], vector[:, :-1]
    return RollHeightStep(
        mean, cov, roll_known, height_known, roll_seen, height_seen, sensitivity, *information
    )


def update_by_widths(
    lanes: SeenLanes, mean: Tensor, cov: Tensor, seen: Tensor, lane_noise: float
) -> tuple[Tensor, Tensor, WidthMeasurement]:
    """Update roll and height by the lanes' widths in an iterated extended Kalman filter.

    Source: Eqs. (15)-(17) with the measurement of Eq. (20); iterated as in Bell and Cathey 1993.
    Deviation: linearised twice, the second time about the first's result: widths are curved in roll by so
    much that after a fifth of a second one update is seven sigmas off. And Q is not constant: a width is as
    good as its boundaries' pixels and as pitch and yaw, whose errors widths of one frame share.

    Args:
        lanes: those of the frame.
        mean: (B, 4) predicted roll, height and their rates.
        cov: (B, 4, 4) their covariance.
        seen: (B, 2) bool, whether widths may move roll and height.
        lane_noise: m, standard deviation of a lane's width about the prior.

    Returns:
        mean (B, 4), covariance (B, 4, 4), and the widths of the last linearisation.
    """
    boundaries, lane_width, direction_cov, _ = lanes
    at, after = mean, cov
    for _ in range(_NUM_LINEARISATIONS):
        measured = measure_widths(boundaries, at[:, 0], at[:, 1], direction_cov, lane_noise)
        error = width_residuals(measured.widths, lane_width, measured.present)
        jacobian = torch.where(measured.present.unsqueeze(-1), measured.jacobian, 0.0) * seen.unsqueeze(1)
        jacobian = torch.cat([jacobian, torch.zeros_like(jacobian)], dim=-1)  # (B, L-1, 4)
        innovation = error + (jacobian @ (at - mean).unsqueeze(-1)).squeeze(-1)
        both = torch.cat([jacobian, innovation.unsqueeze(-1)], dim=-1)
        white = solve_lower(cholesky(measured.noise), both)
        info = kalman.information(white[..., -1], white[..., :-1], torch.ones_like(error))
        at, after = kalman.update(mean, cov, *info)
    return at, after, measured


def departure_information(
    lanes: SeenLanes, measured: WidthMeasurement, seen: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute a frame's information on roll, height and the road's departures from the model.

    Source: docs/method/paper.md, Eq. (T2): derivatives of w_p - w by curvature, vertical curvature, headings,
    deviations and a roll that the frame does not determine.

    Args:
        lanes: those of the frame.
        measured: their widths.
        seen: (B, 2) bool, whether widths may move roll and height.

    Returns:
        (B, 5 + 2 L, 5 + 2 L) and (B, 5 + 2 L).
    """
    boundaries = lanes.boundaries
    error = width_residuals(measured.widths, lanes.lane_width, measured.present)
    eye = torch.eye(boundaries.present.shape[1], dtype=error.dtype, device=error.device)
    turned = boundaries.jacobian[..., 1:] * eye  # a boundary's heading acts as a yaw of its own
    own = torch.cat([boundaries.by_shape, -turned], dim=-1)
    angles = boundaries.jacobian @ lanes.direction_sensitivity + own
    ends = (eye[:-1] - eye[1:]).expand_as(measured.by_angle)
    moved, unseen = measured.jacobian * seen.unsqueeze(1), measured.jacobian[..., :1] * ~seen[:, None, :1]
    columns = [moved, -measured.by_angle @ angles, ends, -unseen, error.unsqueeze(-1)]
    there = measured.present.unsqueeze(-1)
    white = solve_lower(cholesky(measured.noise), torch.where(there, torch.cat(columns, dim=-1), 0.0))
    both = white[..., :-1].mT @ white
    return both[..., :-1], both[..., -1]


def predict_roll_height(
    state: TwoStageState, dt: Tensor, roll_seen: Tensor, height_seen: Tensor, cfg: TwoStageConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Predict roll and height at constant velocity, for ``reacquire_after`` at most.

    Source: Eqs. (21)-(22). Deviation: what this frame does not observe keeps its value, and only its variance
    grows. The paper extrapolates roll on one lane for ever (paper.md D6), and across any gap, so
    far that one linearised update does not lead back.

    Returns:
        mean (B, 4), covariance (B, 4, 4) and transition (B, 4, 4).
    """
    density = dt.new_tensor([cfg.angular_acceleration_density, cfg.height_acceleration_density])
    transition, _ = kalman.constant_velocity(dt.clamp(max=cfg.reacquire_after), density)
    _, noise = kalman.constant_velocity(dt, density)
    moving = torch.stack([roll_seen & state.roll_known, height_seen & state.height_known], dim=-1)
    moving = torch.cat([moving, moving], dim=-1)  # (B, 4) of position and rate
    eye = torch.eye(4, dtype=dt.dtype, device=dt.device)
    still = eye * dt.new_tensor([1.0, 1.0, 0.0, 0.0])
    transition = torch.where(moving.unsqueeze(-1), transition, still)
    # What is not known yet keeps its prior; the variance of what was known and is not seen grows.
    known = torch.stack([state.roll_known, state.height_known] * 2, dim=-1)
    known = known.unsqueeze(-1) & known.unsqueeze(-2)
    mean, cov = kalman.predict(state.roll_height_mean, state.roll_height_cov, transition, noise * known)
    limit = dt.new_tensor([*cfg.initial_pose_std[2:], *cfg.initial_rate_std[2:]]).square()
    cov = kalman.limit_variance(cov, limit)
    rates = torch.where(moving[:, 2:], 0.0, limit[2:])
    cov = cov + torch.cat([torch.zeros_like(rates), rates], dim=-1).diag_embed()
    # Without roll in the measurement, its correlation with height would still move it: cut it.
    together = moving.unsqueeze(-1) == moving.unsqueeze(-2)
    return mean, torch.where(together, cov, 0.0), transition
