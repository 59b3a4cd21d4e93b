"""References of a replay as CSV files: written, read, and compared in sigmas."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from lanebev.estimation.mount import MountCalibration, MountReason, MountStatus
from lanebev.estimation.reasons import Reason
from lanebev.types import Extrinsics, Status
from tools.replay.recording import Recording, Replayed

STEP = 3  # every so manieth frame is kept
POSE = ("pitch_deg", "yaw_deg", "roll_deg", "height_cm")
_UNITS = (180 / math.pi, 180 / math.pi, 180 / math.pi, 100.0)

Row = dict[str, str]


class Difference(NamedTuple):
    """Difference of rows from their reference.

    Attributes:
        sigmas: by column, the largest difference in sigmas of the reference.
        words: by column, how many frames have another status, other reasons or another number of segments.
        problem: None, or why they cannot be compared at all.
    """

    sigmas: dict[str, float]
    words: dict[str, int]
    problem: str | None = None

    def within(self, tolerance: float) -> bool:
        """Return whether all words are the same and no number differs by more than so many sigmas."""
        largest = max(self.sigmas.values(), default=0.0)
        return self.problem is None and not any(self.words.values()) and largest <= tolerance

    def __str__(self) -> str:
        if self.problem:
            return self.problem
        moved = sorted(self.sigmas.items(), key=lambda item: -item[1])[:2]
        parts = [f"{name} {size:.2g} σ" for name, size in moved if size > 0]
        parts += [f"{name} in {count} frames" for name, count in self.words.items() if count]
        return ", ".join(parts) or "the same"


def pose_rows(recording: Recording, replayed: Replayed, row: int) -> list[Row]:
    """Return rows of the file of one drive, every ``STEP``-th frame.

    ``segments`` is how many there are, ``mean_px`` the mean of their end points' coordinates: where these
    differ, it is the drive that changed and not the calibrator.
    """
    rows = []
    for k in range(0, len(replayed.pose), STEP):
        seen = recording.segments.weight[k] > 0
        ends = recording.segments.endpoints[k][seen]
        rows.append(
            {
                "frame": str(k),
                "segments": str(int(seen.sum())),
                "mean_px": f"{float(ends.mean()) if len(ends) else 0.0:.3f}",
                **_numbers(replayed.pose[k, row], replayed.covariance[k, row].diagonal().sqrt()),
                "status": Status(int(replayed.status[k, row])).name,
                "reasons": _flags(Reason(int(replayed.reasons[k, row]))),
            }
        )
    return rows


def mount_rows(mounts: Sequence[MountCalibration], row: int) -> list[Row]:
    """Return rows of the mount estimator's file of one drive, every ``STEP``-th frame."""
    return [
        {
            "frame": str(k),
            **_numbers(
                Extrinsics(*mounts[k].extrinsics).stack()[row], mounts[k].covariance[row].diagonal().sqrt()
            ),
            "progress": f"{float(mounts[k].progress[row]):.0f}",
            "status": MountStatus(int(mounts[k].status[row])).name,
            "axis_status": " ".join(MountStatus(int(value)).name for value in mounts[k].axis_status[row]),
            "reasons": " ".join(
                _flags(MountReason(int(value))) or "-" for value in mounts[k].axis_reasons[row]
            ),
        }
        for k in range(0, len(mounts), STEP)
    ]


def _numbers(pose: Tensor, std: Tensor) -> Row:
    """Return pose and sigmas in degrees and cm; seven decimals are 1e-5 of the smallest sigma."""
    named = dict(zip(POSE, (pose * pose.new_tensor(_UNITS)).tolist(), strict=True))
    sigmas = dict(zip(POSE, (std * std.new_tensor(_UNITS)).tolist(), strict=True))
    return {name: f"{value + 0.0:.7f}" for name, value in named.items()} | {
        _sigma_of(name): f"{value:.7f}" for name, value in sigmas.items()
    }


def _sigma_of(name: str) -> str:
    """Convert a name such as pitch_deg to pitch_std_deg."""
    return name.replace("_", "_std_")


def _flags(reasons: Reason | MountReason) -> str:
    return (reasons.name or "") if reasons else ""


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as a CSV file."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_rows(path: Path) -> list[Row]:
    """Read a CSV file."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def difference_of(rows: Sequence[Row], reference: Sequence[Row]) -> Difference:
    """Compare rows with their reference: numbers in sigmas of the reference, words as they are."""
    if len(rows) != len(reference) or list(rows[0]) != list(reference[0]):
        return Difference({}, {}, "other frames or columns than the reference")
    sigmas: dict[str, float] = {}
    for name in POSE:
        spread = [float(old[_sigma_of(name)]) for old in reference]
        for column in (name, _sigma_of(name)):
            sigmas[column] = max(
                _apart(new[column], old[column], std)
                for new, old, std in zip(rows, reference, spread, strict=True)
            )
    words = {}
    for column in rows[0].keys() - sigmas.keys():
        same = _about_same if column == "mean_px" else str.__eq__
        words[column] = sum(
            not same(new[column], old[column]) for new, old in zip(rows, reference, strict=True)
        )
    return Difference(sigmas, words)


def _apart(new: str, old: str, sigma: float) -> float:
    """Compute the difference of two numbers in sigmas; infinite if one of them is not finite."""
    if new == old:
        return 0.0
    apart = abs(float(new) - float(old)) / sigma
    return apart if math.isfinite(apart) else math.inf


def _about_same(new: str, old: str) -> bool:
    """Return whether two means agree to a hundredth of a pixel."""
    return abs(float(new) - float(old)) < 0.01
