"""Arrays and JPEG images in one ``.npz`` file."""

import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lanebev.io.output.whole_file import whole_file

_QUALITY = 94  # of JPEG


def write_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays by name, whole or not at all."""
    with whole_file(path) as whole, whole.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]  # its option has another type


def read_arrays(path: Path, names: Sequence[str], kind: str) -> list[NDArray[Any]]:
    """Read the arrays of these names."""
    try:
        with np.load(path) as file:
            return [file[name] for name in names]
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: expected {kind} with {', '.join(names)}, got: {error}") from error


def encode_jpegs(images: Iterable[NDArray[np.uint8]]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Encode RGB images (H, W, 3), one after the other.

    Returns:
        the bytes of all, and (N,) where each image's end.
    """
    options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    coded = [cv2.imencode(".jpg", image[..., ::-1], options)[1].ravel() for image in images]
    return np.concatenate(coded), np.cumsum([len(each) for each in coded])


def decode_jpeg(jpeg: NDArray[np.uint8], ends: NDArray[np.int64], index: int) -> NDArray[np.uint8]:
    """Decode one of the images of :func:`encode_jpegs`, (H, W, 3)."""
    start = ends[index - 1] if index else 0
    image = cv2.imdecode(jpeg[start : ends[index]], cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise ValueError(f"frame {index}: expected a JPEG image that decodes, got another")
    return np.asarray(image, np.uint8)
