"""Short drives and how a calibrator follows them, for several test files."""

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.restart import scatter_of_fit
from lanebev.estimation.joint.frame.single_frame import fit_observations
from lanebev.estimation.joint.layout import layout
from lanebev.estimation.joint.measurement.observations import boundary_places, observe
from lanebev.observation.segments import LaneSegments
from lanebev.testing.moments import CAMERA, FPS, WIDTH, Moment, moments
from lanebev.testing.moments import observe as see
from lanebev.types import Calibration

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


class Followed(NamedTuple):
    """One frame of a drive, and what a calibrator made of it."""

    moment: Moment
    segments: LaneSegments
    calibration: Calibration
    state: Any

    @property
    def error(self) -> Tensor:
        """(R, 4) rad and m."""
        return self.calibration.extrinsics.stack() - torch.tensor(self.moment.pose, dtype=DOUBLE)

    @property
    def sigma(self) -> Tensor:
        """(R, 4) standard deviations of the pose."""
        return self.calibration.covariance.diagonal(dim1=1, dim2=2).sqrt()


@torch.inference_mode()
def follow(
    drive: list[Moment],
    calibrator=None,
    rows: int = 1,
    sigma: float = 1.0,
    per_boundary: int = 20,
    seed: int = 0,
) -> list[Followed]:
    """Run a calibrator, the joint one by default, over a drive; each row has its own noise."""
    calibrator = calibrator or JointCalibrator()
    state, followed = calibrator.initial_state(rows, dtype=DOUBLE), []
    for moment, segments in see(drive, rows, sigma, per_boundary, seed, DOUBLE):
        calibration, state = calibrator(segments, cameras(rows), state, moment.dt, WIDTH)
        followed.append(Followed(moment, segments, calibration, state))
    return followed


def fitted_frame(**change):
    """Fit one frame without noise, changed so, by itself: its pose (1, 4) and scatter."""
    [moment] = moments(1 / FPS, lambda t, moment: replace(moment, **change))
    _, segments = next(see([moment], 1, 0.0, 20, 0, DOUBLE))
    segments = segments._replace(sigma=torch.ones_like(segments.sigma))
    seen = observe(segments, CAMERA[None], 6)
    own = boundary_places(WIDTH, 6, seen.sigma).expand(1, -1).gather(1, seen.boundary)
    config = JointConfig()
    fit = fit_observations(seen, own, config.prior)
    return fit.extrinsics.stack(), scatter_of_fit(fit, own, seen, config)


def nothing(segments: LaneSegments) -> LaneSegments:
    return segments._replace(weight=torch.zeros_like(segments.weight))
