"""Where an image sees the cells of a bird's-eye grid, as maps for one resampling.

The position of a cell is the sum of a row's and a column's part. Coordinates are planes (B, 2, U, V), never
pairs, and rows of cells are processed in blocks that stay in the cache. Sums that are zero inside the image
tell what lies outside, since comparisons and ``where`` take several times as long as arithmetic on a CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from lanebev.geometry.distortion import lens_model, max_undistorted_radius, tilt_homography
from lanebev.geometry.precision import full_precision
from lanebev.geometry.rotation import road_from_cam
from lanebev.types import Extrinsics
from lanebev.view.grid import BEVGrid
from lanebev.view.lens import distort_planes

_LEAST_DEPTH = 1e-3  # m in front of the camera
_BEHIND = -1e6  # m, depth given to planes that are not below the camera
_PUSH = (
    1e4  # of what lies outside, away from the map: far enough for a camera that is a millimetre over the road
)
_BLOCK = 1 << 17  # cells: a dozen float32 planes of so many fit a cache of a few MB


class CellSums(NamedTuple):
    """Homogeneous coordinates of cells, as sums of a row's and a column's part.

    Attributes:
        by_row: (B, 3, R), of R = P·U rows, those of the first plane first.
        by_column: (B, 3, V).
    """

    by_row: Tensor
    by_column: Tensor


class Lens(NamedTuple):
    """What leads from the plane z = 1 to the image.

    Attributes:
        coefficients: (B, D) of the distortion.
        model: "pinhole", "fisheye" or "omni".
        focal, skew, centre: (B, 2, 1, 1) each; the skew of y is zero.
        squared_limit: (B, 1, 1), x² + y² up to which the lens does not fold over.
        tilt: (B, 3, 3, 1, 1), homography of a tilted sensor, or None.
    """

    coefficients: Tensor
    model: str
    focal: Tensor
    skew: Tensor
    centre: Tensor
    squared_limit: Tensor
    tilt: Tensor | None


def cells_and_lens(
    grid: BEVGrid,
    image_from_cam: Tensor,
    extrinsics: Extrinsics,
    distortion: Tensor | None,
    model: str,
    dtype: torch.dtype,
    plane_heights: Sequence[float] = (0.0,),
) -> tuple[CellSums, Lens | None]:
    """Prepare the projection of cells.

    Matrices are computed in the dtype of the geometry, and rounded to the dtype in which cells are projected.

    Args:
        grid: U × V cells.
        image_from_cam: (B, 3, 3), the intrinsics, or :func:`normalised_intrinsics` of them.
        extrinsics: each (B,).
        distortion: (B, D), or None.
        model: "pinhole", "fisheye" or "omni".
        dtype: of the results.
        plane_heights: of planes above the road, m.
    """
    if distortion is None or distortion.shape[-1] == 0:
        sums, lens = cell_sums(grid, plane_heights, image_from_cam, extrinsics), None
    else:
        sums = cell_sums(grid, plane_heights, None, extrinsics)
        lens = make_lens(image_from_cam.to(dtype), distortion.to(dtype), model)
    return CellSums(*(part.to(dtype) for part in sums)), lens


@full_precision
def cell_sums(
    grid: BEVGrid, plane_heights: Sequence[float], image_from_cam: Tensor | None, extrinsics: Extrinsics
) -> CellSums:
    """Compute the homogeneous image coordinates of all cells of all planes.

    Args:
        grid: U × V cells.
        plane_heights: P heights of planes above the road, m.
        image_from_cam: (B, 3, 3), the intrinsics; None leaves camera coordinates, m.
        extrinsics: each (B,).
    """
    matrix = road_from_cam(extrinsics.pitch, extrinsics.yaw, extrinsics.roll).mT
    if image_from_cam is not None:
        matrix = image_from_cam @ matrix
    x, z = grid.axes(matrix.dtype, matrix.device)
    right, down, forward = matrix[..., None].unbind(-2)  # (B, 3, 1)
    below = extrinsics.height.unsqueeze(-1) - matrix.new_tensor(plane_heights)  # (B, P)
    by_row = (down * below.unsqueeze(1)).unsqueeze(-1) + (forward * z).unsqueeze(-2)  # (B, 3, P, U)
    by_row = torch.where((below > 0)[:, None, :, None], by_row, _BEHIND)
    return CellSums(by_row.flatten(2), right * x)


def make_lens(image_from_cam: Tensor, distortion: Tensor, model: str) -> Lens:
    """Take apart intrinsics (B, 3, 3) and distortion (B, D)."""
    upper = image_from_cam[:, :2, :, None, None]  # (B, 2, 3, 1, 1)
    focal = torch.stack([upper[:, 0, 0], upper[:, 1, 1]], dim=1)
    skew = torch.stack([upper[:, 0, 1], torch.zeros_like(upper[:, 0, 1])], dim=1)
    limit = max_undistorted_radius(distortion.detach(), model).square()[:, None, None]
    tilt = tilt_homography(distortion[:, 12:])[..., None, None] if distortion.shape[-1] == 14 else None
    return Lens(distortion, lens_model(model), focal, skew, upper[:, :, 2], limit, tilt)


def normalised_intrinsics(intrinsics: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Intrinsics to coordinates in which the image, its outer pixels' edges included, is [-1, 1].

    This is the convention of ``grid_sample(align_corners=False)``: the same for maps of every size.

    Args:
        intrinsics: (B, 3, 3) px.
        image_size: (H, W) px.
    """
    height, width = image_size
    scale = intrinsics.new_tensor([2 / width, 2 / height, 1.0]).unsqueeze(-1)
    shift = intrinsics.new_tensor([1 / width - 1, 1 / height - 1, 0.0])
    return intrinsics * scale + F.pad(shift.unsqueeze(-1), (2, 0))


def image_coordinates(sums: CellSums, lens: Lens | None) -> tuple[Tensor, Tensor]:
    """Project cells.

    Args:
        sums: homogeneous coordinates in the image, or with a lens in the camera.
        lens: None for an undistorted image.

    Returns:
        (B, 2, R, V) coordinates, finite everywhere, and (B, R, V): zero in front of the camera and where the
        lens polynomial grows, else positive.
    """
    cells = sums.by_row.unsqueeze(-1) + sums.by_column.unsqueeze(-2)
    depth = cells[:, 2]
    ahead = depth.clamp(min=_LEAST_DEPTH)
    points = cells[:, :2] / ahead.unsqueeze(1)
    hidden = (ahead - depth).detach()
    if lens is None:
        return points, hidden
    x, y = points.unbind(1)
    squared_radius = torch.addcmul(x * x, y, y)
    clamped = torch.minimum(squared_radius, lens.squared_limit)  # beyond it no gradient, and no overflow
    hidden = hidden + (squared_radius - clamped).detach()
    points = distort_planes(points, clamped, lens.coefficients, lens.model)
    if lens.tilt is not None:
        points, beyond = tilt_planes(points, lens.tilt)
        hidden = hidden + beyond
    return torch.addcmul(points * lens.focal, points[:, 1:], lens.skew) + lens.centre, hidden


def tilt_planes(points: Tensor, homography: Tensor) -> tuple[Tensor, Tensor]:
    """Transform (B, 2, R, V) points by a homography (B, 3, 3, 1, 1).

    Returns:
        (B, 2, R, V), finite, and (B, R, V): zero where the point stays in front, else positive.
    """
    x, y = points.unsqueeze(2).unbind(1)  # (B, 1, R, V)
    mapped = homography[:, :, 0] * x + homography[:, :, 1] * y + homography[:, :, 2]
    depth = mapped[:, 2:]
    ahead = depth.clamp(min=1e-6)
    return mapped[:, :2] / ahead, (ahead - depth).detach().squeeze(1)


def outside_image(points: Tensor, hidden: Tensor) -> Tensor:
    """Mark what an image does not show.

    Args:
        points: (B, 2, R, V) normalised coordinates.
        hidden: (B, R, V), zero where seen.

    Returns:
        (B, R, V), zero where seen and inside the image, else positive; without gradient.
    """
    beyond = F.hardshrink(points.detach(), 1.0)  # zero in [-1, 1]
    x, y = beyond.unbind(1)
    return torch.addcmul(torch.addcmul(hidden, x, x), y, y)


def sampling_maps(
    sums: CellSums, lens: Lens | None, sizes: Sequence[tuple[int, int]]
) -> tuple[list[Tensor], Tensor]:
    """Compute the maps for :func:`resample`.

    Args:
        sums: homogeneous coordinates, :func:`normalised_intrinsics` applied; with a lens in the camera.
        lens: into normalised coordinates, or None.
        sizes: (h, w) of every map to be sampled.

    Returns:
        (B, 2, R, V) for each size, and (B, 1, R, V) bool: valid.
    """
    batch, columns = sums.by_column.shape[0], sums.by_column.shape[2]
    rows = sums.by_row.shape[2]
    if not torch.compiler.is_compiling():  # compiled code has no planes in between
        rows = max(1, _BLOCK // max(1, batch * columns))
    maps: list[tuple[list[Tensor], list[Tensor]]] = [([], []) for _ in sizes]
    invalid = []
    for by_row in sums.by_row.split(rows, dim=-1):
        points, hidden = image_coordinates(sums._replace(by_row=by_row), lens)
        outside = outside_image(points, hidden)
        for (height, width), (xs, ys) in zip(sizes, maps, strict=True):
            inner_x, inner_y = 1 - 1 / width, 1 - 1 / height  # centres of the outermost pixels
            x = F.hardtanh(points[:, 0], -inner_x, inner_x)
            xs.append(torch.add(x, outside, alpha=_PUSH))
            ys.append(F.hardtanh(points[:, 1], -inner_y, inner_y))
        invalid.append(outside.bool())
    stacked = [torch.cat([*xs, *ys], dim=1).unflatten(1, (2, -1)) for xs, ys in maps]
    return stacked, torch.cat(invalid, dim=1).logical_not().unsqueeze(1)


def resample(features: Tensor, sampling_map: Tensor) -> Tensor:
    """Sample (B, C, h, w) bilinearly, zero where the map lies outside, in the features' dtype."""
    sampled = F.grid_sample(
        features.to(sampling_map.dtype), sampling_map.movedim(1, -1), "bilinear", "zeros", align_corners=False
    )
    return sampled.to(features.dtype)
