"""JSON lines: a line per frame."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lanebev.io.formats.record import RunRecord


def frame_fields(record: RunRecord) -> Iterator[dict[str, Any]]:
    """Return a frame's fields after another's: those of ``extrinsics.csv``, and its covariance.

    ``reasons`` is a list of names. ``covariance`` is 4 x 4 of pitch, yaw, roll (rad) and height (m), or None
    where not all of it is known.
    """
    for row, covariance in zip(record.rows, record.covariances, strict=True):
        known = not np.isnan(covariance).any()
        image = row.image.encode("utf-8", "replace").decode()  # names of files may be no text
        yield {
            **row._asdict(),
            "image": image,
            "reasons": row.reason_names,
            "covariance": covariance.tolist() if known else None,
        }


def frame_lines(record: RunRecord) -> Iterator[str]:
    """Return a frame's line after another's: the fields of :func:`frame_fields`, null for what is not finite.

    Source: jsonlines.org; RFC 8259, which has no NaN.
    """
    for fields in frame_fields(record):
        yield json.dumps({name: _finite(value) for name, value in fields.items()}, allow_nan=False)


def write(path: Path, record: RunRecord) -> None:
    """Write the run."""
    with open(path, "w", encoding="utf-8") as file:
        file.writelines(line + "\n" for line in frame_lines(record))


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
