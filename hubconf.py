"""Entry points of ``torch.hub.load(FOLDER_OR_REPOSITORY, NAME)``: every public name of this file is one."""

from typing import Any as _Any

import lanebev as _lanebev
from lanebev.weights import load_segmenter as _load_segmenter

dependencies = ["torch", "kornia", "numpy", "cv2", "safetensors"]


def lanebev(**arguments: _Any) -> _lanebev.LaneBEV:
    """Return the whole model with the shipped weights; see ``LaneBEV.from_pretrained`` for arguments."""
    return _lanebev.LaneBEV.from_pretrained(**arguments)


def lane_segmenter(**arguments: _Any) -> _lanebev.LaneSegmenter:
    """Return the segmentation network with the shipped weights or those of ``path``."""
    return _load_segmenter(**arguments)


def joint_calibrator(**arguments: _Any) -> _lanebev.JointCalibrator:
    """Return a joint calibrator."""
    return _lanebev.JointCalibrator(**arguments)


def two_stage_calibrator(**arguments: _Any) -> _lanebev.TwoStageCalibrator:
    """Return the paper's calibrator."""
    return _lanebev.TwoStageCalibrator(**arguments)
