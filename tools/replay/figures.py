"""Statistics of a calibrator on a drive with known truth, as a row of a table."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.observation.segments import LaneSegments
from lanebev.testing.evaluation import UNITS, Track, frame_bound, recovery, rms, summarise, within_3_sigma
from tools.replay.recording import Recording, Replayed


class Figures(NamedTuple):
    """Statistics of one drive.

    Attributes:
        rmse: of pitch, yaw, roll in degrees and height in cm.
        ratio: RMSE by the per-frame Cramér-Rao bound, NaN where there is none.
        nees: NEES per degree of freedom; 1 where the covariance is right.
        within: share of the four parameters within 3 sigma.
        worst: the same share in the second in which it is lowest.
        back: s from the end of the event until all errors are below twice the bound; inf if that is never,
            NaN where there is no event.
    """

    rmse: tuple[float, ...]
    ratio: tuple[float, ...]
    nees: float
    within: float
    worst: float
    back: float


def drive_figures(recording: Recording, replayed: Replayed, row: int) -> Figures:
    """Compute the figures of one drive; RMSE, ratio and NEES leave out the first 15 frames and the event."""
    run = as_track(recording, replayed, row)
    found = summarise(run)
    fps = 1 / float(recording.dt[recording.dt > 0].median())
    share = within_3_sigma(run)
    window = min(max(round(fps), 1), len(share))
    return Figures(
        rmse=tuple(found["rmse"]),
        ratio=tuple(found["ratio_to_bound"]),
        nees=found["nees_per_dof"],
        within=float(share.mean()),
        worst=float(share.unfold(0, window, 1).mean(-1).amin()),
        back=_back(run, fps),
    )


def after_shock(run: Track, fps: float) -> list[float]:
    """Compute the RMSE (4,) in degrees and cm of the half second that begins half a second after the event.

    Args:
        run: run of a drive with hard frames.
        fps: frame rate of the drive.
    """
    end = int(run.hard.nonzero().max()) + 1
    half = round(0.5 * fps)
    found: list[float] = (rms(run.errors[end + half : end + 2 * half]) * UNITS).tolist()
    return found


def as_track(recording: Recording, replayed: Replayed, row: int) -> Track:
    """Return errors, variances and bounds of one drive, R = 1."""
    error = (replayed.pose[:, row] - recording.truth).unsqueeze(1)
    covariance = replayed.covariance[:, row].unsqueeze(1)
    nees = (error * torch.linalg.solve(covariance, error)).sum(-1)
    return Track(
        error,
        covariance.diagonal(dim1=-2, dim2=-1),
        nees,
        replayed.status[:, row].unsqueeze(1),
        _bounds(recording),
        recording.hard,
    )


def _bounds(recording: Recording) -> Tensor:
    """Return variances (T, 1, 4) of the per-frame bound; inf for a drive that was not generated."""
    if not recording.moments:
        return torch.full((len(recording.truth), 1, 4), torch.inf, dtype=torch.float64)
    return torch.stack(
        [
            frame_bound(
                moment, LaneSegments(*(part[k : k + 1] for part in recording.segments)), recording.intrinsics
            )
            for k, moment in enumerate(recording.moments)
        ]
    )


def _back(run: Track, fps: float) -> float:
    """Return the seconds until the errors are below twice the bound after the last frame of the event."""
    if not run.hard.any():
        return math.nan
    back = recovery(run, run.bounds[:, 0].sqrt(), fps)
    return math.inf if back is None else back


def markdown(rows: list[tuple[str, str, Figures]]) -> str:
    """Return the table of drive, calibrator and figures."""
    lines = [
        "| drive | calibrator | RMSE pitch, yaw, roll °, height cm | × bound | NEES/dof | within 3 σ "
        "| in the worst second | back after |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, calibrator, found in rows:
        rmse = " ".join(f"{value:.3f}" for value in found.rmse)
        ratio = " ".join("–" if math.isnan(value) else f"{value:.2f}" for value in found.ratio)
        lines.append(
            f"| {name} | {calibrator} | {rmse} | {ratio} | {found.nees:.2f} | {100 * found.within:.0f} % "
            f"| {100 * found.worst:.0f} % | {_seconds(found.back)} |"
        )
    return "\n".join(lines)


def _seconds(value: float) -> str:
    if math.isnan(value):
        return ""
    return "not" if math.isinf(value) else f"{value:.2f} s"
