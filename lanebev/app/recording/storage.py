"""Compact storage of every frame until the end of a run: ten hours have a million frames."""

from __future__ import annotations

import io
import math
import tempfile
from array import array
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from lanebev.io.results import ExtrinsicsRow

_NUMBERS = 10  # numbers in a row: nine from time_s on, and the vertical curvature


class StoredRows(Sequence[ExtrinsicsRow]):
    """Rows of ``extrinsics.csv`` stored as columns, 0.1 kB each; a row is made when it is requested."""

    def __init__(self, rows: Iterable[ExtrinsicsRow] = ()) -> None:
        self._numbers, self._counts, self._codes = array("d"), array("q"), array("l")
        self._texts: dict[str, int] = {}
        self._known: list[str] = []
        self._images: list[str] = []  # each is there once, in the source
        for row in rows:
            self.append(row)

    def append(self, row: ExtrinsicsRow) -> None:
        """Add the row of the next frame."""
        curvature = row.vertical_curvature_per_m
        self._numbers.extend(float(number) for number in row[1:10])
        self._numbers.append(math.nan if curvature is None else curvature)
        self._counts.extend((row.frame, row.segments))
        self._codes.extend((self._code(row.status), self._code(row.reasons)))
        self._images.append(row.image)  # last: from now on it is there for other threads

    def __len__(self) -> int:
        return len(self._images)

    @overload
    def __getitem__(self, place: int) -> ExtrinsicsRow: ...

    @overload
    def __getitem__(self, place: slice) -> StoredRows: ...

    def __getitem__(self, place: int | slice) -> ExtrinsicsRow | StoredRows:
        if isinstance(place, slice):
            return StoredRows(self[each] for each in range(*place.indices(len(self))))
        at = range(len(self))[place]
        frame, segments = self._counts[2 * at : 2 * at + 2]
        status, reasons = (self._known[code] for code in self._codes[2 * at : 2 * at + 2])
        *numbers, curvature = self._numbers[_NUMBERS * at : _NUMBERS * (at + 1)]
        texts = (status, segments, self._images[at], reasons)
        return ExtrinsicsRow._make([frame, *numbers, *texts, None if math.isnan(curvature) else curvature])

    def _code(self, text: str) -> int:
        if text not in self._texts:
            self._known.append(text)
            self._texts[text] = len(self._known) - 1
        return self._texts[text]


class StoredNumbers:
    """Arrays of one shape, one for each frame, stored as their numbers only.

    Args:
        shape: shape of each array.
        folder: where they are kept on disk, in a file without a name; None keeps them in memory.
    """

    def __init__(self, *shape: int, folder: str | Path | None = None) -> None:
        self._shape, self._count = shape, 0
        self._file = io.BytesIO() if folder is None else tempfile.TemporaryFile(dir=folder)  # noqa: SIM115

    def append(self, values: NDArray[np.float64]) -> None:
        """Add the array of the next frame.

        Raises:
            ValueError: it has another shape.
            OSError: the disk is full.
        """
        if values.shape != self._shape:
            raise ValueError(f"values: expected shape {self._shape}, got {values.shape}")
        self._file.write(np.ascontiguousarray(values, np.float64).tobytes())
        self._count += 1

    def all(self) -> NDArray[np.float64]:
        """Return all of them, (F, ...), without a copy; no more can be added while it is in use."""
        whole = (self._count, *self._shape)
        if isinstance(self._file, io.BytesIO):
            return np.frombuffer(self._file.getbuffer(), np.float64).reshape(whole)
        self._file.flush()
        return np.memmap(self._file, np.float64, "r", shape=whole) if self._count else np.zeros(whole)
