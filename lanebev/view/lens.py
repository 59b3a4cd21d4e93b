"""Lens distortion of one point per cell: the models of ``geometry.distortion``, in few passes over memory."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.geometry.distortion import lens_model, max_undistorted_radius, tilt_homography

_CENTRE = 1e-16  # squared radius below which a fisheye's factor is 1: sqrt has no gradient at 0


class Lens(NamedTuple):
    """The mapping from the plane z = 1 to the image.

    Attributes:
        coefficients: (B, D) of the distortion.
        model: "pinhole", "fisheye" or "omni".
        focal, skew, centre: (B, 2, 1, 1) each; the skew of y is zero.
        squared_limit: (B, 1, 1), x² + y² up to which the lens does not fold over.
        tilt: (B, 3, 3, 1, 1), homography of a tilted sensor, or None.
    """

    coefficients: Tensor
    model: str
    focal: Tensor
    skew: Tensor
    centre: Tensor
    squared_limit: Tensor
    tilt: Tensor | None

    def excess(self, cells: Tensor) -> Tensor:
        """Compute what is positive where the lens folds over, x² + y² - limit z².

        Args:
            cells: (B, 3, R, V) in the camera, in front of it.

        Returns:
            (B, 1, R, V), quadratic in the cells.
        """
        x, y, z = cells.square().unbind(1)
        return torch.addcmul(x + y, self.squared_limit, z, value=-1).unsqueeze(1)


def make_lens(
    image_from_cam: Tensor, distortion: Tensor | None, model: str, dtype: torch.dtype
) -> Lens | None:
    """Make a lens of intrinsics (B, 3, 3) and distortion (B, D); None of an undistorted image."""
    if distortion is None or distortion.shape[-1] == 0:
        return None
    distortion = distortion.to(dtype)
    upper = image_from_cam.to(dtype)[:, :2, :, None, None]  # (B, 2, 3, 1, 1)
    focal = torch.stack([upper[:, 0, 0], upper[:, 1, 1]], dim=1)
    skew = torch.stack([upper[:, 0, 1], torch.zeros_like(upper[:, 0, 1])], dim=1)
    limit = max_undistorted_radius(distortion.detach(), model).square()[:, None, None]
    tilt = tilt_homography(distortion[:, 12:])[..., None, None] if distortion.shape[-1] == 14 else None
    return Lens(distortion, lens_model(model), focal, skew, upper[:, :, 2], limit, tilt)


def image_planes(points: Tensor, lens: Lens, continued: bool) -> tuple[Tensor, Tensor]:
    """Project points of the ideal z = 1 plane to the image.

    Args:
        points: (B, 2, R, V).
        lens: lens of each row of the batch.
        continued: beyond where the lens folds over, too; then coordinates may be of any size.

    Returns:
        (B, 2, R, V) image coordinates, finite, and (B, R, V): zero where the lens does not fold over, else at
        least 1, without gradient; zero too where it is continued.
    """
    x, y = points.unbind(1)
    squared_radius = torch.addcmul(x * x, y, y)
    # beyond the fold no gradient, and no overflow
    clamped = squared_radius if continued else torch.minimum(squared_radius, lens.squared_limit)
    beyond = (squared_radius - clamped).detach().sign()
    points = distort_planes(points, clamped, lens.coefficients, lens.model)
    if lens.tilt is not None:
        points, behind = tilt_planes(points, lens.tilt)
        beyond = beyond + behind
    points = torch.addcmul(torch.addcmul(lens.centre, points, lens.focal), points[:, 1:], lens.skew)
    return points, beyond


def distort_planes(points: Tensor, squared_radius: Tensor, distortion: Tensor, model: str) -> Tensor:
    """Compute where a lens images points of the ideal z = 1 plane, but for the tilt of a sensor.

    Source: :func:`lanebev.geometry.distortion.distort_plane`, to which it is equal; Brown-Conrady distortion
    is written as x (g + 2 p₁ y + 2 p₂ x) + p₂ r² with the radial factor g, and y likewise.

    Args:
        points: (B, 2, ...), x and y.
        squared_radius: (B, ...), x² + y²; a caller clamps it where the lens folds over.
        distortion: (B, D), D at least 4, OpenCV's order.
        model: "pinhole", "fisheye" or "omni".

    Returns:
        (B, 2, ...). Differentiable in all tensors.
    """
    k = [each.view(-1, *[1] * (squared_radius.ndim - 1)) for each in distortion.unbind(-1)]  # (B, 1, ...)
    if model == "fisheye":
        return points * fisheye_factor(squared_radius, k).unsqueeze(1)
    if model == "omni":
        shrink = 1 / (1 + k[0] * _root(1 + squared_radius))
        return brown_conrady(points * shrink.unsqueeze(1), squared_radius * shrink * shrink, k[1:])
    return brown_conrady(points, squared_radius, k)


def brown_conrady(points: Tensor, squared_radius: Tensor, k: Sequence[Tensor]) -> Tensor:
    """Apply radial, tangential and thin-prism distortion to (B, 2, ...) points."""
    x, y = points.unbind(1)
    p1, p2 = k[2], k[3]
    factor = torch.addcmul(radial_factor(squared_radius, k), y, 2 * p1)
    factor = torch.addcmul(factor, x, 2 * p2)
    offset = torch.stack([p2, p1], dim=1)
    if len(k) > 8:  # thin prism: s1 r² + s2 r⁴ and s3 r² + s4 r⁴
        prism = [first + second * squared_radius for first, second in ((k[8], k[9]), (k[10], k[11]))]
        offset = offset + torch.stack(prism, dim=1)
    return torch.addcmul(offset * squared_radius.unsqueeze(1), points, factor.unsqueeze(1))


def radial_factor(squared_radius: Tensor, k: Sequence[Tensor]) -> Tensor:
    """Compute (1 + k₁ r² + k₂ r⁴ + k₃ r⁶) / (1 + k₄ r² + k₅ r⁴ + k₆ r⁶), OpenCV's order of coefficients."""
    factor = _one_plus_polynomial(squared_radius, [*k[:2], *k[4:5]])
    return factor if len(k) < 8 else factor / _one_plus_polynomial(squared_radius, k[5:8])


def fisheye_factor(squared_radius: Tensor, k: Sequence[Tensor]) -> Tensor:
    """Compute θ (1 + k₁ θ² + k₂ θ⁴ + k₃ θ⁶ + k₄ θ⁸) / r with θ = atan r."""
    radius = _root(squared_radius.clamp(min=_CENTRE))
    theta = radius.atan()
    return _one_plus_polynomial(theta * theta, k) * theta / radius


def _root(positive: Tensor) -> Tensor:
    """Compute the square root. ``sqrt`` would start the threads of MKL for 200 numbers, as ``atan`` does."""
    return positive * positive.rsqrt()


def _one_plus_polynomial(variable: Tensor, coefficients: Sequence[Tensor]) -> Tensor:
    """Compute 1 + c₀ v + c₁ v² + …, by Horner's rule."""
    value = coefficients[-1].expand_as(variable)
    for coefficient in reversed([torch.ones_like(coefficients[0]), *coefficients[:-1]]):
        value = torch.addcmul(coefficient, value, variable)
    return value


def tilt_planes(points: Tensor, homography: Tensor) -> tuple[Tensor, Tensor]:
    """Transform (B, 2, R, V) points by a homography (B, 3, 3, 1, 1).

    Returns:
        (B, 2, R, V), finite, and (B, R, V): zero where the point stays in front, else 1.
    """
    x, y = points.unsqueeze(2).unbind(1)  # (B, 1, R, V)
    mapped = homography[:, :, 0] * x + homography[:, :, 1] * y + homography[:, :, 2]
    depth = mapped[:, 2:]
    ahead = depth.clamp(min=1e-6)
    return mapped[:, :2] / ahead, (ahead - depth).detach().sign().squeeze(1)
