"""Entry points of ``torch.hub.load(FOLDER_OR_REPOSITORY, NAME)``."""

from typing import Any

from lanebev import JointCalibrator, LaneBEV, LaneSegmenter, TwoStageCalibrator
from lanebev.weights import load_segmenter

dependencies = ["torch", "kornia", "numpy", "cv2", "safetensors"]


def lanebev(**arguments: Any) -> LaneBEV:
    """Return the whole model with the shipped weights; see ``LaneBEV.from_pretrained`` for arguments."""
    return LaneBEV.from_pretrained(**arguments)


def lane_segmenter(**arguments: Any) -> LaneSegmenter:
    """Return the segmentation network with the shipped weights or those of ``path``."""
    return load_segmenter(**arguments)


def joint_calibrator(**arguments: Any) -> JointCalibrator:
    """Return a joint calibrator."""
    return JointCalibrator(**arguments)


def two_stage_calibrator(**arguments: Any) -> TwoStageCalibrator:
    """Return the paper's calibrator."""
    return TwoStageCalibrator(**arguments)
