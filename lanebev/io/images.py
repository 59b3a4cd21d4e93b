"""Images in and out: upright, 8 bits, whole."""

from __future__ import annotations

import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm", ".jfif", ".jp2")


_UNREADABLE = (  # what Pillow raises of files that are cut or none
    OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, EOFError, MemoryError,
    struct.error, zlib.error, Image.DecompressionBombError,
)  # fmt: skip


def is_image(path: str | Path) -> bool:
    """Return whether there is a file with an image's suffix."""
    return Path(path).suffix.lower() in IMAGE_SUFFIXES and Path(path).is_file()


def read_image(path: str | Path) -> NDArray[np.uint8]:
    """Read an image as (H, W, 3) uint8 RGB, upright by its EXIF orientation, as viewers and OpenCV show it.

    A file that is cut is an error, not an image with a grey half.

    Raises:
        ValueError: the file is missing, cut or no image.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd EXIF; errors are errors
            with Image.open(path) as image:
                return np.asarray(_eight_bit(_upright(image)).convert("RGB"))
    except _UNREADABLE as error:
        if isinstance(error, UnidentifiedImageError):
            reason = "no image or one whose header is cut"
        else:
            reason = " ".join((getattr(error, "strerror", None) or str(error)).split()).lower()[:100]
            reason = reason or type(error).__name__
        raise ValueError(f"image {path}: expected a whole image, got: {reason}") from error


def image_size(path: str | Path) -> tuple[int, int] | None:
    """Return (height, width) of an image, None if it does not decode."""
    try:
        height, width = read_image(path).shape[:2]
    except ValueError:
        return None
    return height, width


def write_png(path: str | Path, image: NDArray[np.uint8]) -> None:
    """Write (H, W, 3) uint8 RGB to a PNG file."""
    Image.fromarray(image).save(path)


def _upright(image: Image.Image) -> Image.Image:
    try:
        turned = image.getexif().get(ExifTags.Base.Orientation, 1) != 1
    except (SyntaxError, struct.error, ValueError, KeyError, TypeError):  # of odd EXIF
        turned = False
    return ImageOps.exif_transpose(image) if turned else image


def _eight_bit(image: Image.Image) -> Image.Image:
    """Convert 16-bit grey by its own scale; ``convert`` would clip it at 255.

    Raises:
        OSError: floating-point pixels, whose scale is unknown.
    """
    if image.mode == "F":
        raise OSError("floating point, expected 8 or 16 bits")
    if not image.mode.startswith("I"):
        return image
    return Image.fromarray((np.asarray(image).clip(0, 65535) / 257).round().astype(np.uint8))
