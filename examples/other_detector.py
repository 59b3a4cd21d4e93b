"""Calibrate with the lane boundaries of another detector: polylines in pixels, frame by frame."""

import numpy as np

import lanebev

camera = lanebev.Camera.from_parameters(fx=600, fy=600, cx=319.5, cy=179.5, width=640, height=360)
calibrator = lanebev.JointCalibrator()
state = calibrator.initial_state(batch_size=1)
for _ in range(10):
    y = np.linspace(340.0, 190.0, 20)
    polylines = [np.stack([319.5 + slope * (y - 180.0), y], axis=-1) for slope in (-3.9, -1.3, 1.3, 3.9)]
    segments = lanebev.LaneSegments.from_polylines(polylines, camera)
    calibration, state = calibrator(segments, camera.intrinsics[None], state, dt=0.05, lane_width=3.7)
pitch, yaw, roll, height = (float(value) for value in calibration.extrinsics)
print(f"pitch {pitch:.4f} yaw {yaw:.4f} roll {roll:.4f} rad, height {height:.3f} m")
