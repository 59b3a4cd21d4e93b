"""Camera files in JSON of MATLAB and of Gyroflow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lanebev.camera.parameters import CameraParameters
from lanebev.camera.parsing import mapping, numbers, required, whole_number
from lanebev.numbers import shown

_GYROFLOW_MODELS = {"": "fisheye", "opencv_fisheye": "fisheye", "opencv_standard": "pinhole"}


def matlab(fields: Mapping[str, Any]) -> CameraParameters:
    """Read ``jsonencode`` of MATLAB's ``toStruct(cameraParameters)`` or of a ``cameraIntrinsics`` object.

    Source: MATLAB, ``cameraIntrinsicsToOpenCV``. The centre of its first pixel is at (1, 1), and
    ``IntrinsicMatrix`` is the transposed matrix.
    """
    if fields.get("K") is not None:
        fx, skew, cx, _, fy, cy, *_ = numbers(fields, "K", count=9)
    elif fields.get("IntrinsicMatrix") is not None:
        fx, _, _, skew, fy, _, cx, cy, _ = numbers(fields, "IntrinsicMatrix", count=9)
    else:
        (fx, fy), (cx, cy) = (numbers(fields, key, count=2) for key in ("FocalLength", "PrincipalPoint"))
        skew = 0.0
    radial = numbers(fields, "RadialDistortion")
    if len(radial) not in (2, 3):
        raise ValueError(f"RadialDistortion: expected 2 or 3 numbers, got {len(radial)}")
    p1, p2 = numbers(fields, "TangentialDistortion", count=2)
    height, width = numbers(fields, "ImageSize", count=2)
    matrix = [fx, skew, cx - 1, 0.0, fy, cy - 1, 0.0, 0.0, 1.0]
    return CameraParameters(
        matrix, [*radial[:2], p1, p2, *radial[2:]], "pinhole", (round(height), round(width))
    )


def gyroflow(fields: Mapping[str, Any]) -> CameraParameters:
    """Read a lens profile of Gyroflow, for images of ``calib_dimension``.

    Raises:
        ValueError: the camera distorts its images once more, or the lens model is none of OpenCV's.
    """
    name = str(fields.get("distortion_model") or "").strip().lower()
    if name not in _GYROFLOW_MODELS or fields.get("digital_lens"):
        got = shown(fields.get("digital_lens") or name)
        raise ValueError(f"distortion_model: expected opencv_fisheye or opencv_standard, got {got}")
    lens = mapping("fisheye_params", fields["fisheye_params"])
    size = mapping("calib_dimension", required(fields, ["calib_dimension"]))
    matrix, distortion = numbers(lens, "camera_matrix", count=9), numbers(lens, "distortion_coeffs")
    return CameraParameters(
        matrix, distortion, _GYROFLOW_MODELS[name], (whole_number(size, "h"), whole_number(size, "w"))
    )
