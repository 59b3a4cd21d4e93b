"""Several cameras of OpenCV's keys or our own in a file: of its stereo calibration, or below their names."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from lanebev.camera.choice import Readers
from lanebev.camera.formats import MATRIX_KEYS, SHARED_KEYS, opencv_or_ros, spelled
from lanebev.camera.slam import is_kalibr

_HAS_CAMERA = {*MATRIX_KEYS, "fx"}
_STEREO = [  # keys of matrix and coefficients of both cameras, as of OpenCV's stereo_calib
    [(f"{matrix}{side}", f"{lens}{side}") for side in sides]
    for matrix, lens in (("M", "D"), ("K", "D"), ("cameraMatrix", "distCoeffs"), ("mtx", "dist"))
    for sides in ("12", "LR")
]


def named_cameras(content: Any, rectified: bool, image_size: tuple[int, int] | None) -> Readers:
    """Return readers of the cameras that a file has below their names; none for other files."""
    fields = content if isinstance(content, Mapping) else {}
    only = next(iter(fields.values())) if len(fields) == 1 else None
    fields = only if isinstance(only, Mapping) else fields
    if len(fields) < 2 or not all(
        isinstance(each, Mapping) and _HAS_CAMERA & {*map(spelled, each)} and not is_kalibr(each)
        for each in fields.values()
    ):
        return {}
    return {name: partial(opencv_or_ros, each, rectified, image_size) for name, each in fields.items()}


def stereo_cameras(fields: Mapping[str, Any], rectified: bool, image_size: tuple[int, int] | None) -> Readers:
    """Return readers of both cameras of OpenCV's stereo calibration, the left one first; none for others.

    Their names are those of their matrices.
    """
    pair = next((each for each in _STEREO if all(key in fields for keys in each for key in keys)), [])
    of_both = {key: value for key, value in fields.items() if spelled(key) in SHARED_KEYS}
    own = {matrix: {**of_both, "K": fields[matrix], "D": fields[lens]} for matrix, lens in pair}
    return {name: partial(opencv_or_ros, each, rectified, image_size) for name, each in own.items()}
