"""Times of images in a file beside them, as of KITTI and of many recorders."""

import os
import re
from collections.abc import Sequence
from datetime import date
from fractions import Fraction
from itertools import pairwise
from os.path import dirname
from pathlib import Path, PurePath
from statistics import median_low

from lanebev.io.images.names import are_of_a_drive, times_of_stamps
from lanebev.numbers import read_text

_NAME = re.compile(r"(?:frame|image)?_?(?:timestamp|time)s?\.(?:txt|csv)", re.IGNORECASE)
_DATED = re.compile(r"(\d{4})-(\d\d)-(\d\d)[T ](\d\d):(\d\d):(\d\d(?:\.\d+)?)", re.ASCII)
_MILLISECONDS = re.compile(r"(?<=\d\d-\d\d[T ]\d\d:\d\d:\d\d),(?=\d{3}(?!\d))", re.ASCII)
_DECIMAL_COMMA = re.compile(r"\d+,\d{1,9}", re.ASCII)  # more digits are a time since 1970
_SLOWEST = 5  # s between frames of a drive; 33 between them are milliseconds
_TITLE = re.compile(r"(?!exposure|lap).*(time(?!_?zone)|stamp)")  # of a column of times
_NUMBER = re.compile(r"\d+(?:\.\d*)?(?:e[+-]?\d\d?)?", re.ASCII | re.IGNORECASE)


def times_from_file(paths: Sequence[str]) -> tuple[tuple[float, ...], str]:
    """Return the times of frames, s since the first, by a file beside the images or their folder.

    The file is called ``times.txt``, ``timestamps.txt`` or the like and has a line for each image, in their
    order; if it has more, the names of the images must be numbers of its lines, from 0. A line is a date with
    a time of day, or a number: seconds, or milli-, micro- or nanoseconds since 1970. Before the number may be
    the image's; of several columns a first line says which has the times.

    Returns:
        the times, or none, and in words why a file that is there is not used.
    """
    folders = {dirname(path) for path in paths}
    file = _file_of(Path(folders.pop())) if len(folders) == 1 and len(paths) > 1 else None
    if file is None:
        return (), ""
    try:
        stamps = _stamps(read_text(file))
    except ValueError as error:
        return (), f"{file.name} beside them is not used: expected a time for each image, got {error}"
    stems = [PurePath(path).stem for path in paths]
    if len(stamps) > len(paths) and all(stem.isdecimal() and int(stem) < len(stamps) for stem in stems):
        stamps = [stamps[int(stem)] for stem in stems]
    if len(stamps) != len(paths):
        return (), f"{file.name} beside them is not used: it has {len(stamps)} times for {len(paths)} images"
    times = times_of_stamps(stamps) if all(re.fullmatch(r"\d{13,19}", stamp) for stamp in stamps) else ()
    times = times or [Fraction(stamp) for stamp in stamps]
    if not are_of_a_drive(times) or median_low(b - a for a, b in pairwise(times)) > _SLOWEST:
        return (), f"{file.name} beside them is not used: its times are not those of a drive, in seconds"
    return tuple(float(time - times[0]) for time in times), ""


def _file_of(folder: Path) -> Path | None:
    """Return the file of times in the images' folder, or beside it; None if there is none."""
    for place in (folder, folder.resolve().parent):
        try:
            found = sorted(name for name in os.listdir(place) if _NAME.fullmatch(name))
        except OSError:  # a folder that may not be listed
            continue
        if found:
            return place / found[0]
    return None


def _stamps(text: str) -> list[str]:
    """Return the time of each line as a number, s; a first line of words and comments after # have none."""
    rows = [line for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    wholes = [line.strip().split(",")[0] for line in rows if _DECIMAL_COMMA.fullmatch(line.strip())]
    if len(wholes) == len(rows) > len({*wholes}):  # as numbers of images they would differ
        rows = [line.replace(",", ".") for line in rows]
    if all(map(_MILLISECONDS.search, rows[1:])):  # in some lines alone they are numbers of images
        rows = [_MILLISECONDS.sub(".", line) for line in rows]
    found = [_stamp(line) for line in rows]
    titles = re.split(r"[\s,;]+", rows[0].strip().lower()) if rows and not found[0] else []
    named = [place for place, title in enumerate(titles) if _TITLE.match(title)]
    if len(named) == 1:
        words = [re.split(r"[\s,;]+", line.strip()) for line in rows]
        of_title = [each[named[0]] if len(each) == len(titles) else "" for each in words]
        found = [_stamp(word) or stamp for word, stamp in zip(of_title, found, strict=True)]
    for line, stamp in list(zip(rows, found, strict=True))[1:]:
        if not stamp:
            raise ValueError(f"the line {line[:40]!r}")
    return [stamp for stamp in found if stamp]


def _stamp(line: str) -> str:
    """Return the time of a line as a number, s; nothing if it has none."""
    if dated := _DATED.search(line):
        year, month, day, hour, minute, second = dated.groups()
        seconds = (
            86400 * date(int(year), int(month), int(day)).toordinal() + 3600 * int(hour) + 60 * int(minute)
        )
        return str(seconds + Fraction(second))
    numbers = [word for word in re.split(r"[\s,;]+", line) if _NUMBER.fullmatch(word)]
    is_number_first = len(numbers) > 1 and numbers[0].isdecimal() and len(numbers[0]) < 10
    return numbers[1 if is_number_first else 0] if numbers else ""
