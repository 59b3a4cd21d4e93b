"""Resample camera frames as files hold them: one image of bytes."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.geometry.road_profile import check_vertical_curvature
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
        (U, V, 3) or (U, V) bytes, zero where not valid, and (U, V) bool. OpenCV before 5 rounds coordinates
        to 1/32 px.

    Raises:
        ValueError: a frame of another type or size than the camera's, or a curvature of another shape.
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
    curvature = None
    if vertical_curvature is not None:
        check_vertical_curvature(vertical_curvature, 1)
        curvature = vertical_curvature.cpu()
    cells = cell_sums(grid, (0.0,), image_from_cam, extrinsics, curvature).to(torch.float32)
    points = _kept("points", (1, 2, *grid.shape), np.float32)
    memory = torch.from_numpy(points)
    for block in blocks(cells, lens, 1 - 1 / min(size), lambda first, last: memory[:, :, first:last]):
        block_map(block, MapSize(*size), size, block.points)
    valid = points[0, 0] <= 1
    bev = np.empty((*grid.shape, *frame.shape[2:]), np.uint8)
    x, y = _pixels(points[0], size)
    cv2.remap(frame, x, y, cv2.INTER_LINEAR, bev)  # at once, by all of its threads
    if curvature is not None:
        hidden = ~rows_in_sight(grid, (0.0,), extrinsics, curvature)[0].numpy()
        bev[hidden], valid[hidden] = 0, False
    return bev, valid


def _pixels(points: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Convert normalised coordinates (2, U, V) to pixels of an image of size (H, W), in place."""
    sides = np.array([size[1], size[0]], np.float32)[:, None, None]
    points *= sides / 2
    points += (sides - 1) / 2
    return points


@lru_cache(maxsize=8)
def _projection(camera: Camera) -> tuple[Tensor | None, Lens | None]:
    """Return the matrix, (1, 3, 3), or the lens that leads from camera to normalised coordinates."""
    image_from_cam = normalised_intrinsics(camera.intrinsics[None].cpu(), camera.image_size)
    if len(camera.distortion) == 0:
        return image_from_cam, None
    return None, make_lens(image_from_cam.float(), camera.distortion[None].cpu().float(), camera.model)
