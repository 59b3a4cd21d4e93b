"""Interpolate where cells are seen: exact at a few cells of each tile, polynomials for the others.

Perspective and lens are smooth functions of a cell's row and column: the polynomial through 10 × 10 cells of
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

_ROWS, _ROW_NODES = 64, 10
_COLUMNS, _COLUMN_NODES = 128, 10
_TOLERANCE = 4e-6  # of half the image, .004 px of 1920; what float32 rounds is a quarter of it
_OUTSIDE = 0.25  # share of the distance to the image by which a tile that is not in it may be off


class Axis(NamedTuple):
    """Tiles of one size along the rows or the columns of a grid; the last overlaps the one before.

    Attributes:
        size: cells of a tile.
        overlap: cells of the last tile that the one before has too.
        nodes: (T, n) int64, the cells of each tile that are computed, its first and last among them.
        weights: (size, n), values at the cells of a tile from those at its nodes.
        coefficients: (n, n), Chebyshev coefficients from values at the nodes.
    """

    size: int
    overlap: int
    nodes: NDArray[np.int64]
    weights: NDArray[np.float32]
    coefficients: NDArray[np.float32]


@lru_cache(maxsize=64)
def axis_tiles(cells: int, size: int, nodes: int) -> Axis | None:
    """Divide ``cells`` into tiles of ``size``; None if there are less than two cells a node."""
    size = min(size, cells)
    if size < 2 * nodes:
        return None
    first = np.minimum(np.arange(0, cells, size), cells - size)
    of_tile = tile_nodes(size, nodes)
    weights, coefficients = interpolation(size, of_tile)
    return Axis(
        size, len(first) * size - cells, first[:, None] + of_tile,
        weights.astype(np.float32), coefficients.astype(np.float32),
    )  # fmt: skip


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
        smooth: (B, T) bool, whether the polynomials are exact; where not, they mean nothing.
        inside: (T,) of bool, whether all cells are surely seen, and their coordinates in [-limit, limit].
    """

    rows: Axis
    values: Tensor
    smooth: Tensor
    inside: list[bool]

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
        """Write those coordinates to their rows of ``out``, (B, 2, R, V), which are returned."""
        weights = torch.from_numpy(self.rows.weights)
        with autocast_off(out.device):
            for tile in range(first, last):
                rows = out[:, :, self.row(tile) : self.row(tile + 1)]
                own = weights[self.rows.size - rows.shape[2] :].expand(2 * len(out), -1, -1)
                values = self.values[:, :, tile].flatten(0, 1)
                torch.bmm(own, values, out=rows.view(len(own), -1, rows.shape[3]))
        return out[:, :, self.row(first) : self.row(last)]


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
    by_row, by_column = (
        part[..., torch.from_numpy(axis.nodes.reshape(-1))]
        for part, axis in zip(cells, (rows, columns), strict=True)
    )
    nodes = CellSums(by_row, by_column)
    points, hidden = image_coordinates(nodes.rows(0, nodes.shape[1]), lens)
    with autocast_off(points.device):
        values = _along_columns(points.unflatten(3, columns.nodes.shape), columns)
        error, most, least = _sizes(points.detach(), rows, columns)
    seen = _by_tiles(hidden, rows, columns).amax((3, 4)) == 0  # (B, T, S)
    smooth = seen & (error <= (_OUTSIDE * (least - 1)).clamp(min=_TOLERANCE))
    inside = smooth & (most <= limit)
    return Interpolant(
        rows, values.unflatten(2, rows.nodes.shape), smooth.all(2), inside.all(2).all(0).tolist()
    )


def _by_tiles(values: Tensor, rows: Axis, columns: Axis) -> Tensor:
    """Values (..., T·n, S·m) at all nodes as (..., T, S, n, m)."""
    tiles: Tensor = values.unflatten(-1, columns.nodes.shape).unflatten(-3, rows.nodes.shape)
    return tiles.transpose(-3, -2)


def _along_columns(nodes: Tensor, columns: Axis) -> Tensor:
    """Values at all columns, (..., V), from those at the nodes, (..., S, m)."""
    values = nodes @ torch.from_numpy(columns.weights).mT  # (..., S, size)
    if columns.overlap == 0:
        return values.flatten(-2)
    return torch.cat([values[..., :-1, :].flatten(-2), values[..., -1, columns.overlap :]], dim=-1)


def _sizes(points: Tensor, rows: Axis, columns: Axis) -> tuple[Tensor, Tensor, Tensor]:
    """Bound tiles' polynomials by their coefficients.

    Args:
        points: (B, 2, T·n, S·m) at the nodes.
        rows: T tiles.
        columns: S tiles.

    Returns:
        error: what the last two coefficients of rows and columns sum up to.
        most: the sum of all, which no coordinate exceeds.
        least: of the coordinate that is farther from the image at all nodes, at the nearest: each (B, T, S).
    """
    values = _by_tiles(points, rows, columns).contiguous()
    by_column = values @ torch.from_numpy(columns.coefficients).mT
    size = (by_column.mT.contiguous() @ torch.from_numpy(rows.coefficients).mT).abs()  # (B, 2, T, S, m, n)
    most = size.sum((-2, -1))
    rest = size[..., :-2, :-2].sum((-2, -1))
    least = values.abs().amin((-2, -1))
    return (most - rest).amax(1), most.amax(1), least.amax(1)
