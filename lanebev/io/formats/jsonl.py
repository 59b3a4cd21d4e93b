"""JSON lines: a line per frame."""

import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from lanebev.io.formats.record import RunRecord
from lanebev.io.formats.table import frame_fields
from lanebev.io.frames import Frame


def frame_lines(record: RunRecord) -> Iterator[str]:
    """Return a frame's line after another's: the fields of :func:`frame_fields`, null for what is not finite.

    Source: jsonlines.org; RFC 8259, which has no NaN.
    """
    for fields in frame_fields(record):
        yield json.dumps({name: _finite(value) for name, value in fields.items()}, allow_nan=False)


def write(path: Path, record: RunRecord, images: Iterable[Frame] | None = None) -> None:
    """Write the run; ``images`` are not used."""
    with open(path, "w", encoding="utf-8") as file:
        file.writelines(line + "\n" for line in frame_lines(record))


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
