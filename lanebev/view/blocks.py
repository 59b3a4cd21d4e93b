"""Compute where an image shows the cells of a view, in blocks of rows."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.view.lens import Lens
from lanebev.view.projection import Cells, CellSums, image_coordinates, outside_image
from lanebev.view.tiles import Interpolant, interpolant

BLOCK = 1 << 17  # cells: a dozen float32 planes of so many fit a cache of a few MB


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

    def invalid(self) -> Tensor:
        """Return which are not seen, (B, last - first, V) bool."""
        if self.outside is None:
            return torch.zeros_like(self.points[:, 0], dtype=torch.bool)
        return self.outside.bool()


def blocks(cells: Cells, lens: Lens | None, limit: float, out: Tensor | None = None) -> Iterator[Block]:
    """Project cells, block by block, in order.

    float32 cells on a CPU are interpolated where that is as exact, see :mod:`lanebev.view.tiles`; a GPU would
    have to wait for the choice.

    Args:
        cells: as of :func:`resampled`.
        lens: into normalised coordinates, or None.
        limit: up to which coordinates are not beyond the centres of a map's outermost cells.
        out: (B, 2, R, V) to write points to.
    """
    batch, rows, columns = cells.shape
    most = max(1, BLOCK // max(1, batch * columns))  # rows
    if torch.compiler.is_compiling():  # compiled code has no planes in between
        most = rows
    if isinstance(cells, CellSums) and _may_choose(cells):
        curves = interpolant(cells, lens, limit)
        if curves is not None:
            for start, end in _tile_groups(curves, max(1, most // curves.rows.size)):
                yield _tile_block(curves, cells, lens, start, end, out)
            return
    for first in range(0, rows, most):
        yield _exact_block(cells, lens, first, min(first + most, rows), out)


def _may_choose(cells: CellSums) -> bool:
    """Whether what is computed may depend on values, and interpolation is as exact as the numbers."""
    by_row = cells.by_row
    return by_row.dtype == torch.float32 and by_row.device.type == "cpu" and not traced()


def _exact_block(cells: Cells, lens: Lens | None, first: int, last: int, out: Tensor | None) -> Block:
    points, hidden = image_coordinates(cells.rows(first, last), lens)
    if out is not None:
        points = out[:, :, first:last].copy_(points)
    return Block(first, last, points, outside_image(points, hidden))


def _tile_groups(curves: Interpolant, most: int) -> Iterator[tuple[int, int]]:
    """Yield ranges of at most so many tiles that are computed in the same way."""
    kinds = list(zip(curves.smooth.all(0).tolist(), curves.inside, strict=True))
    for _, group in itertools.groupby(range(len(kinds)), key=kinds.__getitem__):
        tiles = list(group)
        for start in range(0, len(tiles), most):
            yield tiles[start], tiles[min(start + most, len(tiles)) - 1] + 1


def _tile_block(
    curves: Interpolant, cells: CellSums, lens: Lens | None, start: int, end: int, out: Tensor | None
) -> Block:
    """Rows of tiles start to end - 1: those of each image by its polynomials where they are exact."""
    first, last = curves.row(start), curves.row(end)
    smooth = curves.smooth[:, start:end].all(1)
    if not smooth.any():
        return _exact_block(cells, lens, first, last, out)
    points = curves.points(start, end) if out is None else curves.write(start, end, out)
    if curves.inside[start]:
        return Block(first, last, points, None)
    outside = outside_image(points, torch.zeros_like(points[:, 0]))
    if not smooth.all():
        exact, hidden = image_coordinates(cells.rows(first, last), lens)
        outside = torch.where(smooth[:, None, None], outside, outside_image(exact, hidden))
        exact = torch.where(smooth[:, None, None, None], points, exact)
        points = exact if out is None else points.copy_(exact)
    return Block(first, last, points, outside)


def traced() -> bool:
    """Tell whether operations are recorded for all possible values."""
    compiled = torch.compiler.is_compiling() or torch.jit.is_tracing()  # type: ignore[attr-defined, no-untyped-call]
    return compiled or torch._C._are_functorch_transforms_active()
