"""Fixed-interval smoothing: estimate every state of a drive from all of its frames.

The predictions of the filter are repeated from its states, so the states of a drive are all that is needed.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import has_flag
from lanebev.estimation import kalman
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.evidence import adaptive_process_noise, with_process_noise
from lanebev.estimation.joint.filter.prediction import elapsed, predict_state
from lanebev.estimation.joint.layout import POSE, layout
from lanebev.estimation.joint.measurement.residuals import OFFSET, ROLL
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.reasons import Reason
from lanebev.geometry.precision import autocast_off, cast_floating, widest_dtype
from lanebev.types import Calibration, Extrinsics, Status

_CHUNK = 256  # rows, of one frame or several, whose gains are computed at once


class Link(NamedTuple):
    """The prediction from one state to the next.

    Attributes:
        predicted: (B, D), mean of the prediction.
        transition: (B, D, D), F.
        noise: (B, D, D), W, with the noise that the frame's evidence added.
        linked: (B, D, D) bool, [i, j]: entry j after has information on entry i before.
    """

    predicted: Tensor
    transition: Tensor
    noise: Tensor
    linked: Tensor


def link_states(before: JointState, after: JointState, dt: Tensor, cfg: JointConfig) -> Link:
    """Repeat the prediction from one frame's state to the next one's.

    A start uses nothing of the state before. Where the boundaries' numbers changed, offset and deviations are
    other quantities. A skipped frame changed nothing. If roll was considered and not estimated, its error and
    those of the other entries have no information on each other, as in the filter; so it is with the speed,
    which is estimated in part only.

    Args:
        before: state after a frame.
        after: state after the next.
        dt: (B,) s between them, as the calibrator was given it.
        cfg: the calibrator's.
    """
    indices = layout(cfg.num_boundaries)
    due, skip, _, _ = elapsed(dt, before, cfg)
    predicted, transition, noise = predict_state(before, due, cfg)
    evidence = torch.where(skip.unsqueeze(-1), 0.0, after.evidence)
    raised = adaptive_process_noise(evidence, predicted.cov[:, indices.observed, indices.observed], cfg)
    known = (skip.unsqueeze(-1) | ~other_quantities(after, cfg)).unsqueeze(-2)  # (B, 1, D)
    roll_alone = has_flag(after.reasons, Reason.ROLL_UNSEEN) & (after.unseen == 0)
    entries = torch.arange(indices.size, device=dt.device)
    of_speed = _alike(entries == indices.speed)  # (D, D)
    of_roll = _alike(torch.isin(entries, torch.tensor(indices.chain(ROLL), device=dt.device)))
    linked = known & of_speed & (of_roll | ~roll_alone[:, None, None])
    return Link(predicted.mean, transition, with_process_noise(noise, raised), linked)


def _alike(chosen: Tensor) -> Tensor:
    """Return of which pairs (D, D) both entries or neither are chosen (D,)."""
    return chosen.unsqueeze(-1) == chosen


def other_quantities(after: JointState, cfg: JointConfig) -> Tensor:
    """Return which entries (B, D) of a state are another quantity than in the state of the frame before."""
    indices = layout(cfg.num_boundaries)
    numbered = (OFFSET, *range(indices.size)[indices.deviations])
    of_numbers = torch.tensor([k in numbered for k in range(indices.size)], device=after.mean.device)
    begun = has_flag(after.reasons, Reason.RESTARTED) | (after.status == int(Status.UNINITIALISED))
    return begun.unsqueeze(-1) | (has_flag(after.reasons, Reason.LANE_CHANGE).unsqueeze(-1) & of_numbers)


def smooth_states(
    states: Sequence[JointState], dt: Sequence[Tensor] | Tensor, cfg: JointConfig
) -> Iterator[JointState]:
    """Yield the smoothed states of a drive, the last one first, with ``mean`` and ``cov`` replaced.

    Source: (J32), (J33); Rauch, Tung and Striebel 1965, Särkkä 2013, Sec. 9.1, on the filter's linearisation.

    Args:
        states: after every frame, (B, ...) each, in order; they are accessed once, from the last to the
            first, so a sequence that reads them from a file suffices.
        dt: (T, B), or (B,) for each frame: s from the frame before, as the calibrator was given it; the first
            is not used.
        cfg: the calibrator's.
    """
    if not states:
        return
    mean, cov = states[-1].mean, states[-1].cov
    yield states[-1]
    rows = mean.shape[0]
    chunk = max(1, _CHUNK // max(1, rows))  # frames
    for stop in range(len(states), 1, -chunk):
        some = [states[k] for k in range(max(stop - 1 - chunk, 0), stop)]
        intervals = torch.cat([dt[k] for k in range(stop - len(some) + 1, stop)])
        links = _backward_links(_joined(some[:-1]), _joined(some[1:]), intervals, cfg)
        parts = [part.unflatten(0, (len(some) - 1, rows)).unbind()[::-1] for part in links]
        for state, predicted, gain, own in zip(some[-2::-1], *parts, strict=True):
            with autocast_off(mean.device):
                mean = state.mean + (gain @ (mean - predicted).unsqueeze(-1)).squeeze(-1)
                cov = kalman.symmetrise(own + gain @ cov.to(gain) @ gain.mT)
            yield state._replace(mean=mean.to(state.mean), cov=cov.to(state.cov))


def _backward_links(
    before: JointState, after: JointState, dt: Tensor, cfg: JointConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute prediction (B, D), gain (B, D, D) and covariance (B, D, D) of a step backward."""
    dtype = widest_dtype(before.mean.device)
    before, after = cast_floating(before, dtype), cast_floating(after, dtype)
    dt = dt.to(dtype)
    with autocast_off(dt.device):
        link = link_states(before, after, dt, cfg)
        gain = kalman.smoother_gain(before.cov, link.transition, link.noise, link.linked)
        own = kalman.smoother_covariance(before.cov, link.transition, link.noise, gain)
    return link.predicted, gain, own


def smooth_drive(
    calibrations: Sequence[Calibration],
    states: Sequence[JointState],
    dt: Sequence[Tensor] | Tensor,
    cfg: JointConfig,
) -> list[Calibration]:
    """Compute the calibration of every frame of a drive from all of its frames.

    Status and inliers are those of the filter. Frames before the first start, and the last frame, are as the
    filter gave them; so is the last frame before a new start.

    Args:
        calibrations: calibrations of every frame, in order, as the calibrator gave them.
        states: after every frame, best in float64.
        dt: (T, B), or (B,) for each frame: s from the frame before, as the calibrator was given it.
        cfg: the calibrator's.

    Raises:
        ValueError: they are not of as many frames.
    """
    if not len(calibrations) == len(states) == len(dt):
        raise ValueError(
            "calibrations, states, dt: expected one of each a frame, got "
            f"{len(calibrations)}, {len(states)}, {len(dt)}"
        )
    backward = zip(calibrations[::-1], states[::-1], smooth_states(states, dt, cfg), strict=True)
    return [smoothed_calibration(*frame) for frame in backward][::-1]


def _joined(states: Sequence[JointState]) -> JointState:
    """Return states of several frames as rows of one batch."""
    return JointState(*(torch.cat(parts) for parts in zip(*states, strict=True)))


def smoothed_calibration(calibration: Calibration, state: JointState, smoothed: JointState) -> Calibration:
    """Replace pose and covariance of a frame's calibration by the smoothed ones.

    The terms that the calibration's covariance has besides the filter's, as for unequal lanes, stay.

    Args:
        calibration: calibration of the frame, as the calibrator gave it.
        state: after the frame.
        smoothed: that state, smoothed.
    """
    added = calibration.covariance - state.cov[:, POSE, POSE].to(calibration.covariance)
    covariance = smoothed.cov[:, POSE, POSE].to(added) + added
    return calibration._replace(
        extrinsics=Extrinsics.unstack(smoothed.mean[:, POSE].to(added)), covariance=covariance
    )
