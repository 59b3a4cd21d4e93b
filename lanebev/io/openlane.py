"""OpenLane's 3D lane points to pixels.

Source: OpenLane, eval/LANE_evaluation/lane3d/eval_3D_lane.py. Labels are in the camera's frame turned to the
vehicle's axes (x forward, y left, z up). Predictions for the benchmark are in the ground frame below the
camera (x right, y forward, z up), whose pose is the label's ``extrinsic``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_CAMERA_FROM_LABEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_VEHICLE_FROM_GROUND = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_NEAREST = 0.1  # m in front of the camera; what is nearer or behind has no image


def camera_from_label_points(points: Array) -> Array:
    """Return label points (P, 3) m, x forward, y left, z up, in camera axes x right, y down, z forward."""
    camera: Array = points @ _CAMERA_FROM_LABEL.T
    return camera


def camera_from_ground_points(points: Array, vehicle_from_camera: Array) -> Array:
    """Return the benchmark's prediction points (P, 3) m in camera axes.

    Args:
        points: (P, 3) m of the ground frame below the camera, x right, y forward, z up.
        vehicle_from_camera: (4, 4), the label's ``extrinsic``; its x and y translation is not used, as in
            the benchmark.
    """
    rotation = _VEHICLE_FROM_GROUND.T @ vehicle_from_camera[:3, :3] @ _CAMERA_FROM_LABEL.T
    camera: Array = (points - np.array([0.0, 0.0, vehicle_from_camera[2, 3]])) @ rotation
    return camera


def image_from_camera_points(points: Array, intrinsics: Array) -> Array:
    """Return the pixels (P, 2) of points (P, 3) m in camera axes, NaN where they are not in front of it.

    Args:
        points: (P, 3) m.
        intrinsics: (3, 3) px.
    """
    depth = np.where(points[:, 2] > _NEAREST, points[:, 2], np.nan)
    homogeneous = points @ intrinsics.T
    pixels: Array = homogeneous[:, :2] / depth[:, None]
    return pixels
