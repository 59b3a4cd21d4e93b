"""Run the estimators on the drives of a replay and compare the results with the references."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from tools.replay.kinds import GENERATED, Generated
from tools.replay.recording import Recording, Replayed, record, replay
from tools.replay.references import Difference, Row, difference_of, mount_rows, pose_rows, read_rows
from tools.replay.rendered import RENDERED, Rendered, load

REFERENCES = Path(__file__).resolve().parents[2] / "tests" / "replay" / "references"

TOLERANCE = 1e-3
"""Sigmas by which a number may differ. Rounding, as other processors and versions of torch do it, stays far
below: it is some 1e-12 px of an end point, and end points moved by a million times that change no number by
as much as 3e-4 sigmas. A change of an estimator that stays below it is no change of the pose."""

_DRIVES: dict[str, Generated | Rendered] = {**GENERATED, **RENDERED}

Key = tuple[str, str]
"""Names of a drive and of an estimator."""


class Results(NamedTuple):
    """Results of the estimators on some drives.

    Attributes:
        rows: rows of the reference files, by drive and estimator.
        replayed: results by calibrator, the drives in their order.
    """

    rows: dict[Key, list[Row]]
    replayed: dict[str, Replayed]


def drive_kinds() -> dict[str, str]:
    """Return the kind of every drive by the drive's name."""
    return {name: drive.kind for name, drive in _DRIVES.items()}


def recordings(names: Collection[str]) -> dict[str, Recording]:
    """Draw or read the drives of these names. Each has its own seed, whatever others there are."""
    return {
        name: record(GENERATED[name], crc32(name.encode())) if name in GENERATED else load(name)
        for name in names
    }


def calibrators() -> dict[str, Calibrator[Any]]:
    """Return the calibrators with their default settings, by their names in the references."""
    return {"joint": JointCalibrator(), "two-stage": TwoStageCalibrator()}


def replay_all(drives: Mapping[str, Recording], estimators: Mapping[str, Calibrator[Any]]) -> Results:
    """Run every calibrator over all drives at once, and the mount estimator behind the first of them."""
    replayed = {label: replay(calibrator, list(drives.values())) for label, calibrator in estimators.items()}
    rows: dict[Key, list[Row]] = {}
    for row, (name, recording) in enumerate(drives.items()):
        for label, made in replayed.items():
            rows[name, label] = pose_rows(recording, made, row)
        if recording.mount:
            rows[name, "mount"] = mount_rows(next(iter(replayed.values())).mounts, row)
    return Results(rows, replayed)


def reference_path(key: Key) -> Path:
    """Return the path of a reference file."""
    return REFERENCES / f"{'.'.join(key)}.csv"


def reference_paths() -> set[Path]:
    """Return the paths of all references that there should be."""
    keys = [(name, label) for name in _DRIVES for label in calibrators()]
    keys += [(name, "mount") for name, drive in _DRIVES.items() if drive.mount]
    return {reference_path(key) for key in keys}


def differences(rows: Mapping[Key, Sequence[Row]]) -> dict[Key, Difference]:
    """Compare rows with the reference files."""
    found = {}
    for key, own in rows.items():
        path = reference_path(key)
        found[key] = (
            difference_of(own, read_rows(path)) if path.is_file() else Difference({}, {}, "no reference")
        )
    return found
