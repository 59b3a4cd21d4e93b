"""Calibrate single images, and summarise the errors of pitch and roll."""

from pathlib import Path
from typing import NamedTuple

import scipy.stats
import torch
from torch import Tensor

from lanebev import Calibration, Camera, JointCalibrator, LaneBEV, Status
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.tracker import Tracker
from lanebev.geometry.rotation import road_from_cam
from lanebev.io.images.pixels import read_image
from lanebev.observation.frames import check_frame, network_image

SIGMAS = 3.0


class Answer(NamedTuple):
    """One image's estimate: angles of the road plane (pitch, roll) and their sigmas, deg; height, m."""

    name: str
    plane: Tensor
    sigma: Tensor
    height: float
    height_sigma: float
    tracking: bool


def plane_angles(normal: Tensor) -> Tensor:
    """Compute the pitch and roll (..., 2), rad, of a camera at zero yaw over a road plane.

    Args:
        normal: (..., 3) of the plane in camera axes, pointing down.
    """
    x, y, z = normal.unbind(-1)
    return torch.stack([torch.atan2(z, y), torch.atan2(-x, torch.hypot(y, z))], dim=-1)


def calibrate(
    model: LaneBEV, path: Path, camera: Camera, lane_width: float, prior: FramePrior | None = None
) -> Answer:
    """Calibrate one image, as ``lanebev run --stills`` does."""
    with torch.inference_mode():
        frame = network_image(check_frame(read_image(path), camera.image_size), torch.device("cpu"))
        return as_answer(path.name, calibrate_frame(model, frame, camera, lane_width, prior))


def calibrate_frame(
    model: LaneBEV, frame: Tensor, camera: Camera, lane_width: float, prior: FramePrior | None = None
) -> Calibration:
    """Calibrate one frame (1, 3, H, W) in [0, 1], as taken."""
    tracker = Tracker(JointCalibrator(prior=prior or FramePrior()), camera, lane_width)
    if model.far_view is None:
        _, vertices = model.boundary_vertices(frame)
    else:
        _, whole = model.whole_vertices(frame)
        vertices = model.add_far_view(frame, whole, tracker.vanishing_point_of_still(whole))
    return tracker.still(vertices, model.pose_sigma_scale).calibration


def as_answer(name: str, calibration: Calibration) -> Answer:
    """Take angles and standard deviations from a calibration of batch size 1."""
    pitch, yaw, roll, height = calibration.extrinsics
    down = road_from_cam(pitch, yaw, roll)[0, 1]
    sigma = calibration.covariance[0].diagonal().sqrt()
    return Answer(
        name,
        plane_angles(down).rad2deg(),
        sigma[[0, 2]].rad2deg(),
        float(height[0]),
        float(sigma[3]),
        int(calibration.status[0]) == Status.TRACKING,
    )


def summarise(answers: list[Answer], truth: Tensor) -> dict[str, float]:
    """Return median errors, how many were calibrated, and the share within three sigma (all images)."""
    plane = torch.stack([answer.plane for answer in answers])
    sigma = torch.stack([answer.sigma for answer in answers])
    error = (plane - truth.rad2deg()).abs()
    tracking = torch.tensor([answer.tracking for answer in answers])
    inside = (error <= SIGMAS * sigma).double().mean(0)
    middle = error.median(0).values
    low, high = median_interval(error)
    return {
        "images": len(answers),
        "tracking": int(tracking.sum()),
        "pitch_median_deg": float(middle[0]),
        "roll_median_deg": float(middle[1]),
        "pitch_median_low_deg": float(low[0]),
        "pitch_median_high_deg": float(high[0]),
        "roll_median_low_deg": float(low[1]),
        "roll_median_high_deg": float(high[1]),
        "pitch_within_3_sigma": float(inside[0]),
        "roll_within_3_sigma": float(inside[1]),
        "pitch_worst_deg": float(error[:, 0].max()),
        "roll_worst_deg": float(error[:, 1].max()),
    }


def median_interval(error: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the 95 % interval of the medians (P,) of errors (N, P), were other images drawn.

    Source: how many of N values lie below a median is binomial (David and Nagaraja 2003, Sec. 7.1).
    """
    count = len(error)
    below = int(scipy.stats.binom.ppf(0.025, count, 0.5))
    ordered = error.sort(0).values
    return ordered[max(below - 1, 0)], ordered[min(count - below, count - 1)]
