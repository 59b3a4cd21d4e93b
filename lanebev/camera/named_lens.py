"""Coefficients of a lens that a file states one by one, under names such as k1 and p1."""

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from lanebev.camera.parsing import given_keys, number, numbers
from lanebev.numbers import shown

LENS_NAMES = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""OpenCV's order of the coefficients of each model."""

_LIKE_LENS = re.compile(  # with words before it, but "undistorted" is none
    r"([a-z]+_)*?(dist(?!ance|ribut|.*(model|type|std))|radial|tangential|[kp][1-6]$)|D$", re.IGNORECASE
)
_BEFORE_DIST = re.compile(r"([a-z]+_)+dist", re.IGNORECASE)  # of one number it is a distance
_USUAL = 5  # coefficients of a pinhole camera without the rational model's k4, k5 and k6


def named_lens(fields: Mapping[str, Any], model: str) -> list[float]:
    """Return the coefficients in OpenCV's order; those that are not stated are 0.

    Args:
        fields: fields of the camera or of its lens.
        model: "pinhole" or "fisheye"; another one has no such names.
    """
    names = LENS_NAMES.get(model, ())
    found = {name: number(fields, name) for name in given_keys(fields, *LENS_NAMES["pinhole"])}
    alone = "k4" in found and "k5" not in found and model == "pinhole"
    unfit = [
        name for name, value in found.items() if value and (name not in names or (alone and name == "k4"))
    ]
    if unfit:
        raise ValueError(
            f"{unfit[0]}: expected no such coefficient of a {model} lens, got {found[unfit[0]]:g}; "
            "is model: fisheye missing, or wrong?"
        )
    coefficients = [found.get(name, 0.0) for name in names]
    if model == "pinhole" and not any(coefficients[_USUAL:]):
        return coefficients[:_USUAL]
    return coefficients


def stated_lens(fields: Mapping[str, Any], keys: Sequence[str], model: str) -> list[float]:
    """Return the coefficients in a list, or under their names, also where these are below the list's key.

    Args:
        fields: fields of the camera.
        keys: spellings of the list's key.
        model: "pinhole", "fisheye" or "omni".
    """
    lists = given_keys(fields, *keys)
    if given_keys(fields, *LENS_NAMES["pinhole"]):
        if lists:
            raise ValueError(f"expected one of k1, k2, ... and {lists[0]}, got both; keep the right one")
        return named_lens(fields, model)
    below = fields[lists[0]] if lists else None
    if not isinstance(below, Mapping) or "k1" not in below:
        return numbers(fields, *keys) if lists else []
    if unknown := [key for key in below if key not in LENS_NAMES["pinhole"]]:
        raise ValueError(f"{lists[0]}: expected k1, k2, p1, p2, k3, got the key {shown(unknown[0])}")
    return named_lens(below, model)


def check_lens_keys(fields: Mapping[str, Any], known: Collection[str]) -> None:
    """Raise if a lens is stated under a name that is not known, so that it would not count.

    Args:
        fields: fields of a camera.
        known: keys of its lens.
    """
    for key, value in fields.items():
        is_other = _BEFORE_DIST.match(key) and not isinstance(value, list | Mapping)
        if key not in known and _LIKE_LENS.match(key) and not is_other and _has_number(value):
            raise ValueError(
                f"distortion: expected k1 k2 p1 p2 k3 under a known key, got {shown(key)}; rename it"
            )


def _has_number(value: Any) -> bool:
    """Return whether a value is, or contains, a number other than 0."""
    if isinstance(value, list | Mapping):
        return any(map(_has_number, value.values() if isinstance(value, Mapping) else value))
    try:
        return float(value) != 0.0
    except (TypeError, ValueError):
        return False
