"""Checks of the arguments of all views."""

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from lanebev.batch import readable
from lanebev.camera.parameters import OFF_CENTRE, are_swapped
from lanebev.geometry.lens import check_distortion, check_intrinsics, last_row_is_small
from lanebev.tensors import constant
from lanebev.types import Extrinsics, check_devices, check_extrinsics, check_tensor

_CORNERS = (0.3, 0.9)  # fractions of width and height below or beyond which a principal point is doubted
_MIDDLE = 0.1  # fraction of a side, less than which from the centre a principal point is in the middle
_BESIDE = -1e6  # px, place of every point in the image of a camera that cannot be used


def check_image(image: Tensor, name: str = "image") -> None:
    """Raise TypeError or ValueError unless this is a (B, C, h, w) map of floating point, h and w above 0."""
    check_tensor(name, image)
    if image.ndim != 4:
        remedy = {3: "; add a batch axis, x[None]", 5: "; flatten clips (B, T) into one batch axis"}
        got = f"{tuple(image.shape)}{remedy.get(image.ndim, '')}"
        raise ValueError(f"{name}: expected (B, C, h, w), got {got}")
    if not image.is_floating_point():
        raise ValueError(f"{name}: expected floating point, got {image.dtype}")
    if not torch.compiler.is_compiling() and 0 in image.shape[-2:]:
        raise ValueError(f"{name}: expected (B, C, h, w) with h and w of 1 or more, got {tuple(image.shape)}")


def check_size(size: object) -> None:
    """Raise TypeError unless this is a pair, (height, width), and ValueError unless both are above 0."""
    if not (isinstance(size, Sequence) and len(size) == 2):
        raise TypeError(f"image_size: expected (height, width) in px, got {size!r}")
    if not torch.compiler.is_compiling() and min(size) <= 0:
        raise ValueError(f"image_size: expected (height, width) of 1 px or more, got {size!r}")


def check_covers(image: Tensor, size: tuple[int, int]) -> None:
    """Raise ValueError if a map (B, C, h, w) has the shape of an image of (W, H) px, not of (H, W) px."""
    if torch.compiler.is_compiling():
        return
    rows, columns = image.shape[-2:]
    if are_swapped(size, (rows, columns)):
        raise ValueError(
            f"image_size: expected (height, width), got {size} with a map of {rows} x {columns} cells: are "
            "they swapped?"
        )


def check_stride(image: Tensor, stride: float | None, size: tuple[int, int]) -> None:
    """Raise ValueError if the cells of a map (B, C, h, w) of this stride do not cover an image (H, W) px.

    One cell more or less, and padding or cropping by a third, are let through; of one axis by any part, as of
    images padded to a square.
    """
    if stride is None or torch.compiler.is_compiling():
        return
    covers = (
        pixels / (1.5 * stride) - 1 <= cells <= 1.5 * pixels / stride + 1
        for cells, pixels in zip(image.shape[-2:], size, strict=True)
    )
    if not any(covers):
        raise ValueError(
            f"strides: expected about {size[0] / image.shape[-2]:.3g} px, since {image.shape[-2]} rows of a "
            f"map cover {size[0]} px, got {stride:g}; give strides in the order of the maps, and image_size "
            "of the image"
        )


def blind_unless_usable(
    intrinsics: Tensor, extrinsics: Extrinsics, distortion: Tensor | None
) -> tuple[Tensor, Extrinsics, Tensor | None]:
    """Replace cameras and poses that cannot be used by those of a camera whose image has nothing in it.

    NaN would become the value and the gradient of every cell. Transposed intrinsics would show another place;
    :func:`check_cameras` does not notice them on a GPU or in a compiled program.

    Args:
        intrinsics: (B, 3, 3).
        extrinsics: each (B,).
        distortion: (B, D), or None.
    """
    usable = intrinsics.isfinite().all(-1).all(-1) & last_row_is_small(intrinsics)
    usable = usable & sum(extrinsics[1:], extrinsics[0]).isfinite()
    if distortion is not None:
        usable = usable & distortion.isfinite().all(-1)
    if readable(usable) and bool(usable.all()):
        return intrinsics, extrinsics, distortion
    blind = constant(((1.0, 0.0, _BESIDE), (0.0, 1.0, _BESIDE), (0.0, 0.0, 1.0)), like=intrinsics)
    intrinsics = torch.where(usable[:, None, None], intrinsics, blind)
    extrinsics = Extrinsics(*(torch.where(usable, part, 0.0) for part in extrinsics))
    if distortion is not None:
        distortion = torch.where(usable.unsqueeze(-1), distortion, 0.0)
    return intrinsics, extrinsics, distortion


def check_cameras(
    image: Tensor,
    intrinsics: Tensor,
    extrinsics: Extrinsics,
    distortion: Tensor | None,
    model: str,
    name: str = "image",
) -> None:
    """Raise TypeError or ValueError unless images (B, ...) have cameras with poses, and lenses that exist.

    Args:
        image: whose device is that of all.
        intrinsics: (B, 3, 3).
        extrinsics: each (B,).
        distortion: (B, D), or None.
        model: name of the lens.
        name: of ``image``, for messages.
    """
    batch = image.shape[0]
    check_intrinsics(intrinsics, batch)
    check_extrinsics(extrinsics, batch)
    check_distortion(distortion, model, batch)
    poses = {f"extrinsics.{axis}": part for axis, part in extrinsics._asdict().items()}
    check_devices({name: image, "intrinsics": intrinsics, **poses, "distortion": distortion})


def doubt_intrinsics(intrinsics: Tensor, size: tuple[int, int]) -> None:
    """Warn if the principal points are at the upper left or lower right corner of images, or beyond.

    Such intrinsics are those of an image before it was resized, or of the image that a feature map covers,
    fractions of the sides, or inverted. Warn too if they are in the middle of images with swapped sides.
    Where reading numbers would wait for a device, there is no warning.

    Args:
        intrinsics: (..., 3, 3) px.
        size: (H, W) px.
    """
    if not (readable(intrinsics) and intrinsics.numel()):
        return
    x, y = intrinsics.detach()[..., :2, 2].unbind(-1)
    (height, width), (low, high) = size, _CORNERS
    at_corners = {
        "upper left": (x < low * width) & (y < low * height),
        "lower right": (x > high * width) & (y > high * height),
    }
    for corner, is_there in at_corners.items():
        if bool(is_there.all()):
            warnings.warn(
                "intrinsics: expected the intrinsics of the image in pixels, got a principal point at or "
                f"beyond its {corner} corner; scale the intrinsics as the image was, or with a feature map "
                "give image_size=(H, W) of the image",
                stacklevel=2,
            )
    if bool(
        _are_off(x / width, y / height, OFF_CENTRE).all() & ~_are_off(x / height, y / width, _MIDDLE).any()
    ):
        warnings.warn(
            f"intrinsics: expected those of images of (height, width) {size}, got a principal point in the "
            "middle of images with swapped sides; give (B, C, H, W), and turn the camera as the image",
            stacklevel=2,
        )


def _are_off(x: Tensor, y: Tensor, least: float) -> Tensor:
    """Return whether places in shares of the sides are further than that from the middle."""
    return torch.maximum((x - 0.5).abs(), (y - 0.5).abs()) > least
