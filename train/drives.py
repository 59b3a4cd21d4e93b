"""Run a network and the online calibrator on held-out rendered drives."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import JointConfig
from lanebev.observation.lines import LineExtractor
from lanebev.observation.segmenter import LaneSegmenter
from lanebev.observation.segments import LaneSegments
from lanebev.pipeline import LaneBEV
from lanebev.render import Drive
from lanebev.types import NUM_BOUNDARIES, Status

WARM_UP = 10  # frames


class DriveObservations(NamedTuple):
    """Detections of a network on a drive: segments, lane widths (L - 1,) and poses (4,) of its frames."""

    segments: list[LaneSegments]
    lane_width: list[Tensor]
    poses: Tensor
    intrinsics: Tensor
    interval: float


def observe_drive(
    segmenters: Sequence[LaneSegmenter], seed: int, frames: int, fps: float
) -> list[DriveObservations]:
    """Run each network on a rendered drive, with the sigmas of its maps."""
    drive = Drive(seed, num_frames=frames, fps=fps)
    models = [_observer(segmenter) for segmenter in segmenters]
    segments: list[list[LaneSegments]] = [[] for _ in segmenters]
    widths, poses = [], []
    for i in range(frames):
        frame = drive.frame(i)
        for model, segmenter, own in zip(models, segmenters, segments, strict=True):
            with torch.inference_mode():
                _, taken = model.observe(frame.image, frame.intrinsics.double())
            own.append(taken._replace(sigma=taken.sigma / segmenter.config.sigma_scale))
        widths.append(frame.lane_width.double())
        poses.append(frame.extrinsics.stack()[0].double())
    truth = (widths, torch.stack(poses), frame.intrinsics.double(), 1 / fps)
    return [DriveObservations(own, *truth) for own in segments]


def _observer(segmenter: LaneSegmenter) -> LaneBEV:
    config = segmenter.config
    if config.num_boundaries != NUM_BOUNDARIES:
        raise ValueError(
            f"num_boundaries: expected the drives' {NUM_BOUNDARIES}, got {config.num_boundaries}"
        )
    extractor = LineExtractor.for_network(config)
    return LaneBEV(segmenter, extractor, JointCalibrator(), network_width=config.image_size[1]).eval()


class CalibratorErrors(NamedTuple):
    """Results on a drive's F frames after the warm-up.

    Attributes:
        error: (F, 4) rad and m.
        covariance: (F, 4, 4).
        tracking: (F,) bool.
    """

    error: Tensor
    covariance: Tensor
    tracking: Tensor


@torch.inference_mode()
def run_calibrator(
    seen: DriveObservations, factor: float, config: JointConfig | None = None
) -> CalibratorErrors:
    """Run the online calibrator with this configuration on a drive, all sigmas times ``factor``."""
    calibrator = JointCalibrator(config)
    state = calibrator.initial_state(1, dtype=torch.float64)
    found = []
    for segments, width, pose in zip(seen.segments, seen.lane_width, seen.poses, strict=True):
        noisy = segments._replace(sigma=factor * segments.sigma)
        out, state = calibrator(noisy, seen.intrinsics, state, seen.interval, width)
        error = out.extrinsics.stack()[0] - pose
        found.append((error, out.covariance[0], out.status[0] == Status.TRACKING))
    return CalibratorErrors(*(torch.stack(part)[WARM_UP:] for part in zip(*found, strict=True)))
