"""Prediction of the joint filter's state from one frame to the next."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.checks import is_running
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.evidence import deviation_prior_std, hill_variance
from lanebev.estimation.joint.layout import SHAPE, layout
from lanebev.estimation.joint.measurement.residuals import CURVATURE
from lanebev.estimation.joint.motion.dynamics import Spread, motion
from lanebev.estimation.joint.motion.road import propagate_road_shape
from lanebev.estimation.joint.state import JointState, unobserved_mask
from lanebev.estimation.kalman import predict


class Interval(NamedTuple):
    """Time from a state to a frame, (B,) each.

    Attributes:
        dt: s to predict over.
        skip: bool, the frame is not later than the state, and is not used.
        early: s by which the state is ahead of a skipped frame, else 0.
        guessed: bool, the time was not usable, and ``JointConfig.assumed_dt`` was taken.
    """

    dt: Tensor
    skip: Tensor
    early: Tensor
    guessed: Tensor


class Prediction(NamedTuple):
    """A predicted state.

    Attributes:
        state: with mean, covariance, phase, hills and heading sensitivity predicted.
        transition: (B, D, D), F.
        noise: (B, D, D), W.
    """

    state: JointState
    transition: Tensor
    noise: Tensor


def elapsed(dt: Tensor, state: JointState, cfg: JointConfig) -> Interval:
    """Compute the time to predict over from the time dt (B,) s since the last frame."""
    due = dt - state.early
    guessed = ~((due > -1.0) & (due < torch.inf))
    due = torch.where(guessed, cfg.assumed_dt, due)
    skip = (due <= 0) & is_running(state.status)
    return Interval(due.clamp(0.0, 60.0), skip, torch.where(skip, -due, 0.0), guessed)


def predict_state(state: JointState, dt: Tensor, cfg: JointConfig) -> Prediction:
    """Predict a state over dt (B,) s.

    Source: (J11), (J12), (J20), (J21), (J29).
    """
    indices, hills = layout(cfg.num_boundaries), hill_variance(state, dt, cfg)
    road = propagate_road_shape(state.mean, state.cov[:, SHAPE, SHAPE], state.phase, dt, indices, cfg.motion)
    scale = state.motion_scale.sqrt()
    unobserved = unobserved_mask(state.reasons)
    scale = torch.where(unobserved, scale.clamp(min=cfg.motion.unobserved_scale), scale)
    unequal = deviation_prior_std(state.mean[:, indices.deviations], cfg)
    vertical = (cfg.motion.vertical_curvature_std**2 + hills).sqrt()
    transition, noise = motion(dt, Spread(scale, unequal, vertical), road, cfg.num_boundaries, cfg.motion)
    mean, cov = predict(state.mean, state.cov, transition, noise)
    mean = torch.cat([mean[:, :CURVATURE], road.shape, mean[:, SHAPE.stop :]], dim=-1)
    by_headings = torch.bmm(transition, state.heading_sensitivity)
    predicted = state._replace(
        mean=mean, cov=cov, phase=road.phase, hills=hills, heading_sensitivity=by_headings
    )
    return Prediction(predicted, transition, noise)
