"""Lines drawn in LabelMe or CVAT, and the labels of VIL-100.

Source: LabelMe's file format (``shapes``); VIL-100 (Zhang et al. 2021), ``annotations.lane``; CVAT's format
"CVAT for images 1.1".
"""

import os
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np

from lanebev.io.lanes.parsing import (
    FrameLines,
    Where,
    as_list,
    as_object,
    checked_pixels,
    field,
    json_object,
    lane_text,
    stated_size,
)
from lanebev.numbers import finite_numbers, shown
from lanebev.observation.polylines import LaneLine

_LINES = ("linestrip", "line")


def read_labelme(path: str | Path) -> FrameLines:
    """Read a file of LabelMe: its shapes of type ``linestrip`` and ``line``. Others are left out.

    Raises:
        ValueError: it has shapes and none is a line.
    """
    path = Path(path)
    with Where(path, None):
        fields = json_object(lane_text(path))
        shapes = [as_object(shape) for shape in field(fields, "shapes", list)]
        lines = [shape for shape in shapes if shape.get("shape_type") in _LINES]
        if shapes and not lines:
            got = f"{shapes[0].get('shape_type')!s:.20}"
            raise ValueError(f"shapes: expected lanes of type linestrip, got {got}; draw lines")
        image = field(fields, "imagePath", str).replace("\\", "/")
        name = os.path.normpath(f"{path.parent}/{image}")
        size = stated_size(fields, "imageHeight", "imageWidth")
        return FrameLines(name, _lines("shapes", lines), image_size=size)


def read_vil100(path: str | Path) -> FrameLines:
    """Read a label of VIL-100."""
    path = Path(path)
    with Where(path, None):
        fields = json_object(lane_text(path))
        lanes = field(field(fields, "annotations", dict), "lane", list)
        info = field(fields, "info", dict)
        name, size = field(info, "image_path", str), stated_size(info, "height", "width")
        return FrameLines(name, _lines("annotations.lane", lanes), image_size=size)


def read_cvat(path: str | Path) -> list[FrameLines]:
    """Read the polylines of the images in a file of "CVAT for images". Other shapes are left out.

    Raises:
        ValueError: it has no image, as that of "CVAT for video", or it has shapes and none is a polyline.
    """
    path = Path(path)
    with Where(path, None):
        try:
            images = ET.fromstring(lane_text(path)).findall("image")
        except ET.ParseError as error:
            raise ValueError("expected CVAT's XML, got a syntax error; is the file cut?") from error
        if not images:
            raise ValueError("expected CVAT's XML with images, got none; export as CVAT for images")
        if any(map(len, images)) and not any(image.find("polyline") is not None for image in images):
            raise ValueError("expected lanes drawn as polylines, got other shapes only; draw polylines")
        return [_cvat_frame(image) for image in images]


def _cvat_frame(image: ET.Element) -> FrameLines:
    name = image.get("name")
    if not name:
        raise ValueError("image: expected its name, got none")
    sides = [image.get(key, "") for key in ("height", "width")]
    size = tuple(map(int, sides)) if all(side.isdecimal() for side in sides) else None
    drawn = [
        {"points": [pair.split(",") for pair in line.get("points", "").split(";")]}
        for line in image.findall("polyline")
    ]
    return FrameLines(name, _lines(f"image {shown(name)}", drawn), image_size=size)  # type: ignore[arg-type]


def _lines(name: str, lanes: list[Any]) -> list[LaneLine]:
    """Return the lines of objects with ``points``, a list of x and y each."""
    found = []
    for i, lane in enumerate(lanes):
        pairs = [
            finite_numbers(f"{name}[{i}].points", as_list(f"{name}[{i}].points", pair), 2)
            for pair in field(lane, "points", list)
        ]
        if pairs:
            found.append(LaneLine(checked_pixels(f"{name}[{i}].points", np.array(pairs))))
    return found
