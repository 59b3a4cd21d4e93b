"""Compact storage of every frame until the end of a run: ten hours have a million frames."""

from __future__ import annotations

import io
import math
import sys
import tempfile
from array import array
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from lanebev.io.results import ExtrinsicsRow

_NUMBERS, _TEXTS = 12, 3  # in a row


class StoredRows(Sequence[ExtrinsicsRow]):
    """Rows of ``extrinsics.csv`` stored as numbers, 0.1 kB each; a row is made when it is requested."""

    def __init__(self, rows: Iterable[ExtrinsicsRow] = ()) -> None:
        self._numbers = array("d")
        self._texts: list[str] = []  # status, image and reasons of each row; equal texts are one object
        for row in rows:
            self.append(row)

    def append(self, row: ExtrinsicsRow) -> None:
        """Add the row of the next frame."""
        curvature = row.vertical_curvature_per_m
        self._numbers.extend(map(float, (*row[:10], row.segments)))
        self._numbers.append(math.nan if curvature is None else curvature)
        # last: from now on it is there for other threads; names of images are those of the source
        self._texts += (sys.intern(row.status), row.image, sys.intern(row.reasons))

    def __len__(self) -> int:
        return len(self._texts) // _TEXTS

    @overload
    def __getitem__(self, place: int) -> ExtrinsicsRow: ...

    @overload
    def __getitem__(self, place: slice) -> StoredRows: ...

    def __getitem__(self, place: int | slice) -> ExtrinsicsRow | StoredRows:
        if isinstance(place, slice):
            return StoredRows(self[each] for each in range(*place.indices(len(self))))
        at = range(len(self))[place]
        frame, *numbers, segments, curvature = self._numbers[_NUMBERS * at : _NUMBERS * (at + 1)]
        status, image, reasons = self._texts[_TEXTS * at : _TEXTS * (at + 1)]
        values = [int(frame), *numbers, status, int(segments), image, reasons]
        return ExtrinsicsRow._make([*values, None if math.isnan(curvature) else curvature])


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
        """Add the array of the next frame."""
        if values.shape != self._shape:
            raise ValueError(f"values: expected shape {self._shape}, got {values.shape}")
        self._file.write(np.ascontiguousarray(values, np.float64).tobytes())
        self._count += 1

    def __len__(self) -> int:
        return self._count

    def all(self) -> NDArray[np.float64]:
        """Return all of them, (F, ...), without a copy; no more can be added while it is in use."""
        whole = (self._count, *self._shape)
        if isinstance(self._file, io.BytesIO):
            return np.frombuffer(self._file.getbuffer(), np.float64).reshape(whole)
        self._file.flush()
        return np.memmap(self._file, np.float64, "r", shape=whole) if self._count else np.zeros(whole)
