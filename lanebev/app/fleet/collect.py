"""Collect all frames of all drives in one Parquet data set, by camera and day."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from lanebev.app.fleet.manifest import Drive
from lanebev.app.fleet.plan import drive_folder
from lanebev.io.formats.folder import read_record
from lanebev.io.formats.names import check_installed
from lanebev.io.formats.parquet import frame_table
from lanebev.io.output.whole_file import whole_file

if TYPE_CHECKING:
    import pyarrow

FRAMES = "frames"


def frames_path(out: str | Path, drive: Drive) -> Path:
    """Return the file of a drive in the data set, whose folders say camera and day as Hive does."""
    parts = (
        f"camera={_quoted(drive.camera_id)}",
        f"day={_quoted(drive.day)}",
        f"{_quoted(drive.name)}.parquet",
    )
    return Path(out) / FRAMES / Path(*parts)


def collect_frames(drives: Sequence[Drive], out: str | Path) -> None:
    """Update the data set: add finished drives, remove the files of all others.

    The columns are those of a run's Parquet file, and ``drive``. A file that is newer than the run stays.
    """
    check_installed(["parquet"])
    import pyarrow.parquet

    wanted = {frames_path(out, drive): drive for drive in drives}
    for path in (Path(out) / FRAMES).glob("camera=*/day=*/*.parquet"):
        if path not in wanted:
            path.unlink()
    for path, drive in wanted.items():
        run = drive_folder(out, drive.name)
        if path.is_file() and path.stat().st_mtime_ns >= (run / "extrinsics.csv").stat().st_mtime_ns:
            continue
        with whole_file(path) as whole:
            pyarrow.parquet.write_table(_table(run, drive.name), whole)


def _table(run: Path, name: str) -> pyarrow.Table:
    import pyarrow as pa

    table = frame_table(read_record(run))
    return table.add_column(0, pa.field("drive", pa.string()), pa.array([name] * table.num_rows, pa.string()))


def _quoted(text: str) -> str:
    return quote(text, safe=" ")
