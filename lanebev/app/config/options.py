"""Fields of settings that are options of the command line too, and their parsers. Imports nothing heavy."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import field, fields
from numbers import Integral, Real
from typing import TypeVar

T = TypeVar("T")

_TYPES: dict[str, tuple[type | tuple[type, ...], str]] = {
    "str": (str, "a text or a path"),
    "bool": (bool, "True or False"),
    "int": (Integral, "a whole number"),
    "float": (Real, "a number"),
    "tuple": ((tuple, list), "a tuple"),
}
_MOST_CELLS = 4096  # pixels a side of the bird's-eye view, which H.264 encodes


def parsed(parse: Callable[[str], object], text: str) -> object:
    """Return a setting by its text."""
    try:
        return parse(text)
    except ValueError as error:
        expected = {float: "a number", int: "a whole number"}.get(parse)  # type: ignore[call-overload]
        raise ValueError(f"expected {expected}, got {text!r}" if expected else str(error)) from error


def parse_path(text: str) -> str:
    """Return a path, with the home folder in place of ~, which shells leave in quotes and after =."""
    if not text:
        raise ValueError("expected a path, got an empty string")
    return os.path.expanduser(text)


def parse_rate(text: str) -> float:
    """Return a frame rate of a text such as ``29.97`` or ``30000/1001``."""
    match = re.fullmatch(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*", text, re.ASCII)
    try:
        return int(match[1]) / int(match[2]) if match else float(text)
    except (ValueError, ZeroDivisionError) as error:
        raise ValueError(f"expected a number such as 29.97 or 30000/1001, got {text!r}") from error


def parse_grid(text: str) -> tuple[float, float, float, float, float]:
    """Return (near, far, left, right, resolution) in m from a text such as ``3:60,-10:10/0.05``."""
    number = r"([-+]?\d+(?:\.\d*)?|[-+]?\.\d+)"
    match = re.fullmatch(rf"{number}:{number},{number}:{number}/{number}", text.replace(" ", ""), re.ASCII)
    if match is None:
        raise ValueError(f"grid: expected NEAR:FAR,LEFT:RIGHT/STEP, such as 3:60,-10:10/0.05, got {text!r}")
    return check_grid(tuple(map(float, match.groups())))


def check_grid(grid: Sequence[float]) -> tuple[float, float, float, float, float]:
    """Return (near, far, left, right, resolution) in m, unless it is no range of a bird's-eye view."""
    if len(grid) != 5 or not all(map(math.isfinite, grid)):
        raise ValueError(f"grid: expected the numbers (near, far, left, right, resolution), got {grid}")
    near, far, left, right, step = map(float, grid)
    text = f"{near:g}:{far:g},{left:g}:{right:g}/{step:g}"
    if not (0 < near < far and left < right and step > 0):
        raise ValueError(f"grid: expected 0 < NEAR < FAR, LEFT < RIGHT and a STEP above 0, got {text}")
    rows, columns = (far - near) / step, (right - left) / step
    if not (16 <= rows <= _MOST_CELLS and 16 <= columns <= _MOST_CELLS):
        got = f"{columns:.0f} x {rows:.0f}"
        raise ValueError(f"grid: expected 16 to {_MOST_CELLS} pixels a side, got {got} of {text}")
    return near, far, left, right, step


def check_types(settings: object) -> None:
    """Raise unless the values of settings have the types of their fields.

    Paths become texts, lists tuples, and numbers, of NumPy too, those of Python.
    """
    for each in fields(settings):  # type: ignore[arg-type]  # a dataclass
        kind, value = str(each.type).removesuffix(" | None"), getattr(settings, each.name)
        if value is None and kind != each.type:
            continue
        if isinstance(value, os.PathLike):
            value = os.fspath(value)
        kind, _, rest = kind.partition("[")
        known, words = _TYPES[kind]
        if not isinstance(value, known) or (isinstance(value, bool) and kind != "bool"):
            name = each.name.replace("_", " ")
            raise TypeError(f"{name}: expected {words}, got {value!r}")
        if isinstance(value, tuple | list):
            part = re.split(r"\W", rest)[0]
            value = tuple(_python_number(one, part) for one in value)
        object.__setattr__(settings, each.name, _python_number(value, kind))


def _python_number(value: object, kind: str) -> object:
    """Return a number as Python's "int" or "float", and a value that is no such number as it is."""
    if isinstance(value, bool):
        return value
    if kind == "int" and isinstance(value, Integral):
        return int(value)
    if kind == "float" and isinstance(value, Real):
        return float(value)
    return value


def option(
    default: T,
    words: str,
    metavar: str = "",
    parse: Callable[[str], object] = parse_path,
    choices: tuple[str, ...] = (),
) -> T:
    """Return a dataclass field with its ``--help`` text and its parser.

    Args:
        default: value if the option is not given.
        words: help text; {} in it is replaced by the default.
        metavar: name of the value in ``--help``.
        parse: converts the text to the value; options with a boolean default are flags instead.
        choices: all allowed values, if there are few.
    """
    metadata = {
        "help": words.replace("{}", str(default)),
        "metavar": metavar,
        "parse": parse,
        "choices": choices,
    }
    return field(default=default, metadata=metadata)
