"""Parts of all readers of lane files: their result, text and JSON, and messages that name file and line."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lanebev.numbers import finite_numbers, numbers_or_gaps, read_text, shown
from lanebev.observation.polylines import LaneLine

_PROBABLE = 0.5  # least probability of a line
_FARTHEST = 1e6  # px or m, of any coordinate
_DECODER = json.JSONDecoder()
_NO_VALUE = re.compile(r"[\s,]*")  # between JSON values
_NO_BOUNDARY = re.compile(r"curb|kerb|crosswalk|zebra|stop[ _-]?line|horizon(?!tal)", re.IGNORECASE)
_SHOWN = 30  # characters of what is no JSON
FORMATS = (
    "formats: TuSimple, CULane, CurveLanes, OpenLane, ONCE-3DLanes, Apollo, LLAMAS, BDD100K, VIL-100, "
    "LabelMe, CVAT, Supervisely, V7, Labelbox, Datumaro, VIA"
)
_NO_JSON = "expected JSON, got a line that breaks off or is none; is the file cut?"


class FrameLines(NamedTuple):
    """The lines of one frame.

    Attributes:
        name: name of the frame in the file.
        lines: lines as they were drawn.
        pose_sigma_scale: factor on the standard deviations of the pose estimated from them; 1 unless stated.
        principal_point: (x, y) px of the camera by which all lines were projected from 3D points, perhaps to
            places outside of the image; None for lines that were drawn in the image.
        focal_length: px, along x, of that camera; None for lines that were drawn in the image.
        image_size: (height, width) px of the image that the lines were drawn on; None if the file says none.
    """

    name: str
    lines: list[LaneLine]
    pose_sigma_scale: float = 1.0
    principal_point: tuple[float, float] | None = None
    focal_length: float | None = None
    image_size: tuple[int, int] | None = None


class Where:
    """Puts file and line before the message of a ValueError."""

    def __init__(self, path: str | Path, line: int | None) -> None:
        self.place = f"lane file {path}" + (f", line {line}" if line else "")

    def __enter__(self) -> None:
        return None

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if isinstance(error, ValueError) and not str(error).startswith("lane file"):
            raise ValueError(f"{self.place}: {error}") from error


def lane_text(path: Path) -> str:
    """Return a lane file's text; a ValueError names the file."""
    try:
        if path.is_fifo():  # which gives its text only once
            raise ValueError("a pipe; write the lanes to a file")
        return read_text(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"lane file {path}: expected a readable file, got: {reason}") from error


def json_object(text: str) -> dict[str, Any]:
    """Return the object that a JSON text holds; else it is a ValueError."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        if getattr(error, "msg", "") == "Extra data":
            raise ValueError("expected one JSON object, got more; write a file per image") from error
        raise ValueError(_NO_JSON) from error
    return as_object(value)


def as_object(value: Any) -> dict[str, Any]:
    """Return the value, if it is a JSON object; else it is a ValueError."""
    if not isinstance(value, dict):
        raise ValueError(f"expected a JSON object, got {type(value).__name__}")
    return value


def json_values(path: str | Path, text: str) -> Iterator[tuple[int, Any]]:
    """Yield the JSON values of a lane file, each with the number of the line on which it begins.

    They follow each other, on lines of their own or not and with commas or not, or are objects in a list.

    Raises:
        ValueError: after the values before, where the text is no JSON.
    """
    place = _begin(text, 0)
    line = 1 + text.count("\n", 0, place)
    while place < len(text):
        with Where(path, line):
            try:
                value, end = _DECODER.raw_decode(text, place)
            except (ValueError, RecursionError) as error:
                got = shown(text[place : place + _SHOWN].split("\n", maxsplit=1)[0])
                words = _NO_JSON if text[place] in "{[" else f"expected JSON, got {got}; {FORMATS}"
                if text[place : place + 2] in ("{'", "['"):
                    words = f"expected JSON, got single quotes: {got}; write it by json.dumps"
                raise ValueError(words) from error
        listed = isinstance(value, list) and all(isinstance(each, dict) for each in value)
        yield from ((line, each) for each in (value if listed else [value]))
        before, place = place, _begin(text, end)
        line += text.count("\n", before, place)


def _begin(text: str, place: int) -> int:
    """Return the place where the next value begins."""
    found = _NO_VALUE.match(text, place)
    return found.end() if found else place


def field(fields: Any, key: str, kind: type) -> Any:
    """Return the value of a key, if it is of this kind; else it is a ValueError."""
    if not isinstance(fields, dict) or not isinstance(fields.get(key), kind):
        got = type(fields.get(key)).__name__ if isinstance(fields, dict) and key in fields else "none"
        raise ValueError(f"{key}: expected a {kind.__name__}, got {got}")
    return fields[key]


def stated_size(fields: dict[str, Any], height: str, width: str) -> tuple[int, int] | None:
    """Return (height, width) px by these keys, None if one of them has no whole number above 0."""
    rows, columns = fields.get(height), fields.get(width)
    if isinstance(rows, int) and isinstance(columns, int) and min(rows, columns) > 0:
        return rows, columns
    return None


def as_list(name: str, values: Any) -> list[Any]:
    """Return the values, if they are a list; else it is a ValueError."""
    if not isinstance(values, list):
        raise ValueError(f"{name}: expected a list, got {shown(values)}")
    return values


def number_array(name: str, values: Any, count: int) -> NDArray[np.float64]:
    """Return a list of ``count`` finite numbers as an array; else it is a ValueError."""
    return np.array(finite_numbers(name, as_list(name, values), count), dtype=np.float64)


def point_array(name: str, points: Any) -> NDArray[np.float64]:
    """Return points, each [x, y] or {"x": x, "y": y}, as (P, 2) px; else it is a ValueError."""
    pairs = [
        finite_numbers(
            name, [point.get("x"), point.get("y")] if isinstance(point, dict) else as_list(name, point), 2
        )
        for point in as_list(name, points)
    ]
    return checked_pixels(name, np.array(pairs, dtype=np.float64).reshape(-1, 2))


def columns(name: str, values: list[Any], count: int) -> NDArray[np.float64]:
    """Return ``count`` lists of one length as (count, P); NaN for missing numbers."""
    lists = len(values) == count and all(isinstance(axis, list) for axis in values)
    if not lists or len({len(axis) for axis in values}) != 1:
        many = {1: "one list", 2: "two lists", 3: "three lists"}[count]
        raise ValueError(f"{name}: expected {many} of one length, got {shown(values)}")
    return np.array([numbers_or_gaps(name, axis) for axis in values])


def may_bound_lane(*labels: Any) -> bool:
    """Return whether a line with these labels may bound a lane; kerbs and what crosses the road do not."""
    return not any(_NO_BOUNDARY.search(each) for each in labels if isinstance(each, str))


def is_probable(name: str, probability: Any) -> bool:
    """Return whether a detector gives a line a probability of at least one half, or none at all.

    The benchmarks' predictions contain lines of any probability, for curves of precision and recall.

    Args:
        name: of the line, for messages.
        probability: number, or those of several classes, of which the largest counts; None if there is none.
    """
    given = probability if isinstance(probability, list) else [probability]
    return probability in (None, []) or max(finite_numbers(f"{name}: probability", given)) >= _PROBABLE


def checked_pixels(name: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the values if they can be pixels."""
    return within(name, "pixels", values)


def within(name: str, unit: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the values if none is too large for this unit."""
    if (np.abs(values) > _FARTHEST).any():  # NaN is not
        raise ValueError(f"{name}: expected {unit}, got {np.nanmax(np.abs(values)):g}")
    return values
