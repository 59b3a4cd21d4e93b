"""Lenses: pixels to rays and back, with distortion, for a whole batch of cameras.

Pixels are (x, y) with centres at integers. "Undistorted" pixels are those of the ideal pinhole
camera with the same intrinsics.
"""

from __future__ import annotations

import math

import torch
from kornia.geometry import calibration
from kornia.geometry.camera import distort_points_kannala_brandt
from torch import Tensor

from lanebev.geometry.precision import full_precision

MODELS = ("pinhole", "fisheye")
DISTORTION_LENGTHS = {"pinhole": (0, 4, 5, 8, 12), "fisheye": (4,)}
_HARMLESS_FOCAL = 1000.0  # px
_UNDISTORT_ITERATIONS = 20  # kornia's default of 5 leaves 1e-2 px at the corners of a wide lens
_KB_NEWTON_ITERATIONS = 10  # quadratic from theta = theta_d: 1e-12 rad below 80 deg


def check_lens(distortion: Tensor, model: str) -> None:
    """Raise unless the lens model exists and has as many coefficients as (..., D) are given."""
    if model not in MODELS:
        raise ValueError(f"model: expected one of {', '.join(MODELS)}, got {model!r}")
    if distortion.shape[-1] not in DISTORTION_LENGTHS[model]:
        expected = ", ".join(map(str, DISTORTION_LENGTHS[model]))
        raise ValueError(
            f"distortion: expected {expected} coefficients for a {model} lens, got {distortion.shape[-1]}"
        )


def check_rows(distortion: Tensor, points: Tensor) -> None:
    """Raise unless (..., D) coefficients go with (..., N, 2) points, row by row."""
    if distortion.shape[:-1] != points.shape[:-2]:
        rows = "".join(f"{size}, " for size in points.shape[:-2])
        raise ValueError(f"distortion: expected ({rows}D) like the points, got {tuple(distortion.shape)}")


def _check(points: Tensor, distortion: Tensor, model: str) -> None:
    check_points(points)
    check_lens(distortion, model)
    check_rows(distortion, points)


def check_intrinsics(intrinsics: Tensor, *rows: int) -> None:
    """Raise unless these are (*rows, 3, 3) matrices of floating point.

    Raises:
        ValueError: saying what was expected and what came.
    """
    if intrinsics.shape != (*rows, 3, 3):
        raise ValueError(f"intrinsics: expected {(*rows, 3, 3)}, got {tuple(intrinsics.shape)}")
    if not intrinsics.is_floating_point():
        raise ValueError(f"intrinsics: expected floating point, got {intrinsics.dtype}")


def usable_cameras(intrinsics: Tensor) -> Tensor:
    """(...,) bool of (..., 3, 3): finite, and with positive focal lengths."""
    finite = intrinsics.isfinite().all(-1).all(-1)
    return finite & (intrinsics[..., 0, 0] > 0) & (intrinsics[..., 1, 1] > 0)


def placeholder_intrinsics(like: Tensor) -> Tensor:
    """(3, 3) to put in place of one that can't be used, so that no number or gradient turns NaN."""
    return torch.diag(like.new_tensor([_HARMLESS_FOCAL, _HARMLESS_FOCAL, 1.0]))


def check_points(points: Tensor, size: int = 2) -> None:
    """Raise unless these are (..., N, size) points."""
    if points.ndim < 2 or points.shape[-1] != size:
        raise ValueError(f"points: expected (..., N, {size}), got {tuple(points.shape)}")


def normalise_points(points: Tensor, intrinsics: Tensor) -> Tensor:
    """Undistorted pixels to the z = 1 plane.

    Args:
        points: (..., N, 2) px.
        intrinsics: (..., 3, 3).

    Returns:
        (..., N, 2) (x/z, y/z).
    """
    check_points(points)
    fx, fy = intrinsics[..., None, 0, 0], intrinsics[..., None, 1, 1]
    skew, cx, cy = intrinsics[..., None, 0, 1], intrinsics[..., None, 0, 2], intrinsics[..., None, 1, 2]
    y = (points[..., 1] - cy) / fy
    return torch.stack([(points[..., 0] - cx - skew * y) / fx, y], dim=-1)


def denormalise_points(points: Tensor, intrinsics: Tensor) -> Tensor:
    """Inverse of :func:`normalise_points`."""
    check_points(points)
    fx, fy = intrinsics[..., None, 0, 0], intrinsics[..., None, 1, 1]
    skew, cx, cy = intrinsics[..., None, 0, 1], intrinsics[..., None, 0, 2], intrinsics[..., None, 1, 2]
    x, y = points.unbind(-1)
    return torch.stack([fx * x + skew * y + cx, fy * y + cy], dim=-1)


def cam_from_image(intrinsics: Tensor) -> Tensor:
    """K⁻¹, undistorted pixels to the z = 1 plane as a matrix.

    In closed form: a row whose camera can't be used is not finite, where a solver would raise for all.

    Args:
        intrinsics: (..., 3, 3), with skew.

    Returns:
        (..., 3, 3).
    """
    fx, fy, skew = intrinsics[..., 0, 0], intrinsics[..., 1, 1], intrinsics[..., 0, 1]
    cx, cy = intrinsics[..., 0, 2], intrinsics[..., 1, 2]
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    along = -skew / (fx * fy)
    entries = [1 / fx, along, -cx / fx - along * cy, zero, 1 / fy, -cy / fy, zero, zero, one]
    inverse: Tensor = torch.stack(entries, dim=-1).unflatten(-1, (3, 3))
    return inverse


@full_precision
def distort_points(points: Tensor, intrinsics: Tensor, distortion: Tensor, model: str = "pinhole") -> Tensor:
    """Undistorted pixels to pixels of the image as it was taken.

    Source: Brown-Conrady as in OpenCV ``calib3d`` (kornia.geometry.calibration); Kannala and Brandt 2006
    (kornia.geometry.camera).

    Args:
        points: (B, N, 2) px, undistorted.
        intrinsics: (B, 3, 3).
        distortion: (B, D), D in 0, 4, 5, 8, 12 (pinhole) or 4 (fisheye), OpenCV's order.
        model: "pinhole" or "fisheye".

    Returns:
        (B, N, 2) px, distorted. Differentiable in all tensors.

    Raises:
        ValueError: unknown model, a number of coefficients that it does not have, or of rows.
    """
    _check(points, distortion, model)
    if distortion.shape[-1] == 0:
        return points
    if model == "fisheye":
        plane = normalise_points(points, intrinsics)
        unit = distortion.new_tensor([1.0, 1.0, 0.0, 0.0]).expand(*distortion.shape[:-1], 4)
        params = torch.cat([unit, distortion], dim=-1)  # (B, 8) of an ideal focal length: stays on the plane
        return denormalise_points(
            distort_points_kannala_brandt(plane, params.unsqueeze(-2).expand(*plane.shape[:-1], 8)),
            intrinsics,
        )
    distorted: Tensor = calibration.distort_points(points, intrinsics, distortion)
    return distorted


@full_precision
def undistort_points(
    points: Tensor, intrinsics: Tensor, distortion: Tensor, model: str = "pinhole"
) -> Tensor:
    """Pixels of the image as it was taken to those of the ideal pinhole.

    Inverse of :func:`distort_points`, by fixed-point iteration (pinhole) or Newton's method on the polar
    angle (fisheye). Where the lens polynomial folds over, far outside the image, the result is not a
    solution; :meth:`Camera.undistort_points` reports such points.

    Args:
        points: (B, N, 2) px, distorted.
        intrinsics: (B, 3, 3).
        distortion: (B, D).
        model: "pinhole" or "fisheye".

    Returns:
        (B, N, 2) px, undistorted.

    Raises:
        ValueError: unknown model, a number of coefficients that it does not have, or of rows.
    """
    _check(points, distortion, model)
    if distortion.shape[-1] == 0:
        return points
    if model == "fisheye":
        plane = normalise_points(points, intrinsics)
        return denormalise_points(_undistort_plane_kannala_brandt(plane, distortion), intrinsics)
    undistorted: Tensor = calibration.undistort_points(
        points, intrinsics, distortion, num_iters=_UNDISTORT_ITERATIONS
    )
    return undistorted


@full_precision
def undistorted_sigma(
    sigma: Tensor,
    points: Tensor,
    along: Tensor,
    intrinsics: Tensor,
    distortion: Tensor,
    model: str = "pinhole",
) -> Tensor:
    """Standard deviation across a line, from pixels of the image as taken to undistorted ones.

    Source: first-order propagation. With F the Jacobian of :func:`distort_points`, a line along the unit
    vector τ appears along F τ, and a pixel across it there is |F τ| / |det F| here.

    Args:
        sigma: (B, N) px as taken.
        points: (B, N, 2) px, undistorted, where it holds.
        along: (B, N, 2) direction of the line there, undistorted, of any length.
        intrinsics: (B, 3, 3).
        distortion: (B, D).
        model: "pinhole" or "fisheye".

    Returns:
        (B, N) px, undistorted; ``sigma`` where the line has no direction.
    """
    if distortion.shape[-1] == 0:
        return sigma
    steps = points.new_tensor([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    moved = (points.unsqueeze(-2) + steps).flatten(-3, -2)  # (B, 4 N, 2)
    seen = distort_points(moved, intrinsics, distortion, model).unflatten(-2, (-1, 4))
    by_x, by_y = seen[..., 0, :] - seen[..., 1, :], seen[..., 2, :] - seen[..., 3, :]
    size = (by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0]).abs()
    length = along.norm(dim=-1)
    stretch = (along[..., :1] * by_x + along[..., 1:] * by_y).norm(dim=-1) / length.clamp(min=1e-9)
    return torch.where((length > 1e-9) & (size > 1e-6), sigma * stretch / size.clamp(min=1e-6), sigma)


def _undistort_plane_kannala_brandt(plane: Tensor, distortion: Tensor) -> Tensor:
    """Kannala-Brandt inverse on the z = 1 plane, (B, N, 2): theta_d = theta (1 + k1 theta^2 + ...)."""
    k1, k2, k3, k4 = distortion[..., None, :].unbind(-1)  # each (B, 1)
    squared = (plane * plane).sum(-1)
    centre = squared < 1e-16  # sqrt has no gradient there, and the lens no effect
    theta_d = torch.where(centre, 1.0, squared).sqrt()
    theta = theta_d
    for _ in range(_KB_NEWTON_ITERATIONS):
        t2 = theta * theta
        value = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        theta = theta - (value - theta_d) / slope
    scale = torch.where(centre, 1.0, theta.tan() / theta_d)
    return plane * scale.unsqueeze(-1)


def max_undistorted_radius(distortion: Tensor, model: str = "pinhole", limit: float = 10.0) -> Tensor:
    """How far from the axis a lens polynomial still grows.

    Beyond it the polynomial folds over and maps points that the camera can't see back into the image.
    Tangential and thin-prism terms, small in comparison, are left out.

    Args:
        distortion: (B, D), OpenCV's order.
        model: "pinhole" or "fisheye".
        limit: the largest radius looked at of a pinhole; 10 is 84 deg off the axis. A fisheye's is 90 deg.

    Returns:
        (B,) radius on the undistorted z = 1 plane.
    """
    check_lens(distortion, model)
    steps = torch.linspace(0.0, 1.0, 2001, dtype=distortion.dtype, device=distortion.device)
    k = torch.nn.functional.pad(distortion, (0, 12 - distortion.shape[-1])).unsqueeze(-1)  # (B, 12, 1)
    if model == "fisheye":
        x = 0.9999 * 0.5 * math.pi * steps
        radius, t = x.tan(), x * x
        value = x * (1 + t * (k[:, 0] + t * (k[:, 1] + t * (k[:, 2] + t * k[:, 3]))))
    else:
        radius = limit * steps
        r = radius * radius
        numerator = 1 + r * (k[:, 0] + r * (k[:, 1] + r * k[:, 4]))
        value = radius * numerator / (1 + r * (k[:, 5] + r * (k[:, 6] + r * k[:, 7])))
    grows = (value.diff(dim=-1) > 0).to(torch.int8).cumprod(-1)  # 1 up to the first step that doesn't
    reach: Tensor = radius[grows.sum(-1)]
    return reach
