"""Lines drawn in LabelMe, CVAT, Supervisely, V7, Labelbox or VIA, exports of Datumaro, and labels of VIL-100.

Source: LabelMe's file format; CVAT's "CVAT for images 1.1"; Supervisely's annotation format; Darwin JSON 2.0;
Labelbox's export as NDJSON; Datumaro's format; annotations and projects of VIA; VIL-100 (Zhang et al. 2021).
"""

import os
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from lanebev.io.lanes.parsing import (
    FrameLines,
    Where,
    as_list,
    as_object,
    field,
    json_values,
    lane_text,
    may_bound_lane,
    point_array,
    stated_size,
)
from lanebev.numbers import shown
from lanebev.observation.polylines import LaneLine


class _Picture(NamedTuple):
    """A picture and what is drawn in it.

    Attributes:
        name: its name, perhaps with folders.
        sides: object with its ``height`` and ``width``, px; None if the file says none.
        drawn: the points of each line, [x, y] or {"x": x, "y": y}; None for another shape.
    """

    name: Any
    sides: Any
    drawn: list[Any]


Pictures = Callable[[Path, dict[str, Any]], Iterator[_Picture]]
"""What reads the pictures of a JSON object in a file."""


def read_annotations(path: Path, pictures: Pictures) -> list[FrameLines]:
    """Read the lines that were drawn in a tool; other shapes are left out."""
    found: list[_Picture] = []
    for line, value in json_values(path, lane_text(path)):
        with Where(path, line):
            found += pictures(path, as_object(value))
    with Where(path, None):
        return _frames(found)


def read_cvat(path: Path) -> list[FrameLines]:
    """Read the polylines of the images in a file of "CVAT for images"; other shapes are left out."""
    with Where(path, None):
        try:
            images = ET.fromstring(lane_text(path)).findall("image")
        except ET.ParseError as error:
            raise ValueError("expected CVAT's XML, got a syntax error; is the file cut?") from error
        if not images:
            raise ValueError("expected CVAT's XML with images, got none; export as CVAT for images")
        return _frames([_cvat(image) for image in images])


def _cvat(image: ET.Element) -> _Picture:
    drawn = [
        _of_lane(shape.get("label"), [pair.split(",") for pair in shape.get("points", "").split(";")])
        if shape.tag == "polyline"
        else None
        for shape in image
    ]
    sides = {key: int(text) for key in ("height", "width") if (text := image.get(key, "")).isdecimal()}
    return _Picture(image.get("name"), sides, drawn)


def _frames(pictures: list[_Picture]) -> list[FrameLines]:
    frames = [_frame(picture) for picture in pictures]
    drawn = [each for picture in pictures for each in picture.drawn]
    if drawn and all(each is None for each in drawn):
        raise ValueError("expected lanes drawn as lines, got other shapes only; draw polylines (linestrips)")
    return frames


def _frame(picture: _Picture) -> FrameLines:
    if not isinstance(picture.name, str) or not picture.name:
        raise ValueError(f"name: expected the image's, got {shown(picture.name)}")
    lines = []
    for i, points in enumerate(picture.drawn):
        name = f"{shown(PurePath(picture.name).name)}, line {i}"
        lines += [LaneLine(point_array(name, points))] if points else []
    size = stated_size(picture.sides, "height", "width") if isinstance(picture.sides, dict) else None
    return FrameLines(picture.name, lines, image_size=size)


def _of_lane(label: Any, points: Any) -> Any:
    """Return a line's points; none of one whose label says that it bounds no lane."""
    return points if may_bound_lane(label) else []


def _objects(fields: Any, key: str) -> list[dict[str, Any]]:
    """Return the objects in a list; none if there is no list."""
    return [as_object(each) for each in as_list(key, as_object(fields).get(key) or [])]


def labelme(path: Path, value: dict[str, Any]) -> Iterator[_Picture]:
    """Yield the picture of a file of LabelMe."""
    shapes = [as_object(shape) for shape in field(value, "shapes", list)]
    are_lines = [shape.get("shape_type") in ("linestrip", "line") for shape in shapes]
    drawn = [
        _of_lane(shape.get("label"), field(shape, "points", list)) if is_line else None
        for shape, is_line in zip(shapes, are_lines, strict=True)
    ]
    image = field(value, "imagePath", str).replace("\\", "/")
    sides = {"height": value.get("imageHeight"), "width": value.get("imageWidth")}
    yield _Picture(os.path.normpath(f"{path.parent}/{image}"), sides, drawn)


def vil100(_: Path, value: dict[str, Any]) -> Iterator[_Picture]:
    """Yield the picture of a label of VIL-100."""
    lanes = field(field(value, "annotations", dict), "lane", list)
    info = field(value, "info", dict)
    yield _Picture(field(info, "image_path", str), info, [field(lane, "points", list) for lane in lanes])


def supervisely(path: Path, value: dict[str, Any]) -> Iterator[_Picture]:
    """Yield the picture of a file, which is named after it (``1.jpg.json``)."""
    objects = _objects(value, "objects")
    are_lines = [each.get("geometryType") in ("line", "polyline") for each in objects]
    drawn = [
        _of_lane(each.get("classTitle"), field(field(each, "points", dict), "exterior", list))
        if is_line
        else None
        for each, is_line in zip(objects, are_lines, strict=True)
    ]
    yield _Picture(str(path).removesuffix(".json"), value.get("size"), drawn)


def darwin(_: Path, value: dict[str, Any]) -> Iterator[_Picture]:
    """Yield the picture of a file of V7."""
    item = field(value, "item", dict)
    drawn = [
        _of_lane(each.get("name"), each["line"] and field(each["line"], "path", list))
        if "line" in each
        else None
        for each in _objects(value, "annotations")
    ]
    yield _Picture(item.get("name"), next(iter(_objects(item, "slots")), None), drawn)


def labelbox(_: Path, value: dict[str, Any]) -> Iterator[_Picture]:
    """Yield the picture of a row of Labelbox's export."""
    row = field(value, "data_row", dict)
    labels = [
        label for project in field(value, "projects", dict).values() for label in _objects(project, "labels")
    ]
    objects = [each for label in labels for each in _objects(label.get("annotations") or {}, "objects")]
    drawn = [_of_lane(each.get("name"), each["line"]) if each.get("line") else None for each in objects]
    name = row.get("external_id") or row.get("global_key") or row.get("row_data")
    yield _Picture(name, value.get("media_attributes"), drawn)


def datumaro(_: Path, value: dict[str, Any]) -> Iterator[_Picture]:
    """Yield the pictures of a file of Datumaro, whose points are x y x y ..."""
    for item in _objects(value, "items"):
        drawn: list[Any] = []
        for each in _objects(item, "annotations"):
            flat = as_list("points", each.get("points") or [])
            pairs = [flat[place : place + 2] for place in range(0, len(flat), 2)]
            drawn.append(pairs if each.get("type") == "polyline" else None)
        image = as_object(item.get("image") or {})
        sides = dict(zip(("height", "width"), as_list("size", image.get("size") or []), strict=False))
        yield _Picture(image.get("path") or item.get("id"), sides, drawn)


def via(_: Path, value: dict[str, Any]) -> Iterator[_Picture]:
    """Yield the pictures of VIA's annotations or project."""
    for image in map(as_object, as_object(value.get("_via_img_metadata", value)).values()):
        regions = image.get("regions") or []  # by number in VIA 1
        listed = list(regions.values()) if isinstance(regions, dict) else as_list("regions", regions)
        drawn: list[Any] = []
        for shape in (field(each, "shape_attributes", dict) for each in listed):
            is_line = shape.get("name") == "polyline"
            axes = [field(shape, f"all_points_{axis}", list) for axis in "xy"] if is_line else []
            drawn.append([list(pair) for pair in zip(*axes, strict=False)] if is_line else None)
        yield _Picture(image.get("filename"), None, drawn)


ANNOTATORS: dict[str, Pictures] = {
    "objects": supervisely,
    "item": darwin,
    "data_row": labelbox,
    "items": datumaro,
    "shapes": labelme,
    "annotations.lane": vil100,
}
"""What reads a tool's pictures, by a key that files of none before it have; a.b is the key b below a."""
