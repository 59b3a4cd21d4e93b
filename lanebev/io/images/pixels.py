"""Images in and out: upright, 8 bits, whole."""

import struct
import warnings
import zlib
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from lanebev.io.images.names import IMAGE_SUFFIXES
from lanebev.numbers import stand_in

_LYING = (5, 6, 7, 8)  # EXIF orientations whose images are shown with their sides exchanged
_DARK = 24  # an image with no brighter value, of 255, is dark; 12 bits in 16 give 15 at most
_UNREADABLE = (  # Pillow's errors for files that are cut or no images
    OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, EOFError, MemoryError,
    struct.error, zlib.error, Image.DecompressionBombError,
)  # fmt: skip


def is_image(path: str | Path) -> bool:
    """Return whether there is a file with an image's suffix, or a link to one that is not there."""
    path = Path(path)
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        return False
    return path.is_file() or (path.is_symlink() and not path.exists())


def read_image(path: str | Path) -> NDArray[np.uint8]:
    """Read an image as (H, W, 3) uint8 RGB, upright by its EXIF orientation, as viewers and OpenCV show it.

    A file that is cut is an error, not an image with a grey half; an animation is one too, not its first
    picture.

    Raises:
        ValueError: the file is missing, cut, damaged or no image, or contains several.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about odd EXIF; errors are raised
            with Image.open(path) as image:
                _check_single(image)
                pixels = np.asarray(_eight_bit(_upright(image)).convert("RGB"))
                if image.format in ("JPEG", "MPO") and is_damaged_jpeg(Path(path).read_bytes()):
                    raise OSError("damaged JPEG data")
                return pixels
    except _UNREADABLE as error:
        if isinstance(error, UnidentifiedImageError):
            with open(path, "rb") as file:
                reason = (
                    stand_in(file.read(100))
                    or "no image, one whose header is cut, or other pixels than of 8 or 16 bits"
                )
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


def stated_size(path: str | Path) -> tuple[int, int] | None:
    """Return (height, width) of an image as shown, by its header alone; None if that cannot be read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                width, height = image.size  # of a TIFF already upright
                lying = image.format != "TIFF" and _orientation(image) in _LYING
                return (width, height) if lying else (height, width)
    except _UNREADABLE:
        return None


def dark_remark(image: NDArray[np.uint8]) -> str:
    """Return a remark on an image whose brightest pixel is nearly black; else nothing."""
    if not 0 < image.max() < _DARK:
        return ""
    return (
        f"the first image is nearly black, its brightest value {image.max()} of 255; are values of 10 or 12 "
        "bits stored in 16? multiply them by 64 or 16"
    )


def write_png(path: str | Path, image: NDArray[np.uint8]) -> None:
    """Write (H, W, 3) uint8 RGB to a PNG file."""
    Image.fromarray(image).save(path)


def is_damaged_jpeg(data: bytes) -> bool:
    """Return whether ffmpeg finds damage in a JPEG file, which Pillow silently shows as garbage.

    Damage that happens to be valid code stays unnoticed.
    """
    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = {"err_detect": "explode"}
    try:
        decoder.decode(av.Packet(data))
    except av.error.InvalidDataError:
        return True
    except av.error.FFmpegError:  # kinds of JPEG that ffmpeg does not know
        return False
    return False


def _check_single(image: Image.Image) -> None:
    """Raise OSError if a file is an animation or has pages of one size; a camera file has previews."""
    count = getattr(image, "n_frames", 1)
    if count == 1 or image.format not in ("PNG", "TIFF", "WEBP"):
        return
    size = image.size
    image.seek(1)
    same = image.size == size
    image.seek(0)
    if same:
        raise OSError(f"{count} pictures in one file; write them as a video or as a folder of images")


def _orientation(image: Image.Image) -> int:
    """Return the orientation in the image's EXIF data, 1 if there is none."""
    try:
        return int(image.getexif().get(ExifTags.Base.Orientation, 1))
    except (SyntaxError, struct.error, ValueError, KeyError, TypeError):  # of odd EXIF
        return 1


def _upright(image: Image.Image) -> Image.Image:
    return image if _orientation(image) == 1 else ImageOps.exif_transpose(image)


def _eight_bit(image: Image.Image) -> Image.Image:
    """Convert 16-bit grey by its own scale; ``convert`` would clip it at 255."""
    if image.mode == "F":
        raise OSError("floating point, expected 8 or 16 bits")
    if not image.mode.startswith("I"):
        return image
    return Image.fromarray((np.asarray(image).clip(0, 65535) / 257).round().astype(np.uint8))
