"""nuScenes' ``calibrated_sensor.json``."""

import hashlib
import json
from pathlib import Path
from typing import Any

from lanebev.io.calibration_file import quaternion_xyzw, vehicle_from_camera
from lanebev.io.formats.record import RunRecord


def calibrated_sensor(record: RunRecord) -> list[dict[str, Any]]:
    """Return the table, with one record.

    Source: nuScenes' ``docs/schema_nuscenes.md``: ``translation`` (m) and ``rotation`` (quaternion w, x,
    y, z) place the sensor in the ego vehicle's frame (x forward, y left, z up), whose origin is on the
    ground; ``camera_intrinsic`` is K of images without lens distortion. nuScenes' origin is below the
    middle of the rear axle, which lanes do not tell: here it is below the camera.
    """
    matrix = vehicle_from_camera(record.standing_pose().extrinsics)[0].double()
    x, y, z, w = quaternion_xyzw(matrix)
    return [
        {
            "token": _token(f"calibrated sensor {record.name}"),
            "sensor_token": _token(f"sensor {record.lens().fingerprint()}"),
            "translation": matrix[:3, 3].tolist(),
            "rotation": [w, x, y, z],
            "camera_intrinsic": record.lens().intrinsics.double().tolist(),
        }
    ]


def write(path: Path, record: RunRecord) -> None:
    """Write the run."""
    path.write_text(json.dumps(calibrated_sensor(record), indent=1) + "\n", encoding="utf-8")


def _token(text: str) -> str:
    """Return 32 hexadecimal digits, as nuScenes' tokens are."""
    return hashlib.blake2b(text.encode("utf-8", "replace"), digest_size=16).hexdigest()
