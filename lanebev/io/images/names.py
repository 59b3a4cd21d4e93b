"""Images' names: their natural order, and the times that they state."""

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import pairwise
from os.path import basename, split, splitext
from pathlib import PurePath
from statistics import median_low

from lanebev.io.images.name_clocks import FASTEST, are_decimal, read_clocks, with_fractions

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm", ".jfif", ".jp2")

_SUFFIXES = r"(?:\.[A-Za-z]\w*)*$"  # .jpg, .lines.txt
_DECIMAL = re.compile(rf"(?<![\d.])(\d+)\.(\d+)(?={_SUFFIXES})", re.ASCII)
_WORDS = r"((?:[_-][A-Za-z]+\d?)*)"  # of a camera after its time, as in _color_rect and _cam0
_NANO = r"[_-](?:0(?=\d{9}(?!\d))|(?=(?:\d{9}|\d{6})(?!\d)))"  # before digits of a fraction; LLAMAS has ten
_SECONDS = re.compile(rf"(?<!\d)(\d{{10}})(?:\.|{_NANO})(\d{{1,9}}){_WORDS}{_SUFFIXES}", re.ASCII)
_STAMP = re.compile(rf"(?<!\d)(\d{{13,19}}){_WORDS}{_SUFFIXES}", re.ASCII)
_DIGITS = re.compile(r"[0-9a-f]+", re.IGNORECASE)  # of numbers to the base 10 or 16
_EPOCH = (315_964_800, 2_208_988_800)  # s: 1980, when the time of GPS begins, to 2040
_STEPS = (Fraction(1, 2000), Fraction(60))  # s between two frames of a drive
_JUMP = Fraction(3, 2)  # times the usual step of numbers

# of the images, of which more with the same number or name are of several cameras or drives
_MOST_ALIKE = 0.5

Key = list[tuple[int, int | Fraction, str]]
_END = (-1, 0, "")  # end of a name, before any name that goes on


def natural_order(path: str, decimal: bool = False) -> Key:
    """Return a sort key with numbers by value: 2.jpg before 10.jpg, and image.jpg before image 2.jpg.

    Args:
        path: path of a file.
        decimal: whether 0.05.jpg is a number with a fraction, and before 0.5.jpg.
    """
    match = _DECIMAL.search(path) if decimal else None
    if match is not None:
        value = Fraction(int(match[1])) + Fraction(int(match[2]), 10 ** len(match[2]))
        return [
            *_numbers_by_value(path[: match.start()]),
            (0, value, match[0]),
            *natural_order(path[match.end() :]),
        ]
    stem, suffix = splitext(path)
    return [*_numbers_by_value(stem), _END, *_numbers_by_value(suffix)]


def _numbers_by_value(text: str) -> Key:
    return [
        (0, int(part), part) if part.isascii() and part.isdigit() else (1, 0, part)
        for part in re.split(r"([0-9]+)", text)
    ]


def in_natural_order(paths: Iterable[str]) -> list[str]:
    """Return the paths sorted by :func:`natural_order`.

    Names of decimal seconds as ``str`` writes them, without zeros at the end, are in the order of time; the
    names of all files tell whether they are: a fraction that ends with a zero, or has more digits than a
    float, is a whole number (1.9 before 1.10; seconds and nanoseconds). Hexadecimal numbers of one length
    (0009, 000a) are in the order of their texts. Names with times of day are in the order of these, also
    over midnight and with the day before the month.
    """
    paths = list(paths)
    if _are_hexadecimal(paths):
        return sorted(paths, key=lambda path: (natural_order(str(PurePath(path).parent)), path))
    decimal = _are_decimal(paths)
    ordered = sorted(paths, key=lambda path: natural_order(path, decimal))
    clocks = read_clocks(tuple(ordered))
    if clocks is None:
        return ordered
    places = sorted(range(len(ordered)), key=lambda place: clocks.seconds[place])
    return [ordered[place] for place in places]


def _are_hexadecimal(paths: Sequence[str]) -> bool:
    """Return whether images' names are numbers of one length to the base 10 or 16."""
    stems = [splitext(basename(path))[0] for path in paths]
    return len({len(stem) for stem in stems}) == 1 and all(map(_DIGITS.fullmatch, stems))


def _are_decimal(paths: Sequence[str]) -> bool:
    """Return whether numbers with a dot at the end of names are decimal; also if there are none."""
    return are_decimal([match[2] for match in map(_DECIMAL.search, paths) if match])


def times_from_names(paths: Sequence[str]) -> tuple[float, ...]:
    """Return the times of frames, s since the first, if their names state them without doubt; else nothing.

    They do if each has a time of day with its date, or ends with a time since 1970 of one kind (seconds with
    a fraction, seconds and nanoseconds, or a whole number of milli-, micro- or nanoseconds), and all of them
    rise in steps of half a millisecond to a minute, with a median of at least 4 ms.
    """
    clocks = read_clocks(tuple(paths))
    by_clock = clocks.seconds if clocks is not None and clocks.is_one_camera else ()
    times = next(filter(are_of_a_drive, (by_clock, _times_since_1970(paths))), ())
    return tuple(float(time - times[0]) for time in times)


def untimed_remark(paths: Sequence[str]) -> tuple[str, str]:
    """Return why frames have no times from their names, and what to do."""
    clocks = read_clocks(tuple(paths))
    times = clocks.seconds if clocks else ()
    if are_of_a_drive(times):
        words = "numbers beside the times in their names may be those of cameras"
        return f"{words}, as from {_two_names(paths)}", "give the images of one as a quoted glob"
    if times and len(set(times)) < len(times) and all(time.denominator == 1 for time in times):
        inner = sum(times[0] < time < times[-1] for time in times)  # the first and the last second are cut
        rate = inner / max(float(times[-1] - times[0] - 1), 1.0)
        return f"the times in their names are whole seconds, with {rate:.3g} images in each", "state --fps"
    return "no times are read from their names", "state --fps"


def _two_names(paths: Sequence[str]) -> str:
    """Return the names of the first two of some images."""
    return " to ".join(PurePath(path).name for path in paths[:2])


def _times_since_1970(paths: Sequence[str]) -> Sequence[Fraction]:
    """Return the times since 1970 (s) at the ends of names; none if one has none or is of another kind."""
    names = [PurePath(path).name for path in paths]
    seconds = [_SECONDS.search(name) for name in names]
    stamps = [_STAMP.search(name) for name in names]
    found = [match for match in (seconds if all(seconds) else stamps) if match]
    if len({match.groups()[-1] for match in found}) > 1:  # words of several cameras
        return ()
    if all(seconds):
        whole = [int(match[1]) for match in seconds if match]
        times = with_fractions(whole, [match[2] for match in seconds if match])
        return times if _are_plausible(times) else ()
    if all(stamps) and len({len(match[1]) for match in stamps if match}) == 1:
        return times_of_stamps([match[1] for match in stamps if match])
    return ()


def times_of_stamps(stamps: Sequence[str]) -> Sequence[Fraction]:
    """Return times (s) by whole numbers of one length; none if one is not from 1980 to 2040.

    They are 10 digits of seconds and those of a fraction. If that gives no such time they are nanoseconds
    since 1980, as in Argoverse. Of 18 digits with a fraction, as in OpenLane, the last two are zeros.
    """
    digits = len(stamps[0]) - 10
    is_whole = digits != 8 or all(stamp.endswith("00") for stamp in stamps)
    units = (10**digits, 10**9) if is_whole else (10**9,)
    readings = ([Fraction(int(stamp), unit) for stamp in stamps] for unit in units)
    return next(filter(_are_plausible, readings), ())


def _are_plausible(times: Sequence[Fraction]) -> bool:
    """Return whether all times (s since 1970) are from 1980 to 2040, as those of drives are."""
    return all(_EPOCH[0] <= time < _EPOCH[1] for time in times)


def are_of_a_drive(times: Sequence[Fraction]) -> bool:
    """Return whether times (s) are of several frames and rise as those of a drive."""
    steps = [b - a for a, b in pairwise(times)]
    return bool(steps) and _STEPS[0] <= min(steps) <= max(steps) <= _STEPS[1] and median_low(steps) >= FASTEST


def drives_remark(paths: Sequence[str]) -> str:
    """Return a remark if images seem to be of several cameras or drives; else an empty text.

    Files of the same numbers in one folder are those of several cameras, or images and masks. Files of the
    same names in several folders are those of several drives.
    """
    numbers: dict[tuple[str, tuple[str, ...]], list[str]] = defaultdict(list)
    folders: dict[str, list[str]] = defaultdict(list)
    digits = r".+" if _are_hexadecimal(paths) else r"\d+"
    for folder, name in map(split, paths):
        numbers[folder, tuple(re.findall(digits, splitext(name)[0]))].append(name)
        folders[name].append(folder or ".")
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
    """Return where the times in images' names, or the only number that differs in these, jump; else nothing.

    A number jumps where images are missing, and where a counter began again at 0: later images come first. Of
    numbers that are times, such as milliseconds, steps differ a little.
    """
    clocks = read_clocks(tuple(paths))
    times = clocks.seconds if clocks else _times_since_1970(paths)
    if times:
        jumps = [b - a > _STEPS[1] for a, b in pairwise(times)]
        kind, remedy = "the times in their names jump", ""
    else:
        steps = _number_steps(paths)
        usual = median_low(steps or [Fraction(0)])
        jumps = [step > _JUMP * usual > 0 for step in steps]
        kind, remedy = "their numbers jump", ", or number them anew"
    if True not in jumps:
        return ""
    place = _two_names(paths[jumps.index(True) :])
    taken = "which are taken for frames one after another"
    return f"{kind}, as from {place}, {taken}; give each part a run{remedy}"


def _number_steps(paths: Sequence[str]) -> list[Fraction]:
    """Return the steps of the only number that differs in images' names; none if there is no such."""
    number = re.compile(r"(\d+(?:\.\d+)?)" if _are_decimal(paths) else r"(\d+)", re.ASCII)
    parts = [number.split(PurePath(path).stem) for path in paths]
    columns = list(zip(*parts, strict=True)) if len(set(map(len, parts))) == 1 else []
    varying = [column for column in columns if len(set(column)) > 1]
    if len(varying) != 1 or not varying[0][0][:1].isdigit():
        return []
    return [Fraction(after) - Fraction(before) for before, after in pairwise(varying[0])]
