"""Camera files of data sets that state no image size: KITTI, nuScenes, OpenLane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lanebev.camera.parameters import CameraParameters
from lanebev.camera.parsing import numbers
from lanebev.numbers import finite_numbers

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


def kitti(text: str, image_size: tuple[int, int] | None) -> CameraParameters:
    """Read KITTI's ``calib.txt`` or ``calib_cam_to_cam.txt``: the left colour camera's rectified images."""
    entries = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    names = [f"P_rect_{i:02d}" for i in (2, 3, 0, 1)] + [f"P{i}" for i in (2, 3, 0, 1)]
    name = next((n for n in names if n in entries), None)
    if name is None:
        raise ValueError("expected a KITTI projection matrix (P_rect_02 or P2), got none of them")
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
    return CameraParameters(matrix, [], "pinhole", size)


def nuscenes(records: Sequence[Any], image_size: tuple[int, int] | None) -> CameraParameters:
    """Read records of nuScenes' table ``calibrated_sensor``, of one camera; its images are undistorted.

    The table has no size of images: nuScenes' are all of one. Other programs write such tables for images of
    other sizes. Images of another size are those of the record if its principal point is less than half as
    far from their centre as from that of nuScenes' images, in shares of the sides; else they were resized.
    """
    matrices = [
        numbers(record, "camera_intrinsic", count=9)
        for record in records
        if isinstance(record, Mapping) and record.get("camera_intrinsic")
    ]
    if not matrices or any(matrix != matrices[0] for matrix in matrices):
        raise ValueError(
            f"camera_intrinsic: expected one camera's, got {len(matrices)}; keep the record of your camera, "
            "by its token"
        )
    known_offset = _centre_offset(matrices[0], _NUSCENES_SIZE)
    if image_size is not None and 2 * _centre_offset(matrices[0], image_size) < known_offset:
        return CameraParameters(matrices[0], [], "pinhole", image_size)
    size = _size("nuScenes'", image_size, _NUSCENES_SIZE)
    return CameraParameters(matrices[0], [], "pinhole", size or _NUSCENES_SIZE)


def _centre_offset(matrix: Sequence[float], image_size: tuple[int, int]) -> float:
    """Return how far the principal point is from the centre of an image, in shares of its sides."""
    (height, width), x, y = image_size, matrix[2], matrix[5]
    return max(abs(x / width - 0.5), abs(y / height - 0.5))


def openlane(fields: Mapping[str, Any], image_size: tuple[int, int] | None) -> CameraParameters:
    """Read the ``intrinsic`` of an OpenLane label or prediction."""
    size = _size("OpenLane's", image_size, _OPENLANE_SIZE)
    return CameraParameters(numbers(fields, "intrinsic", count=9), [], "pinhole", size or _OPENLANE_SIZE)


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
