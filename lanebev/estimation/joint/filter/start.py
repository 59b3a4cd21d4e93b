"""How a state of the joint filter starts: from the prior, or from one frame's fit."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.batch import flag
from lanebev.estimation.joint.config import JointConfig, MotionConfig
from lanebev.estimation.joint.frame.bends import straight_or_bend
from lanebev.estimation.joint.frame.single_frame import SingleFrameFit
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.joint.layout import NUM_COMMON, NUM_POSE, STEPS, layout
from lanebev.estimation.joint.measurement.residuals import (
    CURVATURE,
    HEIGHT,
    NUM_PARAMS,
    NUM_SHAPE,
    NUM_STRAIGHT,
    ROLL,
    VERTICAL,
)
from lanebev.estimation.joint.measurement.road_curve import KNOT_SPACING
from lanebev.estimation.joint.motion.low_pass import pose_variances
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.reasons import Reason
from lanebev.tensors import constant
from lanebev.types import Status

_OFFSET_RATE_STD = 0.5  # m/s, of a start
_UNDETERMINED_ROLL = 0.5  # roll is undetermined if its sigma is a larger fraction of the prior's
_ROLL_NOISE = 1.5  # such a roll may be noise if it is within so many sigmas of the prior's mean


def new_state(mean: Tensor, cov: Tensor, status: Status, reasons: Tensor) -> JointState:
    """Make a state from its mean and covariance; it remembers no frame.

    Args:
        mean: (B, D).
        cov: (B, D, D).
        status: of all rows.
        reasons: (B,) int64 flags.
    """
    batch, num = mean.shape[0], mean.shape[-1] - layout(0).size

    def zero(*shape: int) -> Tensor:
        return mean.new_zeros(batch, *shape)

    return JointState(
        mean=mean,
        cov=cov,
        phase=zero(),
        evidence=zero(NUM_POSE + NUM_COMMON - CURVATURE + num),
        pose_sensitivity=zero(NUM_POSE, num),
        heading_sensitivity=zero(mean.shape[-1], num),
        scatter=zero(2, num + 4),
        places=zero(num, num + 1),
        motion_scale=mean.new_ones(batch, NUM_POSE),
        hills=zero(),
        vertical=zero(2),
        early=zero(),
        unseen=zero(),
        misfit=zero(),
        doubt=zero(),
        contrary=zero(),
        contradiction=zero(NUM_POSE),
        usual=zero(2, NUM_POSE),
        turned=zero(),
        unusual=zero(2),
        status=torch.full_like(reasons, int(status)),
        reasons=reasons,
    )


def state_of_fit(fit: SingleFrameFit, before: JointState, cfg: JointConfig) -> JointState:
    """Make a state of one frame's fit; of the state before only the frames in doubt are kept."""
    mean, cov = start_moments(*with_roll_of_prior(fit, cfg.prior), cfg)
    reasons = (
        int(Reason.RESTARTED)
        | flag(~fit.observed[:, ROLL], Reason.ROLL_UNSEEN)
        | flag(~fit.observed[:, HEIGHT], Reason.HEIGHT_UNSEEN)
    )
    return new_state(mean, cov, Status.TRACKING, reasons)._replace(doubt=before.doubt)


def with_roll_of_prior(fit: SingleFrameFit, prior: FramePrior) -> tuple[Tensor, Tensor, Tensor]:
    """Replace a roll that a fit hardly determines by the prior's mean and variance.

    The two boundaries of one lane do not determine roll. The roll of such a fit is the effect of noise that
    bends the lines, or of the road's vertical curvature, and precise lines can bring it far from the prior.
    The other parameters follow by their regression on roll. A roll farther from the prior is kept.

    Returns:
        parameters (B, 7), covariance (B, 7, 7), and their change (B, 7) per 1/m of vertical curvature.
    """
    params, cov, by_vertical = fit.params(), fit.covariance, fit.by_vertical_curvature
    variance, to_prior = cov[:, ROLL, ROLL, None], prior.roll - params[:, ROLL, None]
    near_prior = to_prior.abs() < _ROLL_NOISE * prior.roll_std
    undetermined = near_prior & (variance > (_UNDETERMINED_ROLL * prior.roll_std) ** 2)
    by_roll = cov[:, ROLL] / variance * undetermined  # (B, 7), 1 in roll; 0 where it is determined
    more = (prior.roll_std**2 - variance).unsqueeze(-1) * by_roll.unsqueeze(-1) * by_roll.unsqueeze(-2)
    return params + to_prior * by_roll, cov + more, by_vertical - by_vertical[:, ROLL, None] * by_roll


def start_moments(
    params: Tensor, param_cov: Tensor, by_vertical: Tensor, cfg: JointConfig
) -> tuple[Tensor, Tensor]:
    """Compute mean and covariance of a state that starts from one frame's fit.

    The fit takes the road as plane: see :func:`with_vertical_curvature`.

    Args:
        params: (B, 7), see ``NUM_PARAMS``.
        param_cov: (B, 7, 7).
        by_vertical: (B, 7), change of the fit per 1/m of vertical curvature.
        cfg: the configuration.

    Returns:
        mean (B, D) and covariance (B, D, D).
    """
    straight, bend = constant(cfg.straight, like=params), cfg.prior.std(params)[CURVATURE:]
    params, param_cov, _ = straight_or_bend(params, param_cov, straight, bend, cfg.bends)
    params = pad(params, (0, 1))  # the vertical curvature's mean is 0
    param_cov = with_vertical_curvature(param_cov, by_vertical, cfg.prior.vertical_curvature_std)
    copies = constant(_by_parameters(cfg.num_boundaries), like=params)
    own = constant(_start_variances(cfg.num_boundaries, cfg.motion), like=params)
    return params @ copies.mT, copies @ param_cov @ copies.mT + own.diag()


def with_vertical_curvature(cov: Tensor, by_vertical: Tensor, std: float) -> Tensor:
    """Add the road's vertical curvature κ to the covariance of a fit that takes it as 0.

    Source: (J22). The fit is off by g κ and the estimate 0 of κ by -κ, so both errors are correlated.

    Args:
        cov: (B, P, P) of the fit.
        by_vertical: (B, P), g, change of the fit per 1/m.
        std: 1/m, prior standard deviation of κ.

    Returns:
        (B, P + 1, P + 1), κ last.
    """
    error = std * pad(by_vertical, (0, 1), value=-1.0).unsqueeze(-1)
    return pad(cov, (0, 1, 0, 1)) + error @ error.mT


@lru_cache(maxsize=16)
def _by_parameters(num_boundaries: int) -> tuple[tuple[float, ...], ...]:
    """Return the state's entries by parameters and vertical curvature of one frame, D × 8.

    The slow mean begins at the pose.
    """
    indices = layout(num_boundaries)
    factors = {(k, k): 1.0 for k in (*range(NUM_STRAIGHT), CURVATURE)}
    factors |= {(step, CURVATURE + 1): KNOT_SPACING for step in range(STEPS.start, STEPS.stop)}
    factors |= {(VERTICAL, NUM_PARAMS): 1.0}
    factors |= {(indices.means.start + axis, axis): 1.0 for axis in range(NUM_POSE)}
    return tuple(tuple(factors.get((k, p), 0.0) for p in range(NUM_PARAMS + 1)) for k in range(indices.size))


@lru_cache(maxsize=16)
def _start_variances(num_boundaries: int, motion: MotionConfig) -> tuple[float, ...]:
    """Return the variances (D,) of a start beside those of the frame's fit."""
    swing = tuple(std**2 for std in motion.pose_std)
    _, rate, acceleration, jerk = pose_variances(motion.bandwidth)
    return (
        *[0.0] * NUM_STRAIGHT,
        *[motion.curvature_step**2] * NUM_SHAPE,
        0.0,
        *[motion.deviation_walk**2] * num_boundaries,
        *(rate * variance for variance in swing),
        _OFFSET_RATE_STD**2,
        *(acceleration * variance for variance in swing),
        *(jerk * variance for variance in swing),
        *swing,
        motion.speed_std**2,
    )
