"""``calibration.yaml``: the camera's lens and mount, in formats that other programs read."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from torch import Tensor

from lanebev.camera.files import camera_info, dump_yaml
from lanebev.camera.model import Camera
from lanebev.camera.parsing import parse
from lanebev.estimation.mount import MountCalibration, MountReason, MountStatus, describe_mount
from lanebev.geometry.rotation import road_from_cam
from lanebev.numbers import finite_numbers, read_text
from lanebev.types import AXES, Extrinsics

ROAD_FROM_VEHICLE = ((0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0))
"""Axes of the road (X right, Y down, Z along the lanes) from the vehicle's (x forward, y left, z up)."""

_USED_BY_AXIS = ("pitch_deg", "yaw_deg", "roll_deg", "height_m")
_ANGLES, _HEIGHTS = (-60.0, 60.0), (0.1, 20.0)  # degrees, m, of any camera that sees the road ahead


def vehicle_from_camera(mount: Extrinsics) -> torch.Tensor:
    """Return the camera's pose in ROS's vehicle frame: x forward, y left, z up, origin on the road.

    Args:
        mount: each (B,).

    Returns:
        (B, 4, 4), camera frame (x right, y down, z forward) to vehicle.
    """
    rotation = road_from_cam(mount.pitch, mount.yaw, mount.roll)
    vehicle_from_road = rotation.new_tensor(ROAD_FROM_VEHICLE).T
    matrix = torch.eye(4, dtype=rotation.dtype, device=rotation.device).repeat(rotation.shape[0], 1, 1)
    matrix[:, :3, :3] = vehicle_from_road @ rotation
    matrix[:, 2, 3] = mount.height
    return matrix


def quaternion_xyzw(matrix: Tensor) -> list[float]:
    """Return the unit quaternion x, y, z, w of a rigid transform (4, 4)."""
    w, x, y, z = rotation_matrix_to_quaternion(matrix[:3, :3].contiguous()).tolist()
    return [x, y, z, w]


class MountPrior(NamedTuple):
    """A mount as read from a file.

    Attributes:
        pose: (4,) pitch, yaw, roll (rad) and height (m).
        std: (4,) rad, rad, rad, m; infinite on an axis that is not calibrated.
    """

    pose: Tensor
    std: Tensor


def write_calibration(path: str | Path, camera: Camera, mounted: MountCalibration) -> None:
    """Write ``calibration.yaml``: a ROS ``camera_info`` with the mount's pose beside it.

    ``mount.valid`` says whether every axis is calibrated. ``pitch_deg``, ``yaw_deg``, ``roll_deg`` and
    ``height_m`` hold calibrated axes only; what is known of the others is under ``preliminary``, and
    ``needs`` says in words what is missing. Where all four are calibrated, the pose is there too as a 4 x 4
    camera-to-vehicle matrix in the axes of ROS and OpenLane (x forward, y left, z up), and as that rotation's
    quaternion. PyYAML, ROS's camera calibration parsers and ``cv2.FileStorage`` read the file; so does
    :meth:`Camera.from_file`.

    Args:
        path: the file.
        camera: the lens.
        mounted: mount estimate of batch size 1.
    """
    pose = mounted.extrinsics.stack()[0].double()
    std = mounted.covariance[0].diagonal().clamp(min=0).sqrt().double()
    values = [*pose[:3].rad2deg().tolist(), float(pose[3])]
    sigmas = [*std[:3].rad2deg().tolist(), float(std[3])]
    calibrated = [int(status) == MountStatus.CALIBRATED for status in mounted.axis_status[0]]
    known: dict[str, Any] = {}
    preliminary: dict[str, Any] = {}
    axes: dict[str, Any] = {}
    for axis, name in enumerate(AXES):
        unit = "m" if name == "height" else "deg"
        kind = known if calibrated[axis] else preliminary
        kind[f"{name}_{unit}"], kind[f"{name}_std_{unit}"] = values[axis], sigmas[axis]
        axes[name] = {
            "status": MountStatus(int(mounted.axis_status[0, axis])).name,
            "progress_percent": round(float(mounted.axis_progress[0, axis]), 3),
            "reasons": _names(int(mounted.axis_reasons[0, axis])),
        }
    mount: dict[str, Any] = {
        "valid": all(calibrated),
        "status": MountStatus(int(mounted.status[0])).name,
        "progress_percent": round(float(mounted.progress[0]), 3),
        "reasons": _names(int(mounted.reasons[0])),
        **known,
        "axes": axes,
    }
    if preliminary:
        mount["preliminary"] = preliminary
        words = describe_mount(mounted)
        mount["needs"] = [text for text, good in zip(words, calibrated, strict=True) if not good]
    fields = camera_info(camera.parameters(), "camera")
    fields["mount"] = mount
    if all(calibrated):
        matrix = vehicle_from_camera(mounted.extrinsics)[0].double()
        fields["vehicle_from_camera"] = {"rows": 4, "cols": 4, "dt": "d", "data": matrix.flatten().tolist()}
        fields["quaternion_xyzw"] = quaternion_xyzw(matrix)
    Path(path).write_text(dump_yaml(fields), encoding="utf-8")


def read_mount(path: str | Path) -> MountPrior:
    """Read the mount of a ``calibration.yaml`` that :func:`write_calibration` wrote.

    Raises:
        ValueError: the file cannot be read, has no mount, no calibrated axis, or a pose that no camera has.
    """
    try:
        fields = parse(read_text(Path(path)))
    except ValueError as error:
        raise ValueError(f"mount file {path}: expected a readable calibration.yaml, got: {error}") from error
    mount = fields.get("mount") if isinstance(fields, dict) else None
    if not isinstance(mount, dict):
        raise ValueError(
            f"mount file {path}: expected the key mount, got none; give a run's calibration.yaml"
        )
    pose, std = torch.zeros(4, dtype=torch.float64), torch.full((4,), torch.inf, dtype=torch.float64)
    for axis, key in enumerate(_USED_BY_AXIS):
        if key in mount:
            try:
                pose[axis], std[axis] = _value_and_std(mount, key)
            except ValueError as error:
                raise ValueError(f"mount file {path}: {error}") from error
    if not std.isfinite().any():
        needs = mount.get("needs")
        why = needs[0] if isinstance(needs, list) and needs else None
        why = " ".join(why.split())[:200] if isinstance(why, str) else "no axis is calibrated"
        raise ValueError(f"mount file {path}: expected a calibrated axis, got none: {why}")
    return MountPrior(pose, std)


def _value_and_std(mount: dict[str, Any], key: str) -> tuple[float, float]:
    """Return value and standard deviation of an axis, rad or m."""
    name, unit = key.rsplit("_", 1)
    std_key = f"{name}_std_{unit}"
    (value,), (std,) = finite_numbers(key, [mount[key]], 1), finite_numbers(std_key, [mount.get(std_key)], 1)
    low, high = _HEIGHTS if unit == "m" else _ANGLES
    if not low <= value <= high:
        raise ValueError(f"{key}: expected {low:g} to {high:g}, got {value:g}")
    if not std > 0:
        raise ValueError(f"{std_key}: expected more than 0, got {std:g}")
    scale = 1.0 if unit == "m" else math.pi / 180
    return scale * value, scale * std


def _names(reasons: int) -> list[str]:
    return [str(flag.name) for flag in MountReason(reasons)]
