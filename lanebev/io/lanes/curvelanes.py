"""CurveLanes' JSON.

Source: CurveLanes (Xu et al. 2020, CurveLane-NAS), ``X.lines.json`` beside ``X.jpg``.
"""

from pathlib import Path
from typing import Any

import numpy as np

from lanebev.io.lanes.parsing import FrameLines, Where, as_list, checked_pixels, field, json_object, lane_text
from lanebev.numbers import numbers_or_gaps
from lanebev.observation.polylines import LaneLine


def read_curvelanes(path: str | Path) -> FrameLines:
    """Read a CurveLanes file: ``Lines``, each a list of points with ``x`` and ``y``, numbers or texts."""
    path = Path(path)
    lines = []
    with Where(path, None):
        for i, line in enumerate(field(json_object(lane_text(path)), "Lines", list)):
            name = f"Lines[{i}]"
            points = np.array([_point(name, each) for each in as_list(name, line)]).reshape(-1, 2)
            if np.isfinite(points).all(-1).any():
                lines.append(LaneLine(checked_pixels(name, points)))
    return FrameLines(str(path).removesuffix(".json").removesuffix(".lines"), lines)


def _point(name: str, point: Any) -> list[float]:
    if not isinstance(point, dict):
        raise ValueError(f"{name}: expected points with x and y, got {type(point).__name__}")
    return numbers_or_gaps(name, [point.get("x"), point.get("y")])
