"""Constant tensors on any device, each sent there once."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


@lru_cache(maxsize=256)
def constant(device: torch.device, *values: float) -> Tensor:
    """Return the values as (N,) float32; not to be written to."""
    return torch.tensor(values).to(device)


def colour(device: torch.device, *values: float) -> Tensor:
    """Return a colour as (3, 1) float32, which broadcasts over (B, 3, N)."""
    return constant(device, *values)[:, None]
