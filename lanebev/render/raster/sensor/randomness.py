"""Random pixels, each row of a batch from its own generator: a row's noise does not depend on the others."""

from collections.abc import Sequence

import torch
from torch import Tensor


def normal_rows(
    shape: tuple[int, ...], generators: Sequence[torch.Generator], device: torch.device
) -> Tensor:
    """Draw (R, *shape) standard normal values on the device, which is the generators'."""
    values = torch.empty(len(generators), *shape, device=device)
    for row, generator in zip(values, generators, strict=True):
        row.normal_(generator=generator)
    return values


def uniform_rows(
    shape: tuple[int, ...], generators: Sequence[torch.Generator], device: torch.device
) -> Tensor:
    """Draw (R, *shape) uniform values in [0, 1) on the device, which is the generators'."""
    values = torch.empty(len(generators), *shape, device=device)
    for row, generator in zip(values, generators, strict=True):
        row.uniform_(generator=generator)
    return values
