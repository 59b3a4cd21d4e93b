"""Iterated update of a predicted state by one frame."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import flag
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.evidence import (
    EVIDENCE_TIME,
    accumulate_evidence,
    adapt_motion_scale,
    adaptive_process_noise,
    normalized_score,
    with_process_noise,
)
from lanebev.estimation.joint.filter.lane_change import best_shift, renumber, shifted
from lanebev.estimation.joint.filter.scatter import (
    Scatter,
    averaged_moments,
    boundary_scatter,
    renumbered_moments,
    summed_places,
    updated_sensitivity,
    with_headings,
)
from lanebev.estimation.joint.filter.update import (
    FrameInformation,
    Step,
    agreement,
    boundary_deviation,
    estimated_entries,
    frame_information,
    kalman_gain,
    membership,
    observed_step,
    posterior_covariance,
    single_frame_std,
    wide_precision,
)
from lanebev.estimation.joint.layout import NUM_COMMON, POSE, SHAPE, layout
from lanebev.estimation.joint.measurement.observations import Observations, ego_lane_width, per_end
from lanebev.estimation.joint.measurement.residuals import (
    NUM_STRAIGHT,
    ROLL,
    VERTICAL,
    Residuals,
    boundary_distances,
    boundary_residuals,
    foot_points,
    look,
)
from lanebev.estimation.joint.motion.road import speed_share
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.reasons import Reason
from lanebev.geometry.linalg import reduced_information, times_vector
from lanebev.tensors import constant

_NO_BOUNDARY_DEVIATION = 0.36  # m; a line that deviates by more bounds no lane (3 ``open_deviation``)


class FrameUpdate(NamedTuple):
    """A state after the update by a frame.

    Attributes:
        state: with the frame.
        trust: (B, N) in [0, 1], weights of the segments.
        inliers: (B, N) in [0, 1].
        single_frame_std: (B, 5) rad and m, of pose and offset by this frame alone.
    """

    state: JointState
    trust: Tensor
    inliers: Tensor
    single_frame_std: Tensor


class Iteration(NamedTuple):
    """One iteration of an update.

    Attributes:
        at: (B, O), point of linearisation.
        prior_cov: (B, D, D), of the prediction, with the process noise so far.
        frame: information of the frame there.
        single_frame_std: (B, 5) rad and m, of pose and offset by the frame alone.
        estimated: (B, D), shares by which entries are estimated, see :func:`estimated_entries`.
        step: what follows.
    """

    at: Tensor
    prior_cov: Tensor
    frame: FrameInformation
    single_frame_std: Tensor
    estimated: Tensor
    step: Step


def update_state(
    predicted: JointState, positions: Tensor, seen: Observations, dt: Tensor, cfg: JointConfig
) -> FrameUpdate:
    """Update a prediction by a frame: lane change, iterated robust update, adaptive process noise.

    After the first iteration, evidence against the motion raises the process noise for the others.

    Args:
        predicted: state.
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        seen: what was observed.
        dt: (B,) s since the last frame.
        cfg: the configuration.
    """
    indices, num, width = layout(cfg.num_boundaries), cfg.num_boundaries, ego_lane_width(positions)
    sight = look(predicted.mean[:, :NUM_COMMON], seen, predicted.phase)
    shift, scale = best_shift(predicted.mean, positions, seen, sight, width)
    mean = renumber(predicted.mean, shift, width, num)
    prior, places = mean[:, indices.observed], positions.gather(1, seen.boundary)  # (B, O), (B, N)
    member = membership(seen.boundary, num, like=places)
    of_speed = speed_share(predicted.mean[:, SHAPE], predicted.cov[:, SHAPE, SHAPE])

    def iterate(at: Tensor, at_cov: Tensor, residuals: Residuals, scale: Tensor, cov: Tensor) -> Iteration:
        frame = frame_information(residuals, scale, at_cov, seen, member)
        alone = single_frame_std(frame.matrix)
        estimated = estimated_entries(alone, of_speed, num)
        observed = cov[:, indices.observed, indices.observed]
        moved = observed_step(prior, observed, at, frame, estimated[:, indices.observed])
        return Iteration(at, cov, frame, alone, estimated, moved)

    cov, on_road = predicted.cov, lateral_places(prior, places, seen)
    at_cov = cov[:, indices.observed, indices.observed]
    feet = foot_points(prior[:, :NUM_COMMON], on_road, seen, sight)
    residuals = boundary_residuals(prior[:, :NUM_COMMON], on_road, seen, predicted.phase, feet, sight)
    last = iterate(prior, at_cov, residuals, scale, cov)
    support = times_vector(member, per_end(last.frame.trust * seen.weight))
    score = normalized_score(at_cov, last.frame, support, seen.weight)
    evidence, motion_scale = with_evidence(predicted, score, last.estimated[:, POSE] > 0, dt)
    cov = with_process_noise(cov, adaptive_process_noise(evidence, at_cov, cfg))
    for _ in range(cfg.iterations - 1):
        at = last.step.mean
        on_road = lateral_places(at, places, seen)
        distance, valid = boundary_distances(at[:, :NUM_COMMON], on_road, seen, feet, predicted.phase)
        residuals = residuals._replace(distance=distance, valid=valid)  # the Jacobian stays
        last = iterate(at, last.step.cov, residuals, last.frame.scale, cov)

    frame, moments = last.frame, renumbered_moments(predicted.scatter, shift)
    informed = with_headings(frame.matrix, frame.vector, frame.residuals, frame.weight, member)
    scatter = scatter_of_frame(*informed, cov, moments)
    gain = kalman_gain(last.prior_cov, last.step, frame, last.estimated)
    of_two = 1 - last.estimated[:, ROLL, None]  # boundaries, which do not determine the roll
    vertical = of_two * vertical_information(frame, cov, last.at[:, VERTICAL])
    by_headings = shifted(predicted.heading_sensitivity, shift)
    updated = predicted._replace(
        mean=torch.baddbmm(mean.unsqueeze(-1), gain, last.step.pull.unsqueeze(-1)).squeeze(-1),
        cov=posterior_covariance(cov, frame.matrix, gain),
        evidence=evidence,
        pose_sensitivity=scatter.sensitivity[..., :num],
        heading_sensitivity=updated_sensitivity(by_headings, gain, informed[0]),
        scatter=averaged_moments(scatter.moments, moments, dt, cfg.scatter_memory),
        places=summed_places(scatter.places, last.at[:, NUM_COMMON:], predicted.places, shift, dt, cfg),
        vertical=vertical + (-dt / cfg.scatter_memory).exp().unsqueeze(-1) * predicted.vertical,
        motion_scale=motion_scale,
        reasons=flag(shift != 0, Reason.LANE_CHANGE),
    )
    return FrameUpdate(updated, frame.trust, inliers_of_lanes(last, seen), last.single_frame_std)


def lateral_places(at: Tensor, places: Tensor, seen: Observations) -> Tensor:
    """Add the boundaries' deviations at (B, O) to the segments' places (B, N) m."""
    return places + at[:, NUM_COMMON:].gather(1, seen.boundary)


def inliers_of_lanes(last: Iteration, seen: Observations) -> Tensor:
    """Compute each segment's inlier probability (B, N), 0 on a line that deviates too much to bound a lane.

    It deviates so either in the state or by this frame alone.
    """
    after = last.step.mean
    agreed = agreement(last.frame, after - last.at, seen)
    apart = torch.maximum(after[:, NUM_COMMON:].abs(), boundary_deviation(last.at, last.frame).abs())
    lane = (apart < _NO_BOUNDARY_DEVIATION).gather(1, seen.boundary)
    return torch.where((seen.weight > 0) & lane, agreed, 0.0)


def with_evidence(
    predicted: JointState, score: Tensor, pose_determined: Tensor, dt: Tensor
) -> tuple[Tensor, Tensor]:
    """Add a frame's scores to the evidence against the motion, and adapt the scale of the motion to them.

    Args:
        predicted: state.
        score: (B, 11 + L), of :func:`~lanebev.estimation.joint.filter.evidence.normalized_score`.
        pose_determined: (B, 4) bool, what of the pose the frame determines; the scale of the rest decays.
        dt: (B,) s since the last frame.

    Returns:
        evidence (B, 11 + L) and scale (B, 4).
    """
    evidence = accumulate_evidence(predicted.evidence, score, dt, EVIDENCE_TIME)
    scored = torch.where(pose_determined, score[:, POSE], 1.0)  # 1 is the score that is expected
    return evidence, adapt_motion_scale(predicted.motion_scale, scored, dt)


def scatter_of_frame(matrix: Tensor, vector: Tensor, cov: Tensor, moments: Tensor) -> Scatter:
    """Estimate the scatter of the boundaries beside pose, offset and vertical curvature.

    Args:
        matrix: (B, O + L, O + L), information of the frame and on headings, see :func:`with_headings`.
        vector: (B, O + L), likewise.
        cov: (B, D, D), of the state before the frame.
        moments: (B, 2, L + 4) of the frames before.
    """
    kept = constant((*range(NUM_STRAIGHT), *range(VERTICAL, vector.shape[-1])), matrix, torch.int64)
    matrix, vector = matrix.index_select(1, kept).index_select(2, kept), vector.index_select(1, kept)
    of_vertical = cov[:, VERTICAL, VERTICAL, None].reciprocal()
    precision = torch.cat([wide_precision(cov), of_vertical], dim=-1)
    return boundary_scatter(matrix, vector, precision, moments)


def vertical_information(frame: FrameInformation, cov: Tensor, at: Tensor) -> Tensor:
    """Compute a frame's information (B, 2) on the vertical curvature, whatever its pose and offset are.

    Source: (J28), of two boundaries.

    Args:
        frame: linearised where the vertical curvature is ``at``.
        cov: (B, D, D), of the state before the frame, for the curvatures.
        at: (B,) 1/m.
    """
    matrix, vector = frame.matrix[:, :NUM_COMMON, :NUM_COMMON], frame.vector[:, :NUM_COMMON]
    of_shape = cov.diagonal(dim1=1, dim2=2)[:, SHAPE].reciprocal()
    found = reduced_information(matrix, vector, torch.cat([wide_precision(matrix), of_shape], dim=-1))
    known, pull = found.flatten(1).unbind(-1)
    return torch.stack([known, pull + known * at], dim=-1)
