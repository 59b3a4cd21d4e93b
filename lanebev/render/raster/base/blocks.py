"""Pixels in blocks: what a mask selects of a whole batch, in pieces of equal length, each of one row.

A function of (B, N) pixels with parameters (B, ...) serves unchanged: its rows are then the blocks, its
parameters those of each block's row. So a batch is shaded at once, without a loop over its rows and
without work on pixels that have not what is shaded.
"""

from collections.abc import Callable
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lanebev.render.raster.base.select import count_where, indices_where
from lanebev.render.rows import take_rows
from lanebev.tensors import map_tensors

BLOCK = 1024  # pixels


class Blocks(NamedTuple):
    """Selected elements of R rows, in T blocks of S; the last block of a row repeats the row's last one.

    Attributes:
        row: (T,) int64, of each block.
        place: (T, S) int64, row-major place of each element in the mask that selected it.
        selected: (R,) int64, how many elements of each row.
        counts: number of blocks of each of the R rows, on the host.
    """

    row: Tensor
    place: Tensor
    selected: Tensor
    counts: list[int]

    def __len__(self) -> int:
        return len(self.row)

    def of_rows(self, rows: list[int]) -> Tensor:
        """Return which blocks belong to some of the rows, (T',) int64."""
        counts, chosen = np.array(self.counts, dtype=np.int64), np.array(rows, dtype=np.int64)
        first, count = (counts.cumsum() - counts)[chosen], counts[chosen]
        within = np.arange(count.sum()) - np.repeat(count.cumsum() - count, count)
        return torch.from_numpy(np.repeat(first, count) + within).to(self.row.device, non_blocking=True)

    def sum_rows(self, values: Tensor) -> Tensor:
        """Sum the values (C, T) of blocks over those of each row, (C, R), always in the same order."""
        most = max(*self.counts, 1)
        within = torch.arange(len(self.row), device=self.row.device) - self._first().index_select(0, self.row)
        table = values.new_zeros(len(values), len(self.counts) * most)
        table.scatter_(1, (self.row * most + within).expand(len(values), -1), values)
        total: Tensor = table.unflatten(1, (-1, most)).sum(2)
        return total

    def real(self) -> Tensor:
        """Return which elements are not repeated ones, (T, S) bool."""
        size = self.place.shape[1]
        block = torch.arange(len(self.row), device=self.row.device) - self._first().index_select(0, self.row)
        left = self.selected.index_select(0, self.row) - block * size
        return torch.arange(size, device=self.row.device) < left[:, None]

    def _first(self) -> Tensor:
        """Return the first block of each row, (R,)."""
        ends = list(accumulate(self.counts))
        first = [end - count for end, count in zip(ends, self.counts, strict=True)]
        return torch.tensor(first).to(self.row.device, non_blocking=True)


def make_blocks(mask: Tensor, size: int = BLOCK, row: Tensor | None = None, num_rows: int = 0) -> Blocks:
    """Select the elements where a mask holds. Waits for the device twice.

    Args:
        mask: (M, N) bool.
        size: S.
        row: (M,) int64, not decreasing, which row each line of the mask belongs to; by default each is one.
        num_rows: R; given with ``row``.
    """
    device = mask.device
    place, count = indices_where(mask), count_where(mask)
    if row is not None:
        count = count.new_zeros(num_rows).index_add_(0, row, count)
    blocks = (count + (size - 1)) // size
    counts: list[int] = blocks.tolist()
    total = sum(counts)
    rows = torch.arange(len(counts), device=device).repeat_interleave(blocks, output_size=total)
    if len(counts) == 1:
        rest = place[-1:].expand(total * size - len(place))
        return Blocks(rows, torch.cat([place, rest]).view(total, size), count, counts)
    first, start = blocks.cumsum(0) - blocks, count.cumsum(0) - count
    within = (torch.arange(total, device=device) - first[rows])[:, None] * size
    within = within + torch.arange(size, device=device)
    source = start[rows][:, None] + torch.minimum(within, (count[rows] - 1)[:, None])
    return Blocks(rows, place.index_select(0, source.flatten()).view(source.shape), count, counts)


def multiply_rows(
    values: Tensor,
    blocks: Blocks,
    rows: list[int],
    factor: Callable[..., Tensor],
    parameters: tuple[Any, ...],
    *planes: Tensor | tuple[Any, ...],
) -> None:
    """Multiply the values of the blocks of some rows by a factor that is 1 elsewhere; changes the values.

    Args:
        values: (T, ...).
        blocks: T of them.
        rows: rows in question.
        factor: factor of T' blocks by their parameters and planes.
        parameters: NamedTuple of (T, ...) tensors, few numbers for each block.
        planes: tensors (T, S) or NamedTuples of them.
    """
    index = blocks.of_rows(rows)
    if not len(index):
        return
    if len(index) == len(values):
        values.mul_(factor(parameters, *planes))
        return
    parts = (map_tensors(lambda tensor: tensor.index_select(0, index), plane) for plane in planes)
    changed = values.index_select(0, index) * factor(take_rows(parameters, index), *parts)
    values.index_copy_(0, index, changed)
