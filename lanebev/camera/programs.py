"""Camera files of MATLAB, Gyroflow, instant-ngp and Nerfstudio, librealsense, Open3D, DepthAI, Metashape."""

import re
from collections.abc import Mapping
from functools import partial
from typing import Any

from lanebev.camera.choice import Readers
from lanebev.camera.named_lens import LENS_NAMES, check_lens_keys, named_lens
from lanebev.camera.parameters import CameraParameters, matrix_entries
from lanebev.camera.parsing import given_keys, mapping, number, numbers, required, stated_size, whole_number
from lanebev.numbers import shown

_GYROFLOW_MODELS = {"": "fisheye", "opencv_fisheye": "fisheye", "opencv_standard": "pinhole"}
_NERF_MODELS = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"), "pinhole"),
    "OPENCV_FISHEYE": "fisheye",
}
_REALSENSE_MODELS = ("none", "brownconrady", "inversebrownconrady", "modifiedbrownconrady")


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
    """Read a lens profile of Gyroflow, for images of ``calib_dimension``."""
    name = str(fields.get("distortion_model") or "").strip().lower()
    if name not in _GYROFLOW_MODELS or fields.get("digital_lens"):
        got = shown(fields.get("digital_lens") or name)
        raise ValueError(f"distortion_model: expected opencv_fisheye or opencv_standard, got {got}")
    lens = mapping("fisheye_params", fields["fisheye_params"])
    size = mapping("calib_dimension", required(fields, "calib_dimension"))
    matrix, distortion = numbers(lens, "camera_matrix", count=9), numbers(lens, "distortion_coeffs")
    return CameraParameters(matrix, distortion, _GYROFLOW_MODELS[name], stated_size(size, "h", "w"))


def nerf(fields: Mapping[str, Any]) -> CameraParameters:
    """Read ``transforms.json`` of instant-ngp or Nerfstudio, whose pixels are COLMAP's.

    Source: instant-ngp, scripts/colmap2nerf.py; Nerfstudio, docs/quickstart/data_conventions.md.
    """
    name = str(fields.get("camera_model") or "OPENCV").strip().upper()
    if name not in _NERF_MODELS:
        raise ValueError(f"camera_model: expected one of {', '.join(_NERF_MODELS)}, got {shown(name)}")
    is_fisheye = str(fields.get("is_fisheye")).lower() == "true"
    model = "fisheye" if is_fisheye else _NERF_MODELS[name]
    check_lens_keys(fields, LENS_NAMES["pinhole"])
    fx, cx, cy = (number(fields, key) for key in ("fl_x", "cx", "cy"))
    matrix = matrix_entries(fx, number(fields, "fl_y", default=fx), cx - 0.5, cy - 0.5)
    return CameraParameters(matrix, named_lens(fields, model), model, stated_size(fields, "h", "w"))


def realsense(fields: Mapping[str, Any]) -> CameraParameters:
    """Read the intrinsics of Intel's librealsense: JSON, YAML, or what ``rs-enumerate-devices -c`` prints."""
    fields = {key.lower(): value for key, value in fields.items()}
    check_lens_keys(fields, ("coeffs", "distortion"))
    distortion = numbers(fields, "coeffs") if fields.get("coeffs") is not None else []
    stated = str(fields.get("model") or fields.get("distortion") or "none")
    name = re.sub(r"[\W_]", "", stated.lower().removeprefix("distortion."))
    if name not in _REALSENSE_MODELS or (name != "brownconrady" and any(distortion)):
        raise ValueError(
            f"model: expected brown_conrady, or coeffs of zeros, got {shown(stated)}; calibrate by OpenCV"
        )
    if name != "none" and not distortion:
        raise ValueError(f"coeffs: expected the coefficients of {shown(stated)}, got none; add the entry")
    fx, fy, cx, cy = (number(fields, key) for key in ("fx", "fy", "ppx", "ppy"))
    return CameraParameters(matrix_entries(fx, fy, cx, cy), distortion, "pinhole", stated_size(fields))


def open3d(fields: Mapping[str, Any]) -> CameraParameters:
    """Read the intrinsics of Open3D, whose matrix is given column by column, also row by row."""
    matrix = numbers(fields, "intrinsic_matrix", count=9)
    if not (matrix[2] or matrix[5]):
        matrix = [*matrix[0::3], *matrix[1::3], *matrix[2::3]]
    return CameraParameters(matrix, [], "pinhole", stated_size(fields))


def depthai_cameras(content: Any) -> Readers:
    """Return readers of the cameras of a calibration of Luxonis' DepthAI, by the numbers of their sockets."""
    data = content.get("cameraData") if isinstance(content, Mapping) else None
    pairs = (
        [each for each in data if isinstance(each, list) and len(each) == 2] if isinstance(data, list) else []
    )
    return {str(socket): partial(_depthai, mapping("cameraData", fields)) for socket, fields in pairs}


def _depthai(fields: Mapping[str, Any]) -> CameraParameters:
    """Read a camera of ``cameraData``; ``cameraType`` 1 is a fisheye, of whose coefficients four count."""
    matrix, distortion = numbers(fields, "intrinsicMatrix", count=9), numbers(fields, "distortionCoeff")
    is_fisheye = str(fields.get("cameraType")).strip().lower() in ("1", "fisheye")
    return CameraParameters(matrix, distortion, "fisheye" if is_fisheye else "pinhole", stated_size(fields))


def metashape(fields: Mapping[str, Any]) -> CameraParameters:
    """Read a camera that Metashape exported in its own XML.

    Source: Agisoft Metashape, User Manual, "Camera models": cx and cy are relative to the middle of the
    image, the centre of the first pixel is at (0.5, 0.5), and P1 and P2 are OpenCV's p2 and p1.
    """
    name = str(fields["projection"]).strip().lower()
    unfit = [key for key in given_keys(fields, "k4", "p3", "p4") if number(fields, key)]
    if name != "frame" or unfit:
        got = unfit[0] if unfit else shown(name)
        raise ValueError(f"projection: expected frame with k1 k2 k3 p1 p2, got {got}; export it as OpenCV's")
    check_lens_keys(fields, ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"))
    width, height = whole_number(fields, "width"), whole_number(fields, "height")
    focal = number(fields, "f")
    cx, cy, b1, b2, k1, k2, k3, p1, p2 = (
        number(fields, key, default=0.0) for key in ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "p1", "p2")
    )
    x, y = 0.5 * width + cx - 0.5, 0.5 * height + cy - 0.5
    return CameraParameters(
        [focal + b1, b2, x, 0.0, focal, y, 0.0, 0.0, 1.0], [k1, k2, p2, p1, k3], "pinhole", (height, width)
    )
