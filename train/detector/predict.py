"""Run a detector on frames of drives, with given poses."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lanebev.types import Extrinsics
from train.detector.frames import Frames
from train.detector.network import VehicleDetector
from train.detector.precision import Centres
from train.detector.targets import decode_boxes

LEAST_SCORE = 0.02
TOGETHER = 8  # frames of a batch
OFFSETS_DEG = (0.1, 0.25, 0.5, 1.0, 2.0)
AXES = ("pitch", "roll", "yaw")
_COLUMN = {"pitch": 0, "yaw": 1, "roll": 2}


@torch.inference_mode()
def find_vehicles(detector: VehicleDetector, frames: Frames, poses: Sequence[Tensor]) -> list[Centres]:
    """Find vehicles in all frames by each of several poses; image features are computed once.

    Args:
        detector: in evaluation mode.
        frames: N of them.
        poses: poses of each: (N, 4).
    """
    size, grid = (frames.image.shape[-2], frames.image.shape[-1]), detector.warp.grid
    found: list[list[tuple[Tensor, Tensor]]] = [[] for _ in poses]
    for rows in torch.arange(len(frames.image)).split(TOGETHER):
        features = detector.features(frames.image[rows].float() / 255)
        for pose, own in zip(poses, found, strict=True):
            extrinsics = Extrinsics.unstack(pose[rows])
            maps = detector.detect(features, frames.intrinsics[rows], extrinsics, size)
            own.append(decode_boxes(maps.float(), grid))
    return [centres(*(torch.cat(part) for part in zip(*own, strict=True))) for own in found]


def centres(boxes: Tensor, score: Tensor) -> Centres:
    """Collect the centres of boxes (N, K, 5) whose scores (N, K) are not negligible."""
    frame, box = (score > LEAST_SCORE).nonzero(as_tuple=True)
    xz = boxes[frame, box, :2].double().numpy()
    return Centres(frame.numpy(), xz, score[frame, box].double().numpy())


def true_centres(frames: Frames) -> Centres:
    """Collect the centres of the boxes that are there."""
    return centres(frames.boxes, frames.seen.float())


def offset_poses(poses: Tensor) -> dict[tuple[str, float], Tensor]:
    """Turn poses (N, 4) about one axis at a time, each frame's by the same angle to a random side."""
    generator = torch.Generator().manual_seed(0)
    side = 2.0 * torch.randint(2, (len(poses),), generator=generator) - 1
    turned = {}
    for axis in AXES:
        for degrees in OFFSETS_DEG:
            off = torch.zeros_like(poses)
            off[:, _COLUMN[axis]] = side * math.radians(degrees)
            turned[axis, degrees] = poses + off
    return turned


def pose_rmse(poses: Tensor, truth: Tensor) -> list[float]:
    """Compute the RMSE of pitch, yaw, roll (degrees) and height (cm) of (N, 4)."""
    rmse = (poses - truth).double().square().mean(0).sqrt().numpy()
    return [float(value) for value in np.append(np.degrees(rmse[:3]), 100 * rmse[3])]
