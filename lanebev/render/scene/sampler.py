"""Random numbers for whole batches, from one generator; nested tuples of tensors, row by row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T", bound=tuple[Any, ...])


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

    def pick(self, weights: list[float] | tuple[float, ...], *shape: int) -> Tensor:
        """Sample indices with the given weights, (B, *shape) int64."""
        cumulative = torch.tensor(weights).cumsum(0)
        draw = torch.rand(self.batch_size, *shape, generator=self.generator) * cumulative[-1]
        return torch.bucketize(draw, cumulative, right=True).clamp(max=len(weights) - 1)

    def pick_from(self, values: Sequence[float] | Sequence[tuple[float, ...]], *shape: int) -> Tensor:
        """Sample one of the values, all equally likely, (B, *shape, ...)."""
        return torch.tensor(values)[self.pick([1.0] * len(values), *shape)]


def map_tensors(function: Callable[[Tensor], Tensor], values: T) -> T:
    """Apply a function to every tensor of a nested NamedTuple; what is neither stays."""
    parts = [
        map_tensors(function, v) if isinstance(v, tuple) else function(v) if isinstance(v, Tensor) else v
        for v in values
    ]
    return type(values)(*parts)


def tensors_of(values: tuple[Any, ...]) -> list[Tensor]:
    """Return all tensors of a nested NamedTuple, in order."""
    found: list[Tensor] = []
    for value in values:
        if isinstance(value, tuple):
            found += tensors_of(value)
        elif isinstance(value, Tensor):
            found.append(value)
    return found


def _first_of(values: tuple[Any, ...]) -> Tensor:
    """Return the first tensor of a nested NamedTuple that begins with one."""
    first = values[0]
    return first if isinstance(first, Tensor) else _first_of(first)


def through_tables(function: Callable[[Tensor], Tensor], values: T) -> T:
    """Apply a function of rows to a (nested) NamedTuple of (B, ...) tensors, all of one dtype at once.

    Hundreds of small tensors so take a handful of operations: they become one table (B, F) for each dtype,
    and the results are views of what the function makes of these.
    """
    leaves = tensors_of(values)
    tables: dict[torch.dtype, Iterator[Tensor]] = {}
    for dtype in {leaf.dtype for leaf in leaves}:
        own = [leaf.flatten(1) if leaf.ndim > 1 else leaf[:, None] for leaf in leaves if leaf.dtype == dtype]
        table = function(torch.cat(own, dim=1))
        tables[dtype] = iter(table.split([part.shape[1] for part in own], dim=1))
    return map_tensors(
        lambda leaf: (
            next(tables[leaf.dtype]).unflatten(1, leaf.shape[1:])
            if leaf.ndim > 1
            else next(tables[leaf.dtype])[:, 0]
        ),
        values,
    )


def select_rows(values: T, rows: Tensor | slice) -> T:
    """Select rows of a (nested) NamedTuple of (B, ...) tensors by an index tensor (R,) or a slice."""
    if isinstance(rows, slice):
        return map_tensors(lambda tensor: tensor[rows], values)
    if _first_of(values).shape[0] == 1:  # a batch of one row has no other: views
        count = rows.shape[0]
        return map_tensors(lambda tensor: tensor.expand(count, *[-1] * (tensor.ndim - 1)), values)
    return through_tables(lambda table: table.index_select(0, rows), values)


def send(values: T, device: torch.device) -> T:
    """Send a (nested) NamedTuple of (B, ...) tensors to a device, without waiting for it."""
    if device.type == "cpu":
        return values
    return through_tables(lambda table: table.to(device, non_blocking=True), values)


def row_of(values: T, index: int) -> T:
    """Return row ``index`` of a (nested) NamedTuple of (B, ...) tensors, with the batch dimension."""
    return select_rows(values, slice(index, index + 1))


def concatenate_rows(parts: Sequence[T]) -> T:
    """Concatenate (nested) NamedTuples of (B, ...) tensors along the batch; all else is the first's."""
    joined = [
        concatenate_rows(group)
        if isinstance(group[0], tuple)
        else torch.cat(group)
        if isinstance(group[0], Tensor)
        else group[0]
        for group in zip(*parts, strict=True)
    ]
    return type(parts[0])(*joined)
