"""A calibrator and a mount estimator over the frames of a drive, with their states."""

from typing import Generic, NamedTuple

import torch
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.estimation.calibrator import Calibrator, StateT
from lanebev.estimation.expected_view import expected_vanishing_point
from lanebev.estimation.mount import MountCalibration, MountEstimator, MountState
from lanebev.estimation.reasons import Reason
from lanebev.estimation.still import calibrate_still_with_state
from lanebev.geometry.focal import focal_covariance
from lanebev.geometry.road import lane_width_covariance
from lanebev.geometry.vanishing_point import vanishing_point
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.segments import LaneSegments, camera_segments
from lanebev.types import Calibration, Extrinsics, Status


class Estimate(NamedTuple):
    """Results for the vertices of one frame; tensors are of batch size 1.

    Attributes:
        segments: what the calibrator was given.
        calibration: calibration of this frame.
        reasons: why the frame is not, or not fully, tracked.
        vertical_curvature: (1,) 1/m of the road, positive over a crest; None for a plane road.
    """

    segments: LaneSegments
    calibration: Calibration
    reasons: Reason
    vertical_curvature: Tensor | None = None


class Tracker(Generic[StateT]):
    """Estimate pose and mount frame by frame.

    Args:
        calibrator: calibrator of the pose.
        camera: the lens.
        lane_width: m.
        focal_std: standard deviation of the focal length as a fraction of it; the pose's contain its effect.
        lane_width_std: standard deviation of the lane width, m; the height's contains its effect.
    """

    def __init__(
        self,
        calibrator: Calibrator[StateT],
        camera: Camera,
        lane_width: float,
        focal_std: float = 0.0,
        lane_width_std: float = 0.0,
    ) -> None:
        self.calibrator, self.camera, self.lane_width = calibrator, camera, lane_width
        self.focal_std, self.lane_width_std = focal_std, lane_width_std
        self.mount_estimator = MountEstimator()
        self.state: StateT = calibrator.initial_state(1, dtype=torch.float64)
        self.mount_state: MountState = self.mount_estimator.initial_state(1, dtype=torch.float64)
        self.mount: MountCalibration | None = None  # after a first frame
        self.own_covariance: Tensor = torch.zeros(1, 4, 4)  # of the last frame, without the common errors

    def states(self) -> dict[str, StateT | MountState]:
        """Return the states by name."""
        return {"calibrator": self.state, "mount": self.mount_state}

    def drive_frame(
        self, vertices: BoundaryVertices, dt: float, pose_sigma_scale: float, speed: float | None = None
    ) -> Estimate:
        """Estimate the pose of the next frame of the drive.

        Args:
            vertices: vertices of batch size 1, in pixels of the image as taken.
            dt: s since the frame before.
            pose_sigma_scale: factor on the standard deviations of the pose.
            speed: speed of the vehicle, m/s, if known, for the road's motion through the view; a slow vehicle
                does not update the mount estimate.
        """
        segments = camera_segments(vertices, self.camera)
        intrinsics = self.camera.intrinsics[None]
        calibration, self.state = self.calibrator(segments, intrinsics, self.state, dt, self.lane_width)
        calibration = self.calibrator.scale_drive(calibration, self.state, pose_sigma_scale, self.lane_width)
        if speed is not None:
            self.state = self.calibrator.with_speed(self.state, speed)
        self.own_covariance = calibration.covariance
        mount, self.mount_state = self.mount_estimator(
            calibration,
            self.mount_state,
            dt,
            speed=None if speed is None else torch.tensor([speed], dtype=torch.float64),
            curvature=self.calibrator.curvature(self.state),
        )
        self.mount = mount._replace(covariance=mount.covariance + self._common_error(mount.extrinsics))
        reasons = Reason(int(self.calibrator.reasons(self.state)[0]))
        vertical_curvature = self.calibrator.vertical_curvature(self.state)
        return Estimate(segments, self.with_common_errors(calibration), reasons, vertical_curvature)

    def still(self, vertices: BoundaryVertices, pose_sigma_scale: float) -> Estimate:
        """Estimate the pose of a single image; the states do not change.

        Args:
            vertices: vertices of batch size 1, in pixels of the image as taken.
            pose_sigma_scale: factor on the standard deviations of the image's information on the pose.
        """
        segments = camera_segments(vertices, self.camera)
        intrinsics = self.camera.intrinsics[None]
        calibration, state = calibrate_still_with_state(
            self.calibrator, segments, intrinsics, self.lane_width
        )
        calibration = self.calibrator.scale_still(calibration, pose_sigma_scale)
        reasons = Reason(int(self.calibrator.reasons(state)[0])) & ~Reason.RESTARTED  # as every image does
        return Estimate(segments, self.with_common_errors(calibration), reasons)

    def vanishing_point(self) -> Tensor:
        """Return where the lanes are expected to meet in the next image, (1, 2) px as taken, or NaN."""
        return expected_vanishing_point(self.calibrator, self.state, *self._lens())

    def vanishing_point_of_still(self, vertices: BoundaryVertices) -> Tensor:
        """Return where the lanes meet in a single image, (1, 2) px as taken; NaN if it is not TRACKING.

        Args:
            vertices: vertices of batch size 1, in pixels of the image as taken.
        """
        calibration = self.still(vertices, 1.0).calibration
        pitch, yaw, _, _ = calibration.extrinsics
        point = vanishing_point(pitch, yaw, *self._lens())
        return torch.where((calibration.status == int(Status.TRACKING)).unsqueeze(-1), point, torch.nan)

    def _lens(self) -> tuple[Tensor, Tensor, str]:
        return self.camera.intrinsics[None], self.camera.distortion[None], self.camera.model

    def _common_error(self, extrinsics: Extrinsics) -> Tensor:
        """Return the covariance (1, 4, 4) of the errors by focal length and lane width, constant in time.

        Neither a filter nor the mount estimate averages them out.
        """
        common = lane_width_covariance(extrinsics.height, self.lane_width_std / self.lane_width)
        if self.focal_std:
            common = common + focal_covariance(extrinsics, self.camera.intrinsics[None], self.focal_std)
        return common

    def with_common_errors(self, calibration: Calibration) -> Calibration:
        """Return a calibration whose covariance contains the errors by focal length and lane width."""
        common = self._common_error(calibration.extrinsics)
        return calibration._replace(covariance=calibration.covariance + common)
