"""KITTI's object ``calib.txt``: projection matrices, and where the camera is."""

from pathlib import Path

import torch
from torch import Tensor

from lanebev.io.calibration_file import ROAD_FROM_VEHICLE
from lanebev.io.formats.record import RunRecord


def kitti_calib(record: RunRecord) -> str:
    """Return the text of a ``calib.txt`` for undistorted images.

    Source: Geiger et al. 2013 and the object development kit's ``readme.txt``: a point of the velodyne frame
    (x forward, y left, z up) is at the pixel ``P2 * R0_rect * Tr_velo_to_cam * (x, y, z, 1)``, the last two
    with a row (0 0 0 1). There is no lidar here: the frame's origin is on the road below the camera. All four
    cameras, P0 to P3, are this one, and the rotation of rectification is none. KITTI's images have no lens
    distortion: undistort yours with the same K.
    """
    intrinsics = record.lens().intrinsics.double()
    projection = torch.cat([intrinsics, intrinsics.new_zeros(3, 1)], dim=1)
    camera_from_road = record.standing_pose().extrinsics.camera_from_road()[0]
    road_from_vehicle = torch.eye(4, dtype=torch.float64)
    road_from_vehicle[:3, :3] = torch.tensor(ROAD_FROM_VEHICLE, dtype=torch.float64)
    camera_from_vehicle = (camera_from_road @ road_from_vehicle)[:3]
    lines = {f"P{number}": projection for number in range(4)}
    identity = torch.eye(3, dtype=torch.float64)
    lines |= {"R0_rect": identity, "Tr_velo_to_cam": camera_from_vehicle, "Tr_imu_to_velo": torch.eye(4)[:3]}
    return "".join(f"{name}: {_numbers(matrix)}\n" for name, matrix in lines.items())


def write(path: Path, record: RunRecord) -> None:
    """Write the run."""
    path.write_text(kitti_calib(record), encoding="utf-8")


def _numbers(matrix: Tensor) -> str:
    return " ".join(f"{value:.12e}" for value in matrix.flatten().tolist())
