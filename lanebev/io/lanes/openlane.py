"""OpenLane's 2D and 3D lanes in JSON.

Source: OpenLane, eval/LANE_evaluation/lane3d/eval_3D_lane.py. Labels are in the camera's frame turned to the
vehicle's axes (x forward, y left, z up). Predictions for the benchmark are in the ground frame below the
camera (x right, y forward, z up), whose pose is the label's ``extrinsic``.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lanebev.io.lanes.parsing import (
    FrameLines,
    Where,
    checked_pixels,
    columns,
    field,
    is_probable,
    json_object,
    lane_text,
    within,
)
from lanebev.numbers import finite_numbers, shown
from lanebev.observation.polylines import LaneLine

Array = NDArray[np.float64]

_CAMERA_FROM_LABEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_VEHICLE_FROM_GROUND = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_CURBS = (20, 21)  # left and right kerb: no lane ends there, so no lane width holds
_FARTHEST = 1e6  # px of the image
_NEAREST = 0.1  # m in front of the camera; what is nearer or behind has no image


def read_openlane(path: str | Path, intrinsics: NDArray[np.float64] | None = None) -> FrameLines:
    """Read an OpenLane 2D or 3D JSON: the ``uv`` of its lane lines, else their ``xyz``.

    Kerbs are left out, and lines that a detector gives a probability below one half.

    Points ``xyz`` alone, as predictions have them, are projected by the file's ``intrinsic``. Three lists of
    P numbers are in the camera's frame, as labels are; P lists of three are in the ground frame of the
    benchmark's predictions if the file has the camera's ``extrinsic``, else in the camera's.

    Args:
        path: path of the file.
        intrinsics: (3, 3) px, for a file that has 3D points and no ``intrinsic``.
    """
    path = Path(path)
    with Where(path, None):
        fields = json_object(lane_text(path))
        name = field(fields, "file_path", str)
        lines = []
        lanes = field(fields, "lane_lines", list)
        by_point = any(_is_list_of_points(lane) for lane in lanes)
        for i, lane in enumerate(lanes):
            points = _openlane_points(f"lane_lines[{i}]", lane, fields, intrinsics, by_point)
            is_seen = is_probable(f"lane_lines[{i}]", lane.get("laneLines_prob"))
            if is_seen and lane.get("category") not in _CURBS and np.isfinite(points).any():
                lines.append(LaneLine(points))
        projected = bool(lines) and all(_is_3d(lane) for lane in lanes)
        matrix = _camera_matrix(fields, intrinsics) if projected else None
    return of_camera(FrameLines(name, lines), matrix)


def of_camera(frame: FrameLines, intrinsics: Array | None) -> FrameLines:
    """Return a frame whose lines were projected by a camera matrix (3, 3) px; by none, the frame itself."""
    if intrinsics is None:
        return frame
    (focal, _, x), (_, _, y) = intrinsics[:2].tolist()
    return frame._replace(principal_point=(x, y), focal_length=focal)


def camera_from_label_points(points: Array) -> Array:
    """Return label points (P, 3) m, x forward, y left, z up, in camera axes x right, y down, z forward."""
    camera: Array = points @ _CAMERA_FROM_LABEL.T
    return camera


def camera_from_ground_points(points: Array, vehicle_from_camera: Array) -> Array:
    """Return the benchmark's prediction points (P, 3) m in camera axes.

    Args:
        points: (P, 3) m of the ground frame below the camera, x right, y forward, z up.
        vehicle_from_camera: (4, 4), the label's ``extrinsic``; its x and y translation is not used, as in
            the benchmark.
    """
    rotation = _VEHICLE_FROM_GROUND.T @ vehicle_from_camera[:3, :3] @ _CAMERA_FROM_LABEL.T
    camera: Array = (points - np.array([0.0, 0.0, vehicle_from_camera[2, 3]])) @ rotation
    return camera


def image_from_camera_points(points: Array, intrinsics: Array) -> Array:
    """Return the pixels (P, 2) of points (P, 3) m in camera axes, NaN where they are not in front of it.

    Args:
        points: (P, 3) m.
        intrinsics: (3, 3) px.
    """
    depth = np.where(points[:, 2] > _NEAREST, points[:, 2], np.nan)
    homogeneous = points @ intrinsics.T
    return homogeneous[:, :2] / depth[:, None]


def _is_list_of_points(lane: Any) -> bool:
    """Return whether a line's ``xyz`` is P lists of three numbers, not three lists of P; 3 do not tell."""
    xyz = lane.get("xyz") if isinstance(lane, dict) else None
    return isinstance(xyz, list) and len(xyz) not in (0, 3) and _are_threes(xyz)


def _is_3d(lane: dict[str, Any]) -> bool:
    """Return whether a line has 3D points only."""
    return lane.get("uv") is None and lane.get("xyz") is not None


def _camera_matrix(fields: dict[str, Any], intrinsics: Array | None) -> Array | None:
    return intrinsics if fields.get("intrinsic") is None else _square(fields, "intrinsic", 3)


def _are_threes(values: list[Any]) -> bool:
    return all(isinstance(each, list) and len(each) == 3 for each in values)


def _openlane_points(
    name: str, lane: Any, fields: dict[str, Any], intrinsics: NDArray[np.float64] | None, by_point: bool
) -> NDArray[np.float64]:
    """Return the points (P, 2) px of a lane line, by its ``uv`` if it has any, else by its ``xyz``.

    Args:
        name: of the line, for messages.
        lane: the line.
        fields: the file's content.
        intrinsics: (3, 3) px, for a file without.
        by_point: whether three lists of three numbers are three points, as other lines of the file tell.
    """
    if not isinstance(lane, dict):
        raise ValueError(f"{name}: expected an object, got {shown(lane)}")
    if not _is_3d(lane):
        return _pixels(name, lane)
    xyz = field(lane, "xyz", list)
    rows_of_three = _is_list_of_points(lane) or (by_point and _are_threes(xyz))
    by_axis = _by_axis(xyz) if rows_of_three and xyz else xyz
    points = within(f"{name}.xyz", "m", columns(f"{name}.xyz", by_axis or [[], [], []], 3).T)
    points = visible_points(f"{name}.visibility", points, lane.get("visibility"))
    if rows_of_three and fields.get("extrinsic") is not None:
        camera = camera_from_ground_points(points, _square(fields, "extrinsic", 4))
    else:
        camera = camera_from_label_points(points)
        if len(camera) and not (camera[:, 2] > 0).any():
            raise ValueError(f"{name}.xyz: expected points before the camera (x forward, y left, z up)")
    matrix = _camera_matrix(fields, intrinsics)
    if matrix is None:
        raise ValueError(f"intrinsic: expected the camera matrix of {name}.xyz, got none")
    image = image_from_camera_points(camera, matrix)
    return image[(np.abs(image) < _FARTHEST).all(-1)]


def _pixels(name: str, lane: dict[str, Any]) -> NDArray[np.float64]:
    """Return the points (P, 2) px of a lane line's ``uv``: two lists of P, or P lists of two."""
    uv = field(lane, "uv", list)
    is_by_point = len(uv) > 2 and all(isinstance(each, list) and len(each) == 2 for each in uv)
    return checked_pixels(f"{name}.uv", columns(f"{name}.uv", _by_axis(uv) if is_by_point else uv, 2).T)


def _by_axis(points: list[list[Any]]) -> list[list[Any]]:
    """Return points as a list for each axis."""
    return [list(axis) for axis in zip(*points, strict=True)]


def visible_points(name: str, points: Array, visibility: Any) -> Array:
    """Return the points (P, 3) whose visibility, a list of P, is above a half; all where it is None."""
    if visibility is None:
        return points
    seen = columns(name, [visibility], 1)[0]
    if len(seen) != len(points):
        raise ValueError(f"{name}: expected {len(points)} numbers, got {len(seen)}")
    visible: Array = points[seen > 0.5]
    return visible


def _square(fields: dict[str, Any], name: str, size: int) -> NDArray[np.float64]:
    """Return a (size, size) matrix of finite numbers."""
    rows = field(fields, name, list)
    if len(rows) != size or not all(isinstance(row, list) for row in rows):
        raise ValueError(f"{name}: expected {size} x {size} numbers, got {shown(rows)}")
    return within(name, "numbers of a camera", np.array([finite_numbers(name, row, size) for row in rows]))
