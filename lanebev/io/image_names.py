"""Images' names: their natural order, and the times that they state."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import pairwise
from pathlib import PurePath
from statistics import median_low

_SUFFIXES = r"(?:\.[A-Za-z]\w*)*$"  # .jpg, .lines.txt
_DECIMAL = re.compile(rf"(?<![\d.])(\d+)\.(\d+)(?={_SUFFIXES})", re.ASCII)
_SECONDS = re.compile(rf"(?<!\d)(\d{{10}})(?:\.|[_-](?=\d{{9}}\b|\d{{6}}\b))(\d{{1,9}}){_SUFFIXES}", re.ASCII)
_STAMP = re.compile(rf"(?<!\d)(\d{{13,19}}){_SUFFIXES}", re.ASCII)
_DIGITS = re.compile(r"[0-9a-f]+", re.IGNORECASE)  # of numbers to the base 10 or 16
_EPOCH = (1_000_000_000, 4_102_444_800)  # s: September 2001 to 2100
_STEPS = (Fraction(1, 2000), Fraction(60))  # s between two frames of a drive
_NANOSECONDS = (8, 9)  # digits: a float of seconds since 1970 has 7 at most, of seconds since a start 17

_MOST_ALIKE = (
    0.5  # of the images, of which more with the same number or name are of several cameras or drives
)

Key = list[tuple[int, Fraction, str]]


def natural_order(path: str, decimal: bool = False) -> Key:
    """Return a sort key with numbers by value: 2.jpg before 10.jpg.

    Args:
        path: path of a file.
        decimal: whether 0.05.jpg is a number with a fraction, and before 0.5.jpg.
    """
    match = _DECIMAL.search(path) if decimal else None
    if match is not None:
        value = Fraction(int(match[1])) + Fraction(int(match[2]), 10 ** len(match[2]))
        before, after = path[: match.start()], path[match.end() :]
        return [*natural_order(before), (0, value, match[0]), *natural_order(after)]
    return [
        (0, Fraction(int(part)), part) if part.isascii() and part.isdigit() else (1, Fraction(0), part)
        for part in re.split(r"([0-9]+)", path)
    ]


def in_natural_order(paths: Iterable[str]) -> list[str]:
    """Return the paths sorted by :func:`natural_order`.

    Names of decimal seconds as ``str`` writes them, without zeros at the end, are in the order of time; the
    names of all files tell whether they are: a fraction that ends with a zero, or has more digits than a
    float, is a whole number (1.9 before 1.10; seconds and nanoseconds). Hexadecimal numbers of one length
    (0009, 000a) are in the order of their texts.
    """
    paths = list(paths)
    stems = [PurePath(path).stem for path in paths]
    if len({len(stem) for stem in stems}) == 1 and all(map(_DIGITS.fullmatch, stems)):
        return sorted(paths, key=lambda path: (natural_order(str(PurePath(path).parent)), path))
    decimal = _are_decimal([match[2] for match in map(_DECIMAL.search, paths) if match])
    return sorted(paths, key=lambda path: natural_order(path, decimal))


def times_from_names(paths: Sequence[str]) -> tuple[float, ...]:
    """Return the times of frames, s since the first, if their names state them without doubt; else nothing.

    They do if each ends with a time since 1970 of one kind (seconds with a fraction, seconds and
    nanoseconds, or a whole number of milli-, micro- or nanoseconds), and all of them rise in steps of half
    a millisecond to a minute.

    Args:
        paths: paths of the images, in order.
    """
    names = [PurePath(path).name for path in paths]
    seconds = [_SECONDS.search(name) for name in names]
    stamps = [_STAMP.search(name) for name in names]
    if len(names) > 1 and all(seconds):
        fractions = [match[2] for match in seconds if match]
        whole = not _are_decimal(fractions)  # nanoseconds without zeros before them
        times = [
            int(match[1]) + (Fraction(int(match[2]), 10**9 if whole else 10 ** len(match[2])))
            for match in seconds
            if match
        ]
    elif len(names) > 1 and all(stamps) and len({len(match[1]) for match in stamps if match}) == 1:
        times = [Fraction(int(match[1]), 10 ** (len(match[1]) - 10)) for match in stamps if match]
    else:
        return ()
    steps = [b - a for a, b in pairwise(times)]
    since_1970 = _EPOCH[0] <= times[0] and times[-1] < _EPOCH[1]
    if not (since_1970 and all(_STEPS[0] <= step <= _STEPS[1] for step in steps)):
        return ()
    return tuple(float(time - times[0]) for time in times)


def drives_remark(paths: Sequence[str]) -> str:
    """Return what speaks for images of several cameras or drives, where one is expected; else nothing.

    Files of the same numbers in one folder are those of several cameras, or images and masks. Files of the
    same names in several folders are those of several drives.

    Args:
        paths: paths of the images.
    """
    numbers: dict[tuple[PurePath, tuple[str, ...]], list[str]] = defaultdict(list)
    folders: dict[str, list[PurePath]] = defaultdict(list)
    for path in map(PurePath, paths):
        numbers[path.parent, tuple(re.findall(r"\d+", path.stem))].append(path.name)
        folders[path.name].append(path.parent)
    alike = [names for (_, found), names in numbers.items() if found and len(names) > 1]
    if alike and sum(map(len, alike)) > _MOST_ALIKE * len(paths):
        return (
            f"several images have the same number, such as {alike[0][0]} and {alike[0][1]}, and are taken "
            "for frames one after another; give those of one camera as a quoted glob"
        )
    twice = [(name, found) for name, found in folders.items() if len(found) > 1]
    if sum(len(found) for _, found in twice) > _MOST_ALIKE * len(paths):
        name, (first, second, *_) = twice[0]
        return (
            f"images of several folders have the same name, such as {name} in {first} and {second}, and are "
            "taken for one drive; give a run each, or --stills"
        )
    return ""


def jump_remark(paths: Sequence[str]) -> str:
    """Return where the only number that differs in images' names jumps; else nothing.

    It jumps where images are missing, and where a counter began again at 0: later images come first then.

    Args:
        paths: paths of the images, in order.
    """
    parts = [re.split(r"(\d+)", PurePath(path).stem, flags=re.ASCII) for path in paths]
    columns = list(zip(*parts, strict=True)) if len(set(map(len, parts))) == 1 else []
    varying = [column for column in columns if len(set(column)) > 1]
    if len(varying) != 1 or not varying[0][0].isdigit():
        return ""
    steps = [int(after) - int(before) for before, after in pairwise(varying[0])]
    place = next((index for index, step in enumerate(steps) if step > median_low(steps) > 0), None)
    if place is None:
        return ""
    before, after = (PurePath(path).name for path in paths[place : place + 2])
    return (
        f"their numbers jump, as from {before} to {after}, which are taken for frames one after another; "
        "give each part a run, or number them anew"
    )


def _are_decimal(fractions: Sequence[str]) -> bool:
    """Tell whether digits after a dot are fractions: of one length, or as in a float's shortest text."""
    lengths = {len(digits) for digits in fractions}
    if len(lengths) <= 1:
        return True
    shortest = all(digits == "0" or digits[-1] != "0" for digits in fractions)
    return shortest and max(lengths) not in _NANOSECONDS
