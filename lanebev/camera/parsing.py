"""Syntax of camera files: YAML, JSON and XML to keys and values; scalars stay unparsed texts."""

import itertools
import json
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import yaml

from lanebev.camera.parameters import left_square, matrix_entries
from lanebev.numbers import finite_numbers, shown
from lanebev.plain_yaml import PlainLoader, once, plain_documents

_LARGEST_YAML = 1_000_000  # characters; PyYAML reads some 100,000 a second
_MOST_NUMBERS = 1_000  # numbers in one matrix
_TABS = re.compile(r"(?<=\S) *\t[ \t]*")  # between words; PyYAML takes none there, YAML and other readers do
_NO_SPACE = re.compile(r"^\w{1,40}:[\w.]{1,20}", re.MULTILINE)  # which OpenCV reads, and YAML does not know
_NO_BREAK_SPACE = "\u00a0"  # of texts copied from web pages
_ROS_INI = re.compile(r"^\[image\]\s*$", re.MULTILINE)
_SECTION = re.compile(r"^\[[A-Za-z]\w*\]\s*$", re.MULTILINE)  # of other programs' INI, and of TOML
_OF_FISHEYE = 4  # coefficients
_OF_FORMER_ROS = (5, 8)  # coefficients that its calibrator stated, and those that it wrote
_BETWEEN_BLANKS = re.compile(r"[^\s,]+(?:,[^\s,]+)?(?:\s+[^\s,]+(?:,[^\s,]+)?)+")  # as 0,31 0,11: no list
_AROUND_NUMBERS = re.compile(r"#.*|[\s,;\[\]()]+")
_MOST_BARE = 1_000  # characters of a text of numbers alone
_INI_KEYS = {
    "width": "image_width",
    "height": "image_height",
    "camera matrix": "camera_matrix",
    "distortion": "distortion_coefficients",
    "rectification": "rectification_matrix",
    "projection": "projection_matrix",
}


def parse(text: str) -> Any:
    """Return what the first document of a camera file says, see :func:`parse_documents`."""
    return parse_documents(text)[0]


def parse_documents(text: str) -> list[Any]:
    """Return what a camera file says: dicts by key, lists, texts, and None for nothing.

    Returns:
        the first document, and the second one of a YAML file that has more.

    Raises:
        ValueError: the syntax is none of YAML, JSON, XML and ROS's INI, or a key is given twice.
    """
    if is_ros_ini(text):
        return [_parse_ini(text)]
    start = text.lstrip()[:1]
    if start not in ("<", "{") and (section := _SECTION.search(text)):
        raise ValueError(
            f"expected YAML, JSON or XML, got the section {section[0].strip()}, as of INI or TOML; write the "
            "numbers of one camera and image size as fx: 1150, with width and height"
        )
    if start == "<":
        return [_parse_xml(text)]
    if start in ("{", "["):
        try:
            fields = json.loads(
                text, object_pairs_hook=once, parse_int=str, parse_float=str, parse_constant=str
            )
            return [fields]
        except (json.JSONDecodeError, RecursionError):
            pass  # YAML has braces too, and says where it breaks off
    return _parse_yaml(text)


def is_ros_ini(text: str) -> bool:
    """Return whether a text is ROS's INI."""
    return _ROS_INI.search(text) is not None


class _CameraLoader(PlainLoader):
    """Loader that also knows OpenCV's matrices and Python's tuples."""


for _tag in ("opencv-matrix", "opencv-nd-matrix"):
    _CameraLoader.add_constructor(
        f"tag:yaml.org,2002:{_tag}", partial(_CameraLoader.construct_mapping, deep=True)
    )
_CameraLoader.add_constructor(
    "tag:yaml.org,2002:python/tuple", partial(_CameraLoader.construct_sequence, deep=True)
)
for _tag in ("int", "float", "bool", "timestamp"):
    _CameraLoader.add_constructor(f"tag:yaml.org,2002:{_tag}", partial(_CameraLoader.construct_scalar))


def _parse_yaml(text: str) -> list[Any]:
    """Return the first two documents that say something; of a second one with errors nothing is said."""
    if len(text) > _LARGEST_YAML:
        raise ValueError(f"expected a camera file, got {len(text)} characters of YAML")
    lines = text.replace(_NO_BREAK_SPACE, " ").splitlines()
    if lines and lines[0].startswith("%YAML"):  # OpenCV writes %YAML:1.0, which YAML does not allow
        lines[0] = ""
    found: list[Any] = []
    try:
        documents = plain_documents(_TABS.sub(" ", "\n".join(lines)), _CameraLoader)
        found.extend(itertools.islice((each for each in documents if each is not None), 2))
        return found or [None]  # ros2 topic echo ends with ---
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        if found and "document start" not in str(getattr(error, "problem", "")):
            return found
        if isinstance(error, ValueError):
            raise
        raise ValueError(_yaml_fault(error, text, bool(found))) from error


def _yaml_fault(error: Exception, text: str, has_document: bool) -> str:
    """Return what is wrong with a text that is no YAML, or none after its first document."""
    mark, problem = getattr(error, "problem_mark", None), str(getattr(error, "problem", ""))
    where = f" at line {mark.line + 1}" if mark else ""
    if isinstance(error, yaml.constructor.ConstructorError) and "!" in text:
        return f"expected numbers, texts and lists, got another object{where}"
    if "\\t" in problem:
        return f"expected YAML, got a tab{where}; indent by spaces"
    if "mapping values" in problem and ", " in text:
        return f"expected a key a line, or all of them in braces, got more{where}"
    if without_space := _NO_SPACE.search(text):
        return f"expected a space after each colon, got {without_space[0]}"
    if has_document:
        is_in_braces = text.lstrip()[:1] in ("{", "[")
        together = "in the braces" if is_in_braces else "in one block, equally indented"
        return f"expected all keys {together}, got more after them{where}"
    return f"expected YAML, got a syntax error{where}; is the file cut?"


def bare_numbers(text: str) -> dict[str, Any] | None:
    """Return the fields of a text of numbers alone; None if it is another.

    Nine are a camera matrix, whose last one is 1, twelve a projection matrix, and sixteen one of 4 x 4; four,
    eight or nine others are fx fy cx cy and the coefficients, as DROID-SLAM has them.
    """
    words = [word for word in _AROUND_NUMBERS.split(text) if word] if len(text) <= _MOST_BARE else []
    try:
        values = [*map(float, words)]
    except ValueError:
        return None
    if len(words) in (12, 16):
        del words[3::4], values[3::4]
        words, values = words[:9], values[:9]
    if len(values) == 9 and values[8] == 1.0:
        return {"K": words, "D": []}
    if len(values) in (4, 8, 9):
        return {**dict(zip(("fx", "fy", "cx", "cy"), words, strict=False)), "distortion": words[4:]}
    return None


def _parse_ini(text: str) -> dict[str, Any]:
    """Read names on lines of their own and the numbers below them; names of sections are ignored.

    ROS writes five coefficients or eight of a pinhole camera, four of a fisheye, and no lens model. Two zeros
    at the end of four are no tangential distortion of a pinhole camera.
    """
    entries: list[tuple[str, list[str]]] = []
    for line in text.splitlines():
        words = line.split("#")[0].strip()
        if words[:1].isalpha():
            entries.append((_INI_KEYS.get(words, words), []))
        elif entries and not words.startswith("["):
            entries[-1][1].extend(words.split())
    found = {key: values[0] if len(values) == 1 else values for key, values in once(entries).items()}
    key = "distortion_coefficients"
    lens = numbers(found, key) if isinstance(found.get(key), list) else []
    is_fisheye = len(lens) == _OF_FISHEYE and any(lens[2:])
    return {**found, **({"distortion_model": "fisheye"} if is_fisheye else {})}


def _parse_xml(text: str) -> dict[str, Any]:
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        line = error.position[0]
        raise ValueError(f"expected XML, got a syntax error at line {line}; is the file cut?") from error
    return once((child.tag, _xml_value(child)) for child in root)


def _xml_value(element: ET.Element) -> Any:
    """Return a matrix's fields, or a text."""
    if not len(element):
        return element.text
    return once((field.tag, (field.text or "").strip()) for field in element)


def given_keys(fields: Mapping[str, Any], *keys: str) -> list[str]:
    """Return which of these keys have a value."""
    return [key for key in keys if fields.get(key) is not None]


def required(fields: Mapping[str, Any], *keys: str) -> Any:
    """Return the value of the first of these spellings of a key that has one."""
    if not (found := given_keys(fields, *keys)):
        raise ValueError(f"{keys[0]}: expected a value, got none; add the entry")
    return fields[found[0]]


def _read_once(
    fields: Mapping[str, Any], keys: Sequence[str], read: Callable[[Any], list[float]]
) -> list[float]:
    """Return the numbers that ``read`` finds in the value of a key; in another spelling they are the same.

    Zeros at the end do not make a difference, as of coefficients.
    """
    required(fields, *keys)
    found = given_keys(fields, *keys)
    first, *others = (read(fields[key]) for key in found)
    if any(a != b for other in others for a, b in itertools.zip_longest(first, other, fillvalue=0.0)):
        raise ValueError(f"expected one of {' and '.join(found)}, got both, which differ; keep the right one")
    return first


def number(fields: Mapping[str, Any], *keys: str, default: float | None = None) -> float:
    """Return the finite number of a key, or the default if the key is not there."""
    if default is not None and not given_keys(fields, *keys):
        return default
    return _read_once(fields, keys, lambda value: finite_numbers(keys[0], [value], 1))[0]


def whole_number(fields: Mapping[str, Any], *keys: str) -> int:
    """Return the whole number of a key, of pixels."""
    value = number(fields, *keys)
    if value != round(value):
        raise ValueError(f"{keys[0]}: expected whole pixels, got {value:g}")
    return round(value)


def stated_size(fields: Mapping[str, Any], height: str = "height", width: str = "width") -> tuple[int, int]:
    """Return (height, width) px of images, by the names of their keys."""
    return whole_number(fields, height), whole_number(fields, width)


def listed_size(fields: Mapping[str, Any], key: str) -> tuple[int, int]:
    """Return (height, width) px of images, of a list with the width first."""
    width, height = numbers(fields, key, count=2)
    return round(height), round(width)


def numbers(fields: Mapping[str, Any], *keys: str, count: int | None = None) -> list[float]:
    """Return the entries of ``{rows, cols, data}`` or of a (nested) list, row by row."""
    return _read_once(fields, keys, lambda value: _numbers(keys[0], value, count))


def _numbers(name: str, value: Any, count: int | None) -> list[float]:
    if isinstance(value, Mapping):
        return finite_numbers(name, *_opencv_data(name, value, count))
    entries = list(itertools.islice(_entries(_sequence(name, value)), _MOST_NUMBERS + 1))
    if len(entries) > _MOST_NUMBERS:
        raise ValueError(f"{name}: expected a few numbers, got more than {_MOST_NUMBERS}")
    return finite_numbers(name, entries, count)


def camera_matrix(fields: Mapping[str, Any], *keys: str) -> list[float]:
    """Return the nine entries of a camera matrix; it may be padded to 3 x 4 or 4 x 4, or be fx fy cx cy."""
    return _read_once(fields, keys, lambda value: _unpadded(keys[0], _numbers(keys[0], value, None)))


def _unpadded(name: str, entries: list[float]) -> list[float]:
    if len(entries) == 4:
        return matrix_entries(*entries)
    is_padded = len(entries) in (12, 16) and not any(entries[3:12:4])
    if is_padded and entries[12:] in ([], [0.0, 0.0, 0.0, 1.0]):
        entries = left_square(entries)
    return finite_numbers(name, entries, 9)


def mapping(name: str, value: Any) -> Mapping[str, Any]:
    """Return the value, if it has keys of its own."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{name}: expected keys and values, got {shown(value)}")
    return value


def _opencv_data(name: str, value: Mapping[str, Any], count: int | None) -> tuple[list[Any], int]:
    """Return the data of ``{rows, cols, data}``, or ``{sizes, data}`` of OpenCV 5, and their number."""
    unknown = sorted(set(value) - {"rows", "cols", "sizes", "data", "dt", "type_id"})  # type_id: JSON's
    if unknown:
        raise ValueError(f"{name}: expected rows, cols, dt, data, got the key {shown(unknown[0])}")
    as_list = {key: field.split() if isinstance(field, str) else field for key, field in value.items()}
    shape = as_list.get("sizes") or [entry for key in ("rows", "cols") for entry in _flat(as_list.get(key))]
    sizes = finite_numbers(f"{name}.rows and .cols", _sequence(name, shape))
    data = list(_entries(_sequence(name, as_list.get("data") or [])))
    if (math.prod(sizes), len(data)) == _OF_FORMER_ROS:
        count = len(data)
    return data, count or (round(min(math.prod(sizes), 1e6)) if sizes else len(data))


def _entries(rows: list[Any]) -> Iterator[Any]:
    for row in rows:
        yield from _flat(row)


def _flat(value: Any) -> list[Any]:
    """Return the numbers of a row, or of a text with blanks between them, as of lists without commas."""
    if isinstance(value, str):
        return value.split()
    return value if isinstance(value, list) else [] if value is None else [value]


def _sequence(name: str, value: Any) -> list[Any]:
    """Return a list of numbers, or the words of a text, as XML has several numbers, or quotes."""
    if isinstance(value, str):
        text = value.strip("[] ")
        words = (text if _BETWEEN_BLANKS.fullmatch(text) else text.replace(",", " ")).split()
        if len(words) > 1:
            return list(words)
    if not isinstance(value, list):
        raise ValueError(f"{name}: expected a list of numbers, got {shown(value)}")
    return value
