"""TuSimple's JSON lines, and lanebev's additional keys."""

import json
import math
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lanebev.io.lanes.parsing import (
    FrameLines,
    Where,
    as_list,
    as_object,
    checked_pixels,
    field,
    json_object,
    json_values,
    lane_text,
    number_array,
    point_array,
)
from lanebev.numbers import finite_numbers, numbers_or_gaps, shown
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.polylines import LaneLine
from lanebev.types import NUM_BOUNDARIES

_TUSIMPLE_ROWS = {56: range(160, 720, 10), 48: range(240, 720, 10)}  # of the benchmark's labels, by number


def read_tusimple(path: str | Path) -> list[FrameLines]:
    """Read TuSimple JSON, an object a line or in a list: ``lanes``, ``h_samples``, ``raw_file``, and our own.

    Predictions for TuSimple's benchmark leave ``h_samples`` out; theirs are the rows of its labels. Lanes may
    also be lists of points, without rows.
    """
    frames = []
    for line, value in json_values(path, lane_text(Path(path))):
        with Where(path, line):
            frames.append(_tusimple_frame(as_object(value)))
    if not frames:
        raise ValueError(f"lane file {path}: expected TuSimple JSON lines, got an empty file")
    names = [frame.name for frame in frames]
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise ValueError(f"lane file {path}: expected each raw_file once, got {shown(twice)} again")
    return frames


def whole_tusimple_lines(path: str | Path) -> Iterator[FrameLines]:
    """Yield the entries of our own lanes.json one by one, up to a line that breaks off."""
    with open(path, encoding="utf-8") as file:
        for text in file:
            try:
                yield _tusimple_frame(json_object(text))
            except ValueError:
                return


def tusimple_line(
    name: str,
    rows: NDArray[np.float64],
    x: NDArray[np.float64],
    seen: BoundaryVertices | None = None,
    pose_sigma_scale: float = 1.0,
) -> str:
    """Return one frame's boundaries as a line of TuSimple JSON, with each lane's ``boundary``.

    Args:
        name: ``raw_file``.
        rows: (R,) px.
        x: (L, R) px; NaN where a boundary is not there.
        seen: of batch size 1, the vertices that the calibrator was given. They go in full precision to the
            key ``seen``, which other readers pass over and :func:`read_tusimple` prefers. None leaves it out.
        pose_sigma_scale: factor on the standard deviations of the pose estimated from them; 1 is left out.
    """
    there = [index for index in range(len(x)) if np.isfinite(x[index]).any()]
    fields: dict[str, Any] = {
        "raw_file": name,
        "h_samples": [round(row) for row in rows.tolist()],
        "lanes": [[-2 if math.isnan(value) else round(value, 3) for value in x[i].tolist()] for i in there],
        "boundary": there,
    }
    if seen is not None:
        fields["seen"] = _vertex_fields(seen)
    return json.dumps(fields if pose_sigma_scale == 1.0 else {**fields, "pose_sigma_scale": pose_sigma_scale})


def _vertex_fields(vertices: BoundaryVertices) -> dict[str, Any]:
    kept = [weight > 0 for weight in vertices.weight[0]]
    lines = [i for i, there in enumerate(kept) if there.any()]
    numbers = {
        name: [part[0, i][kept[i]].double().tolist() for i in lines]
        for name, part in (
            ("points", vertices.points),
            ("sigma", vertices.sigma),
            ("weight", vertices.weight),
        )
    }
    return {"boundary": vertices.boundary[0, lines].tolist(), **numbers}


def _tusimple_frame(fields: dict[str, Any]) -> FrameLines:
    name = fields.get("raw_file")
    if not isinstance(name, str) or not name:
        raise ValueError(f"raw_file: expected the image's path under this key, got {shown(name)}")
    rows = _rows(fields)
    pose_sigma_scale = _pose_sigma_scale(fields)
    seen = field(fields, "seen", dict) if "seen" in fields else None
    lines = _lane_lines(fields, rows) if seen is None else _seen_lines(seen)
    return FrameLines(name, lines, pose_sigma_scale)


def _rows(fields: dict[str, Any]) -> NDArray[np.float64]:
    """Return the rows (R,) px at which lanes have points; none if all are lists of points, or empty."""
    lanes = fields.get("lanes")
    if "h_samples" in fields:
        rows = finite_numbers("h_samples", field(fields, "h_samples", list))
    elif isinstance(lanes, list) and all(lane == [] or _are_points(lane) for lane in lanes):
        return np.zeros(0)
    elif isinstance(lanes, list) and any(map(_are_points, lanes)):
        raise ValueError(
            "lanes: expected lists of one kind, got points and numbers; give all lanes as points, "
            "or all with h_samples"
        )
    else:
        rows = _benchmark_rows(fields)
    if not (all(a < b for a, b in pairwise(rows)) or all(a > b for a, b in pairwise(rows))):
        raise ValueError("h_samples: expected rows that only rise or only fall, got others")
    return checked_pixels("h_samples", np.array(rows))


def _pose_sigma_scale(fields: dict[str, Any]) -> float:
    scale = fields.get("pose_sigma_scale", fields.get("pose_factor", 1.0))  # its former name
    if type(scale) not in (int, float) or not 0 < scale <= sys.float_info.max:
        raise ValueError(f"pose_sigma_scale: expected a finite number above 0, got {shown(scale)}")
    return float(scale)


def _lane_lines(fields: dict[str, Any], rows: NDArray[np.float64]) -> list[LaneLine]:
    """Return the lanes that have points, in pixels, with their boundaries and standard deviations."""
    lanes = field(fields, "lanes", list)
    indices = _boundary_indices(fields, len(lanes))
    sigmas = fields.get("sigma") or [None] * len(lanes)
    if not isinstance(sigmas, list) or len(sigmas) != len(lanes):
        raise ValueError("sigma: expected a list per lane, got another number of them")
    lines = []
    for i, (lane, index, noise) in enumerate(zip(lanes, indices, sigmas, strict=True)):
        points = _points(f"lanes[{i}]", lane, rows)
        there = np.isfinite(points[:, 0])
        sigma = None if noise is None else _on_rows(f"sigma[{i}]", noise, len(points))
        if sigma is not None and not (sigma[there] > 0).all():
            raise ValueError(f"sigma[{i}]: expected px above 0 where the lane is, got {shown(noise)}")
        sigma = None if sigma is None else np.where(there, sigma, np.nan)
        if there.any():
            lines.append(LaneLine(points, index, sigma))
    return lines


def _are_points(lane: Any) -> bool:
    return isinstance(lane, list) and bool(lane) and isinstance(lane[0], list | dict)


def _points(name: str, lane: Any, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points (P, 2) px of a lane, NaN in x where it is not there."""
    points = point_array(name, lane) if _are_points(lane) else None
    x = _on_rows(name, lane, len(rows)) if points is None else points[:, 0]
    x[x < 0] = np.nan  # -2 is "not there", as null and NaN are
    return np.stack([x, rows], axis=-1) if points is None else points


def _boundary_indices(fields: dict[str, Any], count: int) -> Sequence[int | None]:
    if "boundary" not in fields:
        return [None] * count
    indices: Sequence[int] = fields["boundary"]
    valid = isinstance(indices, list) and all(type(i) is int and 0 <= i < NUM_BOUNDARIES for i in indices)
    if not (valid and len(indices) == count == len(set(indices))):
        raise ValueError(
            f"boundary: expected one different index of 0..{NUM_BOUNDARIES - 1} per lane, got "
            f"{shown(indices)}"
        )
    return indices


def _seen_lines(fields: dict[str, Any]) -> list[LaneLine]:
    """Return the vertices that a run wrote, boundary by boundary."""
    points, sigmas, weights = (field(fields, name, list) for name in ("points", "sigma", "weight"))
    if not len(points) == len(sigmas) == len(weights):
        raise ValueError(
            "seen: expected points, sigma and weight of as many lines, got other numbers of them"
        )
    lines = []
    for i, index in enumerate(_boundary_indices(fields, len(points))):
        pairs = [
            number_array(f"seen.points[{i}]", pair, 2) for pair in as_list(f"seen.points[{i}]", points[i])
        ]
        sigma = number_array(f"seen.sigma[{i}]", sigmas[i], len(pairs))
        weight = number_array(f"seen.weight[{i}]", weights[i], len(pairs))
        if not (sigma > 0).all():
            raise ValueError(f"seen.sigma[{i}]: expected px above 0, got {shown(sigmas[i])}")
        if not ((weight > 0) & (weight <= 1)).all():
            raise ValueError(f"seen.weight[{i}]: expected 0 to 1, got {shown(weights[i])}")
        vertices = checked_pixels(f"seen.points[{i}]", np.reshape(pairs, (-1, 2)))
        lines.append(LaneLine(vertices, index, checked_pixels(f"seen.sigma[{i}]", sigma), weight))
    return lines


def _benchmark_rows(fields: dict[str, Any]) -> list[float]:
    """Return the rows of a prediction without ``h_samples``, by their number, as in TuSimple's benchmark."""
    lanes = field(fields, "lanes", list)
    count = max((len(lane) for lane in lanes if isinstance(lane, list)), default=0)
    for name, values in fields.items():  # y_samples, say
        if count > len(lanes) and name != "lanes" and isinstance(values, list) and len(values) == count:
            raise ValueError(
                f"h_samples: expected this key, got {shown(name)} with as many numbers; rename it"
            )
    if count not in _TUSIMPLE_ROWS:
        known = " or ".join(map(str, _TUSIMPLE_ROWS))
        raise ValueError(
            f"h_samples: expected a list, got none, and not lanes of TuSimple's {known} rows; add them, in px"
        )
    return [float(row) for row in _TUSIMPLE_ROWS[count]]


def _on_rows(name: str, values: Any, count: int) -> NDArray[np.float64]:
    if values == []:  # as some detectors write a lane that they do not see
        return np.full(count, np.nan)
    if not isinstance(values, list) or len(values) != count:
        got = len(values) if isinstance(values, list) else shown(values)
        raise ValueError(f"{name}: expected {count} numbers, one per h_sample, got {got}")
    return checked_pixels(name, np.array(numbers_or_gaps(name, values)))
