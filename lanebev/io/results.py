"""The output folder, written completely or not at all, and ``extrinsics.csv`` in it."""

from __future__ import annotations

import csv
import errno
import math
import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from enum import Flag
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from torch import Tensor

from lanebev.io.folder_lock import LOCK_NAME, FolderLock
from lanebev.io.formats.names import FORMATS
from lanebev.io.late_signals import late_signals_ignored
from lanebev.numbers import shown
from lanebev.types import Calibration, Status

CSV_COLUMNS = (
    "frame", "time_s", "pitch_deg", "yaw_deg", "roll_deg", "height_m", "pitch_std_deg", "yaw_std_deg",
    "roll_std_deg", "height_std_m", "status", "segments", "image", "reasons", "vertical_curvature_per_m",
)  # fmt: skip


def _number_or_none(text: str) -> float | None:
    return float(text) if text else None


def _status(text: str) -> str:
    return Status[text].name


_COLUMN_TYPES: tuple[Callable[[str], Any], ...] = (int, *[float] * 9, _status, int, str, str, _number_or_none)
_HEADERS = (CSV_COLUMNS, CSV_COLUMNS[:-1], CSV_COLUMNS[:-2])  # headers of this version and of earlier ones

OUTPUT_NAMES = (
    "extrinsics.csv", "filtered.csv", "lanes.json", "bev.mp4", "bev.png", "overlay.mp4", "overlay.png",
    "report.html", "state.safetensors", "calibration.yaml", "covariance.csv",
    *(known.file for known in FORMATS.values()),
)  # fmt: skip

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # what a disk says that has no room


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
    """Return a row of ``extrinsics.csv`` with this number of columns.

    Raises:
        ValueError: it has another number, or a value is none of its column.
    """
    if len(texts) != count:
        raise ValueError(f"expected {count} values, got {shown(','.join(texts))}; is the file cut?")
    values = []
    for name, kind, text in zip(CSV_COLUMNS, _COLUMN_TYPES, texts, strict=False):
        try:
            values.append(kind(text))
        except (ValueError, KeyError) as error:
            raise ValueError(f"{name}: expected a value as the run wrote it, got {shown(text)}") from error
    return ExtrinsicsRow(*values)


def check_inputs_stay(folder: str | Path, inputs: Iterable[str | Path]) -> None:
    """Raise if an output of the run would replace a file that it reads.

    Args:
        folder: output folder.
        inputs: files that the run reads, its state to resume with left out: that one is meant to be renewed.

    Raises:
        ValueError: an input is one of the files that a run replaces or removes in this folder.
    """
    outputs = {Path(os.path.realpath(folder)) / name for name in OUTPUT_NAMES}
    for path in map(Path, inputs):
        if {path.resolve(), path.parent.resolve() / path.name} & outputs:
            raise ValueError(
                f"input {path}: expected a file that the run leaves as it is, got one of the outputs in "
                f"{folder}; give another folder with --out"
            )


class OutputFolderError(ValueError):
    """The output folder cannot be used: no space, no permission, or another run writes into it."""


class OutputFolder:
    """A folder whose files appear all together when the work is done, or not at all.

    Files are written into a hidden temporary folder in it, or beside it if it is new, so on the same disk.
    On success they are moved into place, and outputs of an earlier run that this one did not write are
    removed; files of other names in an existing folder stay. On any error the folder is unchanged. Only one
    process at a time has the temporary folder. A killed process leaves it behind, for the next one to reuse
    or replace. Hidden files in it serve that purpose and are no outputs.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._target = Path(os.path.realpath(folder))  # of a link, where it leads to

    def __enter__(self) -> OutputFolder:
        """Make the temporary folder.

        Raises:
            OutputFolderError: the folder cannot be made or written, a folder is where an output goes, or
                another process is writing into it.
        """
        target = self._target
        self._made = [parent for parent in target.parents if not parent.exists()]
        try:
            if os.path.lexists(target) and not target.is_dir():
                raise NotADirectoryError(0, "a file of that name is there")
            for path in map(target.joinpath, OUTPUT_NAMES):
                if path.is_dir() and not path.is_symlink():
                    raise IsADirectoryError(0, f"a folder {path.name} in it, where a file goes")
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.is_dir() and not os.access(target, os.W_OK | os.X_OK):
                raise PermissionError(0, "no permission to write in it")
            beside = target if target.is_dir() else target.parent
            self._partial = beside / f".{target.name}.partial"
            self._lock = FolderLock(self._partial)
            if not self._lock.acquire():
                raise BlockingIOError(0, "another run writes into it now")
            for path in self._partial.iterdir():
                if not path.name.startswith("."):
                    path.replace(self.left(path.name))
        except OSError as error:
            self._remove_parents()
            raise OutputFolderError(
                f"output folder {self.folder}: expected one that can be written, got: {error.strerror}; "
                "give another with --out"
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        is_there, failure = self._partial.is_dir(), error
        try:
            if error is None:
                # a signal would leave some outputs of this run beside others of an earlier one
                with late_signals_ignored():
                    self._publish()
        except OSError as unpublished:
            failure = unpublished
        finally:
            shutil.rmtree(self._partial, ignore_errors=True)
            self._lock.release()
            if failure is not None:
                self._remove_parents()
        if isinstance(failure, OSError) and (words := self._words(failure, is_there, error is None)):
            raise OutputFolderError(f"output folder {self.folder}: {words}") from failure

    def _words(self, failure: OSError, is_there: bool, is_ours: bool) -> str:
        """Return what was expected of the folder and what was got; empty of an error elsewhere.

        Args:
            failure: what failed.
            is_there: whether the temporary folder was there at the end.
            is_ours: whether the outputs were moved into place then.
        """
        reason = failure.strerror
        if failure.errno in _FULL:
            return f"expected room for the outputs, got: {reason}; make room or give another with --out"
        if isinstance(failure, FileNotFoundError) and not is_there:
            return "expected it to stay until the outputs are written, got: deleted meanwhile; begin again"
        return f"expected one that can be written, got: {reason}; give another with --out" if is_ours else ""

    def __truediv__(self, name: str) -> Path:
        """Return where to write the file of this name until the work is done."""
        return self._partial / name

    def left(self, name: str) -> Path:
        """Return the path that a file of this name has after its process was killed."""
        return self._partial / f".{name}.left"

    def keep(self, name: str, why: str) -> str:
        """Copy an earlier run's file to ``name.why``, numbered if that exists, and return the new name."""
        names = (f"{name}.{why}{number or ''}" for number in count())
        kept = next(free for free in names if not os.path.lexists(self._target / free))
        shutil.copy2(self._target / name, self / kept)
        return kept

    def _publish(self) -> None:
        for path in self._partial.iterdir():
            if path.name.startswith(".") and path.name != LOCK_NAME:
                path.unlink()
        if not self._target.exists():
            self._partial.chmod(0o777 & ~_umask())  # it is for the owner alone
            self._partial.rename(self._target)
            (self._target / LOCK_NAME).unlink()
            return
        written = {path.name for path in self._partial.iterdir()} - {LOCK_NAME}
        for name in written:
            (self._partial / name).replace(self._target / name)
        for name in set(OUTPUT_NAMES) - written:
            (self._target / name).unlink(missing_ok=True)

    def _remove_parents(self) -> None:
        for parent in self._made:
            if parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
