"""Random numbers for whole batches, from one generator."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


class BatchSampler:
    """Draws (B, ...) tensors on the CPU: the same scenes on every device.

    Args:
        batch_size: B.
        generator: the only source of randomness, of the CPU.
    """

    def __init__(self, batch_size: int, generator: torch.Generator) -> None:
        self.batch_size = batch_size
        self.generator = generator

    def beside(self) -> BatchSampler:
        """Return a sampler with numbers of its own, always the same, for what is not used."""
        generator = torch.Generator(self.generator.device).manual_seed(0)
        return BatchSampler(self.batch_size, generator)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Sample uniform numbers in [low, high), (B, *shape)."""
        return low + (high - low) * torch.rand(self.batch_size, *shape, generator=self.generator)

    def normal(self, std: float, *shape: int) -> Tensor:
        """Sample Gaussian numbers of zero mean, (B, *shape)."""
        return std * torch.randn(self.batch_size, *shape, generator=self.generator)

    def chance(self, probability: float, *shape: int) -> Tensor:
        """Sample truth values, (B, *shape) bool."""
        return torch.rand(self.batch_size, *shape, generator=self.generator) < probability

    def sometimes(
        self, probability: float, low: float, high: float, *shape: int, otherwise: float = 0.0
    ) -> Tensor:
        """Sample uniform numbers in [low, high) with a probability, else the same number, (B, *shape)."""
        return torch.where(self.chance(probability, *shape), self.uniform(low, high, *shape), otherwise)

    def either(
        self, probability: float, first: tuple[float, float], second: tuple[float, float], *shape: int
    ) -> Tensor:
        """Sample uniform numbers in the first interval with a probability, else in the second."""
        chosen = self.chance(probability, *shape)
        return torch.where(chosen, self.uniform(*first, *shape), self.uniform(*second, *shape))

    def pick(self, weights: list[float] | tuple[float, ...], *shape: int) -> Tensor:
        """Sample indices with the given weights, (B, *shape) int64."""
        cumulative = torch.tensor(weights).cumsum(0)
        draw = torch.rand(self.batch_size, *shape, generator=self.generator) * cumulative[-1]
        return torch.bucketize(draw, cumulative, right=True).clamp(max=len(weights) - 1)

    def pick_from(self, values: Sequence[float] | Sequence[tuple[float, ...]], *shape: int) -> Tensor:
        """Sample one of the values, all equally likely, (B, *shape, ...)."""
        return torch.tensor(values)[self.pick([1.0] * len(values), *shape)]
