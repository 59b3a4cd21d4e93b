"""The vehicle's speed, as a measurement of the joint filter's state."""

import torch
from torch import Tensor

from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.layout import layout
from lanebev.estimation.joint.state import JointState


def update_by_speed(state: JointState, speed: Tensor, cfg: JointConfig) -> JointState:
    """Update a state by a measured speed of the vehicle.

    Source: (J34).

    Args:
        state: after a frame.
        speed: (B,) m/s at that frame; below 0 it counts as 0, and where it is not finite nothing changes.
        cfg: the calibrator's.
    """
    indices, motion = layout(cfg.num_boundaries), cfg.motion
    known = speed.isfinite()
    residual = speed.clamp(min=0.0) - motion.speed - state.mean[:, indices.speed]
    residual = torch.where(known, residual, 0.0).unsqueeze(-1)
    column = state.cov[:, :, indices.speed]
    gain = column / (column[:, indices.speed : indices.speed + 1] + motion.measured_speed_std**2)
    gain = torch.where(known.unsqueeze(-1), gain, 0.0)
    sensitivity = state.heading_sensitivity
    return state._replace(
        mean=state.mean + gain * residual,
        cov=state.cov - gain.unsqueeze(-1) * column.unsqueeze(-2),
        heading_sensitivity=sensitivity - gain.unsqueeze(-1) * sensitivity[:, indices.speed].unsqueeze(-2),
    )
