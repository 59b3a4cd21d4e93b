"""openpilot's ``liveCalibration``: roll, pitch and yaw of its device."""

import json
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lanebev.io.formats.record import RunRecord
from lanebev.types import Extrinsics

_VIEW_FROM_DEVICE = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))


def openpilot_angles(pose: Extrinsics) -> Tensor:
    """Compute openpilot's roll, pitch and yaw of a pose.

    Source: commaai/openpilot, ``common/transformations``: ``device_from_calib = rot_from_euler((roll, pitch,
    yaw))``, which is R_z(yaw) R_y(pitch) R_x(roll), right-handed; device and calibrated frame are x forward,
    y right, z down. Their signs are ours: pitch > 0 looks down, yaw > 0 to the left of the way of the car,
    roll > 0 is counter-clockwise seen from behind. Their order is not: openpilot turns by roll, pitch, yaw
    where we turn by roll, yaw, pitch, so that the angles differ in second order.

    openpilot's calibrated frame lies along the car's motion; ours lies along the lanes. They agree for a
    mount, which is the mean over a drive.

    Args:
        pose: each (B,).

    Returns:
        (B, 3) rad: roll, pitch, yaw.
    """
    camera_from_road = pose.camera_from_road()[:, :3, :3]
    view_from_device = camera_from_road.new_tensor(_VIEW_FROM_DEVICE)
    device_from_calib = view_from_device.T @ camera_from_road @ view_from_device
    roll = torch.atan2(device_from_calib[:, 2, 1], device_from_calib[:, 2, 2])
    pitch = -device_from_calib[:, 2, 0].clamp(-1.0, 1.0).asin()
    yaw = torch.atan2(device_from_calib[:, 1, 0], device_from_calib[:, 0, 0])
    return torch.stack([roll, pitch, yaw], dim=-1)


def live_calibration(record: RunRecord) -> dict[str, Any]:
    """Return the fields ``rpyCalib`` (rad) and ``height`` (m) of ``liveCalibration``, and the signs in words.

    Source: commaai/openpilot, ``cereal/log.capnp``, ``LiveCalibrationData``. openpilot itself holds roll at
    zero.
    """
    standing = record.standing_pose()
    angles = openpilot_angles(standing.extrinsics)[0].tolist()
    return {
        "rpyCalib": angles,
        "height": standing.extrinsics.height.tolist(),
        "rpy_deg": [math.degrees(angle) for angle in angles],
        "signs": {
            "roll": "positive: the camera is turned counter-clockwise, seen from behind",
            "pitch": "positive: the camera looks down",
            "yaw": "positive: the camera looks to the left",
        },
        "source": standing.source,
    }


def write(path: Path, record: RunRecord) -> None:
    """Write the run."""
    path.write_text(json.dumps(live_calibration(record), indent=1) + "\n", encoding="utf-8")
