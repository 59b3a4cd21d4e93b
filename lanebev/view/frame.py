"""Resample camera frames as files hold them: one image of bytes."""

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
from lanebev.view.blocks import blocks
from lanebev.view.cells import cell_sums, cells_and_lens
from lanebev.view.grid import BEVGrid, bev_from_image
from lanebev.view.kept import KeptArrays
from lanebev.view.projection import LEAST_DEPTH, normalised_intrinsics

_kept = KeptArrays()


def remap_frame(
    frame: NDArray[np.uint8], camera: Camera, extrinsics: Extrinsics, grid: BEVGrid
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Resample one frame to the bird's-eye view, as :class:`~lanebev.BEVWarp` does, by ``cv2.remap``.

    Args:
        frame: (H, W, 3) or (H, W) of bytes, as taken.
        camera: its lens, of the frame's size.
        extrinsics: extrinsics of batch size 1.
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
    pixels, seen = _pixels_of_cells(camera, extrinsics, grid)
    mask = _kept("mask", grid.shape, np.uint8)
    cv2.inRange(pixels, (-0.5, -0.5), (width - 0.5, height - 0.5), dst=mask)
    if seen is not None:
        mask *= seen
    maps: Any = _kept("whole", (*grid.shape, 2), np.int16), _kept("parts", grid.shape, np.uint16)
    cv2.convertMaps(pixels, None, cv2.CV_16SC2, maps[0], maps[1])  # which cv2.remap does in more time
    taken: Any = _kept("taken", (*grid.shape, *frame.shape[2:]), np.uint8)
    cv2.remap(frame, maps[0], maps[1], cv2.INTER_LINEAR, taken, cv2.BORDER_REPLICATE)
    bev: Any = cv2.bitwise_and(taken, taken, mask=mask)
    return bev, mask > 0


def _pixels_of_cells(
    camera: Camera, extrinsics: Extrinsics, grid: BEVGrid
) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None]:
    """Compute where a camera sees the cells of a grid.

    Args:
        camera: with its lens.
        extrinsics: extrinsics of batch size 1.
        grid: U × V cells.

    Returns:
        (U, V, 2) x and y px of the image as taken, anything where not seen, in memory that is kept; and
        (U, V), whether the cell is in front of the camera and where the lens does not fold over (some that
        are not in the image are not marked either), None if all are.
    """
    with torch.inference_mode():
        if camera.model == "pinhole" and float(camera.intrinsics[0, 1]) == 0.0:
            return _by_opencv(camera, extrinsics, grid)
        height, width = camera.image_size
        image_from_cam = normalised_intrinsics(camera.intrinsics[None], (height, width))
        cells, lens = cells_and_lens(
            grid, image_from_cam, extrinsics, camera.distortion[None], camera.model, torch.float32
        )
        half = torch.tensor([width / 2, height / 2])
        pixels = _kept("pixels", (*grid.shape, 2), np.float32)
        seen = np.ones(grid.shape, np.bool_)
        for block in blocks(cells, lens, limit=1.0):
            points = block.points[0].movedim(0, -1).cpu()
            rows = slice(block.first, block.last)
            torch.addcmul(half - 0.5, points, half, out=torch.from_numpy(pixels)[rows])
            if block.outside is not None:
                seen[rows] = block.invalid()[0].logical_not().cpu().numpy()
    return pixels, seen


def _by_opencv(
    camera: Camera, extrinsics: Extrinsics, grid: BEVGrid
) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None]:
    """Compute the maps in OpenCV's one pass, which marks no cells behind the camera or beyond a fold."""
    bev_from_cam = bev_from_image(extrinsics, camera.intrinsics[None], grid)[0] @ camera.intrinsics
    pixels = _kept("pixels", (*grid.shape, 2), np.float32)
    cv2.initUndistortRectifyMap(
        camera.intrinsics.numpy(), camera.distortion.numpy(), bev_from_cam.cpu().numpy(), np.eye(3),
        grid.shape[::-1], cv2.CV_32FC2, pixels,
    )  # fmt: skip
    by_row, by_column = (part[0].float() for part in cell_sums(grid, (0.0,), None, extrinsics))
    limit = None
    if len(camera.distortion):
        limit = max_undistorted_radius(camera.distortion[None], camera.model)[0].float()
    corners = by_row[:, [0, -1]], by_column[:, [0, -1]]
    if _seen(*corners, limit).all():  # then all are: the corners' rays span a cone, and what is seen is one
        return pixels, None
    return pixels, _seen(by_row, by_column, limit).cpu().numpy()


def _seen(by_row: Tensor, by_column: Tensor, limit: Tensor | None) -> Tensor:
    """Tell whether the sum of a row's (3, U) and a column's vector (3, V) is ahead and within the limit."""
    ahead = by_row[2].unsqueeze(-1) + by_column[2] > LEAST_DEPTH
    return ahead if limit is None else ahead & _within(by_row, by_column, limit)


def _within(by_row: Tensor, by_column: Tensor, limit: Tensor) -> Tensor:
    """Tell whether x² + y² < limit² z² for the sum of a row's and a column's vector, (3, U) and (3, V)."""
    sign = torch.stack([torch.ones_like(limit), torch.ones_like(limit), -limit.square()]).unsqueeze(-1)
    row, column = ((sign * part * part).sum(0) for part in (by_row, by_column))
    left = torch.stack([*(2 * sign * by_row), row, torch.ones_like(row)], dim=1)  # (U, 5)
    right = torch.stack([*by_column, torch.ones_like(column), column])  # (5, V)
    return left @ right < 0
