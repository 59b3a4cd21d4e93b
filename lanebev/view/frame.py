"""The resampling of camera frames as files hold them: one image of bytes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.geometry.distortion import max_undistorted_radius
from lanebev.types import Extrinsics
from lanebev.view.cells import cell_sums, cells_and_lens
from lanebev.view.grid import BEVGrid, bev_from_image
from lanebev.view.sampling import LEAST_DEPTH, image_coordinates

Plane = NDArray[np.float32]


def remap_frame(
    frame: NDArray[np.uint8], camera: Camera, extrinsics: Extrinsics, grid: BEVGrid
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Resample one frame to the bird's-eye view, as :class:`~lanebev.BEVWarp` does, by ``cv2.remap``.

    Args:
        frame: (H, W, 3) or (H, W) of bytes, as taken.
        camera: its lens, of the frame's size.
        extrinsics: of batch size 1.
        grid: the road's rectangle.

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
    x, y, seen = pixels_of_cells(camera, extrinsics, grid)
    valid = seen & (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    maps = cv2.convertMaps(x, y, cv2.CV_16SC2)  # which cv2.remap does in more time
    taken: Any = cv2.remap(frame, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    bev: Any = cv2.bitwise_and(taken, taken, mask=valid.view(np.uint8))
    return bev, valid


def pixels_of_cells(
    camera: Camera, extrinsics: Extrinsics, grid: BEVGrid
) -> tuple[Plane, Plane, NDArray[np.bool_]]:
    """Compute where a camera sees the cells of a grid.

    Args:
        camera: with its lens.
        extrinsics: of batch size 1.
        grid: U × V cells.

    Returns:
        x and y px of the image as taken, and whether the cell is in front of the camera and where the lens
        does not fold over, each (U, V); x and y are anything where it is not.
    """
    with torch.inference_mode():
        if camera.model == "pinhole" and float(camera.intrinsics[0, 1]) == 0.0:
            return _by_opencv(camera, extrinsics, grid)
        cells, lens = cells_and_lens(
            grid, camera.intrinsics[None], extrinsics, camera.distortion[None], camera.model, torch.float32
        )
        points, hidden = image_coordinates(cells.rows(0, cells.shape[1]), lens)
        x, y, seen = (part.cpu().numpy() for part in (*points[0], hidden[0] == 0))
    return x, y, seen


def _by_opencv(
    camera: Camera, extrinsics: Extrinsics, grid: BEVGrid
) -> tuple[Plane, Plane, NDArray[np.bool_]]:
    """By OpenCV's single pass over the cells, which says nothing of cells behind or beyond a fold."""
    sums = cell_sums(grid, (0.0,), None, extrinsics)
    by_row, by_column = (part[0].float() for part in sums)  # (3, U), (3, V) m in the camera
    seen = by_row[2].unsqueeze(-1) + by_column[2] > LEAST_DEPTH
    if len(camera.distortion):
        limit = max_undistorted_radius(camera.distortion[None], camera.model)[0].float()
        seen &= _within(by_row, by_column, limit)
    bev_from_cam = bev_from_image(extrinsics, camera.intrinsics[None], grid)[0] @ camera.intrinsics
    x, y = cv2.initUndistortRectifyMap(
        camera.intrinsics.numpy(), camera.distortion.numpy(), bev_from_cam.cpu().numpy(), np.eye(3),
        grid.shape[::-1], cv2.CV_32FC1,
    )  # fmt: skip
    return x, y, seen.cpu().numpy()


def _within(by_row: Tensor, by_column: Tensor, limit: Tensor) -> Tensor:
    """Whether x² + y² < limit² z² for the sum of a row's and a column's vector, (3, U) and (3, V)."""
    sign = torch.stack([torch.ones_like(limit), torch.ones_like(limit), -limit.square()]).unsqueeze(-1)
    row, column = ((sign * part * part).sum(0) for part in (by_row, by_column))
    left = torch.stack([*(2 * sign * by_row), row, torch.ones_like(row)], dim=1)  # (U, 5)
    right = torch.stack([*by_column, torch.ones_like(column), column])  # (5, V)
    return left @ right < 0
