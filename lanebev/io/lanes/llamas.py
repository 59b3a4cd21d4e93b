"""LLAMAS' lane markers in JSON.

Source: Behrendt and Soussan 2019, "Unsupervised Labeled Lane Markers Using Maps"; the data set's
``label_scripts/spline_creator.py``, which joins a line's markers too.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lanebev.io.lanes.parsing import (
    FrameLines,
    Where,
    as_object,
    checked_pixels,
    field,
    json_object,
    lane_text,
)
from lanebev.numbers import finite_numbers
from lanebev.observation.polylines import LaneLine


def read_llamas(path: str | Path) -> FrameLines:
    """Read a LLAMAS label: ``lanes``, each with the ``markers`` (dashes) of one line, joined.

    ``lane_id`` is not used: its numbers leave out lines, and the data set's own scripts number them anew.
    """
    path = Path(path)
    lines = []
    with Where(path, None):
        fields = json_object(lane_text(path))
        name = field(fields, "image_name", str)
        for i, lane in enumerate(field(fields, "lanes", list)):
            points = [
                _pixel(f"lanes[{i}].markers[{k}]", marker, end)
                for k, marker in enumerate(field(lane, "markers", list))
                for end in ("pixel_start", "pixel_end")
            ]
            if points:
                lines.append(LaneLine(_in_order_of_rows(checked_pixels(f"lanes[{i}]", np.array(points)))))
    return FrameLines(name if "/" in name else f"{path.parent}/{name}", lines)


def _pixel(name: str, marker: Any, end: str) -> list[float]:
    pixel = field(as_object(marker), end, dict)
    return finite_numbers(f"{name}.{end}", [pixel.get("x"), pixel.get("y")])


def _in_order_of_rows(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (P, 2) from bottom to top: markers may overlap, and come in any order."""
    return points[np.argsort(-points[:, 1], kind="stable")]
