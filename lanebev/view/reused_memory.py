"""Memory that is reused from call to call: allocating a page takes longer than filling it."""

import threading
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

_MOST_BYTES = 1 << 28  # that a thread keeps in all its arrays


class ReusedArrays(threading.local):
    """Arrays that every call fills again, separate for each thread.

    They are for what a function computes on its way, and are never part of what it returns.
    """

    def __init__(self) -> None:
        self._arrays: dict[tuple[str, tuple[int, ...], np.dtype[Any]], NDArray[Any]] = {}

    def __call__(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return the array of this name, shape and type, with any values in it."""
        key = name, tuple(shape), np.dtype(dtype)
        if key not in self._arrays:
            made: NDArray[Any] = np.empty(shape, dtype)
            if made.nbytes + sum(array.nbytes for array in self._arrays.values()) > _MOST_BYTES:
                self._arrays.clear()
            if made.nbytes > _MOST_BYTES:
                return made
            self._arrays[key] = made
        return self._arrays[key]
