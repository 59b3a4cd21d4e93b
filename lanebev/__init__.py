"""lanebev: how a camera looks at the road, frame by frame, from lane boundaries alone."""

from lanebev import weights as weights
from lanebev.camera.model import Camera
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.mount import MountEstimator
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.geometry.road import (
    image_covariance,
    image_from_road_points,
    road_covariance,
    road_from_image_points,
)
from lanebev.observation.lines import LineExtractor
from lanebev.observation.segmenter import LaneSegmenter
from lanebev.pipeline import LaneBEV, LaneBEVOutput
from lanebev.types import Calibration, Extrinsics, LaneSegments, Status
from lanebev.view.grid import BEVGrid, bev_from_image
from lanebev.view.warp import BEVWarp

__version__ = "0.1.0"

__all__ = [
    "BEVGrid",
    "BEVWarp",
    "Calibration",
    "Camera",
    "Extrinsics",
    "JointCalibrator",
    "LaneBEV",
    "LaneBEVOutput",
    "LaneSegmenter",
    "LaneSegments",
    "LineExtractor",
    "MountEstimator",
    "Status",
    "TwoStageCalibrator",
    "bev_from_image",
    "image_covariance",
    "image_from_road_points",
    "road_covariance",
    "road_from_image_points",
]
