"""Lines drawn in LabelMe, and the labels of VIL-100, both JSON with points of lines.

Source: LabelMe's file format (``shapes``); VIL-100 (Zhang et al. 2021), ``annotations.lane``.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from lanebev.io.lane_parsing import (
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
from lanebev.numbers import finite_numbers
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
