"""Lenses: pixels to rays and back, with distortion, for a whole batch of cameras.

Pixels are (x, y) with centres at integers. "Undistorted" pixels are those of the ideal pinhole
camera with the same intrinsics.
"""

import torch
from torch import Tensor

from lanebev.batch import readable
from lanebev.geometry.distortion import check_lens, distort_plane, lens_model, max_undistorted_radius
from lanebev.geometry.precision import full_precision
from lanebev.geometry.undistortion import undistort_plane
from lanebev.tensors import constant
from lanebev.types import check_pixels, check_tensor

_HARMLESS_FOCAL = 1000.0  # px
_NO_PIXEL = 0.5  # px


def check_distortion(distortion: Tensor | None, model: str, *rows: int) -> None:
    """Raise unless these are (*rows, D) coefficients, or None, of a lens that exists.

    Raises:
        TypeError: not a tensor.
        ValueError: saying what was expected and what came.
    """
    if distortion is not None:
        check_tensor("distortion", distortion)
        if distortion.shape[:-1] != rows:
            expected = "".join(f"{size}, " for size in rows)
            got = f"{tuple(distortion.shape)}{_remedy(distortion, rows, *distortion.shape[-1:])}"
            raise ValueError(f"distortion: expected ({expected}D), got {got}")
    check_lens(distortion, model)


def _remedy(of_one: Tensor, rows: tuple[int, ...], *size: int) -> str:
    """Return the remedy for a tensor of this size, or of one row, that should have more rows."""
    if not (rows and size) or of_one.shape not in (size, (1, *size)):
        return ""
    return f"; give it to every row by .expand({', '.join(map(str, (*rows, *size)))})"


def _check(points: Tensor, distortion: Tensor, model: str) -> None:
    check_points(points)
    check_distortion(distortion, model, *points.shape[:-2])


def check_intrinsics(intrinsics: Tensor, *rows: int) -> None:
    """Raise unless these are (*rows, 3, 3) matrices of floating point.

    On the CPU also if one is transposed; elsewhere reading numbers would wait for the device, see
    :func:`usable_cameras`.

    Raises:
        TypeError: not a tensor.
        ValueError: saying what was expected and what came.
    """
    check_tensor("intrinsics", intrinsics)
    if intrinsics.shape != (*rows, 3, 3):
        got = f"{tuple(intrinsics.shape)}{_remedy(intrinsics, rows, 3, 3)}"
        raise ValueError(f"intrinsics: expected {(*rows, 3, 3)}, got {got}")
    check_pixels("intrinsics", intrinsics)
    if readable(intrinsics) and bool(intrinsics.detach()[..., 2, :2].any()):
        upright = (intrinsics.mT[..., 2, :2] != 0).any(-1) | last_row_is_small(intrinsics)
        if not bool(upright.all()):
            raise ValueError(
                "intrinsics: expected [fx s cx; 0 fy cy; 0 0 1], got its transpose; give intrinsics.mT"
            )


def usable_cameras(intrinsics: Tensor) -> Tensor:
    """Return (...,) bool of intrinsics (..., 3, 3): finite, with positive focal lengths, not transposed."""
    finite = intrinsics.isfinite().all(-1).all(-1) & last_row_is_small(intrinsics)
    return finite & (intrinsics[..., 0, 0] > 0) & (intrinsics[..., 1, 1] > 0)


def last_row_is_small(intrinsics: Tensor) -> Tensor:
    """Return (...,) bool: not the principal point, px, is in the last row, nor NaN."""
    return intrinsics[..., 2, :2].abs().amax(-1) < _NO_PIXEL


def placeholder_intrinsics(like: Tensor) -> Tensor:
    """Return (3, 3) intrinsics that replace unusable ones, so that no number or gradient becomes NaN."""
    return constant(((_HARMLESS_FOCAL, 0.0, 0.0), (0.0, _HARMLESS_FOCAL, 0.0), (0.0, 0.0, 1.0)), like=like)


def check_points(points: Tensor, size: int = 2) -> None:
    """Raise unless these are (..., N, size) points."""
    check_tensor("points", points)
    if points.ndim < 2 or points.shape[-1] != size:
        raise ValueError(f"points: expected (..., N, {size}), got {tuple(points.shape)}")
    if not points.is_floating_point():  # whole numbers would be cut to pixels
        raise ValueError(f"points: expected floating point, got {points.dtype}")


def normalise_points(points: Tensor, intrinsics: Tensor) -> Tensor:
    """Convert undistorted pixels to the z = 1 plane.

    Args:
        points: (..., N, 2) px.
        intrinsics: (..., 3, 3).

    Returns:
        (..., N, 2) (x/z, y/z).
    """
    check_points(points)
    return _moved(points, cam_from_image(intrinsics))


def denormalise_points(points: Tensor, intrinsics: Tensor) -> Tensor:
    """Convert points of the z = 1 plane to undistorted pixels, the inverse of :func:`normalise_points`."""
    check_points(points)
    return _moved(points, intrinsics)


def _moved(points: Tensor, matrix: Tensor) -> Tensor:
    """Move points (..., N, 2) by affine matrices (..., 3, 3)."""
    (xx, xy, cx), (yx, yy, cy) = (row.unbind(-1) for row in matrix[..., None, :2, :].unbind(-2))
    x, y = points.unbind(-1)
    return torch.stack([xx * x + xy * y + cx, yx * x + yy * y + cy], dim=-1)


def cam_from_image(intrinsics: Tensor) -> Tensor:
    """Return K⁻¹, which converts undistorted pixels to the z = 1 plane.

    In closed form: a row whose camera can't be used is not finite, where a solver would raise for all.

    Args:
        intrinsics: (..., 3, 3), with skew, or of an image that was turned or mirrored.

    Returns:
        (..., 3, 3).
    """
    (fx, skew, cx), (turn, fy, cy), _ = (row.unbind(-1) for row in intrinsics.unbind(-2))
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    area = fx * fy - skew * turn  # the determinant
    xx, xy, yx, yy = fy / area, -skew / area, -turn / area, fx / area
    entries = [xx, xy, -cx * xx - cy * xy, yx, yy, -cx * yx - cy * yy, zero, zero, one]
    inverse: Tensor = torch.stack(entries, dim=-1).unflatten(-1, (3, 3))
    return inverse


@full_precision
def distort_points(points: Tensor, intrinsics: Tensor, distortion: Tensor, model: str = "pinhole") -> Tensor:
    """Convert undistorted pixels to pixels as taken.

    Args:
        points: (B, N, 2) px, undistorted.
        intrinsics: (B, 3, 3).
        distortion: (B, D) in OpenCV's order, see :mod:`lanebev.geometry.distortion`: D in 0, 4, 5, 8, 12, 14
            (pinhole), 4 (fisheye) or 5 (omni: ξ k1 k2 p1 p2).
        model: "pinhole", "fisheye" or "omni" ("mei").

    Returns:
        (B, N, 2) px, distorted. Differentiable in all tensors.

    Raises:
        ValueError: unknown model, a number of coefficients that it does not have, or of rows.
    """
    _check(points, distortion, model)
    if distortion.shape[-1] == 0:
        return points
    plane = distort_plane(normalise_points(points, intrinsics), distortion, lens_model(model))
    return denormalise_points(plane, intrinsics)


@full_precision
def undistort_points(
    points: Tensor, intrinsics: Tensor, distortion: Tensor, model: str = "pinhole"
) -> Tensor:
    """Convert pixels as taken to undistorted pixels.

    :func:`invert_distortion` also tells for which pixels there is no such point.

    Args:
        points: (B, N, 2) px, distorted.
        intrinsics: (B, 3, 3).
        distortion: (B, D).
        model: "pinhole", "fisheye" or "omni" ("mei").

    Returns:
        (B, N, 2) px, undistorted.

    Raises:
        ValueError: unknown model, a number of coefficients that it does not have, or of rows.
    """
    return invert_distortion(points, intrinsics, distortion, model)[0]


@full_precision
def invert_distortion(
    points: Tensor,
    intrinsics: Tensor,
    distortion: Tensor,
    model: str = "pinhole",
    reach: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Convert pixels as taken to undistorted pixels, and tell where there is such a point.

    Inverse of :func:`distort_points`: radially by Newton's method in a bracket, then in the plane by damped
    Newton, each a fixed number of steps; the gradient is the solution's own. A pixel that the lens images
    from nowhere within its reach, outside of the image circle as a rule, has no such point.

    Args:
        points: (B, N, 2) px, distorted.
        intrinsics: (B, 3, 3).
        distortion: (B, D).
        model: "pinhole", "fisheye" or "omni" ("mei").
        reach: (B,) of :func:`max_undistorted_radius`, which saves time in many calls; None computes it.

    Returns:
        (B, N, 2) px, undistorted, and (B, N) bool, false where there is no such point; what is returned
        there is near where the lens folds over and has no gradient.

    Raises:
        ValueError: unknown model, a number of coefficients that it does not have, or of rows.
    """
    _check(points, distortion, model)
    if distortion.shape[-1] == 0:
        return points, points.isfinite().all(-1)
    if reach is None:
        reach = max_undistorted_radius(distortion, model)
    plane, valid = undistort_plane(normalise_points(points, intrinsics), distortion, lens_model(model), reach)
    return denormalise_points(plane, intrinsics), valid


@full_precision
def undistorted_sigma(
    sigma: Tensor,
    points: Tensor,
    along: Tensor,
    intrinsics: Tensor,
    distortion: Tensor,
    model: str = "pinhole",
) -> Tensor:
    """Convert standard deviations across a line from pixels as taken to undistorted pixels.

    Source: first-order propagation. With F the Jacobian of :func:`distort_points`, a line along the unit
    vector τ appears along F τ, and a pixel across it there is |F τ| / |det F| here.

    Args:
        sigma: (B, N) px as taken.
        points: (B, N, 2) px, undistorted, where it holds.
        along: (B, N, 2) direction of the line there, undistorted, of any length.
        intrinsics: (B, 3, 3).
        distortion: (B, D).
        model: "pinhole", "fisheye" or "omni".

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
