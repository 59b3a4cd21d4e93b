"""Camera files of OpenCV, of its Python tutorial, of ROS, and our short YAML."""

import re
from collections.abc import Mapping
from typing import Any

from lanebev.camera.named_lens import LENS_NAMES, stated_lens
from lanebev.camera.parameters import CameraParameters, centre_offset, checked, left_square, matrix_entries
from lanebev.camera.parsing import camera_matrix, given_keys, mapping, number, numbers, whole_number
from lanebev.numbers import shown

MATRIX_KEYS = ("camera_matrix", "K", "mtx", "intrinsics", "intrinsic_matrix")
_LENS_LISTS = (
    "distortion_coefficients", "D", "dist", "dist_coeff", "dist_coeffs", "dist_coefs", "distortion_coeffs",
)  # fmt: skip
DISTORTION_KEYS = (*_LENS_LISTS, "distortion", "Distortion_Coefficients", "distCoeffs", "d")
_PROJECTION_KEYS = ("projection_matrix", "P")
_ROTATION_KEYS = ("rectification_matrix", "R")
_WIDTH_KEYS = ("image_width", "width")
_HEIGHT_KEYS = ("image_height", "height")
_SIDES_KEYS = (
    "image_size",
    "img_size",
    "image_shape",
    "img_shape",
    "resolution",
    "camera_resolution",
    "DIM",
    "size",
)
_SIDES = re.compile(r"\s*(\d{2,5})\s*[x×]\s*(\d{2,5})\s*", re.ASCII)
_LEAST_SIDE = 16  # px; a list of smaller numbers is no size of images
_MODEL_KEYS = ("distortion_model", "camera_model", "model", "DistModel")
_LENS_KEYS = ("distortion", *_LENS_LISTS)
SHARED_KEYS = (*_WIDTH_KEYS, *_HEIGHT_KEYS, *_SIDES_KEYS, *_MODEL_KEYS)
"""Keys that may be those of several cameras of a file."""

_SHORT_KEYS = {
    "fx", "fy", "cx", "cy", *_WIDTH_KEYS, *_HEIGHT_KEYS, *_LENS_KEYS, *LENS_NAMES["pinhole"], *_MODEL_KEYS,
}  # fmt: skip
_KNOWN_KEYS = {
    *MATRIX_KEYS, *_LENS_KEYS, *_PROJECTION_KEYS, *_ROTATION_KEYS, *_WIDTH_KEYS, *_HEIGHT_KEYS,
    *_MODEL_KEYS, *LENS_NAMES["pinhole"], "fisheye_model", "binning_x", "binning_y", "roi", "xi",
}  # fmt: skip
_SPELLED = {key.replace("_", "").lower(): key for key in (*_SHORT_KEYS, *_KNOWN_KEYS, *_SIDES_KEYS)}
_OF_CAMERA = re.compile(  # words in keys that may say something of the lens or the images
    r"^(?!board|grid|pattern|square|marker|chess|charuco).*(dist(?!ance)|lens|model|type|fish|omni|size|dim|"
    r"width|height|resol|shape|crop|roi|region|bin|scal|decim|downsamp|subsamp|zoom|letterbox|"
    r"image_?orientation|flip|mirror|rotate|[xy]_?offset|offset_?[xy]|focal|skew|radial|tangential|rectified|^xi|^[kp]_?\d|^[wh]$)",
    re.IGNORECASE,
)
_OF_RECORD = re.compile(r"_?note|_?comment|rms|serial|.*(error|date|name)$", re.IGNORECASE)
_MODELS = {
    "": "",  # a driver of an ideal camera leaves it empty
    "pinhole": "pinhole",
    "plumb_bob": "pinhole",
    "radtan": "pinhole",
    "rational_polynomial": "pinhole",
    "fisheye": "fisheye",
    "equidistant": "fisheye",
    "equi": "fisheye",
    "kannala_brandt": "fisheye",
    "omni": "omni",
    "mei": "omni",
    "none": "",
}
_ALSO = {  # other programs' names of these, with _ for blanks and hyphens
    "perspective": "pinhole",
    "no_distortion": "none",
    "opencv": "plumb_bob",
    "brown_conrady": "plumb_bob",
    "radial_tangential": "plumb_bob",
    "pinhole_radtan": "plumb_bob",
    "full_opencv": "rational_polynomial",
    "opencv_fisheye": "fisheye",
    "kb4": "fisheye",
    "kannala_brandt4": "fisheye",
    "kannala_brandt8": "fisheye",
    "kannalabrandt8": "fisheye",
    "pinhole_equi": "fisheye",
}
_OF_NO_MODEL = (
    "it states four coefficients and no lens model; they are taken as k1 k2 p1 p2 of a pinhole camera: "
    "if it is a fisheye, add model: fisheye"
)
_RENAME = "rename it, or leave it out"
_INSTEAD = {  # of keys in lower case, in place of a focal length in px
    "fov": "give the horizontal field of view by --fov DEGREES or Camera.from_fov, in place of the file",
    "focal|sensor_?[wh]": "fx is focal length / sensor width (both in mm) times the images' width in px",
}
_OFF_CENTRE = 0.1  # shares of the sides, more than which a file without a size is of other images
_IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def opencv_or_ros(
    fields: Mapping[str, Any], rectified: bool, image_size: tuple[int, int] | None = None
) -> CameraParameters:
    """Read the keys of OpenCV's calibration programs, of ROS's ``camera_info``, or our short ones.

    ROS's ``roi`` (in pixels of the full resolution) and ``binning_x``, ``binning_y`` are applied, in this
    order: what is returned is the camera of the images, as ``image_geometry`` has it. Deviation: a binned
    pixel's centre is the centre of those it binds together, not their corner: (x + 0.5) / b − 0.5.

    Keys are read in any case, with underscores or not. Beside a camera matrix, unknown ones are ignored as
    parts of a calibration's record, unless they may say something of the lens or the images. Coefficients
    may not be missing, so that a misspelled key of theirs is an error. Beside fx and fy only names, dates,
    errors and notes are ignored.

    A file may state its matrix twice, in K and P, as our own writer does: then it is not a person's mistake.

    Args:
        fields: fields of the file.
        rectified: return the camera of rectified images: the projection matrix P without a lens.
        image_size: (height, width) px of the images, for a file without a size.

    Raises:
        ValueError: an unknown key, or a value that no real camera has.
    """
    fields = _spelled_once(fields)
    short = not {"fx", "fy", "cx", "cy"}.isdisjoint(fields)
    fields = with_sides(fields)
    unknown = sorted(set(fields) - (_SHORT_KEYS if short else _KNOWN_KEYS))
    if short:
        unknown = [key for key in unknown if _OF_CAMERA.match(key) or not _OF_RECORD.match(key)]
    elif not {*MATRIX_KEYS, *_PROJECTION_KEYS}.isdisjoint(fields):
        unknown = [*filter(_OF_CAMERA.match, unknown)]
    if unknown:
        has_focal = not {"fx", "fy", *MATRIX_KEYS, *_PROJECTION_KEYS}.isdisjoint(fields)
        instead = {} if has_focal else _INSTEAD
        remedy = next((words for form, words in instead.items() if re.search(form, unknown[0])), _RENAME)
        raise ValueError(
            f"unknown key {shown(unknown[0])}; expected fx, fy, cx, cy, width, height, distortion, model, or "
            f"camera_matrix and distortion_coefficients; {remedy}"
        )
    if image_size and not given_keys(fields, *_WIDTH_KEYS, *_HEIGHT_KEYS):
        return _of_images(fields, rectified, image_size)
    if short:
        return checked(_short(fields, rectified))
    size = (whole_number(fields, *_HEIGHT_KEYS), whole_number(fields, *_WIDTH_KEYS))
    if rectified:
        camera = CameraParameters(_projection(fields), [], "pinhole", size)
        return _as_taken(checked(camera, _restates(fields)), fields)
    matrix = camera_matrix(fields, *MATRIX_KEYS)
    model = stated_model(fields)
    distortion = stated_lens(fields, DISTORTION_KEYS, model) or numbers(fields, *DISTORTION_KEYS)
    if fields.get("xi") is not None:
        xi = numbers(fields, "xi", count=1) if not isinstance(fields["xi"], str) else [number(fields, "xi")]
        distortion = [*xi, *(distortion or [0.0] * 4)]
    camera = CameraParameters(matrix, distortion, model, size)
    if (
        model == "pinhole"
        and len(distortion) == 4
        and any(distortion[2:])
        and not any(map(fields.get, (*_MODEL_KEYS, "fisheye_model")))
    ):
        camera = camera._replace(remark=_OF_NO_MODEL)
    return _as_taken(checked(camera, _restates(fields)), fields)


def spelled(key: str) -> str:
    """Return a key as it is known, for one in any case, with underscores or not, perhaps with its unit."""
    return _SPELLED.get(key.lower().removesuffix("_px").replace("_", ""), key)


def _spelled_once(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields by their known keys."""
    known: dict[str, str] = {}
    for key in fields:
        if (first := known.setdefault(spelled(key), key)) != key:
            raise ValueError(
                f"expected one of {first} and {key}, which mean the same, got both; rename one, or leave it "
                "out"
            )
    return {name: fields[key] for name, key in known.items()}


def with_sides(fields: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the fields with a width and a height in place of a list of both.

    OpenCV has the width first, NumPy the height: it is the order in which the principal point is nearer to
    the middle. Of three numbers the smallest is that of channels, which PyTorch has first.
    """
    fields = {key: _two_sides(value) for key, value in fields.items()}
    lists = (key for key, value in fields.items() if isinstance(value, list | Mapping))
    both = next((key for key in lists if spelled(key) in _SIDES_KEYS), None)
    if both is None or given_keys(fields, *_WIDTH_KEYS, *_HEIGHT_KEYS):
        return fields
    rest = {key: value for key, value in fields.items() if key != both}
    if isinstance(fields[both], Mapping) and "width" in fields[both]:
        return {**rest, **fields[both]}
    sides = numbers(fields, both)
    if len(sides) == 3:
        sides.remove(min(sides))
    if len(sides) != 2 or min(sides) < _LEAST_SIDE:
        raise ValueError(f"{both}: expected width and height, got {shown(fields[both])}")
    if fields.get("cx") is not None:
        matrix = [0.0, 0.0, number(fields, "cx"), 0.0, 0.0, number(fields, "cy")]
    else:
        matrix = camera_matrix(fields, *MATRIX_KEYS)
    first, second = map(round, sides)
    height, width = min((second, first), (first, second), key=lambda size: centre_offset(matrix, size))
    return {**rest, "width": width, "height": height}


def _two_sides(value: Any) -> Any:
    """Return width and height of a text such as 1280x720 as a list; another value as it is."""
    found = _SIDES.fullmatch(value) if isinstance(value, str) else None
    return [*found.groups()] if found else value


def _of_images(fields: Mapping[str, Any], rectified: bool, image_size: tuple[int, int]) -> CameraParameters:
    """Read a file that states no size as one for these images, with a remark."""
    height, width = image_size
    camera = opencv_or_ros({**fields, "width": width, "height": height}, rectified)
    if centre_offset(camera.matrix, image_size) > _OFF_CENTRE:
        raise ValueError(
            f"width and height: expected the size of the images of the calibration, got none, and the "
            f"principal point {camera.matrix[2]:g}, {camera.matrix[5]:g} is not in the middle of "
            f"{width} x {height} px; add them"
        )
    remark = f"the file states no size of images; {width} x {height} px are taken"
    return camera._replace(remark="; ".join(filter(None, (remark, camera.remark))))


def _short(fields: Mapping[str, Any], rectified: bool) -> CameraParameters:
    height, width = whole_number(fields, *_HEIGHT_KEYS[::-1]), whole_number(fields, *_WIDTH_KEYS[::-1])
    fx, fy, cx, cy = (number(fields, key) for key in ("fx", "fy", "cx", "cy"))
    model = stated_model(fields)
    lens = stated_lens(fields, _LENS_KEYS, model)
    camera = CameraParameters(matrix_entries(fx, fy, cx, cy), lens, model, (height, width))
    return without_lens(camera) if rectified else camera


def without_lens(camera: CameraParameters) -> CameraParameters:
    """Return the camera of rectified images, for a file that has no projection matrix of them."""
    if camera.model != "pinhole" or any(camera.distortion):
        raise ValueError("projection_matrix: expected P for rectified images, got none; add the entry")
    return camera._replace(distortion=[])


def _projection(fields: Mapping[str, Any]) -> list[float]:
    """Return the left 3 x 3 matrix of P, row by row."""
    if not given_keys(fields, *_PROJECTION_KEYS):
        raise ValueError("projection_matrix: expected P for rectified images, got none; add the entry")
    return left_square(numbers(fields, *_PROJECTION_KEYS, count=12))


def _restates(fields: Mapping[str, Any]) -> bool:
    """Return whether P = [K | 0] and R = I, which state no rectification."""
    try:
        rotation = numbers(fields, *_ROTATION_KEYS, count=9)
        return rotation == _IDENTITY and _projection(fields) == camera_matrix(fields, *MATRIX_KEYS)
    except ValueError:
        return False


def stated_model(fields: Mapping[str, Any], usual: str = "pinhole") -> str:
    """Return the lens model; beside another one, "pinhole" states the projection only, as in Kalibr.

    Of the keys after the first, names that are no lens model are ignored: they may be a product's.
    """
    written = [str(fields[key]).strip().lower() for key in given_keys(fields, *_MODEL_KEYS)]
    names = [_ALSO.get(name, name) for name in (re.sub(r"[\s_-]+", "_", each) for each in written)]
    if names[:1] == ["none"] and any(stated_lens(fields, _LENS_KEYS, "pinhole")):
        raise ValueError("model: expected the lens model of the coefficients, got none; add the entry")
    if names and names[0] not in _MODELS:
        known = ", ".join(each for each in _MODELS if each)
        raise ValueError(f"model: expected one of {known}, got {shown(written[0])}")
    is_fisheye = str(fields.get("fisheye_model")).strip().lower() in ("1", "true")  # true since OpenCV 5
    stated = {
        name: _MODELS[name] for name in names if name in _MODELS and name not in ("", "none", "pinhole")
    }
    stated |= {"fisheye_model": "fisheye"} if is_fisheye else {}
    stated |= {"xi of an omni": "omni"} if fields.get("xi") is not None else {}
    if len(set(stated.values())) > 1:
        raise ValueError(f"model: expected one, got {' and '.join(stated)}; keep the right one")
    return next(iter(stated.values()), usual)


def _as_taken(camera: CameraParameters, fields: Mapping[str, Any]) -> CameraParameters:
    """Return the camera of the images, cropped to the region of interest and binned.

    The principal point may be outside of the region.
    """
    if isinstance(fields.get("roi"), list):
        raise ValueError(
            "roi: expected x_offset, y_offset, width, height of the images in the full resolution, got a "
            "list; if it is OpenCV's, of undistorted images, leave it out"
        )
    roi = mapping("roi", fields.get("roi") or {})
    left, top, width, height = (
        whole_number(roi, key) if roi.get(key) is not None else 0
        for key in ("x_offset", "y_offset", "width", "height")
    )
    rows, columns = camera.image_size
    height, width = height or rows - top, width or columns - left
    if min(left, top, height, width) < 0 or left + width > columns or top + height > rows:
        raise ValueError(
            f"roi: expected a part of the {columns} x {rows} px, got {width} x {height} at {left}, {top}"
        )
    across, down = (_binning(fields, key) for key in ("binning_x", "binning_y"))
    _check_full_resolution(camera, (rows // down, columns // across))
    fx, skew, cx, zero, fy, cy, *last = camera.matrix
    matrix = [
        fx / across, skew / across, _binned(cx - left, across),
        zero, fy / down, _binned(cy - top, down),
        *last,
    ]  # fmt: skip
    taken = camera._replace(matrix=matrix, image_size=(height // down, width // across))
    return checked(taken, restated=True)


def _check_full_resolution(camera: CameraParameters, binned_size: tuple[int, int]) -> None:
    """Raise if the matrix is that of the binned images, as drivers have it that were calibrated with them."""
    height, width = camera.image_size
    if 2 * centre_offset(camera.matrix, binned_size) < centre_offset(camera.matrix, camera.image_size):
        rows, columns = binned_size
        raise ValueError(
            f"camera_matrix: expected one for the full {width} x {height} px, got a principal point of "
            f"{camera.matrix[2]:g}, {camera.matrix[5]:g}, in the middle of the binned {columns} x {rows}; "
            f"if the matrix is for these, write width {columns}, height {rows} and binning 1"
        )


def _binning(fields: Mapping[str, Any], key: str) -> int:
    """Return the binning factor; 0 means 1."""
    factor = whole_number(fields, key) if fields.get(key) is not None else 1
    if not 0 <= factor <= 64:
        raise ValueError(f"{key}: expected 0 to 64, got {factor}")
    return factor or 1


def _binned(x: float, factor: int) -> float:
    return x if factor == 1 else (x + 0.5) / factor - 0.5
