"""Convert frames of cameras and decoders to the network's input, and resize them."""

import math
import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lanebev.batch import readable
from lanebev.geometry.precision import common_dtype
from lanebev.types import check_tensor

_WIDTH_STEP = 64  # px
_LARGEST = 8.0  # largest value of an image in [0, 1] after changes of contrast; one in [0, 255] has more
_SMALLEST = -0.75  # likewise; one that was normalised by mean and standard deviation, or to [-1, 1], has less


def check_frame(frame: NDArray[np.uint8] | Tensor, image_size: tuple[int, int]) -> Tensor:
    """Return a frame as a tensor with channels first, without a copy.

    Args:
        frame: (H, W, 3) uint8, or a tensor (3, H, W) or (1, 3, H, W), uint8 or floating point in [0, 1].
        image_size: (H, W) px, as expected.

    Returns:
        (3, H, W).
    """
    height, width = image_size
    if isinstance(frame, np.ndarray):
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            got = f"got {frame.shape} {frame.dtype}; {_remedy(frame, image_size)}"
            raise ValueError(f"frame: expected ({height}, {width}, 3) uint8, the camera's size, {got}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about read-only arrays: nothing writes it
            return torch.from_numpy(np.ascontiguousarray(frame)).permute(2, 0, 1)
    if not isinstance(frame, Tensor):
        raise TypeError(
            f"frame: expected a NumPy array or a tensor, got {type(frame).__qualname__}; convert an image of "
            "PIL with np.asarray; lanes go to polylines="
        )
    if frame.shape not in ((3, height, width), (1, 3, height, width)):
        is_array = tuple(frame.shape) == (height, width, 3)
        remedy = "channels go first, see torch.movedim(frame, -1, 0)" if is_array else "see Camera.scaled"
        raise ValueError(
            f"frame: expected a tensor (3, {height}, {width}), the camera's size, got {tuple(frame.shape)}; "
            f"{remedy}"
        )
    if frame.dtype != torch.uint8:
        if not frame.is_floating_point():
            raise ValueError(f"frame: expected uint8 or floating point in [0, 1], got {frame.dtype}")
        check_scale("frame", frame)
    return frame.reshape(3, height, width)


def _remedy(frame: NDArray[np.generic], image_size: tuple[int, int]) -> str:
    """Return the remedy for an array that is no frame of this size."""
    if frame.shape == (3, *image_size):
        return "channels go last, see np.moveaxis(frame, 0, -1)"
    if frame.shape[:2] != image_size:
        return "for images of another size see Camera.scaled"
    if frame.ndim != 3 or frame.shape[2] != 3:
        return "for a grey image repeat its channel three times, of one with alpha take frame[..., :3]"
    if np.issubdtype(frame.dtype, np.floating):
        return "multiply by 255 if it is in [0, 1], then .astype('uint8')"
    return "convert to bytes 0 to 255 with .astype('uint8'), after dividing 16 bits by 257"


def check_images(image: Tensor) -> None:
    """Raise unless these are images (B, 3, H, W), or clips (B, T, 3, H, W), of floating point."""
    check_tensor("image", image)
    if image.ndim not in (4, 5) or image.shape[-3] != 3:
        raise ValueError(f"image: expected (B, 3, H, W) or (B, T, 3, H, W), got {tuple(image.shape)}")
    if not image.is_floating_point():
        raise ValueError(f"image: expected floating point in [0, 1], got {image.dtype}; divide bytes by 255")
    if 0 in image.shape[1:]:  # B may be 0
        raise ValueError(f"image: expected frames with pixels, got {tuple(image.shape)}")


def check_scale(name: str, image: Tensor) -> None:
    """Raise ValueError if a finite image is in [0, 255] or normalised instead of in [0, 1].

    Reading values on another device would wait for it; a compiled program or ``torch.vmap`` cannot read them.
    """
    if not (image.numel() and readable(image)):
        return
    smallest, largest = map(float, image.detach().nan_to_num(0.0, 0.0, 0.0).aminmax())
    if largest > _LARGEST:
        raise ValueError(f"{name}: expected values in [0, 1], got {largest:g}; divide bytes by 255")
    if smallest < _SMALLEST:
        remedy = "leave out the normalisation, which the network does itself"
        raise ValueError(f"{name}: expected values in [0, 1], got {smallest:g}; {remedy}")


def black_unless_finite(image: Tensor) -> tuple[Tensor, Tensor]:
    """Replace images that are not finite, whose product with a zero gradient would be NaN.

    Args:
        image: (B, C, H, W).

    Returns:
        the images, black where a number is not finite, or ``image`` itself if all are known to be finite; and
        (B,) bool, which are finite.
    """
    finite = image.detach().sum((1, 2, 3), dtype=common_dtype(image)).isfinite()
    if readable(finite) and bool(finite.all()):
        return image, finite
    return torch.where(finite[:, None, None, None], image, 0.0), finite


def network_image(frame: Tensor, device: torch.device) -> Tensor:
    """Return a frame (3, H, W) as the network takes it: (1, 3, H, W) in [0, 1], single precision."""
    image = frame.to(device)[None]
    return image.float().div_(255) if image.dtype == torch.uint8 else image.float()


def image_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Convert images (..., 3, H, W), of bytes or in [0, 1], to (..., H, W, 3) bytes."""
    pixels = image if image.dtype == torch.uint8 else (255 * image).round().clamp(0, 255).byte()
    return pixels.movedim(-3, -1).contiguous().cpu().numpy()


def resized_size(image_size: tuple[int, int], network_width: int, pixels: int | None) -> tuple[int, int]:
    """Compute the size (h, w) px of a network's input for images of (H, W) px.

    Args:
        image_size: (H, W).
        network_width: least w.
        pixels: number of pixels that the input should have: w is as large as this allows, in steps of 64 px,
            and at most W. None: w is ``network_width``.
    """
    height, width = map(int, image_size)  # torch.jit.trace has tensors for them
    wanted = network_width
    if pixels is not None:
        equal = min(math.sqrt(pixels * width / height), width)
        wanted = max(network_width, _WIDTH_STEP * int(equal / _WIDTH_STEP))
    return max(32, 32 * round(height * wanted / width / 32)), wanted


def resize_image(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize images (B, C, H, W) to (h, w) px, bilinearly and without aliases; the dtype stays."""
    if size == image.shape[-2:]:
        return image
    resized = nn.functional.interpolate(
        image.to(common_dtype(image)),  # the CPU has no kernel of half precision
        size=size,
        mode="bilinear",
        antialias=True,
        align_corners=False,
    )
    return resized.to(image.dtype)
