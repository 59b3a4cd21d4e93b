"""CULane's ``.lines.txt``."""

from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lanebev.io.lanes.parsing import FrameLines, Where, checked_pixels, lane_text
from lanebev.numbers import numbers_or_gaps
from lanebev.observation.polylines import LaneLine
from lanebev.types import NUM_BOUNDARIES

_NOT_THERE = (-2.0, -1.0)  # x of points that detectors made for TuSimple do not see, or a pixel outside
_MOST_CLASSES = 20  # largest index of a lane's class
_FAR = 10  # times the median distance of rows
_GAP = 2.5  # times the median distance of rows: from there on a line is not seen in between


def read_culane(path: str | Path) -> FrameLines:
    """Read CULane's ``.lines.txt``, a line of ``x y x y ...`` per lane; the path without suffix names it.

    A point that is repeated right after itself counts once; x of ``nan``, -2 or -1 is a point that is not
    there. Where rows are left out, the line is not seen.
    """
    path = Path(path)
    lines = []
    content = lane_text(path)
    rows = content.split("\n")
    for number, text in enumerate(rows, start=1):
        with Where(path, number):
            if "/" in text:
                raise ValueError("expected x y pairs, got a path; give the folder of the .lines.txt files")
            if "," in text or ";" in text:
                raise ValueError("expected spaces between numbers, got commas or semicolons; replace them")
            texts = text.split()
            values = numbers_or_gaps("points", texts)
            if len(values) % 2:
                raise ValueError(
                    f"expected x y pairs, got {len(values)} numbers; is the file cut, or a class beside them?"
                )
            pairs = (pair for pair in zip(values[::2], values[1::2], strict=True) if pair[1] == pair[1])
            found = np.array([point for point, _ in groupby(pairs)]).reshape(-1, 2)
            points = checked_pixels("points", found)
            _check_first_pair(points)
            if number == len(rows) and texts:
                _check_last_row(points[:, 1], texts[-1])
            points[np.isin(points[:, 0], _NOT_THERE), 0] = np.nan
            if np.isfinite(points).all(-1).any():
                lines.append(LaneLine(_with_gaps(points)))
    if len(lines) > NUM_BOUNDARIES and max(len(line.points) for line in lines) == 1:
        raise ValueError(f"lane file {path}: expected a line of text for each lane, got one for each point")
    return FrameLines(str(path).removesuffix(".txt").removesuffix(".lines"), lines)


def _check_first_pair(points: NDArray[np.float64]) -> None:
    """Raise if the first of several points (P, 2) is none: small numbers far from the other rows.

    So it is where a line begins with its class and its score. Zeros may be padding, or a corner.
    """
    if (
        len(points) < 3
        or not points[0].any()
        or not 0 <= points[0, 1] <= 1
        or abs(points[0, 0]) > _MOST_CLASSES
    ):
        return
    first, *others = np.abs(np.diff(points[:, 1]))
    if first > _FAR * np.median(others) > 0:
        raise ValueError(
            f"expected x y pairs in px, got {points[0, 0]:g} {points[0, 1]:g} before them; leave out classes "
            "and scores"
        )


def _check_last_row(y: NDArray[np.float64], last: str) -> None:
    """Raise if a file without an end of line breaks off within its last number.

    Its rows go one way, then, but for the last: 560 became 56. Rows may be left out anywhere.
    """
    steps = np.diff(y)
    if len(steps) and not (np.all(steps > 0) or np.all(steps < 0)):
        raise ValueError("expected rows that only rise or only fall, got others; is the file cut?")
    if len(steps) > 2 and abs(steps[-1]) > _GAP * np.median(np.abs(steps)):
        expected = f"{y[-2] + np.median(steps[:-1]):g}"
        if expected != last and expected.startswith(last.removesuffix(".")):
            raise ValueError(f"expected evenly spaced rows, got {y[-2]:g} then {y[-1]:g}; is the file cut?")


def _with_gaps(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (P, 2) in order of rows, with a NaN where rows were left out."""
    steps = np.abs(np.diff(points[:, 1]))
    if not steps.any():
        return points
    gaps = np.flatnonzero(steps > _GAP * np.median(steps[steps > 0]))
    middle = 0.5 * (points[gaps, 1] + points[gaps + 1, 1])
    return np.insert(points, gaps + 1, np.stack([np.full(len(gaps), np.nan), middle], axis=-1), axis=0)
