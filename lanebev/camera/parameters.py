"""A camera as plain numbers, and checks of their range."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from lanebev.geometry.distortion import DISTORTION_LENGTHS
from lanebev.geometry.lens import invert_distortion

_FOCAL_RANGE = (0.1, 20.0)  # times the longer image side: 160 deg fisheye to 3 deg telephoto
OFF_CENTRE = 0.2
"""Shares of the sides, more than any data set's principal point is off the centre."""

_SAME_SHAPE = 1.25  # factor between height over width of an image and of a map that covers it, padded
_UPRIGHT = 1.1  # height over width, from which an image is clearly upright, or lying if width over height
_LONGEST_SIDE = 99_999  # px
_LARGEST_XI = 100.0  # ξ of the unified model; 1 is a parabolic mirror, fisheyes have 1 to 4


class CameraParameters(NamedTuple):
    """A camera as plain numbers.

    Attributes:
        matrix: nine entries of the camera matrix, row by row, px.
        distortion: coefficients in OpenCV's order, see :mod:`lanebev.geometry.distortion`.
        model: "pinhole", "fisheye" or "omni".
        image_size: (height, width) px.
        remark: note on the file that the camera was read from; else empty.
    """

    matrix: list[float]
    distortion: list[float]
    model: str
    image_size: tuple[int, int]
    remark: str = ""


def are_swapped(size: tuple[int, int], like: tuple[int, int]) -> bool:
    """Return whether a size has the proportions of another one only if its sides are swapped."""
    (height, width), (rows, columns) = size, like
    is_turned = any(
        upright > _UPRIGHT * beside and across > _UPRIGHT * below
        for upright, beside, across, below in ((height, width, columns, rows), (width, height, rows, columns))
    )
    first, second = rows * height, columns * width
    return is_turned and max(first, second) < _SAME_SHAPE * min(first, second)


def matrix_entries(fx: float, fy: float, cx: float, cy: float) -> list[float]:
    """Return the nine entries of a camera matrix without skew, row by row."""
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def left_square(entries: list[float]) -> list[float]:
    """Return the left 3 x 3 of the entries, row by row, of a 3 x 4 matrix or a 4 x 4 one."""
    return entries[0:3] + entries[4:7] + entries[8:11]


def centre_offset(matrix: Sequence[float], image_size: tuple[int, int]) -> float:
    """Return how far the principal point is from the centre of an image, in shares of its sides.

    Args:
        matrix: nine entries of the camera matrix, row by row, px.
        image_size: (height, width) px.
    """
    (height, width), x, y = image_size, matrix[2], matrix[5]
    return max(abs(x / max(width, 1) - 0.5), abs(y / max(height, 1) - 0.5))


def size_of_images(
    whose: str, image_size: tuple[int, int] | None, known: tuple[int, int] | None, spread: int = 0
) -> tuple[int, int] | None:
    """Return the images' size, else the data set's."""
    if image_size and known and max(abs(image_size[0] - known[0]), abs(image_size[1] - known[1])) > spread:
        raise ValueError(
            f"expected images of about {known[1]} x {known[0]} px, {whose}, got "
            f"{image_size[1]} x {image_size[0]}; give images in their original size, or the "
            "short YAML for the resized ones"
        )
    return image_size or known


def checked(camera: CameraParameters, restated: bool = False) -> CameraParameters:
    """Return the camera without needless coefficients, if a real one could be like it.

    Args:
        camera: camera as read from the file.
        restated: the file states the camera matrix twice, as a program does. Then it may be of a cropped
            image, with its principal point outside of it and a focal length of any number of image sides.
    """
    height, width = camera.image_size
    if not (0 < height <= _LONGEST_SIDE and 0 < width <= _LONGEST_SIDE):
        raise ValueError(f"image size: expected 1..{_LONGEST_SIDE} px a side, got {width} x {height}")
    _check_matrix(camera.matrix, camera.image_size, restated)
    camera = camera._replace(distortion=_needed(camera.distortion, camera.model))
    lengths = DISTORTION_LENGTHS[camera.model]
    if len(camera.distortion) not in lengths:
        expected = " or ".join(map(str, lengths))
        got = len(camera.distortion)
        raise ValueError(f"distortion: expected {expected} coefficients ({camera.model}), got {got}")
    if camera.model == "omni" and not 0 <= camera.distortion[0] <= _LARGEST_XI:
        raise ValueError(f"xi: expected 0 to {_LARGEST_XI:g}, got {camera.distortion[0]:g}")
    if not (restated or _invertible(camera)):
        raise ValueError(f"distortion: expected a lens that can be inverted, got {camera.distortion}")
    return camera


def _check_matrix(matrix: list[float], size: tuple[int, int], restated: bool) -> None:
    height, width = size
    fx, skew, cx, zero, fy, cy, *last = matrix
    if not (fx or fy):
        raise ValueError(
            "camera matrix: expected focal lengths, got zeros, by which ROS marks a camera without "
            "calibration; calibrate it, or give --fov"
        )
    low, high = (0.0, float("inf")) if restated else (limit * max(size) for limit in _FOCAL_RANGE)
    for name, focal in (("fx", fx), ("fy", fy)):
        if not low <= focal <= high or focal == 0:
            raise ValueError(
                f"{name}: expected {low:g} to {high:g} px for an image of {width} x {height}, got {focal:g}; "
                "focal lengths are in pixels"
            )
    if abs(skew) > 0.1 * fx or zero != 0 or last != [0.0, 0.0, 1.0]:
        got = "its transpose" if last[:2] != [0.0, 0.0] == [cx, cy] else "other off-diagonal entries"
        raise ValueError(f"camera matrix: expected [fx s cx; 0 fy cy; 0 0 1], got {got}")
    if restated:
        return
    if not 0.4 < fx / fy < 2.5:
        raise ValueError(f"fx / fy: expected nearly square pixels, got {fx:g} / {fy:g}")
    if 0 < cx < 1 and 0 < cy < 1 and min(size) > 1:
        raise ValueError(
            f"cx, cy: expected px, got {cx:g}, {cy:g}; multiply shares of the image's sides by "
            f"{width} and {height}"
        )
    for name, centre, side in (("cx", cx, width), ("cy", cy, height)):
        if not 0 < centre < side:
            raise ValueError(
                f"{name}: expected a principal point inside the image, 0 to {side}, got {centre:g}; the "
                "camera of a cropped image is written by Camera.cropped(...).to_file(...)"
            )


def _needed(distortion: list[float], model: str) -> list[float]:
    """Return the coefficients without needless zeros, and none for a pinhole camera without distortion."""
    if model == "fisheye":
        return [*distortion[:4], *(each for each in distortion[4:] if each)] or [0.0] * 4
    if model == "omni":
        return distortion
    if len(distortion) == 14 and not any(distortion[12:]):
        distortion = distortion[:12]
    if not any(distortion) and len(distortion) in DISTORTION_LENGTHS[model]:
        return []  # no lens to undo, which is much faster to do
    return distortion


def _invertible(camera: CameraParameters) -> bool:
    """Return whether the distortion can be inverted at four points half-way to the corners."""
    height, width = camera.image_size
    inner = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]], dtype=torch.float64)
    points = (inner * inner.new_tensor([width, height]))[None]
    intrinsics = points.new_tensor(camera.matrix).reshape(1, 3, 3)
    _, valid = invert_distortion(points, intrinsics, points.new_tensor(camera.distortion)[None], camera.model)
    return bool(valid.all())
