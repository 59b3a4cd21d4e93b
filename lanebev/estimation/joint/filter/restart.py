"""When the joint filter starts: without a state, or with one that does not fit or that frames contradict.

After a shock the filter may explain a wrong pose by unequal lanes or a bend. Therefore, for some frames after
every jump, each frame is also fitted alone, without the filter's state.
"""

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import flag, replace_rows, select_rows
from lanebev.estimation.checks import is_running
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.evidence import CALL
from lanebev.estimation.joint.filter.scatter import (
    Scatter,
    averaged_moments,
    boundary_scatter,
    determined_sensitivity,
    with_headings,
)
from lanebev.estimation.joint.filter.start import state_of_fit
from lanebev.estimation.joint.filter.update import information, membership
from lanebev.estimation.joint.frame.single_frame import SingleFrameFit, fit_observations
from lanebev.estimation.joint.layout import NUM_COMMON, NUM_POSE, POSE, layout
from lanebev.estimation.joint.measurement.observations import Observations
from lanebev.estimation.joint.measurement.residuals import NUM_STRAIGHT, boundary_residuals
from lanebev.estimation.joint.measurement.robust import log_likelihood, scaled_variance, squared_distance
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.reasons import Reason
from lanebev.geometry.linalg import inverse_spd
from lanebev.types import Status

_CONTRADICTION = 25.7  # χ² with five degrees of freedom, exceeded by chance in one frame of 10,000
_DOUBT_FRAMES = 15.0  # frames after a jump or a misfit that are fitted alone and compared with the state
_CONTRARY_FRAMES = 5  # consecutive usable frames that contradict the state, from which it starts again
_MISFIT_SHARE = 0.5  # the state is in doubt if a smaller fraction of the segments fits


class Compared(NamedTuple):
    """A state after its comparison with a fit of the last frame alone.

    Attributes:
        state: after the frame, or begun from it.
        inliers: (B, N), of the state.
    """

    state: JointState
    inliers: Tensor


def restart(
    state: JointState,
    agreed: Tensor,
    supported: Tensor,
    seen: Observations,
    positions: Tensor,
    cfg: JointConfig,
) -> Compared:
    """Start rows from this frame alone if it determines the pose and there is no state, or a worse one.

    A state that a second frame contradicts is COASTING until enough of them did, or until one agrees with it.
    Only rows without a state, or with one in doubt, are compared with the frame.

    Args:
        state: after the frame.
        agreed: (B, N), inliers.
        supported: (B,) bool, the frame supports the state.
        seen: what was observed.
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        cfg: the configuration.
    """
    total = seen.weight.sum(-1)
    share = (agreed * seen.weight).sum(-1) / total.clamp(min=1e-6)
    state = state._replace(doubt=remaining_doubt(state, share))
    running = is_running(state.status)
    wanted = ~running | (~supported & (state.misfit > cfg.restart_after))
    asked = wanted | (state.doubt > 0)
    state = state._replace(
        contrary=torch.where(asked, state.contrary, 0.0),
        contradiction=torch.where(asked.unsqueeze(-1), state.contradiction, 0.0),
    )
    compare = partial(compare_with_frame, cfg=cfg)
    compared = asked & (total > 0)
    return replace_rows(compared, Compared(state, agreed), compare, state, agreed, wanted, seen, positions)


def compare_with_frame(
    state: JointState,
    agreed: Tensor,
    wanted: Tensor,
    seen: Observations,
    positions: Tensor,
    cfg: JointConfig,
) -> Compared:
    """Fit the frame alone, and compare the state with the fit or start from it.

    Args:
        state: after the frame.
        agreed: (B, N), inliers.
        wanted: (B,) bool, rows that start from any usable frame.
        seen: what was observed.
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        cfg: the configuration.
    """
    places = positions.gather(1, seen.boundary)
    fit = fit_observations(seen, places, cfg.prior, iterations=cfg.start_iterations)
    total = seen.weight.sum(-1).clamp(min=1e-6)
    usable = fit.valid & ((fit.inliers * seen.weight).sum(-1) / total >= cfg.enter_share)
    begun = state_of_fit(fit, state, cfg)
    scatter = scatter_of_fit(fit, places, seen, cfg)
    by_headings = scatter.sensitivity[..., cfg.num_boundaries :]
    assumed_step = torch.full_like(total, cfg.assumed_dt)
    begun = begun._replace(
        pose_sensitivity=scatter.sensitivity[..., : cfg.num_boundaries],
        heading_sensitivity=torch.cat([by_headings, begun.heading_sensitivity[:, NUM_POSE:]], dim=1),
        scatter=averaged_moments(scatter.moments, begun.scatter, assumed_step, cfg.scatter_memory),
        places=scatter.places,
    )
    contrary = usable & is_contrary(state, begun, fit, places, seen, cfg)
    count = torch.where(usable, (state.contrary + 1) * contrary, state.contrary)
    fresh = usable & (wanted | (count >= _CONTRARY_FRAMES))
    doubted = (count > 1) & (state.status == int(Status.TRACKING))
    apart = torch.where(contrary.unsqueeze(-1), (begun.mean - state.mean)[:, POSE], 0.0)
    kept = state._replace(
        contrary=count,
        contradiction=torch.where(usable.unsqueeze(-1), apart, state.contradiction),
        status=torch.where(doubted, int(Status.COASTING), state.status),
        reasons=state.reasons | flag(doubted, Reason.FEW_INLIERS),
    )
    inliers = torch.where(fresh.unsqueeze(-1), fit.inliers, agreed)
    return Compared(select_rows(fresh, begun, kept), inliers)


def remaining_doubt(state: JointState, share: Tensor) -> Tensor:
    """Compute the number (B,) of frames, this one too, that are compared after a jump or a misfit.

    Args:
        state: after the frame.
        share: (B,), of the frame's segments that fit the state.
    """
    jumped = (state.evidence[:, :NUM_POSE].abs() > CALL).any(-1)
    return torch.where(jumped | (share < _MISFIT_SHARE), _DOUBT_FRAMES, (state.doubt - 1).clamp(min=0))


def is_contrary(
    state: JointState,
    begun: JointState,
    fit: SingleFrameFit,
    places: Tensor,
    seen: Observations,
    cfg: JointConfig,
) -> Tensor:
    """Return whether a frame contradicts the state: its own fit differs significantly, and fits no worse.

    Source: (J19).

    If the state is right, its error is part of the frame's, so the covariance of their difference is at most
    that of the frame's fit. The state also has deviations, which the fit does not have: they must raise the
    likelihood by more than the penalty for additional parameters (Schwarz 1978).

    Args:
        state: after the frame.
        begun: the state that would start from the frame.
        fit: fit of the frame.
        places: (B, N) m, of the segments' boundaries on equal lanes.
        seen: what was observed.
        cfg: the configuration.

    Returns:
        (B,) bool.
    """
    straight = slice(0, NUM_STRAIGHT)
    apart = (state.mean - begun.mean)[:, straight].unsqueeze(-1)
    chi2 = (apart.mT @ inverse_spd(begun.cov[:, straight, straight]) @ apart).flatten()
    own = state.mean[:, layout(cfg.num_boundaries).deviations].gather(1, seen.boundary)
    with_state = boundary_residuals(state.mean[:, :NUM_COMMON], places + own, seen, state.phase)
    alone = boundary_residuals(fit.params(), places, seen)
    variance = scaled_variance(seen.sigma, fit.scale)
    by_state, by_fit = (
        log_likelihood(squared_distance(at.distance), at.valid, seen.weight, variance, seen.focal)
        for at in (with_state, alone)
    )
    penalty = 0.5 * cfg.num_boundaries * seen.weight.sum(-1).clamp(min=1.0).log()
    return (chi2 > _CONTRADICTION) & (by_fit + penalty > by_state)


def scatter_of_fit(fit: SingleFrameFit, places: Tensor, seen: Observations, cfg: JointConfig) -> Scatter:
    """Estimate the scatter of the boundaries in a frame that was fitted by itself.

    The sensitivity is 0 where the fit does not determine it, since the prior's covariance contains more
    there.
    """
    params = fit.params()
    residuals = boundary_residuals(params, places, seen)
    weight = residuals.valid * fit.inliers * seen.weight / scaled_variance(seen.sigma, fit.scale)
    member = membership(seen.boundary, cfg.num_boundaries, like=places)
    told = with_headings(*information(residuals, weight, member), residuals, weight, member)
    no_moments = places.new_zeros(places.shape[0], 2, cfg.num_boundaries + 4)
    found = boundary_scatter(*told, cfg.prior.precision(params), no_moments)
    determined = determined_sensitivity(fit.observed, cfg.num_boundaries)
    return found._replace(sensitivity=torch.where(determined, found.sensitivity, 0.0))
