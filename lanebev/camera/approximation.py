"""Kannala-Brandt lenses that are nearest to lenses of other radial models.

A radial lens images what it sees at an angle θ off its axis at a distance r(θ) from the principal point.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lanebev.camera.parameters import CameraParameters, matrix_entries

Array = NDArray[np.float64]
Radius = Callable[[Array], Array]

_WIDEST = math.radians(89.5)  # farther off the axis, a ray has no point on the z = 1 plane
_SAMPLES = 400
_MOST_ERROR = 0.5  # px


def double_sphere(angle: Array, xi: float, alpha: float) -> Array:
    """Return the distance at which a double sphere camera images angles (rad), for a focal length of 1.

    Source: Usenko, Demmel and Cremers 2018, Eqs. (40)-(42).
    """
    x, shifted = np.sin(angle), np.cos(angle) + xi
    return x / (alpha * np.hypot(x, shifted) + (1 - alpha) * shifted)


def extended_unified(angle: Array, alpha: float, beta: float) -> Array:
    """Return the distance at which an extended unified camera images angles (rad), for a focal length of 1.

    Source: Khomutenko, Garcia and Martinet 2016, as in Usenko et al. 2018, Eqs. (27)-(28).
    """
    x, z = np.sin(angle), np.cos(angle)
    radius: Array = x / (alpha * np.sqrt(beta * x * x + z * z) + (1 - alpha) * z)
    return radius


def fov_model(angle: Array, omega: float) -> Array:
    """Return the distance at which an FOV camera images angles (rad), for a focal length of 1.

    Source: Devernay and Faugeras 2001, Eq. (13).
    """
    return np.arctan(2 * np.tan(angle) * math.tan(omega / 2)) / omega


def radial_camera(
    focal: tuple[float, float], centre: tuple[float, float], size: tuple[int, int], radius: Radius
) -> CameraParameters:
    """Return the Kannala-Brandt camera that is nearest to a radial one.

    Args:
        focal: (fx, fy) px.
        centre: (cx, cy) px.
        size: (height, width) px.
        radius: r(θ) for a focal length of 1.
    """
    (fx, fy), (cx, cy), (height, width) = focal, centre, size
    if not (fx > 0 and fy > 0):
        raise ValueError(f"intrinsics: expected positive focal lengths, got {fx:g}, {fy:g}")
    corner = math.hypot(max(cx, width - 1 - cx) / fx, max(cy, height - 1 - cy) / fy)
    scale, distortion = kannala_brandt_like(radius, corner, max(fx, fy))
    return CameraParameters(matrix_entries(scale * fx, scale * fy, cx, cy), distortion, "fisheye", size)


def kannala_brandt_like(radius: Radius, corner: float, focal: float) -> tuple[float, list[float]]:
    """Return a factor on the focal lengths, and k1 to k4, of the Kannala-Brandt lens nearest to a radial one.

    By linear least squares of r(θ) = s θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) from the axis to the image's
    farthest corner, or as far as 89.5 degrees.

    Args:
        radius: r(θ) for a focal length of 1.
        corner: distance of the farthest corner from the principal point, in focal lengths.
        focal: px.
    """
    angles = _WIDEST * np.linspace(0.0, 1.0, _SAMPLES + 1)[1:]
    with np.errstate(all="ignore"):
        values = radius(angles)
        reached = values >= corner
    seen = max(8, int(reached.argmax()) + 1) if reached.any() else _SAMPLES
    angles, values = angles[:seen], values[:seen]
    if not (np.isfinite(values).all() and values[0] > 0 and (np.diff(values) > 0).all()):
        raise ValueError(
            "intrinsics: expected a lens that images larger angles farther out up to the image's corners, "
            "got one that does not; calibrate with pinhole-equi"
        )
    powers = angles[:, None] ** np.array([1, 3, 5, 7, 9])
    with np.errstate(all="ignore"):
        solution = np.linalg.lstsq(powers, values, rcond=None)[0]
        error = focal * float(np.abs(powers @ solution - values).max())
    if not (solution[0] > 0 and error <= _MOST_ERROR):
        raise ValueError(
            f"distortion: expected a lens that a Kannala-Brandt lens equals within {_MOST_ERROR:g} px, got "
            f"one off by {error:.2g} px; calibrate with pinhole-equi"
        )
    return float(solution[0]), (solution[1:] / solution[0]).tolist()
