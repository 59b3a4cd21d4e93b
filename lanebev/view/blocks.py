"""Compute where an image shows the cells of a view, in blocks of rows."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lanebev.view.lens import Lens
from lanebev.view.projection import Cells, CellSums, image_coordinates, outside_image
from lanebev.view.tiles import Interpolant, interpolant

BLOCK = 1 << 17  # cells: a dozen float32 planes of so many fit a cache of a few MB

_EXACT_BLOCK = 1 << 14  # cells of a block that is computed cell by cell, which takes two dozen planes

Memory = Callable[[int, int], Tensor]


class Block(NamedTuple):
    """Cells of rows first to last - 1.

    Attributes:
        first, last: rows.
        points: (B, 2, last - first, V) normalised coordinates.
        outside: (B, last - first, V), zero where seen, else positive; None where all are seen and none beyond
            the centres of the maps' outermost cells.
    """

    first: int
    last: int
    points: Tensor
    outside: Tensor | None

    def valid(self, out: Tensor | None = None) -> Tensor:
        """Return which are seen, (B, last - first, V) bool.

        Args:
            out: of that shape, all true, to write to.
        """
        if self.outside is not None:
            return torch.eq(self.outside, 0, out=out)
        return torch.ones_like(self.points[:, 0], dtype=torch.bool) if out is None else out


def blocks(cells: Cells, lens: Lens | None, limit: float, memory: Memory | None = None) -> Iterator[Block]:
    """Project cells, block by block, in order.

    float32 cells on a CPU are interpolated where that is as exact, see :mod:`lanebev.view.tiles`; a GPU would
    have to wait for the choice.

    Args:
        cells: as of :func:`resampled`.
        lens: into normalised coordinates, or None.
        limit: up to which coordinates are not beyond the centres of a map's outermost cells.
        memory: gives (B, 2, last - first, V) for the points of rows first to last - 1, which then have no
            graph.
    """
    batch, rows, columns = cells.shape
    if isinstance(cells, CellSums) and _may_choose(cells):
        curves = interpolant(cells, lens, limit)
        if curves is not None:
            most = BLOCK // (batch * columns * curves.rows.size)
            for start, end in _tile_groups(curves, max(1, most)):
                if curves.smooth[:, start:end].any():
                    yield _tile_block(curves, cells, lens, start, end, memory)
                else:
                    span = curves.row(start), curves.row(end)
                    yield from _exact_blocks(cells, lens, span, _EXACT_BLOCK, memory)
            return
    # compiled code has no planes in between
    size = batch * rows * columns if torch.compiler.is_compiling() else BLOCK
    yield from _exact_blocks(cells, lens, (0, rows), size, memory)


def _may_choose(cells: CellSums) -> bool:
    """Whether what is computed may depend on values, and interpolation is as exact as the numbers."""
    by_row = cells.by_row
    return by_row.dtype == torch.float32 and by_row.device.type == "cpu" and not traced()


def _exact_blocks(
    cells: Cells, lens: Lens | None, rows: tuple[int, int], size: int, memory: Memory | None
) -> Iterator[Block]:
    """Rows from the first to below the second, cell by cell, in blocks of so many cells."""
    batch, _, columns = cells.shape
    step = max(1, size // max(1, batch * columns))
    for first in range(*rows, step):
        last = min(first + step, rows[1])
        points, hidden = image_coordinates(cells.rows(first, last), lens)
        if memory is not None:
            points = memory(first, last).copy_(points)
        yield Block(first, last, points, outside_image(points, hidden))


def _tile_groups(curves: Interpolant, most: int) -> Iterator[tuple[int, int]]:
    """Yield ranges of at most so many tiles that are computed in the same way."""
    kinds = np.stack([curves.smooth.all(0), curves.inside], axis=-1).tolist()
    for _, group in itertools.groupby(range(len(kinds)), key=kinds.__getitem__):
        tiles = list(group)
        for start in range(0, len(tiles), most):
            yield tiles[start], tiles[min(start + most, len(tiles)) - 1] + 1


def _tile_block(
    curves: Interpolant, cells: CellSums, lens: Lens | None, start: int, end: int, memory: Memory | None
) -> Block:
    """Rows of tiles start to end - 1: those of each image by its polynomials where they are exact."""
    first, last = curves.row(start), curves.row(end)
    smooth = curves.smooth[:, start:end].all(1)
    if memory is None:
        points = curves.points(start, end)
    else:
        points = curves.write(start, end, memory(first, last))
    if curves.inside[start]:
        return Block(first, last, points, None)
    outside = outside_image(points)
    if not smooth.all():
        exact, hidden = image_coordinates(cells.rows(first, last), lens)
        whole = torch.from_numpy(smooth)[:, None, None]
        outside = torch.where(whole, outside, outside_image(exact, hidden))
        exact = torch.where(whole.unsqueeze(1), points, exact)
        points = exact if memory is None else points.copy_(exact)
    return Block(first, last, points, outside)


def traced() -> bool:
    """Tell whether operations are recorded for all possible values."""
    compiled = torch.compiler.is_compiling() or torch.jit.is_tracing()  # type: ignore[attr-defined, no-untyped-call]
    return compiled or torch._C._are_functorch_transforms_active()
