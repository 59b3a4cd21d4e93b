"""Interpolate where cells are seen: exact at a few cells of each tile, polynomials for the others.

Perspective and lens are smooth functions of a cell's row and column: the polynomial through 12 × 12 cells of
a tile is as exact as float32 itself. Its Chebyshev coefficients show whether it is: tiles in which they do
not fall off are computed cell by cell. A lens model whose radial function has a maximum (a fold) is smooth
too: it is continued beyond the fold, and the sign of a quadratic function of row and column marks the cells
beyond it.

Source: Trefethen, Approximation Theory and Approximation Practice, ch. 3 (coefficients from values), 8
(they fall off geometrically and bound the error where a function is analytic).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray
from torch import Tensor

from lanebev.geometry.precision import autocast_off
from lanebev.tensors import one_thread
from lanebev.view.lens import Lens
from lanebev.view.projection import CellSums, image_coordinates
from lanebev.view.thread_limits import ONE_THREAD, small_products

_NODES = 12  # nodes along each side of a tile, at which positions are exact
_LEAST_ROWS = 3 * _NODES  # a tile has at least so many
_GROWTH = 0.5  # share of its least depth that the depth grows by within a tile
_COLUMNS = 128  # a tile has so many; with a lens half
_TOLERANCE = 4e-6  # error, in half images: 0.004 px of 1920; float32 rounds by a quarter of it
_LOW = _NODES - 2  # the coefficients from this degree on estimate the error of leaving out higher ones
_SUMS = np.stack([np.ones(_NODES), np.arange(_NODES) >= _LOW], axis=1).astype(np.float32)
LARGEST_WEIGHTS = 4.0  # the magnitudes of the weights of a cell sum up to less
_OUTSIDE = 0.25  # share of the distance to the image by which a tile that is not in it may be off


class RowTiles(NamedTuple):
    """Tiles along the rows of a grid, of any sizes.

    Attributes:
        edges: (T + 1), the first row of each, and the number of all rows.
        nodes: (T·n,), the rows of each tile that are computed, its first and last among them.
        weights: T of (size, n), values at the rows of a tile from those at its nodes.
        coefficients: (T, n, n), Chebyshev coefficients from the values at its nodes.
    """

    edges: tuple[int, ...]
    nodes: NDArray[np.int64]
    weights: list[NDArray[np.float32]]
    coefficients: NDArray[np.float32]


class ColumnTiles(NamedTuple):
    """Tiles of one size along the columns of a grid; the last overlaps the one before.

    Attributes:
        size: columns of a tile.
        overlap: columns of the last tile that the one before has too.
        nodes: (S·m,), as of :class:`RowTiles`.
        weights: (size, m).
        coefficients: (m, m).
    """

    size: int
    overlap: int
    nodes: NDArray[np.int64]
    weights: NDArray[np.float32]
    coefficients: NDArray[np.float32]


@lru_cache(maxsize=64)
def row_tiles(edges: tuple[int, ...]) -> RowTiles | None:
    """Prepare tiles of rows; None if one has less than three rows a node."""
    sizes = np.diff(edges).tolist()
    if min(sizes) < _LEAST_ROWS:
        return None
    nodes = [tile_nodes(size, _NODES) for size in sizes]
    matrices = [interpolation(size, each) for size, each in zip(sizes, nodes, strict=True)]
    return RowTiles(
        edges,
        np.concatenate([first + each for first, each in zip(edges, nodes, strict=False)]),
        [weights.astype(np.float32) for weights, _ in matrices],
        np.stack([coefficients for _, coefficients in matrices]).astype(np.float32),
    )


@lru_cache(maxsize=64)
def column_tiles(columns: int, size: int) -> ColumnTiles | None:
    """Divide columns into tiles of ``size``; None if there are less than three a node."""
    size = min(size, columns)
    if size < 3 * _NODES:
        return None
    first = np.minimum(np.arange(0, columns, size), columns - size)
    nodes = tile_nodes(size, _NODES)
    weights, coefficients = (matrix.astype(np.float32) for matrix in interpolation(size, nodes))
    return ColumnTiles(
        size, len(first) * size - columns, (first[:, None] + nodes).reshape(-1), weights, coefficients
    )


def road_edges(far: float, step: float, rows: int) -> tuple[int, ...]:
    """Divide the rows of a plane such that perspective is smooth in each tile: in proportion to their depth.

    Args:
        far: depth of the first row, m.
        step: by which each row is nearer than the one before, m.
        rows: of the plane.

    Returns:
        (T + 1), see :class:`RowTiles`.
    """
    edges = [rows]
    while edges[0] > 0:
        near = far / step - edges[0]  # rows from the camera to the tile
        first = edges[0] - max(_LEAST_ROWS, int(_GROWTH * near))
        edges.insert(0, first if first >= _LEAST_ROWS else 0)
    return tuple(edges)


@lru_cache(maxsize=64)
def equal_edges(rows: int) -> tuple[int, ...]:
    """Divide rows into tiles of about 64."""
    return tuple(np.linspace(0, rows, max(1, rows // 64) + 1).astype(int).tolist())


def tile_nodes(cells: int, nodes: int) -> NDArray[np.int64]:
    """Return the cells (n,) nearest to the Chebyshev points of an interval of so many, ends included."""
    angle = np.arange(nodes) * np.pi / (nodes - 1)
    return np.rint((1 - np.cos(angle)) / 2 * (cells - 1)).astype(np.int64)


def interpolation(cells: int, nodes: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the matrices from values at nodes (n,) to those at all cells and to coefficients.

    Returns:
        (cells, n) and (n, n).
    """
    degree = len(nodes) - 1
    at_nodes = chebvander(2 * nodes.astype(np.float64) / (cells - 1) - 1, degree)
    coefficients = np.asarray(np.linalg.inv(at_nodes), np.float64)
    return chebvander(np.linspace(-1, 1, cells), degree) @ coefficients, coefficients


class Interpolant(NamedTuple):
    """Image coordinates of all cells, as polynomials along the rows of each tile.

    Attributes:
        rows: tiles of rows.
        values: (B, 2, T, n, V) at the nodes of the rows.
        excess: (B, 1, T, n, V), positive where the lens folds over; None where it nowhere does.
        smooth: (B, T), whether the polynomials are exact; where not, they mean nothing.
        folds: (T,), whether the lens may fold over.
        inside: (T,), whether all cells are surely seen, and their coordinates in [-limit, limit].
    """

    rows: RowTiles
    values: Tensor
    excess: Tensor | None
    smooth: NDArray[np.bool_]
    folds: NDArray[np.bool_]
    inside: NDArray[np.bool_]

    def points(self, tile: int, rows: slice, out: Tensor | None = None) -> Tensor:
        """Return coordinates of cells of a tile, (B, 2, rows, V).

        Args:
            tile: number of the tile.
            rows: rows of the tile.
            out: of that shape, to write to without a graph.
        """
        return _product(self.rows.weights[tile][rows], self.values[:, :, tile], out)

    def hidden(self, tile: int, rows: slice) -> Tensor | None:
        """Return (B, rows, V), zero where the lens does not fold over, else 1; None where it nowhere does."""
        if self.excess is None or not self.folds[tile]:
            return None
        excess = _product(self.rows.weights[tile][rows], self.excess[:, :, tile])
        return excess.squeeze(1).clamp_(min=0.0).sign_()


@one_thread()  # MKL's threads too, which start for the atan of some hundred numbers
def interpolant(cells: CellSums, lens: Lens | None, limit: float) -> Interpolant | None:
    """Interpolate where cells are seen; None of a grid that has too few, and of an empty batch.

    Args:
        cells: float32, affine in row and column but for jumps: where a tile's corners are ahead of the camera
            and within the limit of the lens, all of it is.
        lens: into normalised coordinates, or None.
        limit: see :class:`Interpolant`.
    """
    batch, count, width = cells.shape
    rows = row_tiles(cells.edges or equal_edges(count))
    columns = column_tiles(width, _COLUMNS // 2 if lens else _COLUMNS)
    if rows is None or columns is None or batch == 0:
        return None
    nodes = CellSums(
        cells.by_row.index_select(-1, torch.from_numpy(rows.nodes)),
        cells.by_column.index_select(-1, torch.from_numpy(columns.nodes)),
    )
    step = max(1, ONE_THREAD // (3 * batch * len(columns.nodes)))
    parts = [nodes.rows(first, first + step) for first in range(0, len(rows.nodes), step)]
    points, hidden = (
        torch.cat(each, dim=-2)
        for each in zip(*(image_coordinates(part, lens, continued=True) for part in parts), strict=True)
    )
    shape = rows.coefficients.shape[:2]

    def by_tiles(values: Tensor) -> NDArray[np.float32]:
        """Reshape (B, k, T·n, S·m) to (B, k, T, n, S, m), without gradient."""
        array: NDArray[np.float32] = values.detach().numpy()
        return array.reshape(*array.shape[:2], *shape, -1, _NODES)

    error, most, least = tile_bounds(by_tiles(points), rows, columns)
    seen = by_tiles(hidden.unsqueeze(1))[:, 0].max(2).max(-1) == 0  # (B, T, S)
    smooth = seen & (error <= np.maximum(_OUTSIDE * (least - 1), _TOLERANCE))
    excess, folds = None, np.zeros(len(rows.weights), np.bool_)
    if lens is not None:
        over = torch.cat([lens.excess(part.detach()) for part in parts], dim=-2)
        folds = by_tiles(over).max((0, 1, 3, 4, 5)) > 0
        excess = _along_columns(over, columns).unflatten(2, shape) if folds.any() else None
    inside = (smooth & (most <= limit)).all((0, 2)) & ~folds
    values = _along_columns(points, columns).unflatten(2, shape)
    return Interpolant(rows, values, excess, smooth.all(2), folds, inside)


def tile_bounds(
    values: NDArray[np.float32], rows: RowTiles, columns: ColumnTiles
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Bound tiles' polynomials by their coefficients.

    Args:
        values: (B, 2, T, n, S, m) at the nodes.
        rows: tiles.
        columns: tiles.

    Returns:
        (B, T, S) each: what the coefficients of the highest degrees sum up to; the sum of all, which no
        coordinate exceeds; of the coordinate that is farther from the image at all nodes, at the nearest.
    """
    along = small_products(values.reshape(-1, _NODES), columns.coefficients.T)
    size = np.abs(rows.coefficients @ along.reshape(*values.shape[:4], -1))
    sums = small_products(size.reshape(-1, _NODES), _SUMS)  # sums over the degrees of the columns
    sums = sums.reshape(*values.shape[:5], 2)
    most = sums[..., 0].sum(3)
    error = sums[:, :, :, :_LOW, :, 1].sum(3) + sums[:, :, :, _LOW:, :, 0].sum(3)
    least = np.abs(values).min(3).min(-1)
    return error.max(1), most.max(1), least.max(1)


def _along_columns(nodes: Tensor, columns: ColumnTiles) -> Tensor:
    """Interpolate values at all columns, (B, k, R, V), from those at the nodes, (B, k, R, S·m)."""
    nodes = nodes.unflatten(-1, (-1, _NODES))
    if nodes.requires_grad:
        with autocast_off(nodes.device):
            values = nodes @ torch.from_numpy(columns.weights).mT  # (..., S, size)
    else:
        each = nodes.numpy().reshape(-1, _NODES)
        values = torch.from_numpy(small_products(each, columns.weights.T)).view(*nodes.shape[:-1], -1)
    if columns.overlap == 0:
        return values.flatten(-2)
    return torch.cat([values[..., :-1, :].flatten(-2), values[..., -1, columns.overlap :]], dim=-1)


def _product(weights: NDArray[np.float32], values: Tensor, out: Tensor | None = None) -> Tensor:
    """Multiply weights (rows, n) with values (..., n, V); no graph with ``out``."""
    if out is not None:
        small_products(weights, values.detach().numpy(), out.numpy())
        return out
    if not values.requires_grad:
        return torch.from_numpy(small_products(weights, values.numpy()))
    with autocast_off(values.device):
        return torch.from_numpy(weights) @ values
