"""Selecting and choosing among pixels, by the operations that are fast on processors as well.

PyTorch's advanced indexing, ``where`` and ``nonzero`` take 4 to 30 times as long there as what is here
(measured: 92,000 of 184,000 pixels, one thread).
"""

import numpy as np
import torch
from torch import Tensor

from lanebev.tensors import constant


def indices_where(mask: Tensor) -> Tensor:
    """Return the row-major places where a mask holds, in order, (N,) int64. Waits for the device."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.flatten().nonzero()[:, 0]


def count_where(mask: Tensor) -> Tensor:
    """Count how often a mask (M, N) holds in each line, (M,) int64."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.count_nonzero(mask.numpy(), axis=1))
    return mask.sum(1)


def take(values: Tensor, place: Tensor) -> Tensor:
    """Return elements of a tensor at row-major places, in the shape of ``place``."""
    return values.flatten().index_select(0, place.flatten()).view(place.shape)


def take_channels(values: Tensor, place: Tensor) -> Tensor:
    """Return the values (C, P) at places in P, (C, *place.shape)."""
    return values.index_select(1, place.flatten()).view(len(values), *place.shape)


def put(values: Tensor, place: Tensor, new: Tensor) -> None:
    """Write (C, *place.shape) values at places in P; changes ``values`` (C, P)."""
    index = place.flatten().expand(len(values), -1)
    values.scatter_(1, index, new.reshape(len(values), -1))


def lines_of(values: Tensor, index: Tensor) -> Tensor:
    """Return lines of a tensor at ascending places, each at most once; of all of them the tensor itself."""
    return values if len(index) == len(values) else values.index_select(0, index)


def as_float(mask: Tensor) -> Tensor:
    """Return 1 where a mask holds, else 0, float32."""
    return mask.contiguous().view(torch.uint8).float()


def choose(mask: Tensor, yes: Tensor | float, no: Tensor | float) -> Tensor:
    """Return ``yes`` where a mask holds, else ``no``, exactly as ``torch.where``; both finite, float32."""
    yes, no = (v if isinstance(v, Tensor) else constant((v,), mask, torch.float32)[0] for v in (yes, no))
    return torch.lerp(no, yes, as_float(mask))


def remainder(value: Tensor, period: Tensor | float) -> Tensor:
    """Compute ``value % period`` up to rounding."""
    return value - (value / period).floor() * period
