"""Rows of nested NamedTuples of tensors (B, ...)."""

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import torch
from torch import Tensor

from lanebev.tensors import all_tensors, map_tensors

T = TypeVar("T", bound=tuple[Any, ...])


def through_tables(function: Callable[[Tensor], Tensor], values: T) -> T:
    """Apply a function of rows to a (nested) NamedTuple of (B, ...) tensors, all of one dtype at once.

    Hundreds of small tensors so take a handful of operations: they become one table (B, F) for each dtype,
    and the results are views of what the function makes of these.
    """
    leaves = list(all_tensors(values))
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


def take_rows(values: T, rows: Tensor | slice) -> T:
    """Select rows of a (nested) NamedTuple of (B, ...) tensors by an index tensor (R,) or a slice."""
    if isinstance(rows, slice):
        return map_tensors(lambda tensor: tensor[rows], values)
    if next(all_tensors(values)).shape[0] == 1:  # a batch of one row has no other: views
        count = rows.shape[0]
        return map_tensors(lambda tensor: tensor.expand(count, *[-1] * (tensor.ndim - 1)), values)
    return through_tables(lambda table: table.index_select(0, rows), values)


def send(values: T, device: torch.device) -> T:
    """Send a (nested) NamedTuple of (B, ...) tensors to a device, without waiting for it."""
    if device.type == "cpu":
        return values
    return through_tables(lambda table: table.to(device, non_blocking=True), values)
