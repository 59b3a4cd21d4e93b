"""Camera files of data sets that state no image size (KITTI, nuScenes, OpenLane), and of COLMAP."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from lanebev.camera.choice import Readers
from lanebev.camera.parameters import CameraParameters, centre_offset
from lanebev.camera.parsing import numbers, once, whole_number
from lanebev.numbers import finite_numbers, shown

_KITTI = re.compile(r"^[ \t]*P(?:_rect_)?\d+[ \t]*:", re.MULTILINE | re.ASCII)
_COLMAP = re.compile(r"^[ \t]*(\d+)[ \t]+([A-Z_]+)[ \t]+(\d{1,6})[ \t]+(\d{1,6})[ \t]+(.+)$", re.MULTILINE)
_COLMAP_MODELS = {  # names of their parameters
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}
_KITTI_SIZES = {  # focal length of the rectified cameras of each recording day -> (height, width)
    721.5377: (375, 1242),
    707.0493: (370, 1224),
    718.3351: (374, 1238),
    707.0912: (370, 1226),
    718.856: (376, 1241),
}
_KITTI_SPREAD = 8  # px, more than rectified images of one camera differ by
_NUSCENES_SIZE = (900, 1600)
_OPENLANE_SIZE = (1280, 1920)
_OFF_CENTRE = 0.2  # shares of the sides, more than any data set's principal point is off the centre


def is_kitti(text: str) -> bool:
    """Return whether a text has a KITTI projection matrix."""
    return _KITTI.search(text) is not None


def kitti_cameras(text: str, image_size: tuple[int, int] | None) -> Readers:
    """Return what reads the rectified cameras of KITTI's ``calib.txt`` or ``calib_cam_to_cam.txt``.

    The left colour camera is the usual one.
    """
    lines = (line.split(":", 1) for line in text.splitlines() if ":" in line)
    entries = once((name.strip(), values) for name, values in lines if name.strip()[:1] in ("P", "S"))
    names = [f"P_rect_{i:02d}" for i in (2, 3, 0, 1)] + [f"P{i}" for i in (2, 3, 0, 1)]
    found = {name: partial(_kitti, entries, name, image_size) for name in names if name in entries}
    if not found:
        raise ValueError(
            "expected P_rect_02 or P2 of KITTI, or keys such as fx: 1150, got "
            f"{shown(next(iter(text.split()), ''))}"
        )
    return found


def _kitti(entries: Mapping[str, str], name: str, image_size: tuple[int, int] | None) -> CameraParameters:
    """Read the entry of a rectified camera."""
    projection = finite_numbers(name, entries[name].split(), 12)
    known = next((s for f, s in _KITTI_SIZES.items() if abs(f - projection[0]) < 1e-3), None)
    if (size_name := name.replace("P", "S", 1)) in entries:
        width, height = finite_numbers(size_name, entries[size_name].split(), 2)
        size: tuple[int, int] | None = (round(height), round(width))
    else:
        size = _size("KITTI's of this focal length", image_size, known, _KITTI_SPREAD)
    if size is None:
        raise ValueError(
            "expected the image size, got none, and the focal length is none of KITTI's; "
            "add a line 'S_rect_02: WIDTH HEIGHT' with P_rect_02, or use the short YAML"
        )
    matrix = projection[0:3] + projection[4:7] + projection[8:11]
    if size_name not in entries and centre_offset(matrix, size) > _OFF_CENTRE:
        raise ValueError(
            f"{name}: expected a camera of the images' {size[1]} x {size[0]} px, got a principal point of "
            f"{matrix[2]:g}, {matrix[5]:g}; give the images as they came, or add 'S_rect_02: WIDTH HEIGHT'"
        )
    return CameraParameters(matrix, [], "pinhole", size)


def is_colmap(text: str) -> bool:
    """Return whether a text has a line of COLMAP's ``cameras.txt``."""
    return _COLMAP.search(text) is not None


def colmap_cameras(text: str) -> Readers:
    """Return what reads the cameras of COLMAP's ``cameras.txt``, by their numbers."""
    found = _COLMAP.findall(text)
    names = _telling([number for number, *_ in found])
    return {name: partial(_colmap, *values) for name, (_, *values) in zip(names, found, strict=True)}


def _telling(names: list[str]) -> list[str]:
    """Return the names of a file's cameras, or their places if these do not tell them apart."""
    return names if len(set(names)) == len(names) else [str(place) for place in range(len(names))]


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
    matrix = [fx, 0.0, given["cx"] - 0.5, 0.0, fy, given["cy"] - 0.5, 0.0, 0.0, 1.0]
    return CameraParameters(matrix, distortion, model, (int(height), int(width)))


def nuscenes_cameras(records: Sequence[Any], image_size: tuple[int, int] | None) -> Readers:
    """Return what reads the cameras of nuScenes' table ``calibrated_sensor``.

    Their names are their tokens, or their places in the table if these do not tell them apart.
    """
    cameras = [each for each in records if isinstance(each, Mapping) and each.get("camera_intrinsic")]
    if not cameras:
        raise ValueError("camera_intrinsic: expected that of a camera, got none")
    names = _telling([str(each.get("token")) for each in cameras])
    return {name: partial(_nuscenes, each, image_size) for name, each in zip(names, cameras, strict=True)}


def _nuscenes(record: Mapping[str, Any], image_size: tuple[int, int] | None) -> CameraParameters:
    """Read a record of nuScenes' table ``calibrated_sensor``; its images are undistorted.

    The table has no size of images: nuScenes' are all of one. Other programs write such tables for images of
    other sizes, some with ``width`` and ``height``. Images of another size are those of the record if its
    principal point is less than half as far from their centre as from that of nuScenes' images, in shares of
    the sides; else they were resized.
    """
    matrix = numbers(record, "camera_intrinsic", count=9)
    return _of_size(matrix, record, image_size, _NUSCENES_SIZE, "nuScenes'")


def openlane(fields: Mapping[str, Any], image_size: tuple[int, int] | None) -> CameraParameters:
    """Read the ``intrinsic`` of an OpenLane label or prediction."""
    matrix = numbers(fields, "intrinsic", count=9)
    return _of_size(matrix, fields, image_size, _OPENLANE_SIZE, "OpenLane's")


def _of_size(
    matrix: list[float],
    record: Mapping[str, Any],
    image_size: tuple[int, int] | None,
    known: tuple[int, int],
    whose: str,
) -> CameraParameters:
    """Return the camera of a data set's record: of the size that it states, the data set's, or the images'.

    Raises:
        ValueError: it states none, and the principal point is in the middle of neither.
    """
    if record.get("width") is not None and record.get("height") is not None:
        stated = (whole_number(record, "height"), whole_number(record, "width"))
        return CameraParameters(matrix, [], "pinhole", stated)
    offset = centre_offset(matrix, known)
    if image_size is not None and 2 * centre_offset(matrix, image_size) < offset:
        return CameraParameters(matrix, [], "pinhole", image_size)
    if image_size is None and offset > _OFF_CENTRE:
        raise ValueError(
            f"expected a camera of {known[1]} x {known[0]} px, {whose}, got a principal point of "
            f"{matrix[2]:g}, {matrix[5]:g}; add width and height beside it"
        )
    return CameraParameters(matrix, [], "pinhole", _size(whose, image_size, known) or known)


def _size(
    whose: str, image_size: tuple[int, int] | None, known: tuple[int, int] | None, spread: int = 0
) -> tuple[int, int] | None:
    """Return the images' size, else the data set's.

    Raises:
        ValueError: they differ: the images were resized.
    """
    if image_size and known and max(abs(image_size[0] - known[0]), abs(image_size[1] - known[1])) > spread:
        raise ValueError(
            f"expected images of about {known[1]} x {known[0]} px, {whose}, got "
            f"{image_size[1]} x {image_size[0]}; give them as they came, or the short YAML for the resized"
        )
    return image_size or known
