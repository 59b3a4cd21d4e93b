"""Compute where an image shows the cells of a view, in blocks of rows."""

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.tensors import one_thread, recorded
from lanebev.torch_internals import is_in_transform
from lanebev.view.lens import Lens
from lanebev.view.projection import Cells, CellSums, image_coordinates, outside_image
from lanebev.view.thread_limits import ONE_THREAD
from lanebev.view.tiles import Interpolant, interpolant

BLOCK = 1 << 17  # cells: a dozen float32 planes of so many fit a cache of a few MB

Memory = Callable[[int, int], Tensor]
Project = Callable[[Tensor, Lens | None], tuple[Tensor, Tensor]]

image_coordinates_by_one_thread: Project = one_thread()(image_coordinates)


class Block(NamedTuple):
    """Cells of rows first to last - 1.

    Attributes:
        first, last: rows.
        points: (B, 2, last - first, V) normalised coordinates.
        outside: (B, last - first, V), zero where seen, else at least 1; None where all are seen and none lies
            beyond the centres of the maps' outermost cells.
    """

    first: int
    last: int
    points: Tensor
    outside: Tensor | None


def blocks(cells: Cells, lens: Lens | None, limit: float, memory: Memory | None = None) -> Iterator[Block]:
    """Project cells to image coordinates, block by block, in order.

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
            yield from _interpolated_blocks(curves, cells, lens, memory)
            return
    # compiled code has no planes in between
    size = batch * rows * columns if torch.compiler.is_compiling() else BLOCK
    yield from _exact_blocks(cells, lens, (0, rows), size, memory)


def _may_choose(cells: CellSums) -> bool:
    """Return whether what is computed may depend on values, and interpolation is as exact as the numbers."""
    by_row = cells.by_row
    return by_row.dtype == torch.float32 and by_row.device.type == "cpu" and not traced()


def _interpolated_blocks(
    curves: Interpolant, cells: CellSums, lens: Lens | None, memory: Memory | None
) -> Iterator[Block]:
    """Yield all rows tile by tile: by polynomials where they are exact in an image, else cell by cell."""
    batch, _, columns = cells.shape
    for tile, span in enumerate(itertools.pairwise(curves.rows.edges)):
        smooth = curves.smooth[:, tile]
        if not smooth.any():
            yield from _exact_blocks(
                cells, lens, span, ONE_THREAD // 3, memory, image_coordinates_by_one_thread
            )
        elif curves.inside[tile] or memory is None:
            yield _tile_block(curves, cells, lens, tile, span, memory)
        else:
            planes = batch * (1 if smooth.all() else 3)  # cell by cell, all coordinates at once
            for rows in _spans(span, ONE_THREAD // (planes * columns)):
                yield _tile_block(curves, cells, lens, tile, rows, memory)


def _exact_blocks(
    cells: Cells,
    lens: Lens | None,
    rows: tuple[int, int],
    size: int,
    memory: Memory | None,
    project: Project = image_coordinates,
) -> Iterator[Block]:
    """Yield rows from the first to below the second, cell by cell, in blocks of so many cells."""
    batch, _, columns = cells.shape
    for first, last in _spans(rows, size // max(1, batch * columns)):
        points, hidden = project(cells.rows(first, last), lens)
        if memory is not None:
            points = memory(first, last).copy_(points)
        yield Block(first, last, points, outside_image(points, hidden))


def _tile_block(
    curves: Interpolant,
    cells: CellSums,
    lens: Lens | None,
    tile: int,
    rows: tuple[int, int],
    memory: Memory | None,
) -> Block:
    """Yield rows of a tile: those of each image by its polynomials where they are exact."""
    inner = slice(*(row - curves.rows.edges[tile] for row in rows))
    points = curves.points(tile, inner, None if memory is None else memory(*rows))
    if curves.inside[tile]:
        return Block(*rows, points, None)
    outside = outside_image(points, curves.hidden(tile, inner))
    smooth = curves.smooth[:, tile]
    if not smooth.all():
        exact, hidden = image_coordinates_by_one_thread(cells.rows(*rows), lens)
        whole = torch.from_numpy(smooth)[:, None, None]
        outside = torch.where(whole, outside, outside_image(exact, hidden))
        exact = torch.where(whole.unsqueeze(1), points, exact)
        points = exact if memory is None else points.copy_(exact)
    return Block(*rows, points, outside)


def _spans(rows: tuple[int, int], step: int) -> Iterator[tuple[int, int]]:
    """Divide rows from the first to below the second, into spans of so many, of one at least."""
    step = max(1, step)
    return ((first, min(first + step, rows[1])) for first in range(*rows, step))


def traced() -> bool:
    """Return whether operations are recorded for all possible values."""
    return recorded() or is_in_transform()
