"""3D lanes of ONCE-3DLanes and of the Apollo synthetic data set in JSON.

Source: ONCE-3DLanes (Yan et al. 2022), in camera axes; Gen-LaneNet (Guo et al. 2020), tools/utils.py,
``projection_g2im``: on the ground below the camera, x right, y forward, z up.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lanebev.io.lanes.openlane import image_from_camera_points, of_camera, visible_points
from lanebev.io.lanes.parsing import (
    FrameLines,
    Where,
    as_list,
    as_object,
    columns,
    field,
    is_probable,
    json_object,
    json_values,
    lane_text,
    within,
)
from lanebev.numbers import finite_numbers
from lanebev.observation.polylines import LaneLine

Array = NDArray[np.float64]

_FARTHEST = 1e6  # px of the image


def read_once(path: Path, intrinsics: Array | None) -> FrameLines:
    """Read a label or a prediction of ONCE-3DLanes, of the image that is named as the file is.

    Args:
        path: path of the file.
        intrinsics: (3, 3) px, for a file without ``calibration``.
    """
    with Where(path, None):
        fields = json_object(lane_text(path))
        if fields.get("calibration") is not None:
            rows = [
                finite_numbers("calibration", as_list("calibration", row)) for row in fields["calibration"]
            ]
            if len(rows) != 3 or any(len(row) not in (3, 4) for row in rows):
                raise ValueError("calibration: expected the camera matrix, 3 x 3 or 3 x 4, got other numbers")
            intrinsics = within("calibration", "numbers of a camera", np.array([row[:3] for row in rows]))
        lanes = [_once_points(f"lanes[{i}]", lane) for i, lane in enumerate(field(fields, "lanes", list))]
        return _projected(str(path).removesuffix(".json"), lanes, intrinsics)


def read_apollo(path: Path, intrinsics: Array | None) -> list[FrameLines]:
    """Read the ``laneLines`` of Apollo's synthetic images, one image a line.

    Args:
        path: path of the file.
        intrinsics: (3, 3) px; the file has none.
    """
    frames = []
    for line, value in json_values(path, lane_text(path)):
        with Where(path, line):
            fields = as_object(value)
            given = finite_numbers(
                "cam_height, cam_pitch", [fields.get("cam_height"), fields.get("cam_pitch")]
            )
            height, pitch = within("cam_height, cam_pitch", "m and rad", np.array(given)).tolist()
            lanes = [camera_from_apollo(points, height, pitch) for points in _apollo_points(fields)]
            frames.append(_projected(field(fields, "raw_file", str), lanes, intrinsics))
    return frames


def _once_points(name: str, lane: Any) -> Array:
    """Return the points of a label, or of a prediction with a score; none of an improbable one."""
    if not isinstance(lane, dict):
        return _points(name, lane)
    return _points(name, field(lane, "points", list) if is_probable(name, lane.get("score")) else [])


def _apollo_points(fields: dict[str, Any]) -> list[Array]:
    """Return the visible points of each line, without improbable lines.

    A file of predictions is made of one of labels, whose visibility is that of other lines.
    """
    named = {f"laneLines[{i}]": lane for i, lane in enumerate(field(fields, "laneLines", list))}
    probabilities = _of_each("laneLines_prob", fields, len(named))
    is_predicted = fields.get("laneLines_prob") is not None
    visibilities = _of_each("laneLines_visibility", {} if is_predicted else fields, len(named))
    return [
        visible_points(f"{name}_visibility", _points(name, lane), visibility)
        for (name, lane), visibility, probability in zip(
            named.items(), visibilities, probabilities, strict=True
        )
        if is_probable(name, probability)
    ]


def _of_each(key: str, fields: dict[str, Any], count: int) -> list[Any]:
    """Return what a key has for each of the lines; None for each without the key."""
    given = as_list(key, fields.get(key) or [None] * count)
    if len(given) != count:
        raise ValueError(f"{key}: expected a value for each of {count} lines, got {len(given)}")
    return given


def camera_from_apollo(points: Array, height: float, pitch: float) -> Array:
    """Return points (P, 3) m on the ground in the axes of a camera with a height (m) and a pitch (rad)."""
    sine, cosine = math.sin(pitch), math.cos(pitch)
    x, y, z = points.T
    return np.stack([x, height - sine * y - cosine * z, cosine * y - sine * z], axis=-1)


def _points(name: str, lane: Any) -> Array:
    """Return a list of three numbers each as (P, 3) m."""
    rows = [
        list(axis) for axis in zip(*(as_list(name, point) for point in as_list(name, lane)), strict=False)
    ]
    return within(name, "m", columns(name, rows or [[], [], []], 3).T)


def _projected(name: str, lanes: list[Array], intrinsics: Array | None) -> FrameLines:
    """Return lanes in camera axes in pixels of the image."""
    if intrinsics is None:
        raise ValueError("intrinsics: expected the camera matrix of lanes in 3D, got none; give the camera")
    lines = []
    for lane in lanes:
        image = image_from_camera_points(lane, intrinsics)
        kept = image[(np.abs(image) < _FARTHEST).all(-1)]
        lines += [LaneLine(kept)] if len(kept) else []
    return of_camera(FrameLines(name, lines), intrinsics if lines else None)
