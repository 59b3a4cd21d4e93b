"""A textbook extended Kalman filter, filterpy's, behind the interface of the calibrators: for comparison.

State: pitch, yaw, roll, height, offset and their rates, constant velocity. Measurement: the perpendicular
pixel distance of every end point to its boundary, linearised once. No robust weights, curvature, lane
changes or status. It loops over rows and inverts a matrix of all end points. Needs ``pip install filterpy``.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lanebev.estimation.joint.measurement.observations import boundary_places, observe
from lanebev.estimation.joint.measurement.residuals import NUM_PARAMS, boundary_residuals
from lanebev.estimation.kalman import constant_velocity
from lanebev.observation.segments import LaneSegments
from lanebev.types import NUM_BOUNDARIES, Calibration, Extrinsics, Status

_SIZE = 5  # pitch, yaw, roll, height, offset
_DENSITY = (0.08, 0.08, 0.08, 0.15, 0.2)  # of the accelerations, unit²/s³: those of JointCalibrator
_START_STD = (0.12, 0.15, 0.05, 0.5, 1.5, 0.2, 0.2, 0.2, 0.5, 0.5)


class TextbookEKF:
    """``initial_state`` and call as ``JointCalibrator``; the state is a list of filterpy filters."""

    def initial_state(self, batch_size: int, dtype: torch.dtype = torch.float64) -> list[Any]:
        """Return one filter per row, at the prior."""
        from filterpy.kalman import ExtendedKalmanFilter

        rows = []
        for _ in range(batch_size):
            ekf = ExtendedKalmanFilter(dim_x=2 * _SIZE, dim_z=1)
            ekf.x = np.zeros(2 * _SIZE)
            ekf.x[3] = 1.5
            ekf.P = np.diag(np.square(_START_STD))
            rows.append(ekf)
        return rows

    def __call__(
        self, segments: LaneSegments, intrinsics: Tensor, state: list[Any], dt: float, lane_width: float = 3.7
    ) -> tuple[Calibration, list[Any]]:
        """Process one frame of every row."""
        seen = observe(segments, intrinsics, NUM_BOUNDARIES)
        places = boundary_places(lane_width, NUM_BOUNDARIES, seen.sigma).gather(1, seen.boundary)
        step = torch.full((1,), dt if dt > 0 else 0.0, dtype=torch.float64)
        transition, noise = (
            part[0].numpy() for part in constant_velocity(step, torch.tensor(_DENSITY, dtype=torch.float64))
        )
        for ekf in state:
            ekf.F, ekf.Q = transition, noise
            ekf.predict()
        params = torch.zeros(len(state), NUM_PARAMS, dtype=seen.sigma.dtype)
        params[:, :_SIZE] = torch.from_numpy(np.stack([ekf.x[:_SIZE] for ekf in state]))
        found = boundary_residuals(params, places, seen)
        used = (found.valid & (seen.weight > 0)).numpy()
        for row, ekf in enumerate(state):
            keep = np.tile(used[row], 2)
            if not keep.any():
                continue
            jacobian = np.zeros((int(keep.sum()), 2 * _SIZE))
            jacobian[:, :_SIZE] = found.jacobian[row, :_SIZE].T.numpy()[keep]
            distance = found.distance[row].flatten().numpy()[keep]
            ekf.dim_z = len(jacobian)
            ekf.update(
                np.zeros(ekf.dim_z),
                HJacobian=lambda _, value=jacobian: value,
                Hx=lambda _, value=distance: value,
                R=np.diag(np.tile(seen.sigma[row].square().numpy(), 2)[keep]),
            )
        pose = torch.from_numpy(np.stack([ekf.x[:4] for ekf in state]))
        cov = torch.from_numpy(np.stack([ekf.P[:4, :4] for ekf in state]))
        status = torch.full((len(state),), int(Status.TRACKING))
        return Calibration(Extrinsics.unstack(pose), cov, status, seen.weight), state
