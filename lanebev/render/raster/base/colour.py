"""Constant colours as tensors."""

import torch
from torch import Tensor

from lanebev.tensors import constant


def colour(like: Tensor, *values: float) -> Tensor:
    """Return a colour as (3, 1) float32 on the device of ``like``, which broadcasts over (B, 3, N)."""
    return constant(values, like, torch.float32)[:, None]
