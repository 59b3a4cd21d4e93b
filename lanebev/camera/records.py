"""Cameras of data sets in JSON, of Autoware and of OpenCV's interactive calibration.

Each is a record with the camera matrix under a name of the data set's or the program's own.
"""

from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

from lanebev.camera.choice import Readers, unique_names
from lanebev.camera.datasets import is_woodscape, woodscape
from lanebev.camera.formats import DISTORTION_KEYS, stated_model, with_sides
from lanebev.camera.named_lens import LENS_NAMES, check_lens_keys, stated_lens
from lanebev.camera.parameters import (
    OFF_CENTRE,
    CameraParameters,
    centre_offset,
    matrix_entries,
    size_of_images,
)
from lanebev.camera.parsing import camera_matrix, given_keys, listed_size, number, whole_number

Record = Mapping[str, Any]


class _Layout(NamedTuple):
    """The keys under which a data set states its cameras.

    Attributes:
        whose: its name, for messages.
        matrix: key of the camera matrix.
        images: (height, width) px of its images, for records without a size.
        sides: key of width and height in one list, px; else they have keys of their own.
        model: its lens model, where the record names none.
        rectified: key of the camera matrix of rectified images.
    """

    whose: str
    matrix: str
    images: tuple[int, int] = (0, 0)
    sides: str = ""
    model: str = "pinhole"
    rectified: str = ""


_LAYOUTS = (
    _Layout("nuScenes'", "camera_intrinsic", (900, 1600)),
    _Layout("OpenLane's", "intrinsic", (1280, 1920)),
    _Layout("ONCE's", "cam_intrinsic", (1020, 1920)),
    _Layout("A2D2's", "CamMatrixOriginal", sides="Resolution", rectified="CamMatrix"),
    _Layout("ZOD's", "intrinsics", sides="image_dimensions", model="fisheye"),
    _Layout("DAIR-V2X's", "cam_K", (1080, 1920)),
    _Layout("Autoware's", "CameraMat", sides="ImageSize"),
    _Layout("opencv_interactive-calibration's", "cameraMatrix", sides="cameraResolution"),
)
_CITYSCAPES = _Layout("Cityscapes'", "intrinsic", (1024, 2048))  # by numbers with names
_LENS_KEYS = (*DISTORTION_KEYS, "camera_distortion", "camera_dist_coeffs", "Distortion", "cam_D", "DistCoeff")
_PLACES = ("calib", "cameras")  # keys below which ONCE and A2D2 have their cameras


def record_cameras(content: Any, image_size: tuple[int, int] | None, rectified: bool) -> Readers:
    """Return readers of the cameras of a data set's JSON; none for other files.

    Their names are those of the file, in a list their tokens (nuScenes) or ``name``, or their places if these
    do not tell them apart.
    """
    if isinstance(content, list):
        records = [each for each in content if _layout(each)]
        names = [str(each.get("token") or each.get("name")) for each in records]
        named = dict(zip(unique_names(names), records, strict=True))
    elif is_woodscape(content):
        return {"": partial(woodscape, content)}
    elif _layout(content):
        named = {"": content}
    else:
        places = [content, *(content[key] for key in _PLACES if isinstance(content.get(key), Mapping))]
        named = {key: each for place in places for key, each in place.items() if _layout(each)}
    return {name: partial(_read, record, image_size, rectified) for name, record in named.items()}


def _layout(record: Any) -> _Layout | None:
    """Return the layout of a record; None if it is no camera's."""
    if not isinstance(record, Mapping):
        return None
    if _named_numbers(record):
        return _CITYSCAPES
    fits = (each for each in _LAYOUTS if record.get(each.matrix) and (not each.sides or each.sides in record))
    return next(fits, None)


def _named_numbers(record: Record) -> Record | None:
    """Return fx, fy and the principal point by name, which stand for the matrix; None without them."""
    found = (record.get(key) for key in ("intrinsic", "intrinsics", "camera_matrix"))
    return next((each for each in found if isinstance(each, Mapping) and "fx" in each), None)


def _read(record: Record, image_size: tuple[int, int] | None, rectified: bool) -> CameraParameters:
    """Read a record; the lens beside the matrix counts, under any of its names."""
    layout = _layout(record) or _LAYOUTS[0]
    if rectified and layout.rectified:
        matrix = camera_matrix(record, layout.rectified)
        return CameraParameters(matrix, [], "pinhole", _size(matrix, record, image_size, layout))
    if named := _named_numbers(record):
        record = {**record, **named}  # whose lens and size count too
        fx, fy, cx, cy = (number(record, *keys) for keys in (("fx",), ("fy",), ("cx", "u0"), ("cy", "v0")))
        matrix = matrix_entries(fx, fy, cx, cy)
    else:
        matrix = camera_matrix(record, layout.matrix)
        if _is_waymos(matrix):
            record = {**record, "distortion": matrix[4:]}
            matrix = matrix_entries(*matrix[:4])
    check_lens_keys(record, (*_LENS_KEYS, *LENS_NAMES["pinhole"]))
    model = "fisheye" if record.get("Lens") == "Fisheye" else stated_model(record, layout.model)
    distortion = stated_lens(record, _LENS_KEYS, model)
    if model == "fisheye" and not distortion:
        raise ValueError("distortion: expected the coefficients of a fisheye, got none; add the entry")
    return CameraParameters(matrix, distortion, model, _size(matrix, record, image_size, layout))


def _is_waymos(values: list[float]) -> bool:
    """Return whether nine numbers are Waymo's fx fy cx cy k1 k2 p1 p2 k3, and no camera matrix."""
    return values[8] != 1.0 and values[1] > 0.5 * values[0] > 0.0


def _size(
    matrix: list[float], record: Record, image_size: tuple[int, int] | None, layout: _Layout
) -> tuple[int, int]:
    """Return the size (height, width) that a record states; else the data set's, or that of the images.

    Other programs write such records for images of other sizes. Images of another size are those of the
    record if its principal point is less than half as far from their centre as from that of the data set's
    images, in shares of the sides; else they were resized.
    """
    if layout.sides:
        return listed_size(record, layout.sides)
    with suppress(ValueError):  # of a list that is no size, such as that of a map
        record = with_sides({**record, "cx": matrix[2], "cy": matrix[5]})
    sides = (("height", "image_height"), ("width", "image_width"))
    if all(given_keys(record, *keys) for keys in sides):
        return whole_number(record, *sides[0]), whole_number(record, *sides[1])
    offset = centre_offset(matrix, layout.images)
    if image_size is not None and 2 * centre_offset(matrix, image_size) < offset:
        return image_size
    if image_size is None and offset > OFF_CENTRE:
        raise ValueError(
            f"expected a camera of {layout.images[1]} x {layout.images[0]} px, {layout.whose}, got a "
            f"principal point of {matrix[2]:g}, {matrix[5]:g}; add width and height beside it"
        )
    return size_of_images(layout.whose, image_size, layout.images) or layout.images
