"""Camera files: OpenCV, ROS, KITTI and our own short YAML in; a ``camera_info`` YAML out.

Reading is strict: an unknown key, a missing, non-finite or absurd value is a ``ValueError`` of one line.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml

from lanebev.geometry.lens import DISTORTION_LENGTHS, distort_points, undistort_points
from lanebev.numbers import finite_numbers

_SHORT_KEYS = {"fx", "fy", "cx", "cy", "width", "height", "distortion", "model"}
_MATRIX_KEYS = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "k")
_DISTORTION_KEYS = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D", "d")
_WIDTH_KEYS = ("image_width", "image_Width", "width")
_HEIGHT_KEYS = ("image_height", "image_Height", "height")
_MODEL_KEYS = ("distortion_model", "model")
_IGNORED_KEYS = {
    # ROS camera_info beside the raw image's lens
    "camera_name", "rectification_matrix", "projection_matrix", "header", "R", "P", "r", "p", "roi",
    "binning_x", "binning_y",
    # what OpenCV's calibration programs note down
    "calibration_time", "nframes", "nr_of_frames", "nrOfFrames", "board_width", "board_height", "board_size",
    "square_size", "marker_size", "aspectRatio", "fix_aspect_ratio", "flags", "flagValue", "fisheye_model",
    "avg_reprojection_error", "per_view_reprojection_errors", "extrinsic_parameters", "image_points",
    "grid_points",
    # our own calibration.yaml
    "mount", "vehicle_from_camera", "quaternion_xyzw",
}  # fmt: skip
_MODELS = {
    "pinhole": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "fisheye": "fisheye",
    "equidistant": "fisheye",
    "kannala_brandt": "fisheye",
}
_KITTI_SIZES = {  # focal length of the rectified cameras of each recording day -> (height, width)
    721.5377: (375, 1242),
    707.0493: (370, 1224),
    718.3351: (374, 1238),
    707.0912: (370, 1226),
    718.856: (376, 1241),
}
_KITTI_SPREAD = 8  # px, more than rectified images of one camera differ by
_FOCAL_RANGE = (0.1, 20.0)  # times the longer image side: 160 deg fisheye to 3 deg telephoto


class CameraParameters(NamedTuple):
    """A camera as plain numbers.

    Attributes:
        matrix: nine entries of the camera matrix, row by row, px.
        distortion: coefficients in OpenCV's order.
        model: "pinhole" or "fisheye".
        image_size: (height, width) px.
    """

    matrix: list[float]
    distortion: list[float]
    model: str
    image_size: tuple[int, int]


def read_camera(path: str | Path, image_size: tuple[int, int] | None = None) -> CameraParameters:
    """Read OpenCV FileStorage YAML or XML, ROS ``camera_info`` YAML, KITTI ``calib.txt`` or our short YAML.

    KITTI's left colour camera is used (``P_rect_02``, ``P2``), else the lowest number there is; its images
    are rectified, so there is no distortion. Its object and odometry files do not hold the image's size:
    it is then ``image_size``, or that of KITTI's recording days, known by their focal lengths.

    Args:
        path: the file.
        image_size: (height, width) px of the images, for a KITTI file without a size. Not used otherwise.

    Raises:
        ValueError: the file is missing, cut, holds an unknown key, or a missing or absurd value.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise ValueError(f"camera file {path}: expected a readable camera file, got: {reason}") from error
    try:
        if path.suffix.lower() == ".txt":
            return _checked(_parse_kitti(text, image_size))
        fields = _parse_xml(text) if text.lstrip().startswith("<") else _parse_yaml(text)
        return _checked(_normalise(fields))
    except ValueError as error:
        raise ValueError(f"camera file {path}: {error}") from error


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that knows OpenCV's matrices and refuses a key given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        twice = {key for key in keys if keys.count(key) > 1}
        if twice:
            raise ValueError(f"expected each key once, got {sorted(twice)[0]} twice")
        return super().construct_mapping(node, deep)


def _construct_opencv_matrix(loader: _StrictLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


for _tag in ("opencv-matrix", "opencv-nd-matrix"):
    _StrictLoader.add_constructor(f"tag:yaml.org,2002:{_tag}", _construct_opencv_matrix)


def _parse_yaml(text: str) -> dict[str, Any]:
    lines = text.splitlines()
    if lines and lines[0].startswith("%YAML"):  # OpenCV writes %YAML:1.0, which YAML does not allow
        lines[0] = ""
    try:
        documents = yaml.load_all("\n".join(lines), Loader=_StrictLoader)
        fields = next((each for each in documents if each is not None), None)  # ros2 topic echo ends with ---
    except (yaml.YAMLError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        raise ValueError(f"expected YAML, got a syntax error{where}; is the file cut?") from error
    if not isinstance(fields, dict):
        raise ValueError("expected keys such as fx, fy, cx, cy, width, height, got none; is the file empty?")
    return {str(key): value for key, value in fields.items()}


def _parse_xml(text: str) -> dict[str, Any]:
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        line = error.position[0]
        raise ValueError(f"expected XML, got a syntax error at line {line}; is the file cut?") from error
    return {
        child.tag: {field.tag: (field.text or "").strip() for field in child} if len(child) else child.text
        for child in root
    }


def _parse_kitti(text: str, image_size: tuple[int, int] | None) -> CameraParameters:
    entries = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    names = [f"P_rect_{i:02d}" for i in (2, 3, 0, 1)] + [f"P{i}" for i in (2, 3, 0, 1)]
    name = next((n for n in names if n in entries), None)
    if name is None:
        raise ValueError("expected a KITTI projection matrix (P_rect_02 or P2), got none of them")
    projection = finite_numbers(name, entries[name].split(), 12)
    known = next((s for f, s in _KITTI_SIZES.items() if abs(f - projection[0]) < 1e-3), None)
    size = image_size or known
    if (size_name := name.replace("P", "S", 1)) in entries:
        width, height = finite_numbers(size_name, entries[size_name].split(), 2)
        size = (round(height), round(width))
    elif size and known and max(abs(size[0] - known[0]), abs(size[1] - known[1])) > _KITTI_SPREAD:
        raise ValueError(
            f"expected images of about {known[1]} x {known[0]} px, KITTI's of this focal length, got "
            f"{size[1]} x {size[0]}; give them as they came, or the short YAML for the resized"
        )
    if size is None:
        raise ValueError(
            "expected the image size, got none, and the focal length is none of KITTI's; "
            "add a line 'S_rect_02: WIDTH HEIGHT' with P_rect_02, or use the short YAML"
        )
    matrix = projection[0:3] + projection[4:7] + projection[8:11]
    return CameraParameters(matrix, [], "pinhole", size)


def _normalise(fields: Mapping[str, Any]) -> CameraParameters:
    """Keys of any YAML or XML flavour to (K row by row, distortion, model, (height, width))."""
    short = "fx" in fields or "fy" in fields
    spelled = {*_MATRIX_KEYS, *_DISTORTION_KEYS, *_WIDTH_KEYS, *_HEIGHT_KEYS, *_MODEL_KEYS} | _IGNORED_KEYS
    unknown = sorted(set(fields) - (_SHORT_KEYS if short else spelled))
    if unknown:
        known = "fx, fy, cx, cy, width, height, distortion, model"
        raise ValueError(f"unknown key {unknown[0]!r}; expected {known}, or those of OpenCV or ROS")
    sizes = (("width",), ("height",)) if short else (_WIDTH_KEYS, _HEIGHT_KEYS)
    width, height = (_integer(fields, keys) for keys in sizes)
    if short:
        fx, fy, cx, cy = (
            finite_numbers(key, [_required(fields, (key,))], 1)[0] for key in ("fx", "fy", "cx", "cy")
        )
        matrix = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        distortion = finite_numbers("distortion", _sequence("distortion", fields.get("distortion") or []))
    else:
        matrix = _matrix_entries(fields, _MATRIX_KEYS, 9)
        distortion = _matrix_entries(fields, _DISTORTION_KEYS)
    default = "fisheye" if str(fields.get("fisheye_model", "0")).strip() == "1" else "pinhole"
    name = next((str(fields[key]).strip() for key in _MODEL_KEYS if key in fields), default)
    if name not in _MODELS:
        raise ValueError(f"model: expected one of {', '.join(_MODELS)}, got {name!r}")
    return CameraParameters(matrix, distortion, _MODELS[name], (height, width))


def _checked(camera: CameraParameters) -> CameraParameters:
    """The camera, if a real one could be like it."""
    matrix, distortion, model, size = camera
    height, width = size
    if not (0 < height < 100_000 and 0 < width < 100_000):
        raise ValueError(f"image size: expected 1..99999 px a side, got {width} x {height}")
    fx, skew, cx, zero, fy, cy, *last = matrix
    low, high = (limit * max(width, height) for limit in _FOCAL_RANGE)
    for name, focal in (("fx", fx), ("fy", fy)):
        if not low <= focal <= high:
            raise ValueError(
                f"{name}: expected {low:g} to {high:g} px for an image of {width} x {height}, got {focal:g}; "
                "focal lengths are in pixels"
            )
    if not 0.4 < fx / fy < 2.5:
        raise ValueError(f"fx / fy: expected nearly square pixels, got {fx:g} / {fy:g}")
    for name, centre, side in (("cx", cx, width), ("cy", cy, height)):
        if not 0 < centre < side:
            raise ValueError(
                f"{name}: expected a principal point inside the image, 0 to {side}, got {centre:g}"
            )
    if abs(skew) > 0.1 * fx or zero != 0 or last != [0.0, 0.0, 1.0]:
        raise ValueError("camera matrix: expected [fx s cx; 0 fy cy; 0 0 1], got other off-diagonal entries")
    if len(distortion) == 14 and not any(distortion[12:]):  # OpenCV's tilted sensor, not tilted
        distortion = distortion[:12]
    if (
        model == "pinhole" and not any(distortion) and len(distortion) in DISTORTION_LENGTHS[model]
    ):  # no lens to undo, which is much faster to do
        distortion = []
    lengths = DISTORTION_LENGTHS[model]
    if model == "fisheye" and not distortion:
        distortion = [0.0] * 4
    if len(distortion) not in lengths:
        expected = " or ".join(map(str, lengths))
        raise ValueError(f"distortion: expected {expected} coefficients ({model}), got {len(distortion)}")
    if not _invertible(matrix, distortion, model, size):
        raise ValueError(f"distortion: expected a lens that can be inverted, got {distortion}")
    return CameraParameters(matrix, distortion, model, size)


def _invertible(matrix: list[float], distortion: list[float], model: str, size: tuple[int, int]) -> bool:
    """Whether the lens can be undone at four points half-way to the corners."""
    inner = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]], dtype=torch.float64)
    points = (inner * inner.new_tensor([size[1], size[0]]))[None]
    lens = (points.new_tensor(matrix).reshape(1, 3, 3), points.new_tensor(distortion)[None], model)
    error = distort_points(undistort_points(points, *lens), *lens) - points
    return bool((error.norm(dim=-1) < 0.05).all())


def _required(fields: Mapping[str, Any], keys: Sequence[str]) -> Any:
    for key in keys:
        if fields.get(key) is not None:
            return fields[key]
    raise ValueError(f"{keys[0]}: expected a value, got none; add the entry")


def _integer(fields: Mapping[str, Any], keys: Sequence[str]) -> int:
    (value,) = finite_numbers(keys[0], [_required(fields, keys)], 1)
    if value != round(value):
        raise ValueError(f"{keys[0]}: expected whole pixels, got {value:g}")
    return round(value)


def _matrix_entries(fields: Mapping[str, Any], keys: Sequence[str], count: int | None = None) -> list[float]:
    """Entries of ``{rows, cols, data}`` or of a (nested) list, row by row."""
    value = _required(fields, keys)
    if isinstance(value, Mapping):
        return finite_numbers(keys[0], *_opencv_data(keys[0], value, count))
    return finite_numbers(
        keys[0], [entry for row in _sequence(keys[0], value) for entry in _flat(row)], count
    )


def _opencv_data(name: str, value: Mapping[str, Any], count: int | None) -> tuple[list[Any], int]:
    """Data of ``{rows, cols, data}``, or ``{sizes, data}`` of OpenCV 5, and how many there should be."""
    unknown = sorted(set(value) - {"rows", "cols", "sizes", "data", "dt"})
    if unknown:
        raise ValueError(f"{name}: expected rows, cols, dt, data, got the key {unknown[0]!r}")
    as_list = {key: field.split() if isinstance(field, str) else field for key, field in value.items()}
    shape = as_list.get("sizes") or [entry for key in ("rows", "cols") for entry in _flat(as_list.get(key))]
    sizes = finite_numbers(f"{name}.rows and .cols", _sequence(name, shape))
    if not sizes:
        raise ValueError(f"{name}: expected rows and cols, got neither")
    return _sequence(name, as_list.get("data") or []), count or round(min(math.prod(sizes), 1e6))


def _flat(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def _sequence(name: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{name}: expected a list of numbers, got {value!r}")
    return value


def camera_info(camera: CameraParameters, name: str = "camera") -> dict[str, Any]:
    """The camera as the fields of a ROS ``camera_info`` YAML.

    ROS knows no lens with fewer than five pinhole coefficients: zeros are added, the lens stays the same.
    Reading takes all zeros as no distortion.
    """
    height, width = camera.image_size
    coefficients = [float(value) for value in camera.distortion]
    if camera.model == "fisheye":
        model = "equidistant"
    else:
        coefficients += [0.0] * (5 - len(coefficients))
        model = "plumb_bob" if len(coefficients) == 5 else "rational_polynomial"
    matrix = [float(value) for value in camera.matrix]
    projection = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
    identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    return {
        "image_width": width,
        "image_height": height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "dt": "d", "data": matrix},
        "distortion_model": model,
        "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "dt": "d", "data": coefficients},
        "rectification_matrix": {"rows": 3, "cols": 3, "dt": "d", "data": identity},
        "projection_matrix": {"rows": 3, "cols": 4, "dt": "d", "data": projection},
    }


def write_camera(path: str | Path, camera: CameraParameters, name: str = "camera") -> None:
    """Write the camera as a ROS ``camera_info`` YAML, which :func:`read_camera` reads as well."""
    Path(path).write_text(dump_yaml(camera_info(camera, name)), encoding="utf-8")


def dump_yaml(fields: Mapping[str, Any]) -> str:
    """Plain YAML that PyYAML, yaml-cpp (ROS) and ``cv2.FileStorage`` read."""
    header = "%YAML 1.1\n---\n"  # cv2.FileStorage wants this line
    body: str = yaml.safe_dump(dict(fields), sort_keys=False, default_flow_style=None, width=1000)
    return header + body
