"""Dates and times of day in images' names, such as 2026-11-29_10-15-30.123.jpg."""

import math
import re
from collections.abc import Sequence
from datetime import date
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from os.path import splitext
from pathlib import PurePath
from statistics import median
from typing import NamedTuple

_DAY = 86_400  # s
_DATES = (  # and which of their numbers may be year, month and day
    (r"(?<!\d)(?P<a>20\d\d)[-_.]?(?P<b>\d\d)[-_.]?(?P<c>\d\d)", ("ymd",)),
    (r"(?<!\d)(?P<a>20\d\d)[-_.](?P<b>\d\d?)[-_.](?P<c>\d\d?)", ("ymd",)),
    (r"(?<!\d)(?P<a>\d\d)[-_.]?(?P<b>\d\d)[-_.]?(?P<c>20\d\d)", ("dmy", "mdy")),
    (r"(?<!\d)(?P<a>\d\d?)[-_.](?P<b>\d\d?)[-_.](?P<c>20\d\d)", ("dmy", "mdy")),
)
_SHORT_DATE = r"(?<!\d)(?P<a>\d\d)(?P<b>\d\d)(?P<c>\d\d)[_-]"
_BETWEEN = r"(?P<between>[T_ .@/-]{0,3}|[ _]at[ _])"  # date and time of day
_CLOCK = r"(?P<hour>\d\d?)[-_.:h](?P<minute>\d\d?)[-_.:m](?P<second>\d\d?)"
_DIGITS = r"(?P<hour>\d\d)(?P<minute>\d\d)(?P<second>\d\d)"
_ALONE = r"(?<![^/])(?P<words>[^\d/]*)" + _CLOCK.replace(".", "")
_FRACTION = (
    r"(?:(?:[.,s](?=\d{1,9}(?!\d))|(?P<loose>[-_]?)(?=(?:\d{3}|\d{6}|\d{9})(?!\d)))(?P<fraction>\d+))?"
)
_END = r"(?!\d)(?:[ \u202f_-]?(?P<half>[AaPp])[Mm](?![A-Za-z]))?"
_FORMS = (
    *((day + _BETWEEN + clock + _FRACTION + _END, orders)
      for day, orders in _DATES for clock in (_CLOCK, _DIGITS)),
    (_SHORT_DATE + _DIGITS + r"(?P<fraction>\d{3})(?!\d)", ("ymd", "dmy")),
    (_ALONE + _FRACTION + _END, ("",)),
)  # fmt: skip
FASTEST = Fraction(1, 250)  # s between frames, of fractions that may be numbers of images


class NameClocks(NamedTuple):
    """Times of day in images' names.

    Attributes:
        seconds: s of any epoch, one for each image.
        is_one_camera: whether nothing else in the names tells some images from others, as the number of a
            camera would.
    """

    seconds: tuple[Fraction, ...]
    is_one_camera: bool


@lru_cache(maxsize=1)  # the steps of opening a folder ask for the same, in turn
def read_clocks(paths: tuple[str, ...]) -> NameClocks | None:
    """Return the times that images' names, and the folders above them, state as time of day.

    A time has a date or at least a fraction of a second. Where day and month may be exchanged, they are read
    so that the drive is the shorter one.

    Returns:
        None if a name has no time, if all have the same, or if they differ in other words.
    """
    texts = ["/".join(PurePath(path).parts[-2:]) for path in paths]
    for form, orders in _FORMS:
        matches = _last_matches(re.compile(form, re.ASCII), texts)
        drives = [times for order in orders if matches and (times := _times(matches, order))]
        if drives:
            seconds = min(drives, key=lambda times: max(times) - min(times))
            rests = [_rest(text, match) for text, match in zip(texts, matches, strict=True)]
            if len({re.sub(r"\d+", "", "/".join(rest)) for rest in rests}) > 1 or len(set(seconds)) == 1:
                return None
            is_one = all(len(set(part)) in (1, len(part)) for part in zip(*rests, strict=True))
            return NameClocks(tuple(seconds), is_one)
    return None


def are_decimal(fractions: Sequence[str]) -> bool:
    """Return whether digits after a dot are fractions: of one length, or as in a float's shortest text."""
    lengths = {len(digits) for digits in fractions}
    if len(lengths) <= 1:
        return True
    shortest = all(digits == "0" or digits[-1] != "0" for digits in fractions)
    return shortest and max(lengths) not in (8, 9)  # ns: since 1970 a float has 7 at most, else 17


def with_fractions(whole: Sequence[int], fractions: Sequence[str]) -> list[Fraction]:
    """Return whole seconds and the digits after them as times (s); no digits are 0.

    Digits are decimal fractions, or whole milli-, micro- or nanoseconds without zeros before them. A zero at
    the beginning or the end tells which; without one, the reading with the more even steps is taken.
    """

    def read(unit: int | None) -> list[Fraction]:
        return [
            a + Fraction(int(b or 0), unit or 10 ** len(b)) for a, b in zip(whole, fractions, strict=True)
        ]

    given = [digits for digits in fractions if digits]
    if len(set(map(len, given))) <= 1 or any(digits[0] == "0" != digits for digits in given):
        return read(None)
    unit = next(10**power for power in (3, 6, 9) if max(map(len, given)) <= power)
    return min(read(None), read(unit), key=_unevenness) if are_decimal(given) else read(unit)


def _last_matches(form: re.Pattern[str], texts: Sequence[str]) -> list[re.Match[str]]:
    """Return the last match in each text, which must end in the file's name; none if one has none."""
    found = []
    for text in texts:
        of_name = [match for match in form.finditer(text) if match.end() > text.rfind("/") + 1]
        if not of_name:
            return []
        found.append(of_name[-1])
    return found


def _rest(text: str, match: re.Match[str]) -> tuple[str, str]:
    """Return what a path has before and after its time, without the file's suffix."""
    before = text[: match.start()] + (match.groupdict().get("words") or "")
    return before, splitext("_" + text[match.end() :])[0]


def _times(matches: Sequence[re.Match[str]], order: str) -> list[Fraction] | None:
    """Return the times (s), the numbers of a date in this order; None if one is no time, or in doubt."""
    groups = [match.groupdict("") for match in matches]
    days, clocks = [_day(each, order) for each in groups], [_time_of_day(each) for each in groups]
    if None in days or None in clocks:
        return None
    whole = [_DAY * day + clock for day, clock in zip(days, clocks, strict=True)]  # type: ignore[operator]
    if order and _may_be_numbers(matches):
        return None
    times = with_fractions(whole, [each["fraction"] for each in groups])
    may_count = all("loose" in match.re.groupindex and match["loose"] is not None for match in matches)
    are_counts = _begin_again(times) or (may_count and _are_counts(times))
    if are_counts or not any(each["fraction"] for each in groups):
        return [Fraction(each) for each in whole] if order else None
    return times if order else _over_midnight(times)


def _day(groups: dict[str, str], order: str) -> int | None:
    """Return the number of a date, 0 where none is expected; None if it is no date."""
    if not order:
        return 0
    number = {kind: int(groups[name]) for kind, name in zip(order, "abc", strict=True)}
    try:
        return date(number["y"] % 100 + 2000, number["m"], number["d"]).toordinal()
    except ValueError:
        return None


def _time_of_day(groups: dict[str, str]) -> int | None:
    """Return a time of day, whole s; None if it is none."""
    hour, minute, second = (int(groups[name]) for name in ("hour", "minute", "second"))
    half = groups.get("half", "").lower()
    if minute > 59 or second > 59 or hour > 23 or (half and not 1 <= hour <= 12):
        return None
    hour = hour % 12 + 12 * (half == "p") if half else hour
    return 3600 * hour + 60 * minute + second


def _unevenness(times: Sequence[Fraction]) -> float:
    """Return the mean square of the steps between times over the square of their mean: 1 if all are equal.

    A step counts as 1 s at most, so that gaps do not decide.
    """
    steps = [min(float(b - a), 1.0) for a, b in pairwise(sorted(times))]
    return len(steps) * sum(step**2 for step in steps) / (sum(steps) ** 2 or math.inf)


def _may_be_numbers(matches: Sequence[re.Match[str]]) -> bool:
    """Return whether digits after a date may be numbers of images.

    They may if they are 6 that begin with 00, or 9 with 0000; also 6 of one minute from its first second on,
    such as 100000 to 100020.
    """
    if any(
        match.end("hour") < match.start("minute") or "T" in match.groupdict("").get("between", "")
        for match in matches
    ):
        return False
    minutes = {match["hour"] + match["minute"] for match in matches}
    fractions = [match for match in matches if match["fraction"]]
    if fractions:
        return minutes == {"0000"} and all(
            match.string[match.end("second")] not in ".," for match in fractions
        )
    seconds = {match["second"] for match in matches}
    of_one_minute = len(minutes) == 1 and "00" in seconds and len(seconds) == len(matches)
    return of_one_minute or all(minute.startswith("00") for minute in minutes)


def _begin_again(times: Sequence[Fraction]) -> bool:
    """Return whether digits after the seconds begin again in each before they fill it, as numbers do."""
    seconds = {int(time) for time in times}
    rate = len(times) / len(seconds)
    return len(seconds) > 2 and max(time % 1 for time in times) < 1 - 2 / rate


def _are_counts(times: Sequence[Fraction]) -> bool:
    """Return whether digits after the seconds are numbers, as of images or cameras.

    Those of a clock differ, fall from a second to the next, and do not rise by less than 4 ms.
    """
    ordered = sorted(times)
    parts = [time % 1 for time in ordered]
    if len(set(parts)) == 1:
        return True
    same = any(int(a) == int(b) for a, b in pairwise(ordered))
    rising = all(a <= b for a, b in pairwise(parts))
    steps = [b - a for a, b in pairwise(ordered)]
    return same and (rising or median(steps) < FASTEST)


def _over_midnight(times: list[Fraction]) -> list[Fraction]:
    """Return times of day (s) of which those after midnight are of the next day, by the longest gap."""
    ordered = sorted(times)
    gaps = [(b - a, b) for a, b in pairwise(ordered)]
    longest, begin = max(gaps, default=(Fraction(0), Fraction(0)))
    if longest <= _DAY - ordered[-1] + ordered[0]:
        return times
    return [time if time >= begin else time + _DAY for time in times]
