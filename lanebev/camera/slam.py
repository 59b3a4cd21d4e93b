"""Camera files of Kalibr, EuRoC, Basalt and maplab, of CamOdoCal and VINS, of ORB-SLAM and stella_vslam."""

import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from lanebev.camera.approximation import Array, double_sphere, extended_unified, fov_model, radial_camera
from lanebev.camera.choice import Readers
from lanebev.camera.named_lens import check_lens_keys
from lanebev.camera.parameters import CameraParameters, matrix_entries
from lanebev.camera.parsing import listed_size, mapping, number, numbers, required, stated_size, whole_number
from lanebev.numbers import shown

_KALIBR_MODELS = {  # camera_model, distortion_model of Kalibr, EuRoC and TUM-VI
    ("pinhole", "none"): "pinhole",
    ("pinhole", "radtan"): "pinhole",
    ("pinhole", "radial-tangential"): "pinhole",
    ("pinhole", "equi"): "fisheye",
    ("pinhole", "equidistant"): "fisheye",
    ("omni", "none"): "omni",
    ("omni", "radtan"): "omni",
}
_KALIBR_RADIAL: dict[tuple[str, str], tuple[int, int, Callable[..., Array]]] = {
    # numbers before fx in the intrinsics, and of distortion_coeffs; the distance by the angle and by these
    ("ds", "none"): (2, 0, double_sphere),
    ("eucm", "none"): (2, 0, extended_unified),
    ("pinhole", "fov"): (0, 1, fov_model),
}
_ORB_SLAM_MODELS = {  # Camera.type, or Camera.model of stella_vslam -> model and coefficients
    "pinhole": ("pinhole", "k1 k2 p1 p2 k3"),
    "perspective": ("pinhole", "k1 k2 p1 p2 k3"),
    "rectified": ("pinhole", ""),
    "kannalabrandt8": ("fisheye", "k1 k2 k3 k4"),
    "fisheye": ("fisheye", "k1 k2 k3 k4"),
}


_BASALT_MODELS = {  # camera_type -> models of Kalibr, its intrinsics, and its distortion_coeffs
    "ds": ("ds", "none", "xi alpha fx fy cx cy", ""),
    "eucm": ("eucm", "none", "alpha beta fx fy cx cy", ""),
    "pinhole": ("pinhole", "none", "fx fy cx cy", ""),
    "kb4": ("pinhole", "equidistant", "fx fy cx cy", "k1 k2 k3 k4"),
    "pinhole-radtan8": ("pinhole", "radtan", "fx fy cx cy", "k1 k2 p1 p2 k3 k4 k5 k6"),
}


def as_kalibr(fields: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a calibration of Basalt or maplab with the keys of Kalibr's camera chain; another as it is.

    Source: Basalt, "calibration.json"; aslam_cv2, NCamera's YAML.
    """
    rig = fields.get("value0")
    if isinstance(rig, Mapping) and isinstance(rig.get("intrinsics"), list):
        sizes = rig.get("resolution") or []
        cameras = [_of_basalt(camera, size) for camera, size in zip(rig["intrinsics"], sizes, strict=False)]
    elif isinstance(rig := fields.get("cameras"), list) and all(
        "camera" in mapping("cameras", each) for each in rig
    ):
        cameras = [_of_maplab(each) for each in rig]
    else:
        return fields
    if not cameras:
        raise ValueError("resolution: expected the image size of each camera, got none")
    return {f"cam{number}": camera for number, camera in enumerate(cameras)}


def _of_basalt(camera: Any, size: Any) -> Mapping[str, Any]:
    name = str(required(mapping("intrinsics", camera), "camera_type"))
    if name not in _BASALT_MODELS:
        raise ValueError(f"camera_type: expected one of {', '.join(_BASALT_MODELS)}, got {shown(name)}")
    *models, intrinsics, distortion = _BASALT_MODELS[name]
    values = mapping("intrinsics", required(camera, "intrinsics"))
    check_lens_keys(values, distortion.split())
    return {
        "camera_model": models[0],
        "distortion_model": models[1],
        "intrinsics": [number(values, key) for key in intrinsics.split()],
        "distortion_coeffs": [number(values, key) for key in distortion.split()],
        "resolution": size,
    }


def _of_maplab(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    camera = mapping("camera", required(entry, "camera"))
    check_lens_keys(camera, ("distortion",))
    lens = mapping("distortion", camera.get("distortion") or {})
    return {
        "camera_model": required(camera, "type"),
        "distortion_model": lens.get("type"),
        "intrinsics": required(camera, "intrinsics"),
        "distortion_coeffs": lens.get("parameters"),
        "resolution": [whole_number(camera, "image_width"), whole_number(camera, "image_height")],
    }


def is_kalibr(fields: Mapping[str, Any]) -> bool:
    """Return whether the keys are those of Kalibr's camera chain, or of one camera as in EuRoC."""
    lens = fields.get("intrinsics")
    is_row = isinstance(lens, str) or (
        isinstance(lens, list) and not any(isinstance(row, list) for row in lens)
    )
    of_one = is_row and not fields.keys().isdisjoint({"camera_model", "resolution"})
    return of_one or any(re.fullmatch(r"cam\d+", key, re.ASCII) for key in fields)


def kalibr_cameras(fields: Mapping[str, Any]) -> Readers:
    """Return readers of the cameras of Kalibr's camchain, or the one of EuRoC's ``sensor.yaml``."""
    chain = [key for key in fields if re.fullmatch(r"cam\d+", key, re.ASCII)]
    if not chain:
        return {"": partial(_kalibr, fields)}
    in_order = sorted(chain, key=lambda key: int(key[3:10]))
    return {key: lambda key=key: _kalibr(mapping(key, fields[key])) for key in in_order}  # type: ignore[misc]


def _kalibr(fields: Mapping[str, Any]) -> CameraParameters:
    """Read one camera.

    A double sphere (``ds``), extended unified (``eucm``) or FOV camera becomes the nearest Kannala-Brandt
    one, see :func:`~lanebev.camera.approximation.kannala_brandt_like`.

    Source: Kalibr, wiki, "Supported models" and "Yaml formats".
    """
    names = (
        str(required(fields, "camera_model")).strip().lower(),
        str(fields.get("distortion_model") or "none").strip().lower(),
    )
    if names in _KALIBR_RADIAL:
        return _radial(fields, *_KALIBR_RADIAL[names])
    if names not in _KALIBR_MODELS:
        known = ", ".join("-".join(each) for each in (*_KALIBR_MODELS, *_KALIBR_RADIAL))
        raise ValueError(f"camera_model: expected one of {known}, got {shown('-'.join(names))}")
    model = _KALIBR_MODELS[names]
    intrinsics = numbers(fields, "intrinsics", count=5 if model == "omni" else 4)
    coefficients = ("distortion_coeffs", "distortion_coefficients")
    check_lens_keys(fields, coefficients)
    distortion = [0.0] * 4
    if names[1] != "none":
        distortion = numbers(fields, *coefficients, count=None if model == "pinhole" else 4)
    elif any(fields.get(key) for key in coefficients) and any(numbers(fields, *coefficients)):
        raise ValueError("distortion_model: expected the lens model of distortion_coeffs, got none; add it")
    *xi, fx, fy, cx, cy = intrinsics
    size = listed_size(fields, "resolution")
    return CameraParameters(matrix_entries(fx, fy, cx, cy), [*xi, *distortion], model, size)


def _radial(
    fields: Mapping[str, Any], before: int, after: int, radius: Callable[..., Array]
) -> CameraParameters:
    """Return the Kannala-Brandt camera that is nearest to a radial one of Kalibr.

    Args:
        fields: fields of the camera.
        before: number of the lens's parameters in ``intrinsics``, before fx.
        after: number of those in ``distortion_coeffs``.
        radius: distance from the principal point by the angle and by the parameters.
    """
    *shape, fx, fy, cx, cy = numbers(fields, "intrinsics", count=before + 4)
    if after:
        shape += numbers(fields, "distortion_coeffs", count=after)
    size = listed_size(fields, "resolution")
    return radial_camera((fx, fy), (cx, cy), size, lambda angle: radius(angle, *shape))


def camodocal(fields: Mapping[str, Any]) -> CameraParameters:
    """Read CamOdoCal's YAML, which VINS and KITTI-360's fisheyes use: PINHOLE, KANNALA_BRANDT or MEI."""
    name = str(required(fields, "model_type")).strip().upper()
    projection = mapping("projection_parameters", required(fields, "projection_parameters"))
    size = stated_size(fields, "image_height", "image_width")
    if name == "KANNALA_BRANDT":
        fx, fy, cx, cy = (number(projection, key) for key in ("mu", "mv", "u0", "v0"))
        model, distortion = "fisheye", [number(projection, key) for key in ("k2", "k3", "k4", "k5")]
    elif name in ("PINHOLE", "MEI"):
        distorted = mapping("distortion_parameters", required(fields, "distortion_parameters"))
        names = ("k1", "k2", "p1", "p2")
        check_lens_keys(distorted, names)
        model, distortion = "pinhole", [number(distorted, key) for key in names]
        keys = ("fx", "fy", "cx", "cy")
        if name == "MEI":
            mirror = mapping("mirror_parameters", required(fields, "mirror_parameters"))
            model, distortion = "omni", [number(mirror, "xi"), *distortion]
            keys = ("gamma1", "gamma2", "u0", "v0")
        fx, fy, cx, cy = (number(projection, key) for key in keys)
    else:
        raise ValueError(f"model_type: expected PINHOLE, KANNALA_BRANDT or MEI, got {shown(name)}")
    return CameraParameters(matrix_entries(fx, fy, cx, cy), distortion, model, size)


def orb_slam_fields(fields: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return ORB-SLAM's settings, or stella_vslam's as these; None if they are neither."""
    below = fields.get("Camera")
    if isinstance(below, Mapping) and "fx" in below:
        return {f"Camera.{key}": value for key, value in below.items()}
    return fields if "Camera.fx" in fields or "Camera1.fx" in fields else None


def orb_slam_cameras(fields: Mapping[str, Any], rectified: bool) -> Readers:
    """Return readers of the camera in the settings of ORB-SLAM 2 or 3, or of the left and the right one.

    ORB-SLAM 2's ``Camera`` is that of rectified images, where ``LEFT`` and ``RIGHT`` are those as taken.
    """
    pair = [name for name in ("Camera1", "Camera2") if f"{name}.fx" in fields]
    if pair:
        return {name: partial(_orb_slam, fields, f"{name}.") for name in pair}
    taken = {name: partial(_as_taken, fields, name) for name in ("LEFT", "RIGHT") if f"{name}.K" in fields}
    if not taken:
        return {"": partial(_orb_slam, fields, "Camera.")}
    both: Readers = {"Camera": partial(_orb_slam, fields, "Camera.")}
    return {**both, **taken} if rectified else {**taken, **both}


def _as_taken(fields: Mapping[str, Any], name: str) -> CameraParameters:
    """Read a camera of ORB-SLAM 2's stereo settings."""
    matrix, distortion = numbers(fields, f"{name}.K", count=9), numbers(fields, f"{name}.D")
    size = stated_size(fields, f"{name}.height", f"{name}.width")
    return CameraParameters(matrix, distortion, "pinhole", size)


def _orb_slam(fields: Mapping[str, Any], of: str) -> CameraParameters:
    """Read the camera whose keys begin with ``of``."""
    kind = str(fields.get("Camera.type") or fields.get("Camera.model") or "PinHole").strip()
    if kind.lower() not in _ORB_SLAM_MODELS:
        raise ValueError(f"Camera.type: expected one of {', '.join(_ORB_SLAM_MODELS)}, got {shown(kind)}")
    model, names = _ORB_SLAM_MODELS[kind.lower()]
    fx, fy, cx, cy = (number(fields, of + key) for key in ("fx", "fy", "cx", "cy"))
    for start in (
        {"Camera.", of} if names else ()
    ):  # the second of a stereo camera's, which has some keys for both
        own = {key.removeprefix(start): value for key, value in fields.items() if key.startswith(start)}
        check_lens_keys(own, (*names.split(), "k4") if start == of else ())
    given = [of + key for key in names.split()]
    distortion = [number(fields, key, default=0.0) for key in given]
    if model == "pinhole" and fields.get(of + "k4") is not None and number(fields, of + "k4"):
        raise ValueError(f"{of}k4: expected no k4 of {kind}, got it; is Camera.type: KannalaBrandt8 missing?")
    size = (
        whole_number(fields, "Camera.height", "Camera.rows"),
        whole_number(fields, "Camera.width", "Camera.cols"),
    )
    return CameraParameters(matrix_entries(fx, fy, cx, cy), distortion, model, size)
