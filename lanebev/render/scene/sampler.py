"""Random numbers for whole batches, from one generator; rows of nested tuples of tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T", bound=tuple[Any, ...])


class Dice:
    """Draws (B, ...) tensors.

    Args:
        batch_size: B.
        generator: the only source of randomness.
    """

    def __init__(self, batch_size: int, generator: torch.Generator) -> None:
        self.batch_size = batch_size
        self.generator = generator

    def beside(self) -> Dice:
        """Dice with numbers of their own, always the same, for what is not used."""
        generator = torch.Generator(self.generator.device).manual_seed(0)
        return Dice(self.batch_size, generator)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """(B, *shape) uniform in [low, high)."""
        return low + (high - low) * torch.rand(self.batch_size, *shape, generator=self.generator)

    def normal(self, std: float, *shape: int) -> Tensor:
        """(B, *shape) Gaussian of zero mean."""
        return std * torch.randn(self.batch_size, *shape, generator=self.generator)

    def chance(self, probability: float, *shape: int) -> Tensor:
        """(B, *shape) bool."""
        return torch.rand(self.batch_size, *shape, generator=self.generator) < probability

    def pick(self, weights: list[float] | tuple[float, ...], *shape: int) -> Tensor:
        """(B, *shape) int64, an index with the given weights."""
        cumulative = torch.tensor(weights).cumsum(0)
        draw = torch.rand(self.batch_size, *shape, generator=self.generator) * cumulative[-1]
        return torch.bucketize(draw, cumulative, right=True).clamp(max=len(weights) - 1)

    def pick_from(self, values: Sequence[float] | Sequence[tuple[float, ...]], *shape: int) -> Tensor:
        """(B, *shape, ...) one of the values, all equally likely."""
        return torch.tensor(values)[self.pick([1.0] * len(values), *shape)]


def map_tensors(function: Callable[[Tensor], Tensor], values: T) -> T:
    """Apply a function to every tensor of a nested NamedTuple; what is neither stays."""
    parts = [
        map_tensors(function, v) if isinstance(v, tuple) else function(v) if isinstance(v, Tensor) else v
        for v in values
    ]
    return type(values)(*parts)


def row_of(values: T, index: int) -> T:
    """Row ``index`` of a (nested) NamedTuple of (B, ...) tensors, the batch dimension kept."""
    return map_tensors(lambda tensor: tensor[index : index + 1], values)
