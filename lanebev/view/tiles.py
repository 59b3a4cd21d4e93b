"""Interpolate where cells are seen: exact at a few cells of each tile, polynomials for the others.

Perspective and lens are smooth functions of a cell's row and column: the polynomial through 12 × 12 cells of
a tile of 64 × 128 is as exact as float32 itself. Whether it is, its Chebyshev coefficients tell; tiles in
which they do not fall off are computed cell by cell.

Source: Trefethen, Approximation Theory and Approximation Practice, ch. 3 (coefficients from values), 8
(they fall off geometrically and bound the error where a function is analytic).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray
from torch import Tensor

from lanebev.geometry.precision import autocast_off
from lanebev.view.lens import Lens
from lanebev.view.projection import CellSums, image_coordinates

_ROWS, _ROW_NODES = 64, 12
_COLUMNS, _COLUMN_NODES = 128, 12
_TOLERANCE = 4e-6  # of half the image, .004 px of 1920; what float32 rounds is a quarter of it
_HIGHEST = 2  # degrees of which the coefficients tell what those of higher ones would add
_OUTSIDE = 0.25  # share of the distance to the image by which a tile that is not in it may be off


class Axis(NamedTuple):
    """Tiles of one size along the rows or the columns of a grid; the last overlaps the one before.

    Attributes:
        size: cells of a tile.
        overlap: cells of the last tile that the one before has too.
        nodes: (T, n) int64, the cells of each tile that are computed, its first and last among them.
        weights: (size, n), values at the cells of a tile from those at its nodes.
    """

    size: int
    overlap: int
    nodes: NDArray[np.int64]
    weights: NDArray[np.float32]


@lru_cache(maxsize=64)
def axis_tiles(cells: int, size: int, nodes: int) -> Axis | None:
    """Divide ``cells`` into tiles of ``size``; None if there are less than three cells a node."""
    size = min(size, cells)
    if size < 3 * nodes:
        return None
    first = np.minimum(np.arange(0, cells, size), cells - size)
    of_tile = tile_nodes(size, nodes)
    weights, _ = interpolation(size, of_tile)
    return Axis(size, len(first) * size - cells, first[:, None] + of_tile, weights.astype(np.float32))


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


@lru_cache(maxsize=64)
def tile_coefficients(rows: int, row_nodes: int, columns: int, column_nodes: int) -> NDArray[np.float32]:
    """Compute the matrix from values at all nodes of a tile to its Chebyshev coefficients.

    Returns:
        (nodes, coefficients), those of the two highest degrees of rows or columns last.
    """
    _, by_row = interpolation(rows, tile_nodes(rows, row_nodes))
    _, by_column = interpolation(columns, tile_nodes(columns, column_nodes))
    degree = np.indices((row_nodes, column_nodes)).reshape(2, -1)
    highest = (degree[0] >= row_nodes - _HIGHEST) | (degree[1] >= column_nodes - _HIGHEST)
    matrix = np.kron(by_row, by_column)[np.argsort(highest, kind="stable")]
    return np.ascontiguousarray(matrix.T, np.float32)


class Interpolant(NamedTuple):
    """Image coordinates of all cells, as polynomials along the rows of each tile.

    Attributes:
        rows: tiles of rows.
        values: (B, 2, T, n, V) at the nodes of the rows.
        smooth: (B, T), whether the polynomials are exact; where not, they mean nothing.
        inside: (T,), whether all cells are surely seen, and their coordinates in [-limit, limit].
    """

    rows: Axis
    values: Tensor
    smooth: NDArray[np.bool_]
    inside: NDArray[np.bool_]

    def row(self, tile: int) -> int:
        """Return the first row of a tile that the one before has not, or the number of all rows."""
        count = len(self.inside) * self.rows.size - self.rows.overlap
        return min(tile * self.rows.size, count)

    def points(self, first: int, last: int) -> Tensor:
        """Return coordinates of the rows of tiles first to last - 1, (B, 2, rows, V)."""
        with autocast_off(self.values.device):
            points = torch.from_numpy(self.rows.weights) @ self.values[:, :, first:last]
        if self.rows.overlap == 0 or last < len(self.inside):
            return points.flatten(2, 3)
        before, own = points[:, :, :-1], points[:, :, -1, self.rows.overlap :]
        return torch.cat([before.flatten(2, 3), own], dim=2)

    def write(self, first: int, last: int, out: Tensor) -> Tensor:
        """Write those coordinates to ``out``, (B, 2, rows, V), without a graph."""
        values, cells = self.values.numpy(), out.numpy()  # whose small products take half as long
        for tile in range(first, last):
            start, end = self.row(tile) - self.row(first), self.row(tile + 1) - self.row(first)
            weights = self.rows.weights[self.rows.size - (end - start) :]
            np.matmul(weights, values[:, :, tile], out=cells[:, :, start:end])
        return out


def interpolant(cells: CellSums, lens: Lens | None, limit: float) -> Interpolant | None:
    """Interpolate where cells are seen; None of a grid that has too few.

    Args:
        cells: float32, affine in row and column but for jumps: where a tile's corners are ahead of the camera
            and within the limit of the lens, all of it is.
        lens: into normalised coordinates, or None.
        limit: see :class:`Interpolant`.
    """
    _, count, width = cells.shape
    rows, columns = axis_tiles(count, _ROWS, _ROW_NODES), axis_tiles(width, _COLUMNS, _COLUMN_NODES)
    if rows is None or columns is None:
        return None
    nodes = CellSums(
        *(
            part.index_select(-1, torch.from_numpy(axis.nodes.reshape(-1)))
            for part, axis in zip(cells, (rows, columns), strict=True)
        )
    )
    points, hidden = image_coordinates(nodes.rows(0, nodes.shape[1]), lens)
    values = _along_columns(points.unflatten(3, columns.nodes.shape), columns)
    error, most, least = _sizes(_by_tiles(points, rows, columns), rows.size, columns.size)
    seen = _by_tiles(hidden, rows, columns).max(-1) == 0  # (B, T, S)
    smooth = seen & (error <= np.maximum(_OUTSIDE * (least - 1), _TOLERANCE))
    inside = smooth & (most <= limit)
    return Interpolant(rows, values.unflatten(2, rows.nodes.shape), smooth.all(2), inside.all((0, 2)))


def _by_tiles(values: Tensor, rows: Axis, columns: Axis) -> NDArray[np.float32]:
    """Values (..., T·n, S·m) at all nodes as (..., T, S, n·m), without gradient."""
    tiles = values.detach().unflatten(-1, columns.nodes.shape).unflatten(-3, rows.nodes.shape)
    array: NDArray[np.float32] = tiles.transpose(-3, -2).flatten(-2).numpy()
    return array


def _along_columns(nodes: Tensor, columns: Axis) -> Tensor:
    """Values at all columns, (..., V), from those at the nodes, (..., S, m)."""
    if nodes.requires_grad:
        with autocast_off(nodes.device):
            values = nodes @ torch.from_numpy(columns.weights).mT  # (..., S, size)
    else:  # in half the time
        values = torch.from_numpy(nodes.flatten(0, -2).numpy() @ columns.weights.T)
        values = values.view(*nodes.shape[:-1], -1)
    if columns.overlap == 0:
        return values.flatten(-2)
    return torch.cat([values[..., :-1, :].flatten(-2), values[..., -1, columns.overlap :]], dim=-1)


def _sizes(values: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """Bound tiles' polynomials by their coefficients.

    Args:
        values: (B, 2, T, S, n·m) at the nodes.
        rows: of a tile.
        columns: of a tile.

    Returns:
        (3, B, T, S): what the coefficients of the highest degrees sum up to; the sum of all, which no
        coordinate exceeds; of the coordinate that is farther from the image at all nodes, at the nearest.
    """
    matrix = tile_coefficients(rows, _ROW_NODES, columns, _COLUMN_NODES)
    size = np.abs(values.reshape(-1, values.shape[-1]) @ matrix).reshape(values.shape)
    low = (_ROW_NODES - _HIGHEST) * (_COLUMN_NODES - _HIGHEST)
    error = size[..., low:].sum(-1)
    bounds: NDArray[np.float32] = np.stack([error, size.sum(-1), np.abs(values).min(-1)]).max(2)
    return bounds
