"""``covariance.csv``: the covariance matrix of every frame."""

import csv
import itertools
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lanebev.numbers import finite_numbers, shown
from lanebev.types import AXES

PAIRS = tuple(itertools.combinations_with_replacement(range(4), 2))
COVARIANCE_COLUMNS = ("frame", *(f"{AXES[i]}_{AXES[j]}" for i, j in PAIRS))


def write_covariances(path: str | Path, covariances: Iterable[NDArray[np.float64]]) -> None:
    """Write a header and one row per frame: the upper triangle, row by row, rad², rad m and m².

    Args:
        path: the file.
        covariances: (4, 4) of pitch, yaw, roll (rad) and height (m), a frame each.
    """
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COVARIANCE_COLUMNS)
        for number, covariance in enumerate(covariances):
            writer.writerow([number, *(f"{covariance[pair]:.9g}" for pair in PAIRS)])


def read_covariances(path: str | Path) -> NDArray[np.float64]:
    """Read what :func:`write_covariances` wrote.

    Returns:
        (N, 4, 4).

    Raises:
        ValueError: the file cannot be read, its header or a row is not ours, or frames are out of order.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            header, *rows = [row for row in csv.reader(file) if row] or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(f"{path}: expected a readable covariance.csv, got: {reason}") from error
    if tuple(header) != COVARIANCE_COLUMNS:
        expected, got = ",".join(COVARIANCE_COLUMNS), shown(",".join(header))
        raise ValueError(f"{path}: expected the columns {expected}, got {got}")
    result, before = np.zeros((len(rows), 4, 4)), 0.0
    for number, row in enumerate(rows):
        try:
            frame, *values = finite_numbers("covariance", row, len(COVARIANCE_COLUMNS))
            if number and frame <= before:
                raise ValueError(f"expected frames in order, got {frame:g} after {before:g}")
        except ValueError as error:
            raise ValueError(f"{path}, line {number + 2}: {error}") from error
        before = frame
        for (i, j), value in zip(PAIRS, values, strict=True):
            result[number, i, j] = result[number, j, i] = value
    return result


def diagonal_covariances(std: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 4, 4) of standard deviations (N, 4), NaN where two axes meet: it is not known."""
    result = np.full((len(std), 4, 4), np.nan)
    result[:, range(4), range(4)] = std**2
    return result
