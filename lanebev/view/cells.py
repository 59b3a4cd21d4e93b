"""The cells of a bird's-eye grid as a camera sees them: a row's part plus a column's part."""

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from lanebev.geometry.precision import cast_floating, full_precision
from lanebev.geometry.road_profile import in_sight
from lanebev.geometry.rotation import road_from_cam
from lanebev.tensors import constant, made_once
from lanebev.types import Extrinsics
from lanebev.view.grid import BEVGrid
from lanebev.view.lens import Lens, make_lens
from lanebev.view.projection import CellSums
from lanebev.view.tiles import road_edges

_BEHIND = -1e6  # m, depth given to planes that are not below the camera
_axes = made_once(BEVGrid.axes)


def cells_and_lens(
    grid: BEVGrid,
    image_from_cam: Tensor,
    extrinsics: Extrinsics,
    distortion: Tensor | None,
    model: str,
    dtype: torch.dtype,
    plane_heights: Sequence[float] = (0.0,),
    vertical_curvature: Tensor | None = None,
) -> tuple[CellSums, Lens | None]:
    """Compute the coordinates of cells in the image, or with a lens in the camera, and the lens.

    Matrices are computed in the dtype of the geometry, and rounded to the dtype in which cells are projected.

    Args:
        grid: U × V cells.
        image_from_cam: (B, 3, 3), the intrinsics, or ``normalised_intrinsics`` of them.
        extrinsics: each (B,).
        distortion: (B, D), or None.
        model: "pinhole", "fisheye" or "omni".
        dtype: dtype of the results.
        plane_heights: plane heights of P planes above the road, m.
        vertical_curvature: (B,) 1/m of the road, or None for a plane.

    Returns:
        cells of P·U rows, those of the first plane first, and the lens, None for an undistorted image.
    """
    lens = make_lens(image_from_cam, distortion, model, dtype)
    matrix = image_from_cam if lens is None else None
    sums = cell_sums(grid, plane_heights, matrix, extrinsics, vertical_curvature)
    return cast_floating(sums, dtype), lens


@full_precision
def cell_sums(
    grid: BEVGrid,
    plane_heights: Sequence[float],
    image_from_cam: Tensor | None,
    extrinsics: Extrinsics,
    vertical_curvature: Tensor | None,
) -> CellSums:
    """Compute the homogeneous image coordinates of all cells of all planes.

    A vertical curvature lowers the cells of a row by the same, κ Z²/2, so they stay a sum of two parts.

    Args:
        grid: U × V cells.
        plane_heights: P heights of planes above the road, m.
        image_from_cam: (B, 3, 3), the intrinsics; None leaves camera coordinates, m.
        extrinsics: each (B,).
        vertical_curvature: (B,) 1/m of the road, or None for a plane.
    """
    matrix = road_from_cam(extrinsics.pitch, extrinsics.yaw, extrinsics.roll).mT
    if image_from_cam is not None:
        matrix = image_from_cam @ matrix
    x, z = _axes(grid, matrix.dtype, matrix.device)
    right, down, forward = matrix[..., None].unbind(-2)  # (B, 3, 1)
    below = extrinsics.height.unsqueeze(-1) - constant(tuple(plane_heights), like=matrix)  # (B, P)
    offset = torch.where((below > 0).unsqueeze(1), down * below.unsqueeze(1), _BEHIND)  # (B, 3, P)
    by_row = torch.addcmul(offset.unsqueeze(-1), forward.unsqueeze(-1), z)  # (B, 3, P, U)
    if vertical_curvature is not None:
        lower = 0.5 * vertical_curvature.unsqueeze(-1) * z * z  # (B, U)
        by_row = torch.addcmul(by_row, down.unsqueeze(-1), lower[:, None, None])
    return CellSums(by_row.flatten(2), right * x, _edges(grid, len(plane_heights)))


@full_precision
def rows_in_sight(
    grid: BEVGrid, plane_heights: Sequence[float], extrinsics: Extrinsics, vertical_curvature: Tensor
) -> Tensor:
    """Return which rows of cells, (B, P·U), no crest hides; arguments as of :func:`cell_sums`."""
    _, z = _axes(grid, vertical_curvature.dtype, vertical_curvature.device)
    below = extrinsics.height.unsqueeze(-1) - constant(tuple(plane_heights), like=vertical_curvature)
    return in_sight(below.unsqueeze(-1), vertical_curvature[:, None, None], z).flatten(1)


@lru_cache(maxsize=64)
def _edges(grid: BEVGrid, planes: int) -> tuple[int, ...]:
    """Return the first rows of tiles of all planes, and the number of all rows."""
    rows = grid.shape[0]
    edges = road_edges(grid.z[1], grid.resolution, rows)
    return (*(plane * rows + edge for plane in range(planes) for edge in edges[:-1]), planes * rows)
