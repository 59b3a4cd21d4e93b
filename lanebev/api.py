"""The public names of the package; ``import lanebev`` gives them."""

from lanebev import weights
from lanebev.camera.model import Camera
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import HILLY_ROADS, JointConfig
from lanebev.estimation.mount import MountCalibration, MountConfig, MountEstimator, MountReason, MountStatus
from lanebev.estimation.reasons import Reason
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.estimation.two_stage.state import TwoStageConfig
from lanebev.geometry.road import (
    image_covariance,
    image_from_road_points,
    road_covariance,
    road_from_image_points,
)
from lanebev.io.state import load_state, save_state
from lanebev.observation.far_view import FarView
from lanebev.observation.lines import LineExtractor
from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from lanebev.observation.segments import LaneSegments
from lanebev.observation.vertices import LineConfig
from lanebev.pipeline import LaneBEV, LaneBEVOutput
from lanebev.session import Session, SessionResult
from lanebev.types import Calibration, Extrinsics, Status
from lanebev.view.canonical import CanonicalView
from lanebev.view.grid import BEVGrid, bev_from_image
from lanebev.view.paint import ImageFromBEV
from lanebev.view.warp import BEVWarp

__all__ = [
    "HILLY_ROADS",
    "BEVGrid",
    "BEVWarp",
    "Calibration",
    "Camera",
    "CanonicalView",
    "Extrinsics",
    "FarView",
    "ImageFromBEV",
    "JointCalibrator",
    "JointConfig",
    "LaneBEV",
    "LaneBEVOutput",
    "LaneSegmenter",
    "LaneSegments",
    "LineConfig",
    "LineExtractor",
    "MountCalibration",
    "MountConfig",
    "MountEstimator",
    "MountReason",
    "MountStatus",
    "Reason",
    "SegmenterConfig",
    "Session",
    "SessionResult",
    "Status",
    "TwoStageCalibrator",
    "TwoStageConfig",
    "bev_from_image",
    "image_covariance",
    "image_from_road_points",
    "load_state",
    "road_covariance",
    "road_from_image_points",
    "save_state",
    "weights",
]
