"""Constant tensors on any device, each sent there once."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


@lru_cache(maxsize=256)
def constant(device: torch.device, *values: float) -> Tensor:
    """(N,) float32 of the values; not to be written to."""
    return torch.tensor(values).to(device)


def colour(device: torch.device, *values: float) -> Tensor:
    """(3, 1) float32: broadcasts over (B, 3, N)."""
    return constant(device, *values)[:, None]
