"""Lens models on the z = 1 plane: where an ideal pinhole's point is imaged by a real lens.

Coefficients are (B, D), points (B, N, 2). D and its order are OpenCV's:

- ``pinhole``, Brown-Conrady: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [τx τy]]]], D in 0, 4, 5, 8, 12, 14.
  Source: OpenCV, module calib3d, "Detailed Description".
- ``fisheye``, Kannala and Brandt 2006, Eq. (6) with the angle's first coefficient 1: k1 k2 k3 k4. Source:
  OpenCV, ``cv::fisheye``.
- ``omni``, the unified model of Mei and Rives 2007: ξ k1 k2 p1 p2. Source: OpenCV, ``cv::omnidir``, which
  keeps ξ apart; also called MEI.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.tensors import made_once

MODELS = ("pinhole", "fisheye", "omni")
DISTORTION_LENGTHS = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (4,), "omni": (5,)}
_OTHER_NAMES = {"mei": "omni"}
_REACH_STEPS = 2000  # number of steps in the search for the radius at which a lens folds over
_PINHOLE_REACH = 10.0  # the largest radius that is searched


def lens_model(name: str) -> str:
    """Return the model's name in :data:`MODELS`: ``mei`` is ``omni``.

    Raises:
        TypeError: not one name, which all rows of a batch share.
        ValueError: there is no such model.
    """
    if not isinstance(name, str):
        raise TypeError(f"model: expected one name for all rows, got {name!r}; call once for each lens model")
    known = _OTHER_NAMES.get(name, name)
    if known not in MODELS:
        raise ValueError(f"model: expected one of {', '.join(MODELS)}, got {name!r}")
    return known


def check_lens(distortion: Tensor | None, model: str) -> None:
    """Raise unless the lens model exists and has as many coefficients as (..., D) are given, None as 0."""
    lengths = DISTORTION_LENGTHS[lens_model(model)]
    count = 0 if distortion is None else distortion.shape[-1]
    if count not in lengths:
        expected = ", ".join(map(str, lengths))
        raise ValueError(f"distortion: expected {expected} coefficients for a {model} lens, got {count}")


def distort_plane(plane: Tensor, distortion: Tensor, model: str) -> Tensor:
    """Distort points of the ideal z = 1 plane as the lens does, (B, N, 2) to (B, N, 2)."""
    if model == "fisheye":
        return kannala_brandt(plane, distortion)
    if model == "omni":
        return _distorted(unified_plane(plane, distortion[..., :1]), distortion[..., 1:])
    if distortion.shape[-1] == 0:
        return plane
    distorted = _distorted(plane, distortion)
    if distortion.shape[-1] > 12:
        return transform_plane(distorted, tilt_homography(distortion[..., 12:]))[0]
    return distorted


def _distorted(plane: Tensor, distortion: Tensor) -> Tensor:
    """Apply Brown-Conrady distortion, (B, N, 2)."""
    return brown_conrady(coordinates_first(plane), distortion).value.movedim(0, -1)


def squared_radius(plane: Tensor) -> Tensor:
    """Return the squared distance (B, N) of points (B, N, 2) from the axis."""
    x, y = plane.unbind(-1)
    return x * x + y * y


def coordinates_first(plane: Tensor) -> Tensor:
    """Return points (B, N, 2) as (2, B, N)."""
    return torch.stack(plane.unbind(-1))


class Linearised(NamedTuple):
    """A map of the plane and its Jacobian at points; coordinates come first, which is several times faster.

    Attributes:
        value: (2, B, N).
        diagonal: (2, B, N), derivatives of x by x and of y by y.
        cross: (2, B, N), derivatives of x by y and of y by x.
    """

    value: Tensor
    diagonal: Tensor
    cross: Tensor

    def determinant(self) -> Tensor:
        """Return the Jacobian's determinant, (B, N)."""
        return self.diagonal[0] * self.diagonal[1] - self.cross[0] * self.cross[1]


def brown_conrady(plane: Tensor, distortion: Tensor) -> Linearised:
    """Compute radial, tangential and thin-prism distortion, and its Jacobian.

    OpenCV's formula with u the point, q = (p2, p1), s₁ = (s1, s3), s₂ = (s2, s4) and the radial scale σ(r²):
    f(u) = u (σ + 2 q·u) + q r² + s₁ r² + s₂ r⁴, so that with m = q + s₁ + 2 s₂ r²

        ∂f/∂u = (σ + 2 q·u) I + 2 (u (σ' u + q)ᵀ + m uᵀ).

    Args:
        plane: (2, B, N).
        distortion: (B, D), D at least 4; the tilt of the last two of 14 is not applied.
    """
    r2 = (plane * plane).sum(0)
    scale, slope = radial_scale(r2, distortion)
    tangential = by_radius = _pair(distortion, 3, 2)  # q and m
    scale = scale + 2 * (plane * tangential).sum(0)
    value = plane * scale + tangential * r2
    if distortion.shape[-1] > 8:
        first, second = _pair(distortion, 8, 10), _pair(distortion, 9, 11)
        value = value + r2 * (first + second * r2)
        by_radius = tangential + first + 2 * second * r2
    by_scale = slope * plane + tangential
    diagonal = scale + 2 * plane * (by_scale + by_radius)
    cross = 2 * (plane * by_scale.flip(0) + by_radius * plane.flip(0))
    return Linearised(value, diagonal, cross)


def _pair(distortion: Tensor, first: int, second: int) -> Tensor:
    """Return two coefficients as (2, B, 1)."""
    return torch.stack([distortion[..., first], distortion[..., second]]).unsqueeze(-1)


def radial_scale(r2: Tensor, distortion: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the factor of radial distortion at squared radii (B, N), and its derivative by these."""
    count = distortion.shape[-1]
    k = distortion.unsqueeze(-2).unbind(-1)  # each (B, 1)
    scale, slope = 1 + r2 * (k[0] + r2 * k[1]), k[0] + 2 * r2 * k[1]
    if count > 4:
        r4 = r2 * r2
        scale, slope = scale + k[4] * (r4 * r2), slope + 3 * k[4] * r4
    if count <= 5:
        return scale, slope
    under = 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    scale = scale / under
    return scale, (slope - scale * (k[5] + r2 * (2 * k[6] + 3 * r2 * k[7]))) / under


def kannala_brandt(plane: Tensor, distortion: Tensor) -> Tensor:
    """Compute Kannala-Brandt distortion, (B, N, 2) by (B, 4)."""
    squared = squared_radius(plane)
    centre = squared < 1e-16  # sqrt has no gradient there, and the lens no effect
    radius = torch.where(centre, 1.0, squared).sqrt()
    distance, _ = fisheye_distance(radius.atan(), distortion)
    return plane * torch.where(centre, 1.0, distance / radius).unsqueeze(-1)


def fisheye_distance(angle: Tensor, distortion: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the image radius of rays at angles (B, N) rad off the axis, and its derivative by the angle."""
    k1, k2, k3, k4 = distortion[..., None, :].unbind(-1)  # each (B, 1)
    t2 = angle * angle
    distance = angle * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return distance, 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))


def unified_plane(plane: Tensor, xi: Tensor) -> Tensor:
    """Project by the unified model: onto the unit sphere, and from ξ behind its centre onto a plane.

    Source: Mei and Rives 2007, Sec. III-B.

    Args:
        plane: (B, N, 2) of the ideal z = 1 plane.
        xi: (B, 1).

    Returns:
        (B, N, 2).
    """
    length = (1 + squared_radius(plane)).sqrt()
    return plane / (1 + xi * length).unsqueeze(-1)


def lift_unified_plane(plane: Tensor, xi: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the inverse of :func:`unified_plane`.

    Source: Mei and Rives 2007, Eq. (2), the inverse projection.

    Args:
        plane: (B, N, 2).
        xi: (B, 1).

    Returns:
        (B, N, 2) of the ideal z = 1 plane, and (B, N) bool, false where the ray does not point forwards;
        the points there are zero.
    """
    r2 = squared_radius(plane)
    under = 1 + (1 - xi * xi) * r2
    factor = (xi + under.clamp(min=0.0).sqrt()) / (r2 + 1)  # the ray is (factor x, factor y, factor - ξ)
    forward = factor - xi
    front = (under > 0) & (forward > 1e-9)
    scale = torch.where(front, factor, 0.0) / torch.where(front, forward, 1.0)
    return plane * scale.unsqueeze(-1), front


def tilt_homography(tau: Tensor) -> Tensor:
    """Return the homography from an upright to a tilted sensor.

    Source: OpenCV, calib3d, "Detailed Description", and its ``computeTiltProjectionMatrix``.

    Args:
        tau: (B, 2) rad, (τx, τy).

    Returns:
        (B, 3, 3).
    """
    (sx, sy), (cx, cy) = tau.sin().unbind(-1), tau.cos().unbind(-1)
    zero, one = torch.zeros_like(sx), torch.ones_like(sx)
    rotation = _matrix([cy, sy * sx, -sy * cx, zero, cx, sx, sy, -cy * sx, cy * cx])  # R(τy) R(τx)
    r13, r23, r33 = rotation[..., 0, 2], rotation[..., 1, 2], rotation[..., 2, 2]
    return _matrix([r33, zero, -r13, zero, r33, -r23, zero, zero, one]) @ rotation


def upright_homography(tau: Tensor) -> Tensor:
    """Return the inverse of :func:`tilt_homography`, in closed form."""
    (sx, sy), (cx, cy) = tau.sin().unbind(-1), tau.cos().unbind(-1)
    zero, one = torch.zeros_like(sx), torch.ones_like(sx)
    back = _matrix([cy, zero, sy, sy * sx, cx, -cy * sx, -sy * cx, sx, cy * cx])  # (R(τy) R(τx))ᵀ
    r13, r23, r33 = -sy * cx, sx, cy * cx
    return back @ _matrix([1 / r33, zero, r13 / r33, zero, 1 / r33, r23 / r33, zero, zero, one])


def transform_plane(plane: Tensor, homography: Tensor) -> tuple[Tensor, Tensor]:
    """Transform points (B, N, 2) by a homography (B, 3, 3); beyond infinity they are zero, and false."""
    mapped = plane @ homography[..., :2].mT + homography[..., None, :, 2]
    depth = mapped[..., 2:]
    finite = depth > 1e-9
    return torch.where(finite, mapped[..., :2], 0.0) / torch.where(finite, depth, 1.0), finite[..., 0]


def max_undistorted_radius(distortion: Tensor, model: str = "pinhole") -> Tensor:
    """Compute how far from the axis a lens still images points farther out.

    Beyond, its polynomial folds over and maps points that the camera can't see back into the image.
    Tangential, thin-prism and tilt terms, small in comparison, are left out.

    Args:
        distortion: (B, D).
        model: "pinhole", "fisheye" or "omni".

    Returns:
        (B,) radius on the undistorted z = 1 plane: at most 10 of a pinhole, which is 84 deg off the axis, and
        90 deg of the others.
    """
    check_lens(distortion, model)
    steps, angle, radius, sine, cosine = (
        part.expand(*distortion.shape[:-1], -1) for part in _reaches(distortion.dtype, distortion.device)
    )
    if lens_model(model) == "fisheye":
        value, _ = fisheye_distance(angle, distortion)
    elif lens_model(model) == "omni":
        seen = sine / (cosine + distortion[..., :1])
        value = seen * radial_scale(seen * seen, distortion[..., 1:])[0]
    else:
        radius = _PINHOLE_REACH * steps
        value = radius * (radial_scale(radius * radius, distortion)[0] if distortion.shape[-1] else 1.0)
    grows = value.diff(dim=-1) > 0
    return torch.where(grows, radius[..., -1:], radius[..., :-1]).amin(-1)  # the first that doesn't


@made_once
def _reaches(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    """Return fractions from 0 to 1, those of 90 degrees as angles, and their tangents, sines and cosines."""
    steps = torch.linspace(0.0, 1.0, _REACH_STEPS + 1, dtype=dtype, device=device)
    angle = 0.9999 * 0.5 * math.pi * steps
    return steps, angle, angle.tan(), angle.sin(), angle.cos()


def _matrix(entries: list[Tensor]) -> Tensor:
    """Return (B, 3, 3) of nine entries (B,), row by row."""
    matrix: Tensor = torch.stack(entries, dim=-1).unflatten(-1, (3, 3))
    return matrix
