"""BDD100K's lane labels in JSON, in Scalabel's format.

Source: BDD100K, "Label Format" (doc.bdd100k.com/format.html), and ``poly2patch`` of its viewer for curves.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lanebev.io.lanes.parsing import (
    FORMATS,
    FrameLines,
    Where,
    as_list,
    as_object,
    checked_pixels,
    field,
    is_probable,
    json_values,
    lane_text,
    may_bound_lane,
)
from lanebev.numbers import finite_numbers, shown
from lanebev.observation.polylines import LaneLine

Array = NDArray[np.float64]

_ACROSS = "vertical"  # direction of lines across the road
_STEPS = np.linspace(0.125, 1.0, 8)  # along a Bézier curve, without its start


def read_bdd100k(path: str | Path) -> list[FrameLines]:
    """Read BDD100K's lanes: ``labels`` of frames in a list or below ``frames``, or of a file per image.

    Other labels than those of lanes, kerbs, crosswalks and lines across the road (``vertical``) are left out.
    """
    path = Path(path)
    frames = []
    for line, value in json_values(path, lane_text(path)):
        with Where(path, line):
            for name, labels in _frames(path, as_object(value)):
                lanes = [label for label in labels if _is_lane(as_object(label))]
                frames.append(FrameLines(name, [each for label in lanes for each in _lines(label)]))
    return frames


def bezier_points(start: Array, controls: Array) -> Array:
    """Return points on a cubic Bézier curve after its start, (8, 2) px.

    Args:
        start: (2,) px.
        controls: (3, 2) px, two control points and the end.
    """
    t, s = _STEPS[:, None], 1.0 - _STEPS[:, None]
    points: Array = (
        s**3 * start + 3 * s**2 * t * controls[0] + 3 * s * t**2 * controls[1] + t**3 * controls[2]
    )
    return points


def _frames(path: Path, value: dict[str, Any]) -> Iterator[tuple[str, list[Any]]]:
    """Yield each frame's name and labels; a file of one image may name it, or be named as it is."""
    frames = as_list("frames", value["frames"]) if "frames" in value else [value]
    for frame in map(as_object, frames):
        if {"name", "labels", "objects"}.isdisjoint({*frame, *value}):
            got = shown(", ".join(frame))
            raise ValueError(f"frames: expected name and labels, as BDD100K has, got {got}; {FORMATS}")
        name = frame.get("name", value.get("name", path.stem))
        if not isinstance(name, str) or not name:
            raise ValueError(f"name: expected the image's, got {shown(name)}")
        yield name, as_list("labels", frame.get("labels") or frame.get("objects") or [])


def _is_lane(label: dict[str, Any]) -> bool:
    is_named = re.match(r"lane\b", str(label.get("category"))) is not None
    return is_named or "laneDirection" in as_object(label.get("attributes") or {})


def _lines(label: dict[str, Any]) -> list[LaneLine]:
    """Return the lines of a lane label; none if it is no boundary of a lane."""
    attributes = as_object(label.get("attributes") or {})
    kind = (label.get("category"), *attributes.values())
    if _ACROSS in kind or not may_bound_lane(*kind) or not is_probable("label", label.get("score")):
        return []
    parts = field(label, "poly2d", list)
    if any(isinstance(part, list) for part in parts):  # as first released: [x, y, type]
        points = [as_list("poly2d", part) for part in parts]
        types = "".join("C" if "C" in each[2:] else "L" for each in points)
        parts = [{"vertices": [each[:2] for each in points], "types": types}]
    lines = [_polyline(field(part, "vertices", list), part.get("types")) for part in parts]
    return [LaneLine(points) for points in lines if len(points)]


def _polyline(vertices: list[Any], types: Any) -> Array:
    """Return points (P, 2) px through the vertices; those of type C are the controls of curves.

    A vertex of type C and the next two are the two control points and the end of a curve, whatever the types
    of those two, as Matplotlib's paths have it, by which the data set is drawn.
    """
    pairs = [finite_numbers("vertices", as_list("vertices", each), 2) for each in vertices]
    corners = checked_pixels("vertices", np.array(pairs).reshape(-1, 2))
    curved = [each == "C" for each in str(types).ljust(len(corners))]
    parts = [corners[:1]]
    i = 1
    while i < len(corners):
        is_curve = curved[i] and i + 2 < len(corners)
        parts.append(bezier_points(corners[i - 1], corners[i : i + 3]) if is_curve else corners[i : i + 1])
        i += 3 if is_curve else 1
    return np.concatenate(parts)
