"""``calibration.yaml``: the lens and how it is mounted, in formats others read."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion

from lanebev.camera.files import camera_info, dump_yaml
from lanebev.camera.model import Camera
from lanebev.estimation.mount import MountCalibration, MountReason, MountStatus
from lanebev.geometry.rotation import road_from_cam
from lanebev.types import Extrinsics


def vehicle_from_camera(mount: Extrinsics) -> torch.Tensor:
    """Camera pose in ROS's (and OpenLane's) vehicle frame: x forward, y left, z up, origin on the road.

    Args:
        mount: each (B,).

    Returns:
        (B, 4, 4), camera frame (x right, y down, z forward) to vehicle.
    """
    rotation = road_from_cam(mount.pitch, mount.yaw, mount.roll)
    vehicle_from_road = rotation.new_tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    matrix = torch.eye(4, dtype=rotation.dtype, device=rotation.device).repeat(rotation.shape[0], 1, 1)
    matrix[:, :3, :3] = vehicle_from_road @ rotation
    matrix[:, 2, 3] = mount.height
    return matrix


def write_calibration(path: str | Path, camera: Camera, mounted: MountCalibration) -> None:
    """Write ``calibration.yaml``: a ROS ``camera_info`` with the mount's pose beside it.

    The pose is there as angles and height in our signs, as a 4 x 4 camera-to-vehicle matrix in the axes of
    ROS and OpenLane (x forward, y left, z up), and as that rotation's quaternion. PyYAML, ROS's camera
    calibration parsers and ``cv2.FileStorage`` read the file; so does :func:`read_camera`.

    Args:
        path: the file.
        camera: the lens.
        mounted: of batch size 1.
    """
    matrix = vehicle_from_camera(mounted.extrinsics)[0].double()
    w, *xyz = rotation_matrix_to_quaternion(matrix[:3, :3]).tolist()
    pose = mounted.extrinsics.stack()[0].tolist()
    std = mounted.covariance[0].diagonal().clamp(min=0).sqrt().tolist()
    angles = ("pitch", "yaw", "roll")
    fields = camera_info(camera.parameters(), "camera")
    fields["mount"] = {
        "status": MountStatus(int(mounted.status[0])).name,
        "progress_percent": float(mounted.progress[0]),
        "reasons": [flag.name for flag in MountReason(int(mounted.reasons[0]))],
        **{f"{name}_deg": math.degrees(value) for name, value in zip(angles, pose[:3], strict=True)},
        "height_m": pose[3],
        **{f"{name}_std_deg": math.degrees(value) for name, value in zip(angles, std[:3], strict=True)},
        "height_std_m": std[3],
    }
    fields["vehicle_from_camera"] = {"rows": 4, "cols": 4, "dt": "d", "data": matrix.flatten().tolist()}
    fields["quaternion_xyzw"] = [*xyz, w]
    Path(path).write_text(dump_yaml(fields), encoding="utf-8")
