"""Rows of ``extrinsics.csv``: made of calibrations, written and read."""

import csv
import math
from collections.abc import Callable, Iterable, Sequence
from enum import Flag
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lanebev.numbers import shown
from lanebev.types import Calibration, Extrinsics, Status


class ExtrinsicsRow(NamedTuple):
    """One row of ``extrinsics.csv``, in its units and order.

    ``reasons`` are names joined by ``|``; ``vertical_curvature_per_m`` is None where it was not estimated.
    """

    frame: int
    time_s: float
    pitch_deg: float
    yaw_deg: float
    roll_deg: float
    height_m: float
    pitch_std_deg: float
    yaw_std_deg: float
    roll_std_deg: float
    height_std_m: float
    status: str
    segments: int
    image: str
    reasons: str = ""
    vertical_curvature_per_m: float | None = None

    @property
    def pose(self) -> tuple[float, float, float, float]:
        """Pitch, yaw, roll (deg) and height (m)."""
        return self.pitch_deg, self.yaw_deg, self.roll_deg, self.height_m

    @property
    def std(self) -> tuple[float, float, float, float]:
        """Standard deviations of pitch, yaw, roll (deg) and height (m)."""
        return self.pitch_std_deg, self.yaw_std_deg, self.roll_std_deg, self.height_std_m

    @property
    def reason_names(self) -> list[str]:
        """Names of the reasons that hold in the frame."""
        return [name for name in self.reasons.split("|") if name]


CSV_COLUMNS = ExtrinsicsRow._fields
_HEADERS = (CSV_COLUMNS, CSV_COLUMNS[:-1], CSV_COLUMNS[:-2])  # headers of this version and of earlier ones


def _number_or_none(text: str) -> float | None:
    return float(text) if text else None


def _status(text: str) -> str:
    return Status[text].name


_COLUMN_TYPES: tuple[Callable[[str], Any], ...] = (int, *[float] * 9, _status, int, str, str, _number_or_none)


def poses_of(rows: Iterable[ExtrinsicsRow]) -> Extrinsics:
    """Return the poses of N rows, each (N,) rad and m, float64."""
    scale = torch.tensor([math.pi / 180] * 3 + [1.0], dtype=torch.float64)
    degrees = torch.tensor([row.pose for row in rows], dtype=torch.float64)
    return Extrinsics.unstack(degrees.reshape(-1, 4) * scale)


def extrinsics_row(
    frame: int,
    time: float,
    calibration: Calibration,
    weight: Tensor,
    image: str,
    reasons: Iterable[Flag] = (),
    vertical_curvature: Tensor | None = None,
) -> ExtrinsicsRow:
    """Return the row of a frame.

    Args:
        frame: its number.
        time: s.
        calibration: calibration of batch size 1.
        weight: (1, N) of the frame's segments; those above zero are counted.
        image: the file's path as found, empty for a video.
        reasons: flags such as those of :class:`lanebev.Reason` that hold in this frame.
        vertical_curvature: (1,) 1/m of the road; None where the calibrator takes it as plane.
    """
    pitch, yaw, roll, height = calibration.extrinsics.stack()[0].tolist()
    variances = calibration.covariance[0].diagonal().clamp_min(0)
    pitch_std, yaw_std, roll_std, height_std = variances.sqrt().tolist()
    return ExtrinsicsRow(
        frame=frame,
        time_s=time,
        pitch_deg=math.degrees(pitch),
        yaw_deg=math.degrees(yaw),
        roll_deg=math.degrees(roll),
        height_m=height,
        pitch_std_deg=math.degrees(pitch_std),
        yaw_std_deg=math.degrees(yaw_std),
        roll_std_deg=math.degrees(roll_std),
        height_std_m=height_std,
        status=Status(int(calibration.status[0])).name,
        segments=int((weight[0] > 0).sum()),
        image=image,
        reasons="|".join(str(reason.name) for reason in reasons),
        vertical_curvature_per_m=None if vertical_curvature is None else float(vertical_curvature[0]),
    )


def write_extrinsics(path: str | Path, rows: Iterable[ExtrinsicsRow]) -> None:
    """Write ``extrinsics.csv``: a header and one row per frame."""
    with open(path, "w", newline="", encoding="utf-8", errors="surrogateescape") as file:  # names of files
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CSV_COLUMNS)
        for row in rows:
            *numbers, curvature = (f"{value:.6f}" if isinstance(value, float) else value for value in row)
            if row.vertical_curvature_per_m is not None:
                curvature = f"{row.vertical_curvature_per_m:.9f}"  # a radius of 100 km is 0.00001
            writer.writerow([*numbers, curvature])


def read_extrinsics(path: str | Path) -> list[ExtrinsicsRow]:
    """Read what :func:`write_extrinsics` wrote, now or in an earlier version without the last columns.

    Raises:
        ValueError: the file is missing, its header or a row is not ours, or its frames are not in order.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig", errors="surrogateescape") as file:
            reader = csv.reader(file)
            header, *rows = [(reader.line_num, row) for row in reader if row] or [(1, [])]
    except (OSError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(f"{path}: expected a readable extrinsics.csv, got: {reason}") from error
    if tuple(header[1]) not in _HEADERS:
        expected, got = ",".join(CSV_COLUMNS), shown(",".join(header[1]))
        raise ValueError(
            f"{path}: expected the columns {expected}, got {got}; if another program saved it, take the "
            "run's own file"
        )
    result: list[ExtrinsicsRow] = []
    for number, row in rows:
        try:
            result.append(_read_row(row, len(header[1])))
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from error
        before, after = (each.frame for each in (result[-2:] if len(result) > 1 else (result[0], result[0])))
        if len(result) > 1 and after <= before:
            raise ValueError(
                f"{path}, line {number}: expected frames in order, got {after} after {before}; were the rows "
                "sorted or copied?"
            )
    return result


def _read_row(texts: Sequence[str], count: int) -> ExtrinsicsRow:
    """Return a row of ``extrinsics.csv`` with this number of columns."""
    if len(texts) != count:
        raise ValueError(f"expected {count} values, got {shown(','.join(texts))}; is the file cut?")
    values = []
    for name, kind, text in zip(CSV_COLUMNS, _COLUMN_TYPES, texts, strict=False):
        try:
            values.append(kind(text))
        except (ValueError, KeyError) as error:
            raise ValueError(f"{name}: expected a value as the run wrote it, got {shown(text)}") from error
    return ExtrinsicsRow(*values)
