"""Speeds of the vehicle over a drive, from a text file."""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lanebev.numbers import read_text

_NEAREST = 1.0  # s between a frame and the nearest speed, at most
_FASTEST = 100.0  # m/s
_FAST = 45.0  # m/s; more may be km/h
_SPEED = ("speed", "velocity", "vel", "v", "vf")  # words of a column's title
_TIME = ("time", "timestamp", "stamp", "t")
_SPEED_UNITS = {
    **dict.fromkeys(("m/s", "m/sec", "mps"), 1.0),
    **dict.fromkeys(("km/h", "kmh", "kph", "kmph", "km", "km/hr", "kmhr"), 1 / 3.6),
    **dict.fromkeys(("mph", "mi/h", "mi/hr", "miles"), 0.44704),
    **dict.fromkeys(("kn", "kt", "kts", "knot", "knots"), 1852 / 3600),
    **dict.fromkeys(("ft/s", "ft", "fps"), 0.3048),
    **dict.fromkeys(("cm/s", "cm"), 0.01),
    **dict.fromkeys(("mm/s", "mm"), 0.001),
}
_APART = re.compile(  # in a comment, where they are units of others
    r"\b(?<!speed )(?<!in )(?<!speed [\[(])(?:km|miles|ft|fps|cm|mm)\b(?!\s*(?:/|per\b))"
)
_PAIR = re.compile(r"\d+,\d+", re.ASCII)  # one number with a decimal comma, or two whole ones
_DECIMALS = re.compile(r"-?\d+(?:,\d+)?(?:\s+-?\d+(?:,\d+)?)+", re.ASCII)
_OF_OTHERS = {  # in titles of other columns
    "accuracy", "std", "stddev", "sigma", "error", "uncertainty", "limit", "desired", "target", "cruise",
    "angular", "engine", "motor", "rpm", "fan", "wind",
}  # fmt: skip
_TIME_UNITS = {
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "usec", "micros", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanoseconds"), 1e-9),
    **dict.fromkeys(("min", "mins", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hours"), 3600.0),
}
_NO_NUMBER = ("", "nan", "none", "null")
_UNKNOWN = -1  # speed that phones write
_FORM = "expected a speed in each line, or time and speed, or a first line of titles that names them"


class Speeds(NamedTuple):
    """Speeds of the vehicle over a drive.

    Attributes:
        speeds: (N,) m/s, NaN where it is not known.
        times: (N,) s since the source's first frame, rising; None if there is a speed for each frame.
    """

    speeds: NDArray[np.float64]
    times: NDArray[np.float64] | None = None

    def at(self, number: int, time: float) -> float | None:
        """Return the speed at a frame, m/s, linear between two times; None where it is not known.

        Args:
            number: number of the frame in the whole source.
            time: its time in the source, s.
        """
        if self.times is None:
            speed = float(self.speeds[number]) if number < len(self.speeds) else math.nan
        else:
            is_far = self.without(np.array([time]))
            speed = math.nan if is_far else float(np.interp(time, self.times, self.speeds))
        return speed if math.isfinite(speed) else None

    def without(self, times: NDArray[np.float64]) -> int:
        """Return how many of these times of frames (N,) s have no speed near them."""
        if self.times is None:
            return 0
        after = np.searchsorted(self.times, times).clip(1, max(len(self.times) - 1, 1))
        around = self.times[np.stack([after - 1, after]).clip(0, len(self.times) - 1)]
        return int((np.abs(around - times).min(0) > _NEAREST).sum())


def fast_remark(speed: float, remedy: str) -> str:
    """Return a remark on a speed (m/s) that may be in km/h, with what to do then; else nothing."""
    if abs(speed) <= _FAST:
        return ""
    return f"speed: up to {abs(speed):.3g} m/s, {abs(3.6 * speed):.0f} km/h; if it is in km/h, {remedy}"


def read_speeds(path: str | Path) -> Speeds:
    """Read a table with a speed for each frame, or with times and speeds.

    Its columns are separated by commas, semicolons, tabs or spaces. Without titles it has one column, a speed
    (m/s) for each frame, or two, time (s since the source's first frame) and speed. Titles name the columns:
    ``speed`` and, if there is one, ``time``, among others, with another unit than m/s and s in them, such as
    ``speed_kmh`` and ``time_ms``; they may be in a comment, as of ``numpy.savetxt``. A speed that is empty,
    ``nan`` or -1 is not known.
    """
    try:
        return _speeds_of(_rows(read_text(Path(path))))
    except (ValueError, csv.Error) as error:
        raise ValueError(f"speed {path}: {error}") from error


def _rows(text: str) -> list[list[str]]:
    """Return the cells of each line; where commas do not separate them, numbers may have decimal commas.

    Lines that begin with # are left out, but for titles above the numbers, as by ``numpy.savetxt``.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    first = next((place for place, line in enumerate(lines) if line[0] != "#"), len(lines))
    table = [line for line in lines[first:] if line[0] != "#"]
    numbers = table[min(1, len(table) - 1)] if table else ""
    above = [_APART.sub("", lines[first - 1].lstrip("# "))] if first else []
    if _are_commas_decimal(table):
        table = [line.replace(",", ".") for line in table]
        numbers = numbers.replace(",", ".")
    delimiter = next((sign for sign in ";\t," if sign in numbers), None)
    if delimiter is not None:
        cells = csv.reader([*above, *table], delimiter=delimiter, skipinitialspace=True)
        rows = [[cell.strip().replace(",", ".") for cell in row] for row in cells]
    elif " " in numbers:
        rows = [line.split() for line in (*above, *table)]
    else:
        rows = [[line] for line in (*above, *table)]
    titled = bool(above) and _are_titles(rows[0], rows[1:2])
    rows = rows if titled else rows[len(above) :]
    with_unit = next(filter(_states_unit, lines[: first - titled]), "")
    if with_unit and not any(map(_states_unit, rows[0] if rows else [])):
        raise ValueError(
            f"expected titles with the unit, got {with_unit[:100]!r}; write them with the separator of the "
            "numbers, as time,speed_kmh"
        )
    return rows


def _are_commas_decimal(table: list[str]) -> bool:
    """Return whether commas are within the numbers of a table, not between its columns.

    Raises:
        ValueError: it cannot be told.
    """
    if not table:
        return False
    pairs = [line.split(",") for line in table if _PAIR.fullmatch(line)]
    if len(pairs) == len(table) > len({first for first, _ in pairs}):
        raise ValueError(
            f"expected rising times, got {table[0]!r} and the like; write decimals with a point, or above "
            "them the titles time,speed"
        )
    of_speed = "," not in table[0] and _names(table[0], _SPEED) and not _names(table[0], _TIME)
    are_counted = [line.split(",")[0] for line in table[1:]] == [str(i) for i in range(len(table) - 1)]
    if of_speed and (are_counted or any("." in line for line in table[1:])):  # a column without a title
        return False
    return of_speed or _DECIMALS.fullmatch(table[-1]) is not None


def _states_unit(text: str) -> bool:
    """Return whether a title or a comment says in which unit speeds are."""
    return _names(text, _SPEED) and _unit(text, _SPEED_UNITS) != 1.0


def _are_titles(cells: list[str], below: list[list[str]]) -> bool:
    """Return whether a comment above a table names its columns."""
    if not below or len(cells) != len(below[0]) or not all(map(_is_number, below[0])):
        return False
    has_time = len(cells) == 1 or any(_names(cell, _TIME) for cell in cells)
    return has_time and any(_names(cell, _SPEED) for cell in cells)


def _speeds_of(rows: list[list[str]]) -> Speeds:
    titles = None if not rows or all(map(_is_number, rows[0])) else rows.pop(0)
    if not rows:
        raise ValueError(f"{_FORM}, got no numbers")
    first = titles or rows[0]
    if uneven := next((row for row in rows if len(row) != len(first)), None):
        raise ValueError(
            f"expected {len(first)} columns as in the first line, got {' '.join(uneven)[:100]!r}"
        )
    if titles is not None:
        speed, metres = _column(titles, _SPEED, _SPEED_UNITS)
        time, seconds = _column(titles, _TIME, _TIME_UNITS) if len(titles) > 1 else (None, 1.0)
    else:
        time, speed = {1: (None, 0), 2: (0, 1)}.get(len(first), (None, None))
        seconds = metres = 1.0
    if speed is None:
        raise ValueError(f"{_FORM}, got {' '.join(first)[:100]!r}")
    cells = [row[speed] for row in rows]
    speeds = np.array([_number(cell) for cell in cells])
    speeds = metres * np.where(speeds == _UNKNOWN, math.nan, speeds)
    if (fastest := np.nanmax(np.abs(speeds), initial=0.0)) > _FASTEST:
        raise ValueError(f"expected m/s up to {_FASTEST:g}, got {fastest:g}; name another unit, as speed_kmh")
    if time is None:
        return Speeds(speeds)
    if time == speed:
        raise ValueError(
            "expected a title of time and one of speed, got one title of both; write them with the separator "
            "of the numbers, as time,speed_kmh"
        )
    times = seconds * np.array([_number(row[time]) for row in rows])
    if not (np.diff(times) >= 0).all():  # false on NaN
        raise ValueError("expected times that rise, got others")
    return Speeds(speeds, times)


def _number(cell: str) -> float:
    if cell.lower() in _NO_NUMBER:
        return math.nan
    try:
        return float(cell)
    except ValueError as error:
        raise ValueError(
            f"expected a number, got {cell!r}; write times in seconds since the source's first frame, and "
            "units in titles, as speed_kmh"
        ) from error


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True


def _column(titles: list[str], names: Sequence[str], units: Mapping[str, float]) -> tuple[int | None, float]:
    """Return which column has one of these words in its title, None if there is none, and its unit."""
    found = [place for place, title in enumerate(titles) if _names(title, names)]
    if len(found) > 1:
        several = ", ".join(titles[place] for place in found)
        raise ValueError(f"expected one column of {names[0]}, got {several}; leave the others out")
    if not found:
        return None, 1.0
    return found[0], _unit(titles[found[0]], units)


def _unit(title: str, units: Mapping[str, float]) -> float:
    return next((units[word] for word in _words(title) if word in units), 1.0)


def _names(title: str, names: Sequence[str]) -> bool:
    """Return whether a title has one of these words, and none of other quantities."""
    words = _words(title)
    return not {*words}.isdisjoint(names) and _OF_OTHERS.isdisjoint(words)


def _words(title: str) -> list[str]:
    """Return the words of a title in lower case, such as "speed" and "kmh" of speedKmh."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", title).lower()
    return re.findall(r"[a-zµ]+(?:/[a-z]+)?", apart)
