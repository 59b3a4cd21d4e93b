"""Parquet: a row per frame."""

from pathlib import Path
from typing import Any

from lanebev import __version__
from lanebev.io.formats.jsonl import frame_fields
from lanebev.io.formats.record import RunRecord
from lanebev.io.results import CSV_COLUMNS

CONVENTIONS = (
    "pitch > 0: camera looks down; yaw > 0: it points left of the lanes; roll > 0: counter-clockwise seen "
    "from behind; height in m above the road; covariance: 4 x 4, row by row, of pitch, yaw, roll (rad) and "
    "height (m)"
)


def frame_table(record: RunRecord) -> Any:
    """Return a ``pyarrow.Table``, a row per frame.

    Columns are those of ``extrinsics.csv`` with its names and units, where ``reasons`` is a list of texts,
    and ``covariance``, 16 numbers or null: row by row, of pitch, yaw, roll (rad) and height (m). The schema's
    metadata name the conventions, the version and, if it is known, the camera's fingerprint.
    """
    import pyarrow as pa

    numbers = [(name, pa.float64()) for name in CSV_COLUMNS[1:10]]
    schema = pa.schema(
        [
            ("frame", pa.int64()),
            *numbers,
            ("status", pa.string()),
            ("segments", pa.int64()),
            ("image", pa.string()),
            ("reasons", pa.list_(pa.string())),
            ("vertical_curvature_per_m", pa.float64()),
            ("covariance", pa.list_(pa.float64(), 16)),
        ],
        metadata={"lanebev": __version__, "conventions": CONVENTIONS, "run": record.name}
        | ({} if record.camera is None else {"camera": record.camera.fingerprint()}),
    )
    columns: dict[str, list[Any]] = {name: [] for name in schema.names}
    for fields in frame_fields(record):
        if fields["covariance"] is not None:
            fields["covariance"] = [value for line in fields["covariance"] for value in line]
        for name, values in columns.items():
            values.append(fields[name])
    return pa.table(columns, schema=schema)


def write(path: Path, record: RunRecord) -> None:
    """Write the run."""
    import pyarrow.parquet

    pyarrow.parquet.write_table(frame_table(record), path)
