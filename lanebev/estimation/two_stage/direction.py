"""Stage 1: pitch and yaw from the vanishing direction, by EKF."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import may_skip
from lanebev.estimation import kalman
from lanebev.estimation.checks import is_running
from lanebev.estimation.two_stage import departures
from lanebev.estimation.two_stage.state import TwoStageConfig, TwoStageState
from lanebev.estimation.two_stage.vanishing import (
    gate_angles,
    incidence_noise,
    ransac_vanishing_point,
    segment_angles,
    vanishing_dir_least_squares,
)
from lanebev.geometry.road import great_circle_normals
from lanebev.geometry.rotation import (
    pitch_yaw_from_vanishing_dir,
    road_from_cam,
    vanishing_dir_from_pitch_yaw,
)
from lanebev.observation.segments import LaneSegments


class DirectionStep(NamedTuple):
    """Stage 1 after a frame.

    Attributes:
        mean: (B, 4) pitch, yaw and their rates; cov: (B, 4, 4).
        inliers: (B, N) in {0, 1}, L_c.
        seen: (B,) bool, the frame supported the vanishing point.
        fresh: (B,) bool, started over in this frame.
        transition: (B, 4, 4), of the prediction.
    """

    mean: Tensor
    cov: Tensor
    inliers: Tensor
    seen: Tensor
    fresh: Tensor
    transition: Tensor


class Start(NamedTuple):
    """Pitch and yaw of one frame.

    Attributes:
        mean: (B, 4) pitch, yaw and their rates; cov: (B, 4, 4).
        inliers: (B, N) in {0, 1}, L_c.
        seen: (B,) bool, the frame supported the vanishing point.
    """

    mean: Tensor
    cov: Tensor
    inliers: Tensor
    seen: Tensor


class FrameRays(NamedTuple):
    """The segments of a frame with their rays.

    Attributes:
        segments: cleaned, see :func:`lanebev.estimation.checks.clean_segments`.
        rays: (B, N, 2, 3) of the end points.
        intrinsics: (B, 3, 3) px.
    """

    segments: LaneSegments
    rays: Tensor
    intrinsics: Tensor


def track_direction(
    frame: FrameRays, state: TwoStageState, dt: Tensor, draws: Tensor, cfg: TwoStageConfig
) -> DirectionStep:
    """Predict, gate and update pitch and yaw; start over where that fails.

    Source: Sec. III-D, Eqs. (9)-(17). Deviation: the paper takes L_c from Algorithm 1 in every frame; here
    that searches only at a start and after a gap, and a row that tracks takes what agrees with its
    prediction, so that lines of another direction, however many, do not turn it.

    Args:
        frame: its segments.
        state: state of the frame before.
        dt: (B,) s.
        draws: (N_loop, 2), see :func:`lanebev.estimation.two_stage.vanishing.segment_pairs`.
        cfg: the configuration.

    Returns:
        the step; a row that is neither supported nor started keeps its prediction.
    """
    segments, rays, intrinsics = frame
    mean, cov, transition = predict_direction(state, dt, cfg)
    normals = great_circle_normals(rays)

    residual, jacobian, noise = incidence(mean, normals, rays, segments.sigma, intrinsics)
    innovation = kalman.innovation(residual)
    there = segments.weight > 0
    gates = gate_angles(segments.endpoints, segments.sigma, cfg.gate_sigmas)
    vanishing = vanishing_dir_from_pitch_yaw(mean[:, 0], mean[:, 1])
    point = (intrinsics @ vanishing.unsqueeze(-1)).squeeze(-1)
    near = segment_angles(segments.endpoints, point) < gates
    if cfg.gate_sigmas > 0:
        near = near | kalman.gate(innovation, jacobian, noise, cov, cfg.gate_sigmas)
    inliers = (near & there).to(mean.dtype)
    supported = is_supported(segments, inliers, cfg)

    tracking = is_running(state.status)
    # After a gap the prediction is too uncertain to recognise outliers: search instead of gating.
    spread = cov[:, :2, :2].diagonal(dim1=-2, dim2=-1).amax(-1).sqrt()
    start = ~tracking | (state.unseen + dt > cfg.reacquire_after) | (spread > cfg.reacquire_spread)
    wanted = start & there.any(-1)
    started = start_direction(frame, mean, wanted, draws, cfg)
    fresh = start & started.seen
    seen = torch.where(start, fresh, supported)
    inliers = torch.where(fresh.unsqueeze(-1), started.inliers, inliers * supported.unsqueeze(-1))

    use = segments.weight * inliers * (seen & ~fresh).unsqueeze(-1)
    mean, cov = kalman.update(mean, cov, *kalman.information(innovation, jacobian, noise, use))
    mean = torch.where(fresh.unsqueeze(-1), started.mean, mean)
    cov = torch.where(fresh[:, None, None], started.cov, cov)
    return DirectionStep(mean, cov, inliers, seen, fresh, transition)


def predict_direction(state: TwoStageState, dt: Tensor, cfg: TwoStageConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Predict pitch and yaw at constant velocity, for ``reacquire_after`` at most.

    Source: Eqs. (9), (10), (12), (13). Deviation: the paper extrapolates for ever; after a gap the pose keeps
    its value and only its variance grows, up to that of the initial guess.

    Returns:
        mean (B, 4), covariance (B, 4, 4) and transition (B, 4, 4).
    """
    density = dt.new_full((2,), cfg.angular_acceleration_density)
    moving = torch.minimum(dt, (cfg.reacquire_after - state.unseen).clamp_min(0.0))
    tracking = is_running(state.status)
    transition, _ = kalman.constant_velocity(torch.where(tracking, moving, 0.0), density)
    _, noise = kalman.constant_velocity(torch.where(tracking, dt, 0.0), density)
    mean, cov = kalman.predict(state.direction_mean, state.direction_cov, transition, noise)
    limit = dt.new_tensor([*cfg.initial_pose_std[:2], *cfg.initial_rate_std[:2]]).square()
    return mean, kalman.limit_variance(cov, limit), transition


def is_supported(segments: LaneSegments, inliers: Tensor, cfg: TwoStageConfig) -> Tensor:
    """Return which rows have enough segments that agree, on two boundaries at least, (B,) bool."""
    weight = segments.weight * inliers
    every = torch.arange(cfg.num_boundaries, device=weight.device)
    member = (segments.boundary.unsqueeze(-1) == every).to(weight.dtype)
    boundaries = ((weight.unsqueeze(1) @ member).squeeze(1) > 0).sum(-1)
    count = (weight > 0).sum(-1)
    share = weight.sum(-1) / segments.weight.sum(-1).clamp_min(1e-9)
    return (count >= cfg.min_segments) & (boundaries >= 2) & (share >= cfg.min_inlier_share)


def start_direction(
    frame: FrameRays, mean: Tensor, wanted: Tensor, draws: Tensor, cfg: TwoStageConfig
) -> Start:
    """Start pitch and yaw from the vanishing direction.

    Source: Algorithm 1 and Eqs. (3), (4), (7), (8).

    Args:
        frame: its segments.
        mean: (B, 4) of pitch, yaw and their rates, for rows that are not wanted.
        wanted: (B,) bool, rows that start.
        draws: (N_loop, 2), see :func:`lanebev.estimation.two_stage.vanishing.segment_pairs`.
        cfg: the configuration.
    """
    segments, rays, intrinsics = frame
    if may_skip(wanted):
        nothing = torch.zeros_like(segments.weight)
        no = torch.zeros_like(wanted)
        return Start(mean, torch.zeros_like(mean).diag_embed(), nothing, no)
    _, agree = ransac_vanishing_point(
        segments.endpoints, segments.weight, segments.sigma, draws.to(mean.dtype), cfg.gate_sigmas
    )
    inliers, normals = agree.to(mean.dtype), great_circle_normals(rays)
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
    seen = is_supported(segments, inliers, cfg) & determined
    return Start(torch.stack([pitch, yaw, rates, rates], dim=-1), cov, inliers, seen)


class DirectionDepartures(NamedTuple):
    """Effect of the road's departures from the model on stage 1.

    Attributes:
        distance: (B, N, 2) m, of the segments' ends ahead on the road.
        sensitivity: (B, 4, 2 + L) of the state to curvature, vertical curvature and headings.
        matrix: (B, 4 + L, 4 + L), information of the frame on pitch, yaw and these departures.
        vector: (B, 4 + L), likewise.
    """

    distance: Tensor
    sensitivity: Tensor
    matrix: Tensor
    vector: Tensor


def follow_departures(step: DirectionStep, frame: FrameRays, state: TwoStageState) -> DirectionDepartures:
    """Follow the sensitivity of pitch and yaw to curvatures and headings through a frame.

    Source: docs/method/paper.md, Eqs. (T1) to (T3).

    Args:
        step: stage 1 after the frame.
        frame: its segments.
        state: state of the frame before.
    """
    segments, rays, intrinsics = frame
    pitch, yaw = step.mean[:, 0], step.mean[:, 1]
    roll, height = state.roll_height_mean[:, 0], state.roll_height_mean[:, 1]
    normals = great_circle_normals(rays)
    residual, jacobian, noise = incidence(step.mean[:, :2], normals, rays, segments.sigma, intrinsics)
    feet = departures.foot_points(rays, vanishing_dir_from_pitch_yaw(pitch, yaw), residual, noise)
    distance = departures.road_distances(feet, road_from_cam(pitch, yaw, roll), height)

    before = state.sensitivity[:, :4]
    num_boundaries = (before.shape[-1] - departures.NUM_SHAPE - 1) // 2
    own = departures.direction_by_departures(jacobian, distance, segments.boundary, num_boundaries)
    both, weight = torch.cat([jacobian, own], dim=-1), segments.weight * step.inliers
    matrix, vector = kalman.information(kalman.innovation(residual), both, noise, weight)
    predicted = step.transition @ before[..., : departures.NUM_SHAPE + num_boundaries]
    predicted = torch.where(step.fresh[:, None, None], 0.0, predicted)
    sensitivity = departures.updated_sensitivity(predicted, step.cov, matrix)
    return DirectionDepartures(distance, sensitivity, matrix, vector)


def incidence(
    mean: Tensor, normals: Tensor, rays: Tensor, sigma: Tensor, intrinsics: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the incidence of great circles and vanishing direction, with Jacobian and variance.

    Source: Eq. (11), h = d_Zᵀ R_CWᵀ n, with its derivatives by pitch and yaw.

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
