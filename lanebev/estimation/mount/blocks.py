"""Blocks of seconds in which the poses of frames are averaged, per axis."""

import torch
from torch import Tensor

from lanebev.estimation.mount.results import MountState


def block_index(state: MountState) -> Tensor:
    """Return the blocks' numbers, (1, K, 1), the newest first."""
    return torch.arange(state.blocks.shape[1], device=state.blocks.device).view(1, -1, 1)


def newest_age(state: MountState) -> Tensor:
    """Return the s (B, 4) since the newest block was begun; 0 where there is none."""
    ages = torch.where(state.filled > 0, state.ages, torch.inf).amin(1)
    return torch.where(ages.isfinite(), ages, 0.0)


def push_block(values: Tensor, new: Tensor, full: Tensor) -> Tensor:
    """Put (B, 4) in front of (B, K, 4) where ``full`` (B, 4) holds; the last falls out."""
    return torch.where(full.unsqueeze(1), torch.cat([new.unsqueeze(1), values[:, :-1]], 1), values)


def add_frame(
    state: MountState, used: Tensor, pose: Tensor, variance: Tensor, elapsed: Tensor, longest: float
) -> MountState:
    """Add the frame, weighted by its time, to the current block of each axis that uses it; let time pass."""
    part = torch.where(used, elapsed.clamp(max=longest), 0.0)
    open_block = (state.seconds > 0) | used
    return state._replace(
        ages=state.ages + elapsed.unsqueeze(1),
        pose_sum=state.pose_sum + part * torch.where(used, pose, 0.0),
        variance_sum=state.variance_sum + part * torch.where(used, variance, 0.0),
        seconds=state.seconds + part,
        begun=torch.where(open_block, state.begun + elapsed, 0.0),
    )
