"""Run a calibrator on a drive with known truth: errors, covariance, status, and their statistics."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.joint.measurement.observations import observe as make_ready
from lanebev.estimation.joint.measurement.residuals import NUM_PARAMS, boundary_residuals, normal_equations
from lanebev.geometry.precision import cast_floating
from lanebev.observation.segments import LaneSegments
from lanebev.testing.moments import CAMERA, FPS, PLACES, WIDTH, Moment, observe
from lanebev.types import Status

NAMES = ("pitch_deg", "yaw_deg", "roll_deg", "height_cm")
UNITS = torch.tensor([180 / math.pi] * 3 + [100.0], dtype=torch.float64)
WARM_UP = 15  # frames left out
_DETERMINED = (0.1, 0.1, 0.1, 0.5)  # rad and m, standard deviation below which one frame determines it


class Track(NamedTuple):
    """Results of a calibrator on a drive of T frames in R rows.

    Attributes:
        errors: (T, R, 4) rad and m.
        variances: (T, R, 4).
        nees: (T, R).
        status: (T, R) int64.
        bounds: (T, R, 4) variances of the per-frame Cramér-Rao bound, inf of what a frame does not determine.
        hard: (T,) bool, frames that the scenario names.
    """

    errors: Tensor
    variances: Tensor
    nees: Tensor
    status: Tensor
    bounds: Tensor
    hard: Tensor


def track(
    calibrator: Any, drive: list[Moment], rows: int, sigma: float = 1.0, per_boundary: int = 30
) -> Track:
    """Run a calibrator over a drive.

    Args:
        calibrator: with ``initial_state`` and a call as ``JointCalibrator``.
        drive: from :func:`lanebev.testing.moments.moments`.
        rows: R Monte Carlo runs.
        sigma: px, noise of an end point.
        per_boundary: segments of each boundary.
    """
    state = calibrator.initial_state(rows, dtype=torch.float64)
    intrinsics = CAMERA.double().expand(rows, 3, 3)
    found = []
    for moment, segments in observe(drive, rows, sigma, per_boundary, seed=0, dtype=torch.float64):
        calibration, state = calibrator(segments, intrinsics, state, moment.dt, WIDTH)
        error = calibration.extrinsics.stack().double() - torch.tensor(moment.pose, dtype=torch.float64)
        cov = calibration.covariance.double()
        nees = (error * torch.linalg.solve(cov, error)).sum(-1)
        found.append(
            (error, cov.diagonal(dim1=1, dim2=2), nees, calibration.status, frame_bound(moment, segments))
        )
    hard = torch.tensor([bool(moment.tag) for moment in drive])
    errors, variances, nees, status, bounds = (torch.stack(part) for part in zip(*found, strict=True))
    return Track(errors, variances, nees, status, bounds, hard)


def frame_bound(moment: Moment, segments: LaneSegments, intrinsics: Tensor = CAMERA) -> Tensor:
    """Compute the variances (R, 4) of the per-frame bound with unknown offset, inf if not determined.

    Source: Kay 1993, Sec. 3.9. Wrong segments count as if they were right ones, which only lowers it.
    """
    rows = segments.boundary.shape[0]
    cameras = intrinsics.double().expand(rows, 3, 3)
    seen = make_ready(cast_floating(segments, torch.float64), cameras, 6)
    params = torch.zeros(rows, NUM_PARAMS, dtype=torch.float64)
    params[:, :5] = torch.tensor([*moment.pose, moment.offset], dtype=torch.float64)
    at = boundary_residuals(params, PLACES[segments.boundary], seen)
    weight = seen.weight * at.valid / seen.sigma.square()
    info, _ = normal_equations(at.jacobian[:, :5], at.distance, weight)
    cov = torch.linalg.inv(info + 1e-6 * torch.eye(5, dtype=torch.float64))
    variances = cov.diagonal(dim1=1, dim2=2)[:, :4]
    return torch.where(variances < variances.new_tensor(_DETERMINED).square(), variances, torch.inf)


def summarise(run: Track, reference: Tensor | None = None) -> dict[str, Any]:
    """Return a track's figures; ``reference`` (4,) is the RMSE on a straight road, for the recovery."""
    later = torch.arange(len(run.hard)) >= WARM_UP
    easy, hard = later & ~run.hard, later & run.hard
    known = run.bounds.isfinite() & easy[:, None, None]
    figures: dict[str, Any] = {
        "rmse": (rms(run.errors[easy]) * UNITS).tolist(),
        "ratio_to_bound": (mean_of(run.errors.square(), known) / mean_of(run.bounds, known)).sqrt().tolist(),
        "nees_per_dof": float(run.nees[easy].mean() / 4),
        "within_3_sigma": within_3_sigma(run)[later].mean().item(),
        "time_in_status": {s.name: float((run.status[later] == s).double().mean()) for s in Status},
    }
    if hard.any():
        figures["hard"] = {
            "rmse": (rms(run.errors[hard]) * UNITS).tolist(),
            "largest": (run.errors[hard].abs().amax((0, 1)) * UNITS).tolist(),
            "largest_sigma": (run.variances[hard].amax((0, 1)).sqrt() * UNITS).tolist(),
            "nees_per_dof": float(run.nees[hard].mean() / 4),
        }
        if reference is not None:
            figures["recovery_s"] = recovery(run, reference)
    return figures


def within_3_sigma(run: Track) -> Tensor:
    """Compute the share (T,) of all rows' parameters whose error is at most three of their sigmas."""
    return (run.errors.square() <= 9 * run.variances).double().mean((1, 2))


def recovery(run: Track, reference: Tensor, fps: float = FPS) -> float | None:
    """Compute the longest time, s, from the end of hard frames until all errors are below twice a reference.

    None if it never comes back before the next hard frames or the end.

    Args:
        run: run of a drive with hard frames.
        reference: (4,) or (T, 4) rad and m.
        fps: frame rate of the drive.
    """
    fine = (run.errors.square().mean(1).sqrt() <= 2 * reference).all(-1)  # (T,)
    ends = [k + 1 for k in range(len(fine) - 1) if run.hard[k] and not run.hard[k + 1]]
    longest = 0.0
    for end in ends:
        until = end
        while until < len(fine) and not fine[until] and not run.hard[until]:
            until += 1
        if until == len(fine) or run.hard[until]:
            return None
        longest = max(longest, (until - end) / fps)
    return longest


def rms(values: Tensor) -> Tensor:
    """Compute the root mean square over all dimensions but the last."""
    return values.flatten(0, -2).square().mean(0).sqrt()


def mean_of(values: Tensor, where: Tensor) -> Tensor:
    """Compute the mean over all dimensions but the last of the entries in the mask; NaN if there are none."""
    return torch.where(where, values, 0.0).flatten(0, -2).sum(0) / where.flatten(0, -2).sum(0)
