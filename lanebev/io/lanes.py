"""Lane files of other detectors and data sets: TuSimple, CULane, OpenLane; which frame each belongs to.

Everything here is in pixels of the image as it came. A cut or malformed file is a ``ValueError`` of one line
that names file and line.
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from itertools import groupby, pairwise
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lanebev.io.image_names import in_natural_order
from lanebev.io.images import IMAGE_SUFFIXES
from lanebev.io.openlane import (
    camera_from_ground_points,
    camera_from_label_points,
    image_from_camera_points,
)
from lanebev.numbers import finite_numbers, numbers_or_gaps, read_text, shown
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.polylines import LaneLine
from lanebev.types import NUM_BOUNDARIES

_OPENLANE_CURBS = (20, 21)  # left and right kerb: no lane ends there, so no lane width holds
_GAP = 2.5  # times the usual distance of rows: from there on a line is not seen in between
_FARTHEST = 1e6  # px or m, of any coordinate
_TUSIMPLE_ROWS = {56: range(160, 720, 10), 48: range(240, 720, 10)}  # of the benchmark's labels, by number


class FrameLines(NamedTuple):
    """The lines of one frame.

    Attributes:
        name: of the frame in the file.
        lines: as they were drawn.
        pose_sigma_scale: factor on the standard deviations of the pose estimated from them; 1 unless stated.
    """

    name: str
    lines: list[LaneLine]
    pose_sigma_scale: float = 1.0


def read_lanes(path: str | Path, intrinsics: NDArray[np.float64] | None = None) -> list[FrameLines]:
    """Read a TuSimple, CULane or OpenLane file, or a folder of the latter two.

    Args:
        path: of the file or folder.
        intrinsics: (3, 3) px of the camera, for OpenLane's 3D points in a file without ``intrinsic``.

    Raises:
        ValueError: there is no such file, or it is cut, malformed or of no known format.
    """
    path = Path(path)
    if path.is_dir():
        frames = [frame for file in lane_files(path) for frame in read_lanes(file, intrinsics)]
        if not frames:
            raise ValueError(f"lane folder {path}: expected .lines.txt or .json files, got none")
        return frames
    if path.name.endswith(".txt"):
        return [read_culane(path)]
    text = _text(path)
    start = next((line for line in text.split("\n") if line.strip()), "")
    return [read_openlane(path, intrinsics)] if _is_openlane(start, text) else read_tusimple(path)


def lane_files(path: str | Path) -> list[Path]:
    """The files that :func:`read_lanes` reads: the file itself, or a folder's in natural order."""
    path = Path(path)
    if not path.is_dir():
        return [path]
    found = [*path.rglob("*.lines.txt"), *path.rglob("*.json")]
    return [Path(file) for file in in_natural_order(map(str, found))]


def read_tusimple(path: str | Path) -> list[FrameLines]:
    """Read TuSimple JSON lines: ``lanes``, ``h_samples``, ``raw_file``, and what ours say besides.

    Predictions for TuSimple's benchmark leave ``h_samples`` out; theirs are the rows of its labels.
    """
    frames = []
    for number, text in enumerate(_text(Path(path)).split("\n"), start=1):
        if text.strip():
            with _Where(path, number):
                frames.append(_tusimple_frame(_json(text)))
    if not frames:
        raise ValueError(f"lane file {path}: expected TuSimple JSON lines, got an empty file")
    names = [frame.name for frame in frames]
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise ValueError(f"lane file {path}: expected each raw_file once, got {shown(twice)} again")
    return frames


def read_culane(path: str | Path) -> FrameLines:
    """Read CULane's ``.lines.txt``, a line of ``x y x y ...`` per lane; the path without suffix names it.

    A point that is repeated right after itself counts once; ``nan`` is a point that is not there. Where rows
    are left out, the line is not seen.
    """
    path = Path(path)
    lines = []
    content = _text(path)
    rows = content.split("\n")
    for number, text in enumerate(rows, start=1):
        with _Where(path, number):
            texts = text.split()
            values = numbers_or_gaps("points", texts)
            if len(values) % 2:
                raise ValueError(f"expected x y pairs, got {len(values)} numbers; is the file cut?")
            pairs = (pair for pair in zip(values[::2], values[1::2], strict=True) if pair[1] == pair[1])
            points = np.array([point for point, _ in groupby(pairs)]).reshape(-1, 2)
            _check_culane_rows(points[:, 1], texts[-1] if number == len(rows) and texts else "")
            if np.isfinite(points).all(-1).any():
                lines.append(LaneLine(_with_gaps(_pixels("points", points))))
    return FrameLines(str(path).removesuffix(".txt").removesuffix(".lines"), lines)


def read_openlane(path: str | Path, intrinsics: NDArray[np.float64] | None = None) -> FrameLines:
    """Read an OpenLane 2D or 3D JSON, kerbs left out: the ``uv`` of its lane lines, else their ``xyz``.

    Points ``xyz`` alone, as predictions have them, are projected by the file's ``intrinsic``. Three lists of
    P numbers are in the camera's frame, as labels are; P lists of three are in the ground frame of the
    benchmark's predictions if the file has the camera's ``extrinsic``, else in the camera's.

    Args:
        path: of the file.
        intrinsics: (3, 3) px, for a file that has 3D points and no ``intrinsic``.
    """
    path = Path(path)
    with _Where(path, None):
        fields = _json(_text(path))
        name = _field(fields, "file_path", str)
        lines = []
        for i, lane in enumerate(_field(fields, "lane_lines", list)):
            points = _openlane_points(f"lane_lines[{i}]", lane, fields, intrinsics)
            if lane.get("category") not in _OPENLANE_CURBS and np.isfinite(points).any():
                lines.append(LaneLine(points))
    return FrameLines(name, lines)


def tusimple_line(
    name: str,
    rows: NDArray[np.float64],
    x: NDArray[np.float64],
    seen: BoundaryVertices | None = None,
    pose_sigma_scale: float = 1.0,
) -> str:
    """One frame's boundaries as a line of TuSimple JSON, with each lane's ``boundary``.

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


def match_frames(names: Sequence[str], frames: Sequence[FrameLines]) -> list[int | None]:
    """Which lane entry belongs to each image: the one that shares the longest tail of its path.

    An entry of the image's very name is its own. Else whole path components are compared from the end, the
    last without an image's suffix. An entry goes to the image that shares most with it, so an image without
    an entry of its own gets None rather than a stranger's.

    Args:
        names: paths of the images.
        frames: entries of the lane file.

    Returns:
        for each image an index into ``frames``, or None.

    Raises:
        ValueError: no image matches, or two entries (or two images) match equally well.
    """
    by_tail: dict[tuple[str, ...], list[int]] = defaultdict(list)
    for i, frame in enumerate(frames):
        parts = _parts(frame.name)
        for start in range(len(parts)):
            by_tail[parts[start:]].append(i)
    exact = {frame.name: i for i, frame in enumerate(frames)}
    exact = exact if len(exact) == len(frames) else {}  # a name given twice is nobody's own
    matches: list[tuple[int, int] | None] = []  # (length of the common tail, entry)
    for name in names:
        parts = _parts(name)
        if name in exact:
            matches.append((len(parts) + 1, exact[name]))
            continue
        tail = next((parts[k:] for k in range(len(parts)) if parts[k:] in by_tail), None)
        matches.append(None if tail is None else (len(tail), by_tail[tail][0]))
        if tail is not None and len(by_tail[tail]) > 1:
            first, second = (frames[i].name for i in by_tail[tail][:2])
            raise ValueError(
                f"image {name}: expected one lane entry, got {first!r} and {second!r}, which fit equally "
                "well; give images by a path that tells them apart"
            )
    owners: dict[int, list[int]] = defaultdict(list)
    for image, match in enumerate(matches):
        if match is not None:
            owners[match[1]].append(image)
    result: list[int | None] = [None] * len(names)
    for entry, images in owners.items():
        longest = max(matches[image][0] for image in images)  # type: ignore[index]
        best = [image for image in images if matches[image][0] == longest]  # type: ignore[index]
        if len(best) > 1:
            raise ValueError(
                f"lane entry {frames[entry].name!r}: expected one image, got {names[best[0]]} and "
                f"{names[best[1]]}, which fit equally well; give entries a longer path"
            )
        result[best[0]] = entry
    if names and all(entry is None for entry in result):
        raise ValueError(
            f"lanes: expected an entry for at least one image, got none that ends like {names[0]}; "
            f"the file's first is {frames[0].name!r}"
        )
    return result


def _parts(name: str) -> tuple[str, ...]:
    path = PurePath(name.replace("\\", "/"))
    if path.suffix.lower() in IMAGE_SUFFIXES:  # what follows the last dot may be part of the name
        path = path.with_suffix("")
    return tuple(part for part in path.parts if part not in ("/", "."))


def _tusimple_frame(fields: dict[str, Any]) -> FrameLines:
    name = _field(fields, "raw_file", str)
    if not name:
        raise ValueError("raw_file: expected the image's path, got an empty string")
    if "h_samples" in fields:
        rows = finite_numbers("h_samples", _field(fields, "h_samples", list))
    else:
        rows = _benchmark_rows(_field(fields, "lanes", list))
    if any(b <= a for a, b in pairwise(rows)):
        raise ValueError("h_samples: expected rising rows, got others")
    _pixels("h_samples", np.array(rows))
    pose_sigma_scale = fields.get("pose_sigma_scale", fields.get("pose_factor", 1.0))  # its former name
    if type(pose_sigma_scale) not in (int, float) or not 0 < pose_sigma_scale <= sys.float_info.max:
        raise ValueError(f"pose_sigma_scale: expected a finite number above 0, got {shown(pose_sigma_scale)}")
    if "seen" in fields:
        return FrameLines(name, _seen_lines(_field(fields, "seen", dict)), float(pose_sigma_scale))
    lanes = _field(fields, "lanes", list)
    indices = _boundary_indices(fields, len(lanes))
    sigmas = fields.get("sigma") or [None] * len(lanes)
    if not isinstance(sigmas, list) or len(sigmas) != len(lanes):
        raise ValueError("sigma: expected a list per lane, got another number of them")
    lines = []
    for i, (lane, index, noise) in enumerate(zip(lanes, indices, sigmas, strict=True)):
        x = _on_h_samples(f"lanes[{i}]", lane, len(rows))
        sigma = None if noise is None else _on_h_samples(f"sigma[{i}]", noise, len(rows))
        if sigma is not None and not (sigma[np.isfinite(x)] > 0).all():
            raise ValueError(f"sigma[{i}]: expected px above 0 where the lane is, got {shown(noise)}")
        if np.isfinite(x).any():
            lines.append(LaneLine(np.stack([x, np.array(rows)], axis=-1), index, sigma))
    return FrameLines(name, lines, float(pose_sigma_scale))


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
    """The vertices that a run wrote, boundary by boundary."""
    points, sigmas, weights = (_field(fields, name, list) for name in ("points", "sigma", "weight"))
    if not len(points) == len(sigmas) == len(weights):
        raise ValueError(
            "seen: expected points, sigma and weight of as many lines, got other numbers of them"
        )
    lines = []
    for i, index in enumerate(_boundary_indices(fields, len(points))):
        pairs = [_numbers(f"seen.points[{i}]", pair, 2) for pair in _list(f"seen.points[{i}]", points[i])]
        sigma = _numbers(f"seen.sigma[{i}]", sigmas[i], len(pairs))
        weight = _numbers(f"seen.weight[{i}]", weights[i], len(pairs))
        if not (sigma > 0).all():
            raise ValueError(f"seen.sigma[{i}]: expected px above 0, got {shown(sigmas[i])}")
        if not ((weight > 0) & (weight <= 1)).all():
            raise ValueError(f"seen.weight[{i}]: expected 0 to 1, got {shown(weights[i])}")
        vertices = _pixels(f"seen.points[{i}]", np.reshape(pairs, (-1, 2)))
        lines.append(LaneLine(vertices, index, _pixels(f"seen.sigma[{i}]", sigma), weight))
    return lines


def _benchmark_rows(lanes: list[Any]) -> list[float]:
    """Of a prediction as TuSimple's benchmark takes it, without ``h_samples``: their number says which."""
    count = len(lanes[0]) if lanes and isinstance(lanes[0], list) else 0
    if lanes and count not in _TUSIMPLE_ROWS:
        known = " or ".join(map(str, _TUSIMPLE_ROWS))
        raise ValueError(
            f"h_samples: expected a list, got none, and not lanes of TuSimple's {known} rows; add them, in px"
        )
    return [float(row) for row in _TUSIMPLE_ROWS.get(count, ())]


def _on_h_samples(name: str, values: Any, count: int) -> NDArray[np.float64]:
    if not isinstance(values, list) or len(values) != count:
        got = len(values) if isinstance(values, list) else shown(values)
        raise ValueError(f"{name}: expected {count} numbers, one per h_sample, got {got}")
    x = _pixels(name, np.array(numbers_or_gaps(name, values)))
    x[x < 0] = np.nan  # -2 is "not there", as null and NaN are
    return x


def _numbers(name: str, values: Any, count: int) -> NDArray[np.float64]:
    return np.array(finite_numbers(name, _list(name, values), count), dtype=np.float64)


def _list(name: str, values: Any) -> list[Any]:
    if not isinstance(values, list):
        raise ValueError(f"{name}: expected a list, got {shown(values)}")
    return values


def _check_culane_rows(y: NDArray[np.float64], last: str) -> None:
    """Raise unless rows go one way, and the text of the file's last number is not the start of the next row.

    Rows may be left out anywhere. A file that is cut within a number ends with the first digits of a row
    that would have been the next: 560 became 56.
    """
    steps = np.diff(y)
    if len(steps) and not (np.all(steps > 0) or np.all(steps < 0)):
        raise ValueError("expected rows in one direction, got others; is the file cut?")
    if len(steps) > 2 and abs(steps[-1]) > _GAP * np.median(np.abs(steps)):
        expected = f"{y[-2] + np.median(steps[:-1]):g}"
        if expected != last and expected.startswith(last.removesuffix(".")) and last:
            raise ValueError(f"expected evenly spaced rows, got {y[-2]:g} then {y[-1]:g}; is the file cut?")


def _with_gaps(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (P, 2) in order of rows, with a NaN put where rows were left out."""
    steps = np.abs(np.diff(points[:, 1]))
    if not len(steps):
        return points
    gaps = np.flatnonzero(steps > _GAP * np.median(steps))
    middle = 0.5 * (points[gaps, 1] + points[gaps + 1, 1])
    return np.insert(points, gaps + 1, np.stack([np.full(len(gaps), np.nan), middle], axis=-1), axis=0)


def _pixels(name: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The values, if they can be pixels."""
    return _within(name, "pixels", values)


def _within(name: str, unit: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The values, if none is larger than any of this unit."""
    if (np.abs(values) > _FARTHEST).any():  # NaN is not
        raise ValueError(f"{name}: expected {unit}, got {np.nanmax(np.abs(values)):g}")
    return values


def _openlane_points(
    name: str, lane: Any, fields: dict[str, Any], intrinsics: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """(P, 2) px of a lane line, by its ``uv`` if it has any, else by its ``xyz``."""
    if not isinstance(lane, dict):
        raise ValueError(f"{name}: expected an object, got {shown(lane)}")
    if lane.get("uv") is not None or lane.get("xyz") is None:
        return _pixels(f"{name}.uv", _columns(f"{name}.uv", _field(lane, "uv", list), 2).T)
    xyz = _field(lane, "xyz", list)
    rows_of_three = len(xyz) != 3 and all(isinstance(point, list) and len(point) == 3 for point in xyz)
    columns = [list(axis) for axis in zip(*xyz, strict=True)] if rows_of_three and xyz else xyz
    points = _within(f"{name}.xyz", "m", _columns(f"{name}.xyz", columns or [[], [], []], 3).T)
    if (visibility := lane.get("visibility")) is not None:
        seen = _columns(f"{name}.visibility", [visibility], 1)[0]
        if len(seen) != len(points):
            raise ValueError(f"{name}.visibility: expected {len(points)} numbers, got {len(seen)}")
        points = points[seen > 0.5]
    if rows_of_three and fields.get("extrinsic") is not None:
        camera = camera_from_ground_points(points, _square(fields, "extrinsic", 4))
    else:
        camera = camera_from_label_points(points)
        if len(camera) and not (camera[:, 2] > 0).any():
            raise ValueError(f"{name}.xyz: expected points before the camera (x forward, y left, z up)")
    matrix = intrinsics if fields.get("intrinsic") is None else _square(fields, "intrinsic", 3)
    if matrix is None:
        raise ValueError(f"intrinsic: expected the camera matrix of {name}.xyz, got none")
    pixels = image_from_camera_points(camera, matrix)
    return pixels[(np.abs(pixels) < _FARTHEST).all(-1)]


def _columns(name: str, values: list[Any], count: int) -> NDArray[np.float64]:
    """(count, P) of ``count`` lists of one length; NaN where there is no number."""
    lists = len(values) == count and all(isinstance(axis, list) for axis in values)
    if not lists or len({len(axis) for axis in values}) != 1:
        many = {1: "one list", 2: "two lists", 3: "three lists"}[count]
        raise ValueError(f"{name}: expected {many} of one length, got {shown(values)}")
    return np.array([numbers_or_gaps(name, axis) for axis in values])


def _square(fields: dict[str, Any], name: str, size: int) -> NDArray[np.float64]:
    """(size, size) matrix of finite numbers."""
    rows = _field(fields, name, list)
    if len(rows) != size or not all(isinstance(row, list) for row in rows):
        raise ValueError(f"{name}: expected {size} x {size} numbers, got {shown(rows)}")
    return _within(name, "numbers of a camera", np.array([finite_numbers(name, row, size) for row in rows]))


def _is_openlane(first_line: str, text: str) -> bool:
    try:
        return "lane_lines" in _json(text)
    except ValueError:
        return '"lane_lines"' in first_line


class _Where:
    """Puts file and line before the message of a ValueError."""

    def __init__(self, path: str | Path, line: int | None) -> None:
        self.place = f"lane file {path}" + (f", line {line}" if line else "")

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if isinstance(error, ValueError) and not str(error).startswith("lane file"):
            raise ValueError(f"{self.place}: {error}") from error


def _text(path: Path) -> str:
    try:
        return read_text(path)
    except ValueError as error:
        raise ValueError(f"lane file {path}: expected a readable file, got: {error}") from error


def _json(text: str) -> dict[str, Any]:
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError("expected JSON, got a line that breaks off or is none; is the file cut?") from error
    if not isinstance(fields, dict):
        raise ValueError(f"expected a JSON object, got {type(fields).__name__}")
    return fields


def _field(fields: Any, key: str, kind: type) -> Any:
    if not isinstance(fields, dict) or not isinstance(fields.get(key), kind):
        got = type(fields.get(key)).__name__ if isinstance(fields, dict) and key in fields else "none"
        raise ValueError(f"{key}: expected a {kind.__name__}, got {got}; formats: TuSimple, CULane, OpenLane")
    return fields[key]
