"""Short drives and how the joint calibrator follows them, for several test files."""

import torch

from lanebev.estimation.joint.layout import layout
from lanebev.observation.segments import LaneSegments
from lanebev.testing.moments import CAMERA, FPS, WIDTH, moments
from lanebev.testing.moments import observe as see

DOUBLE = torch.float64
PLACE = layout(6)
OBLIQUE = CAMERA * torch.tensor([[1.1], [0.9], [1.0]]).double()  # pixels that are neither square nor upright
OBLIQUE[0, 1] = 30.0


def drive(frames: int, rows: int = 2, per_boundary: int = 8, sigma: float = 1.0, seed: int = 0):
    return list(see(moments(frames / FPS), rows, sigma, per_boundary, seed, DOUBLE))


def cameras(rows: int):
    return CAMERA.expand(rows, 3, 3)


def run(calibrator, frames, state=None, dt=1 / FPS):
    rows = frames[0][1].boundary.shape[0]
    state = calibrator.initial_state(rows, dtype=DOUBLE) if state is None else state
    for _, segments in frames:
        out, state = calibrator(segments, cameras(rows), state, dt, WIDTH)
    return out, state


def nothing(segments: LaneSegments) -> LaneSegments:
    return segments._replace(weight=torch.zeros_like(segments.weight))
