"""Camera files of programs that reconstruct scenes from pictures: OpenSfM, OpenDroneMap and OpenMVG."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from lanebev.camera.choice import Readers
from lanebev.camera.named_lens import LENS_NAMES, check_lens_keys, named_lens
from lanebev.camera.parameters import CameraParameters, matrix_entries
from lanebev.camera.parsing import mapping, number, numbers, required, stated_size
from lanebev.numbers import shown

_OPENSFM_MODELS = {
    **dict.fromkeys(("perspective", "simple_radial", "radial", "brown"), "pinhole"),
    **dict.fromkeys(("fisheye", "fisheye_opencv"), "fisheye"),
}
_OPENMVG_LENSES = {  # keys of the coefficients -> their model, and their places in OpenCV's order
    "disto_k1": ("pinhole", (0,)),
    "disto_k3": ("pinhole", (0, 1, 4)),
    "disto_t2": ("pinhole", (0, 1, 4, 2, 3)),
    "fisheye": ("fisheye", (0, 1, 2, 3)),
}


def opensfm_cameras(content: Any) -> Readers:
    """Return readers of the cameras of ``camera_models.json``, ``cameras.json`` or ``reconstruction.json``.

    Source: OpenSfM, opensfm/io.py and doc/source/geometry.rst: lengths are in shares of the longer side, from
    the middle of the image.
    """
    first = content[0] if isinstance(content, list) and content else content
    cameras = first.get("cameras") if isinstance(content, list) and isinstance(first, Mapping) else first
    if not isinstance(cameras, Mapping):
        return {}
    found = {name: each for name, each in cameras.items() if isinstance(each, Mapping)}
    return {name: partial(_opensfm, each) for name, each in found.items() if "projection_type" in each}


def _opensfm(fields: Mapping[str, Any]) -> CameraParameters:
    name = str(fields["projection_type"]).strip().lower()
    if name not in _OPENSFM_MODELS:
        raise ValueError(f"projection_type: expected one of {', '.join(_OPENSFM_MODELS)}, got {shown(name)}")
    check_lens_keys(fields, LENS_NAMES["pinhole"])
    model, size = _OPENSFM_MODELS[name], stated_size(fields)
    fx, fy = (
        number(fields, key if fields.get(key) is not None else "focal") for key in ("focal_x", "focal_y")
    )
    x, y = (number(fields, key, default=0.0) for key in ("c_x", "c_y"))
    unit, (height, width) = max(size), size
    cx, cy = 0.5 * (width - 1) + unit * x, 0.5 * (height - 1) + unit * y
    return CameraParameters(
        matrix_entries(unit * fx, unit * fy, cx, cy), named_lens(fields, model), model, size
    )


def openmvg_cameras(content: Any) -> Readers:
    """Return readers of the cameras of ``sfm_data.json``, by their keys; none for other files.

    Source: OpenMVG, cameras/Camera_*.hpp, whose pixels have their centres at whole numbers.
    """
    if not isinstance(content, Mapping) or "sfm_data_version" not in content:
        return {}
    entries: Sequence[Any] = content.get("intrinsics") or []
    found = [mapping("intrinsics", each) for each in entries]
    if not found:
        raise ValueError("intrinsics: expected an entry for each camera, got none")
    return {str(each.get("key")): partial(_openmvg, each) for each in found}


def _openmvg(entry: Mapping[str, Any]) -> CameraParameters:
    value = mapping("value", required(entry, "value"))
    fields = mapping("data", mapping("ptr_wrapper", required(value, "ptr_wrapper")).get("data"))
    fields = {**fields, **mapping("value0", fields.get("value0") or {})}
    check_lens_keys(fields, _OPENMVG_LENSES)
    size = stated_size(fields)
    focal, (cx, cy) = number(fields, "focal_length"), numbers(fields, "principal_point", count=2)
    model, distortion = "pinhole", [0.0] * 5
    for key, (own, places) in _OPENMVG_LENSES.items():
        if fields.get(key) is not None:
            model = own
            for place, coefficient in zip(places, numbers(fields, key, count=len(places)), strict=True):
                distortion[place] = coefficient
    lens = distortion[:4] if model == "fisheye" else distortion
    return CameraParameters(matrix_entries(focal, focal, cx, cy), lens, model, size)
