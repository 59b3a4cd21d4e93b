"""Calibrators on the frames of a drive, one after another."""

import torch

from lanebev.testing.segments import INTRINSICS


def drive(calibrator, frames, dt=1 / 30, lane_width=3.7):
    """Return the calibration of every frame, and the state after the last."""
    state = calibrator.initial_state(frames[0].weight.shape[0], dtype=torch.float64)
    outputs = []
    for segments in frames:
        intrinsics = INTRINSICS.expand(segments.weight.shape[0], 3, 3)
        calibration, state = calibrator(segments, intrinsics, state, dt, lane_width)
        outputs.append(calibration)
    return outputs, state


def finite(calibration):
    """Tell whether pose and covariance are numbers."""
    return calibration.extrinsics.stack().isfinite().all() and calibration.covariance.isfinite().all()
