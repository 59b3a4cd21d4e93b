"""A finished run's folder, read back for conversion."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lanebev.camera.model import Camera
from lanebev.io.calibration_file import read_mount
from lanebev.io.covariances import diagonal_covariances, read_covariances
from lanebev.io.formats.record import Lines, RunRecord
from lanebev.io.lanes.parsing import Where, field, json_object, number_array
from lanebev.io.results import read_extrinsics
from lanebev.numbers import finite_numbers
from lanebev.types import Extrinsics

CALIBRATION, LANES, COVARIANCES = "calibration.yaml", "lanes.json", "covariance.csv"


def read_record(folder: str | Path, camera: str | Path | None = None) -> RunRecord:
    """Read a run's folder; of its files only ``extrinsics.csv`` must be there.

    Args:
        folder: output folder of a run.
        camera: camera file; None is the folder's ``calibration.yaml``, if there is one.

    Raises:
        ValueError: a file of it is missing or not ours, or has another number of frames.
    """
    folder = Path(folder)
    rows = read_extrinsics(folder / "extrinsics.csv")
    if not rows:
        raise ValueError(f"{folder / 'extrinsics.csv'}: expected a row per frame, got none")
    std = np.array([row.std for row in rows])
    covariances = diagonal_covariances(std * (*[np.pi / 180] * 3, 1.0))
    if (folder / COVARIANCES).is_file():
        covariances = read_covariances(folder / COVARIANCES)
    lanes = FittedLanes(folder / LANES) if (folder / LANES).is_file() else None
    for name, parts in ((COVARIANCES, covariances), (LANES, lanes)):
        if parts is not None and len(parts) != len(rows):
            raise ValueError(
                f"{folder / name}: expected {len(rows)} frames as in extrinsics.csv, got {len(parts)}"
            )
    lens = Camera.from_file(folder / CALIBRATION) if (folder / CALIBRATION).is_file() else None
    if camera is not None:
        given = Camera.from_file(camera, None if lens is None else lens.image_size)
        if lens is not None and lens.fingerprint() != given.fingerprint():
            raise ValueError(
                f"camera {camera}: expected the run's, which is in {folder / CALIBRATION}, got another; "
                "leave --camera out"
            )
        lens = given
    return RunRecord(
        name=folder.resolve().name,
        rows=rows,
        covariances=covariances,
        lanes=lanes,
        camera=lens,
        mounted=_mounted(folder / CALIBRATION),
    )


class FittedLanes:
    """The boundaries that a run fitted, ``lanes`` of its ``lanes.json``, read anew by each iteration.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def __len__(self) -> int:
        with open(self.path, "rb") as file:
            return sum(1 for line in file if line.strip())

    def __iter__(self) -> Iterator[Lines]:
        """Return a frame's boundaries after another's.

        Raises:
            ValueError: the file is cut, or not ours.
        """
        with open(self.path, encoding="utf-8", errors="surrogateescape") as file:
            for number, text in enumerate(file, start=1):
                with Where(self.path, number):
                    lines = _lines(json_object(text))
                yield lines


def _lines(fields: dict[str, Any]) -> Lines:
    """Return the boundaries of a frame by index; -2 is where there is none, as TuSimple has it."""
    rows = np.array(finite_numbers("h_samples", field(fields, "h_samples", list)))
    lanes, indices = field(fields, "lanes", list), field(fields, "boundary", list)
    if len(lanes) != len(indices):
        raise ValueError(f"boundary: expected {len(lanes)} indices, one per lane, got {len(indices)}")
    found = {}
    for index, lane in zip(indices, lanes, strict=True):
        x = number_array(f"lane {index}", lane, len(rows))
        found[int(index)] = np.stack([x, rows], axis=-1)[x >= 0]
    return {index: points for index, points in found.items() if len(points)}


def _mounted(path: Path) -> Extrinsics | None:
    """Return a ``calibration.yaml``'s mount, each (1,), if it is calibrated on all axes."""
    try:
        mount = read_mount(path)
    except ValueError:
        return None  # no file, or no axis is calibrated
    return Extrinsics.unstack(mount.pose[None]) if bool(mount.std.isfinite().all()) else None
