"""Convert frames of cameras and decoders to the network's input."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def check_frame(frame: NDArray[np.uint8] | Tensor, image_size: tuple[int, int]) -> Tensor:
    """Return a frame as a tensor with channels first, without a copy.

    Args:
        frame: (H, W, 3) uint8, or a tensor (3, H, W) or (1, 3, H, W), uint8 or floating point in [0, 1].
        image_size: (H, W) px, as expected.

    Returns:
        (3, H, W).

    Raises:
        TypeError: neither an array nor a tensor.
        ValueError: another shape or type of number.
    """
    height, width = image_size
    if isinstance(frame, np.ndarray):
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            got = f"got {frame.shape} {frame.dtype}; {_remedy(frame, image_size)}"
            raise ValueError(f"frame: expected ({height}, {width}, 3) uint8, the camera's size, {got}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of arrays that must not be written: it is not
            return torch.from_numpy(np.ascontiguousarray(frame)).permute(2, 0, 1)
    if not isinstance(frame, Tensor):
        raise TypeError(
            f"frame: expected an array or a tensor, got {type(frame).__qualname__}; lanes go to polylines="
        )
    if frame.shape not in ((3, height, width), (1, 3, height, width)):
        raise ValueError(
            f"frame: expected a tensor (3, {height}, {width}), the camera's size, got {tuple(frame.shape)}; "
            "see Camera.scaled"
        )
    if frame.dtype != torch.uint8 and not frame.is_floating_point():
        raise ValueError(f"frame: expected uint8 or floating point in [0, 1], got {frame.dtype}")
    return frame.reshape(3, height, width)


def _remedy(frame: NDArray[np.generic], image_size: tuple[int, int]) -> str:
    """Return what to do about an array that is no frame of this size."""
    if frame.shape[:2] != image_size:
        return "for images of another size see Camera.scaled"
    if frame.ndim != 3 or frame.shape[2] != 3:
        return "for a grey image repeat its channel three times"
    return "convert to bytes 0 to 255 with .astype('uint8')"


def network_image(frame: Tensor, device: torch.device) -> Tensor:
    """Return a frame (3, H, W) as the network takes it: (1, 3, H, W) in [0, 1], single precision."""
    image = frame.to(device)[None]
    return image.float().div_(255) if image.dtype == torch.uint8 else image.float()
