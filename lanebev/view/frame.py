"""Resample camera frames as files hold them: one image of bytes."""

from __future__ import annotations

from functools import lru_cache, partial

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.tensors import constant
from lanebev.types import Extrinsics
from lanebev.view.blocks import blocks
from lanebev.view.cells import cell_sums, rows_in_sight
from lanebev.view.grid import BEVGrid
from lanebev.view.kept import KeptArrays
from lanebev.view.lens import Lens, make_lens
from lanebev.view.projection import normalised_intrinsics
from lanebev.view.sampling import MapSize, block_map

_kept = KeptArrays()


@torch.inference_mode()
def remap_frame(
    frame: NDArray[np.uint8],
    camera: Camera,
    extrinsics: Extrinsics,
    grid: BEVGrid,
    vertical_curvature: Tensor | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Resample one frame to the bird's-eye view, as :class:`~lanebev.BEVWarp` does, by ``cv2.remap``.

    Args:
        frame: (H, W, 3) or (H, W) of bytes, as taken.
        camera: its lens, of the frame's size.
        extrinsics: extrinsics of batch size 1.
        grid: the road's rectangle.
        vertical_curvature: (1,) 1/m of the road, or None for a plane.

    Returns:
        (U, V, 3) or (U, V) bytes, zero where not valid, and (U, V) bool. cv2 rounds coordinates to 1/32 px.

    Raises:
        ValueError: a frame of another type or size than the camera's.
    """
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3):
        raise ValueError(f"frame: expected (H, W, 3) of uint8, got {frame.shape} of {frame.dtype}")
    height, width = camera.image_size
    if frame.shape[:2] != (height, width):
        raise ValueError(
            f"frame: expected the camera's {height} x {width}, got {frame.shape[0]} x {frame.shape[1]}; "
            "see Camera.scaled"
        )
    size = camera.image_size
    image_from_cam, lens = _projection(camera)
    extrinsics = Extrinsics(*(part.cpu() for part in extrinsics))
    curvature = None if vertical_curvature is None else vertical_curvature.cpu()
    cells = cell_sums(grid, (0.0,), image_from_cam, extrinsics, curvature).to(torch.float32)
    bev, valid = np.empty((*grid.shape, *frame.shape[2:]), np.uint8), np.empty(grid.shape, np.bool_)
    for block in blocks(cells, lens, 1 - 1 / min(size), partial(_points, grid.shape[1])):
        rows = slice(block.first, block.last)
        points = block_map(block, MapSize(*size), size, block.points)[0]
        np.less_equal(points[0].numpy(), 1, out=valid[rows])
        cv2.remap(frame, *_fixed_point_pixels(points, size), cv2.INTER_LINEAR, bev[rows])
    if curvature is not None:
        hidden = ~rows_in_sight(grid, (0.0,), extrinsics, curvature)[0].numpy()
        bev[hidden], valid[hidden] = 0, False
    return bev, valid


def _points(columns: int, first: int, last: int) -> Tensor:
    """Return memory that is kept for the points of a block."""
    return torch.from_numpy(_kept("points", (1, 2, last - first, columns), np.float32))


def _fixed_point_pixels(
    points: Tensor, size: tuple[int, int]
) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Convert normalised coordinates to pixels as cv2.remap wants them.

    Args:
        points: (2, rows, V), which are overwritten.
        size: (H, W) px.

    Returns:
        (rows, V, 2) whole px and (rows, V) parts of px, in memory that is kept.
    """
    centre = constant(((size[1] - 1) / 2, (size[0] - 1) / 2), like=points)
    x, y = (
        torch.add(middle, plane, alpha=side / 2, out=plane).numpy()
        for middle, plane, side in zip(centre, points, reversed(size), strict=True)
    )
    whole, parts = _kept("whole", (*x.shape, 2), np.int16), _kept("parts", x.shape, np.uint16)
    cv2.convertMaps(x, y, cv2.CV_16SC2, whole, parts)
    return whole, parts


@lru_cache(maxsize=8)
def _projection(camera: Camera) -> tuple[Tensor | None, Lens | None]:
    """Return the matrix, (1, 3, 3), or the lens that leads from camera to normalised coordinates."""
    image_from_cam = normalised_intrinsics(camera.intrinsics[None].cpu(), camera.image_size)
    if len(camera.distortion) == 0:
        return image_from_cam, None
    return None, make_lens(image_from_cam.float(), camera.distortion[None].cpu().float(), camera.model)
