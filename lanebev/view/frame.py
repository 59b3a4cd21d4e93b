"""The resampling of camera frames as files hold them: one image of bytes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from lanebev.camera.model import Camera
from lanebev.types import Extrinsics
from lanebev.view.cells import cells_and_lens
from lanebev.view.grid import BEVGrid
from lanebev.view.sampling import MapSize, normalised_intrinsics, sampling_maps


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
    with torch.inference_mode():
        image_from_cam = normalised_intrinsics(camera.intrinsics[None], (height, width))
        cells, lens = cells_and_lens(
            grid, image_from_cam, extrinsics, camera.distortion[None], camera.model, torch.float32
        )
        (coordinates,), valid = sampling_maps(cells, lens, [MapSize(height, width)], (height, width))
        half = coordinates.new_tensor([0.5 * width, 0.5 * height]).view(2, 1, 1)
        pixels: Any = (coordinates[0] * half + (half - 0.5)).cpu().numpy()
    bev: Any = cv2.remap(frame, pixels[0], pixels[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return bev, valid[0, 0].cpu().numpy()
