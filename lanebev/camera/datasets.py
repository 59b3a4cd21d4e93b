"""Camera files of KITTI, of COLMAP and of WoodScape."""

import math
import re
import struct
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lanebev.camera.approximation import fov_model, kannala_brandt_like, radial_camera
from lanebev.camera.choice import Readers, unique_names
from lanebev.camera.parameters import (
    OFF_CENTRE,
    CameraParameters,
    centre_offset,
    left_square,
    matrix_entries,
    size_of_images,
)
from lanebev.camera.parsing import mapping, number, stated_size
from lanebev.numbers import finite_numbers, shown
from lanebev.plain_yaml import once

_KITTI = re.compile(r"^[ \t]*P(?:_rect_)?\d+[ \t]*:", re.MULTILINE | re.ASCII)
_KITTI_KEY = re.compile(r"\s*(P|S|[KD]_)")
_COLMAP = re.compile(r"^[ \t]*(-?\d+)[ \t]+([A-Z_]+)[ \t]+(\d{1,6})[ \t]+(\d{1,6})[ \t]+(.+)$", re.MULTILINE)
_COLMAP_MODELS = {  # names of their parameters; the first ten are in the order of their numbers
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
}
_COLMAP_NUMBERS = [*_COLMAP_MODELS][:10]
_LARGEST_BIN = 1_000_000  # bytes
_KITTI_SIZES = {  # focal length of the rectified cameras of each recording day -> (height, width)
    721.5377: (375, 1242),
    707.0493: (370, 1224),
    718.3351: (374, 1238),
    707.0912: (370, 1226),
    718.856: (376, 1241),
}
KITTI_CAMERAS = 4
"""Most cameras of KITTI's, of which the left colour camera is the usual one; others' files have more."""

_KITTI_SPREAD = 8  # px, more than rectified images of one camera differ by


def is_kitti(text: str) -> bool:
    """Return whether a text has a KITTI projection matrix."""
    return _KITTI.search(text) is not None


def kitti_cameras(text: str, image_size: tuple[int, int] | None) -> Readers:
    """Return readers of the rectified cameras of KITTI's ``calib.txt`` or ``calib_cam_to_cam.txt``.

    The left colour camera is the usual one.
    """
    lines = (line.split(":", 1) for line in text.splitlines() if ":" in line)
    entries = once((name.strip(), values) for name, values in lines if _KITTI_KEY.match(name))
    names = [kind.format(i) for kind in ("P_rect_{:02d}", "P{}") for i in (2, 3, 0, 1, *range(4, 10))]
    found = {name: partial(_kitti, entries, name, image_size) for name in names if name in entries}
    if not found:
        raise ValueError(
            "expected P_rect_02 or P2 of KITTI, or keys such as fx: 1150, got "
            f"{shown(next(iter(text.split()), ''))}"
        )
    return found


def _kitti(entries: Mapping[str, str], name: str, image_size: tuple[int, int] | None) -> CameraParameters:
    """Read the entry of a rectified camera; for images as it took them, of another size, its K and D."""
    number = name.removeprefix("P_rect_")
    taken, rectified, own, lens = (
        entries.get(f"{key}_{number}", "").split() for key in ("S", "S_rect", "K", "D")
    )
    has_both = all((taken, rectified, own, lens))
    if has_both and image_size == _kitti_size("S", taken) != _kitti_size("S_rect", rectified):
        return CameraParameters(
            finite_numbers("K", own, 9), finite_numbers("D", lens, 5), "pinhole", image_size
        )
    projection = finite_numbers(name, entries[name].split(), 12)
    known = next((s for f, s in _KITTI_SIZES.items() if abs(f - projection[0]) < 1e-3), None)
    if (size_name := name.replace("P", "S", 1)) in entries:
        size: tuple[int, int] | None = _kitti_size(size_name, entries[size_name].split())
    else:
        size = size_of_images("KITTI's of this focal length", image_size, known, _KITTI_SPREAD)
    if size is None:
        raise ValueError(
            "expected the image size, got none, and the focal length is none of KITTI's; "
            "add a line 'S_rect_02: WIDTH HEIGHT' with P_rect_02, or use the short YAML"
        )
    matrix = left_square(projection)
    if size_name not in entries and centre_offset(matrix, size) > OFF_CENTRE:
        raise ValueError(
            f"{name}: expected a camera of the images' {size[1]} x {size[0]} px, got a principal point of "
            f"{matrix[2]:g}, {matrix[5]:g}; give the images in their original size, or add "
            "'S_rect_02: WIDTH HEIGHT'"
        )
    return CameraParameters(matrix, [], "pinhole", size)


def _kitti_size(name: str, values: list[str]) -> tuple[int, int]:
    width, height = finite_numbers(name, values, 2)
    return round(height), round(width)


def is_colmap(text: str) -> bool:
    """Return whether a text has a line of COLMAP's ``cameras.txt``."""
    return _COLMAP.search(text) is not None


def colmap_text(path: Path) -> str:
    """Return COLMAP's ``cameras.bin`` as its ``cameras.txt`` would be.

    Source: COLMAP, scripts/python/read_write_model.py.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(_LARGEST_BIN)
        (count,), place, lines = struct.unpack_from("<Q", data), 8, []
        for _ in range(count):
            camera, model, width, height = struct.unpack_from("<iIQQ", data, place)
            name = _COLMAP_NUMBERS[model]
            values = struct.unpack_from(f"<{len(_COLMAP_MODELS[name].split())}d", data, place + 24)
            place += 24 + 8 * len(values)
            lines.append(" ".join(map(str, (camera, name, width, height, *values))))
    except OSError as error:
        raise ValueError(error.strerror or str(error)) from error
    except (struct.error, IndexError):
        lines = []
    if place < len(data) or not lines:
        raise ValueError(
            "a cameras.bin of COLMAP that is cut, or has a camera model that is not known here; convert it "
            "by colmap model_converter --output_type TXT"
        )
    return "\n".join(lines)


def colmap_cameras(text: str) -> Readers:
    """Return readers of the cameras of COLMAP's ``cameras.txt``, by their numbers."""
    found = _COLMAP.findall(text)
    names = unique_names([number for number, *_ in found])
    return {name: partial(_colmap, *values) for name, (_, *values) in zip(names, found, strict=True)}


def _colmap(name: str, width: str, height: str, values: str) -> CameraParameters:
    """Read a camera's line.

    Source: COLMAP, sensor/models.h; the centre of its first pixel is at (0.5, 0.5).
    """
    if name not in _COLMAP_MODELS:
        raise ValueError(f"model: expected one of {', '.join(_COLMAP_MODELS)}, got {name}")
    names = _COLMAP_MODELS[name].split()
    given = dict(zip(names, finite_numbers(name, values.split(), len(names)), strict=True))
    fx, fy = (given.get(key, given.get("f", 0.0)) for key in ("fx", "fy"))
    model = "fisheye" if name.endswith("FISHEYE") else "pinhole"
    order = "k1 k2 k3 k4" if model == "fisheye" else "k1 k2 p1 p2 k3 k4 k5 k6"
    distortion = [given.get(key, 0.0) for key in order.split()]
    cx, cy, size = given["cx"] - 0.5, given["cy"] - 0.5, (int(height), int(width))
    if name == "FOV":
        return radial_camera((fx, fy), (cx, cy), size, partial(fov_model, omega=given["omega"]))
    return CameraParameters(matrix_entries(fx, fy, cx, cy), distortion, model, size)


def is_woodscape(record: Any) -> bool:
    """Return whether a content is that of WoodScape's calibration of a fisheye."""
    intrinsic = record.get("intrinsic") if isinstance(record, Mapping) else None
    return isinstance(intrinsic, Mapping) and intrinsic.get("model") == "radial_poly"


def woodscape(record: Mapping[str, Any]) -> CameraParameters:
    """Return the Kannala-Brandt camera nearest to WoodScape's, of radius k1 θ + k2 θ² + k3 θ³ + k4 θ⁴ px.

    Source: WoodScape (Yogamani et al. 2019), scripts/calibration/projection.py.
    """
    fields = mapping("intrinsic", record["intrinsic"])
    height, width = stated_size(fields)
    slopes = [number(fields, key) for key in ("k1", "k2", "k3", "k4")]
    aspect = number(fields, "aspect_ratio")
    cx = 0.5 * (width - 1) + number(fields, "cx_offset")
    cy = 0.5 * (height - 1) + number(fields, "cy_offset")
    if not (slopes[0] > 0 and aspect > 0):
        raise ValueError(f"k1, aspect_ratio: expected numbers above 0, got {slopes[0]:g}, {aspect:g}")
    corner = math.hypot(max(cx, width - 1 - cx), max(cy, height - 1 - cy) / aspect) / slopes[0]
    relative = np.array(slopes) / slopes[0]
    scale, distortion = kannala_brandt_like(
        lambda angle: angle * np.polyval(relative[::-1], angle), corner, slopes[0]
    )
    fx = scale * slopes[0]
    return CameraParameters(matrix_entries(fx, fx * aspect, cx, cy), distortion, "fisheye", (height, width))
