"""Texts and numbers from files, and numbers of settings."""

import codecs
import math
import re
import reprlib
from collections.abc import Collection, Sequence
from dataclasses import fields
from numbers import Real
from pathlib import Path
from typing import Any

from lanebev.pipes import await_bytes, open_pipe

_BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",  # as PowerShell's > writes
    codecs.BOM_UTF16_BE: "utf-16",
}
_BEGINNING = 65_536  # first bytes of a file, which decide whether it is a text
_GZIP = b"\x1f\x8b"
_STAND_INS = {  # what came in place of another file, by its first bytes
    b"version https://git-lfs.github.com/": "a pointer of Git LFS; fetch the file by git lfs pull",
    b"\x93NUMPY": "an array of NumPy; write numbers as JSON or YAML, images as PNG",
    b"MATLAB ": "MATLAB's own format; save it as JSON by jsonencode",
    b"PK\x03\x04": "a ZIP archive, or a sheet of Excel; unpack it, or save the sheet as CSV",
    b"\x89HDF": "HDF5, as of MATLAB 7.3 and h5py; save it as JSON",
    b"PAR1": "a Parquet table; save it as JSON",
    b"ARROW1": "a Feather table; save it as JSON",
    **dict.fromkeys(
        (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"),
        "a pickle of Python, which is not opened since it may run commands; save it as JSON",
    ),
}
_MOST_FOREIGN = 0.3  # fraction of a text's letters, if its encoding is not known
_REPR = reprlib.Repr()
_REPR.maxlist = _REPR.maxdict = _REPR.maxtuple = 4
_REPR.maxlevel, _REPR.maxstring = 3, 200


def stand_in(begin: bytes) -> str:
    """Name the kind of file that came in place of another, by its first bytes; empty if it is not known."""
    if not begin:
        return "an empty file"
    if begin.lstrip()[:14].lower().startswith((b"<!doctype html", b"<html")):
        return "a web page; download the file again"
    return next((what for first, what in _STAND_INS.items() if begin.startswith(first)), "")


def read_text(path: Path, errors: str = "strict") -> str:
    """Return a text file's content: UTF-8, or UTF-16 where a byte order mark says so.

    Args:
        path: of the file.
        errors: "replace" reads files of other encodings, with other letters in place of those beyond ASCII.

    Raises:
        ValueError: why the file can't be read, in a few words; the caller says which file.
    """
    try:
        data = _bytes_of_pipe(path) if path.is_fifo() else _bytes_of_file(path)
        if data.startswith(_GZIP):
            raise ValueError("compressed by gzip; unpack it")
        if data and (instead := stand_in(data)):
            raise ValueError(instead)
        mark = next((each for each in _BYTE_ORDER_MARKS if data.startswith(each)), b"")
        text = data.decode(_BYTE_ORDER_MARKS.get(mark, "utf-8"), errors)
        if errors == "replace" and text.count("\ufffd") > _MOST_FOREIGN * len(text):
            raise ValueError("not a text file")
        if "\0" in text:
            wide = text.count("\0") > _MOST_FOREIGN * len(text)
            of_utf16 = ", or one in UTF-16 without a byte order mark; save it as UTF-8" if wide else ""
            raise ValueError(f"not a text file{of_utf16}")
        return text
    except UnicodeDecodeError as error:
        raise ValueError("not a text file") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        raise ValueError(getattr(error, "strerror", None) or str(error)) from error


def _bytes_of_file(path: Path) -> bytes:
    """Return a file's content; of one that is no text, such as a video, the beginning only."""
    with open(path, "rb") as file:
        begin = file.read(_BEGINNING)
        is_text = b"\0" not in begin or begin.startswith(tuple(_BYTE_ORDER_MARKS))
        return begin + file.read() if is_text else begin


def _bytes_of_pipe(path: Path) -> bytes:
    """Return the bytes that come through a pipe, such as the output of ``<(command)`` in the shell."""
    with open_pipe(path) as pipe:
        await_bytes(pipe)
        return pipe.read()


def check_number(name: str, value: object, expected: str = "a number") -> None:
    """Raise unless an argument is a number of Python or NumPy; a truth value is none."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name}: expected {expected}, got {type(value).__qualname__}")


def check_settings(config: Any, positive: Collection[str], infinite: Collection[str]) -> None:
    """Raise unless every number of a dataclass is finite and at least 0.

    Args:
        config: an instance; fields whose default is no number are not checked.
        positive: names of those that must be more than 0.
        infinite: names of those that may be infinite.
    """
    for name in (part.name for part in fields(config) if isinstance(part.default, Real)):
        value = getattr(config, name)
        check_number(name, value)
        enough = value > 0 if name in positive else value >= 0
        if not (enough and (value < math.inf or name in infinite)):
            least = "more than 0" if name in positive else "at least 0"
            finite = "" if name in infinite else "a finite number, "
            raise ValueError(f"{name}: expected {finite}{least}, got {value}")


def shown(value: Any, most: int = 60) -> str:
    """Return a value as it is shown in a message: on one line, cut, and quickly also of deep or huge ones."""
    text = " ".join(_REPR.repr(value).split())
    return text if len(text) <= most else text[: most - 1] + "…"


def finite_numbers(name: str, values: Sequence[Any], count: int | None = None) -> list[float]:
    """Convert texts or numbers to floats, ``count`` of them if given."""
    if count is not None and len(values) != count:
        raise ValueError(f"{name}: expected {count} number{'s'[: count != 1]}, got {len(values)}")
    numbers = _floats(values)
    if numbers is None or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name}: expected finite numbers, got {_listed(values)}")
    return numbers


def numbers_or_gaps(name: str, values: Sequence[Any]) -> list[float]:
    """Convert texts or numbers to floats, NaN for missing ones: ``null``, ``nan`` or NaN."""
    numbers = _floats([math.nan if value is None else value for value in values])
    if numbers is None or any(map(math.isinf, numbers)):
        raise ValueError(
            f"{name}: expected finite numbers, or null where there is none, got {_listed(values)}"
        )
    return numbers


def _floats(values: Sequence[Any]) -> list[float] | None:
    """Return the values as floats, None if one is not a number."""
    if any(isinstance(value, bool) for value in values):
        return None
    try:
        return [float(value) for value in values]
    except (TypeError, ValueError, OverflowError):
        return None


def _listed(values: Sequence[Any]) -> str:
    return ", ".join(shown(value).strip("'\"") for value in values[:60])[:60]


def parse_size(text: str) -> tuple[int, int]:
    """Return (height, width) of a text such as ``1280x720``, width first."""
    match = re.fullmatch(r"\s*(\d{1,6})\s*[x×X]\s*(\d{1,6})\s*", text, re.ASCII)
    if match is None or 0 in (size := (int(match[2]), int(match[1]))):
        raise ValueError(f"lanes size: expected WIDTHxHEIGHT in px, such as 1280x720, got {text!r}")
    return size


def parse_crop(text: str) -> tuple[int, int, int, int]:
    """Return (top, left, height, width) of a text such as ``1280x480+0+240``: WIDTHxHEIGHT+LEFT+TOP."""
    number = r"\s*(\d{1,6})\s*"
    match = re.fullmatch(rf"{number}[x×X]{number}\+{number}\+{number}", text, re.ASCII)
    width, height, left, top = map(int, match.groups()) if match else (0, 0, 0, 0)
    if not (width and height):
        raise ValueError(f"lanes crop: expected WIDTHxHEIGHT+LEFT+TOP, such as 1280x480+0+240, got {text!r}")
    return top, left, height, width
