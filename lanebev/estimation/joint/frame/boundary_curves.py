"""The boundaries of a frame as curves, each with its own offset and heading, given the pose."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import masked_median
from lanebev.estimation.joint.measurement.observations import Observations, observe, per_end
from lanebev.geometry.road import image_from_road_points
from lanebev.geometry.road_profile import (
    check_vertical_curvature,
    meet_road,
    meets_before_farthest,
    road_profile,
)
from lanebev.geometry.rotation import road_from_cam
from lanebev.observation.segments import LaneSegments
from lanebev.types import NUM_BOUNDARIES, Extrinsics

_HEADING_STD = 0.02  # rad; real boundaries differ by about a degree in direction
_CURVE_HEADING_STD = 0.005  # rad, likewise, while a curvature is fitted that would pass for it
_CURVATURE_STD = (2e-3, 2e-5)  # 1/m, 1/m²; of c0 and c1 where they are not given
_TOLERANCE = 0.008  # focal lengths: distance at which a segment's weight is a quarter
_REWEIGHTINGS = 5


class Boundaries(NamedTuple):
    """Curves X(Z) = offset + heading Z + c0 Z²/2 + c1 Z³/6 on the road, one a boundary.

    Attributes:
        offset: (B, L) m, X at Z = 0, right of the camera.
        heading: (B, L) rad (tangent), own deviation from the common direction.
        extent: (B, L, 2) m, nearest and farthest Z of inlier end points; (0, 0) where not present.
        present: (B, L) bool, enough inlier segments.
        curvature: (B, 2), c0 and c1, common to all.
    """

    offset: Tensor
    heading: Tensor
    extent: Tensor
    present: Tensor
    curvature: Tensor


def fit_boundaries(
    segments: LaneSegments,
    intrinsics: Tensor,
    extrinsics: Extrinsics,
    least_support: float = 2.0,
    vertical_curvature: Tensor | None = None,
) -> Boundaries:
    """Fit each boundary's offset and heading and their curvature by robust least squares on pixel distances.

    Real lanes are neither equally wide nor parallel: the boundaries have only pose and curvature in common.
    The start is the median offset of a boundary's end points.

    Args:
        segments: (B, N) line segments.
        intrinsics: (B, 3, 3).
        extrinsics: each (B,), of this frame.
        least_support: sum of the inlier segments' weights from which a boundary is present.
        vertical_curvature: (B,) 1/m of the road, or None for a plane.

    Returns:
        The curves.

    Raises:
        ValueError: shapes that do not fit.
    """
    seen = observe(segments, intrinsics, NUM_BOUNDARIES)
    if vertical_curvature is not None:
        check_vertical_curvature(vertical_curvature, intrinsics.shape[0])
    z, across, scale, weight = _ends_on_road(seen, extrinsics, vertical_curvature)
    height, focal = extrinsics.height.unsqueeze(-1), seen.focal.unsqueeze(-1)
    member = torch.nn.functional.one_hot(per_end(seen.boundary), NUM_BOUNDARIES).mT.to(z.dtype)  # (B, L, 2N)
    member = member * weight.unsqueeze(1)
    sigma = per_end(seen.sigma)

    offset = masked_median(across.unsqueeze(1).expand_as(member), member > 0)  # (B, L)
    heading, lateral = torch.zeros_like(offset), across
    for _ in range(_REWEIGHTINGS):
        residual = lateral.unsqueeze(1) - offset.unsqueeze(-1) - heading.unsqueeze(-1) * z.unsqueeze(1)
        per_metre = _pixels_per_metre(offset, scale, height, focal)  # (B, L, 2N)
        far_off = residual * per_metre / (_TOLERANCE * focal.unsqueeze(-1))
        trust = (1 + far_off.square()).square().reciprocal()
        precision = member * trust * (per_metre / sigma.unsqueeze(1)).square()  # 1/m²
        curvature = _fit_curvature(z, across, precision)
        lateral = across - _bend(z, curvature)
        offset, heading = _fit_line(z, lateral, precision)
    present = 0.5 * (member * trust).sum(-1) >= least_support
    extent = torch.where(present.unsqueeze(-1), _extent(z, (member > 0) & (trust > 0.25)), 0.0)
    return Boundaries(offset, heading, extent, present, curvature)


def _ends_on_road(
    seen: Observations, extrinsics: Extrinsics, vertical_curvature: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project end points to the road: Z and X in m, the scale of their directions, weights, (B, 2N) each."""
    rotation = road_from_cam(extrinsics.pitch, extrinsics.yaw, extrinsics.roll)
    directions = rotation @ seen.cam_from_image @ seen.pixels
    height = extrinsics.height.unsqueeze(-1)
    curved = torch.zeros_like(height) if vertical_curvature is None else vertical_curvature.unsqueeze(-1)
    profile = road_profile(height, curved)
    on_road, z = meets_before_farthest(directions, profile), meet_road(directions, profile)
    x, _, ahead = directions.unbind(1)
    scale = z / torch.where(on_road, ahead, 1.0)
    return z, scale * x, scale, per_end(seen.weight) * on_road


def _extent(z: Tensor, reached: Tensor) -> Tensor:
    """Return the nearest and farthest z (B, 2N) that each boundary reaches (B, L, 2N), (B, L, 2) m."""
    near = z.unsqueeze(1).masked_fill(~reached, torch.inf).amin(-1)
    far = z.unsqueeze(1).masked_fill(~reached, -torch.inf).amax(-1)
    return torch.stack([near, far], dim=-1)


def boundary_polylines(
    boundaries: Boundaries,
    intrinsics: Tensor,
    extrinsics: Extrinsics,
    num_points: int,
    vertical_curvature: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the seen part of each boundary as a polyline in the undistorted image, near to far.

    Args:
        boundaries: from :func:`fit_boundaries`.
        intrinsics: (B, 3, 3).
        extrinsics: each (B,).
        num_points: P.
        vertical_curvature: (B,) 1/m of the road, or None for a plane.

    Returns:
        (B, L, P, 2) px, and (B, L, P) bool: boundary present and point before the camera. Points may lie
        outside the image, whose size is not known here.
    """
    first, last = boundaries.extent.unbind(-1)  # (B, L)
    first = torch.where(boundaries.present, first, 1.0).clamp(min=0.5)
    last = torch.maximum(torch.where(boundaries.present, last, 1.0), first)
    steps = torch.linspace(0, 1, num_points, dtype=first.dtype, device=first.device)
    inverse = first.reciprocal().unsqueeze(-1) * (1 - steps) + last.reciprocal().unsqueeze(-1) * steps
    z = inverse.reciprocal()  # (B, L, P)
    x = boundaries.offset.unsqueeze(-1) + boundaries.heading.unsqueeze(-1) * z
    x = x + _bend(z.flatten(1), boundaries.curvature).view_as(z)
    road = torch.stack([x, z], dim=-1).flatten(1, 2)
    pixels, ahead = image_from_road_points(road, intrinsics, extrinsics, vertical_curvature)
    return pixels.view(*z.shape, 2), ahead.view_as(z) & boundaries.present.unsqueeze(-1)


def _bend(z: Tensor, curvature: Tensor) -> Tensor:
    """Compute c0 Z²/2 + c1 Z³/6, (B, M) m."""
    c0, c1 = curvature.unsqueeze(-1).unbind(1)
    return z * z * (c0 / 2 + c1 * z / 6)


def _pixels_per_metre(offset: Tensor, scale: Tensor, height: Tensor, focal: Tensor) -> Tensor:
    """Compute the perpendicular pixels in the image per lateral metre on the road, (B, L, 2N)."""
    steepness = (1 + (offset / height).square()).rsqrt()
    return (focal / scale).unsqueeze(1) * steepness.unsqueeze(-1)


def _fit_line(
    z: Tensor, lateral: Tensor, precision: Tensor, heading_std: float = _HEADING_STD
) -> tuple[Tensor, Tensor]:
    """Fit a weighted line through (z, lateral), (B, M) each, with a prior on its heading."""
    total = precision.sum(-1)
    some = total > 0
    safe = torch.where(some, total, 1.0)
    mean_z = (precision * z.unsqueeze(1)).sum(-1) / safe
    mean_x = (precision * lateral.unsqueeze(1)).sum(-1) / safe
    centred = z.unsqueeze(1) - mean_z.unsqueeze(-1)
    spread = (precision * centred * centred).sum(-1) + heading_std**-2
    heading = (precision * centred * (lateral.unsqueeze(1) - mean_x.unsqueeze(-1))).sum(-1) / spread
    return mean_x - heading * mean_z, heading


def _fit_curvature(z: Tensor, across: Tensor, precision: Tensor) -> Tensor:
    """Fit weighted c0 and c1 (B, 2) common to all boundaries, each with its own offset and heading.

    Source: least squares with the offsets and headings eliminated (Frisch and Waugh 1933): the lines through
    each boundary are taken off the shapes Z²/2 and Z³/6 and off the points (B, M), then these are fitted.
    """
    std = z.new_tensor(_CURVATURE_STD)
    shapes = torch.stack([z.square() / 2, z**3 / 6], dim=1) * std.unsqueeze(-1)  # (B, 2, M)
    left = [_off_line(z, part, precision) for part in (*shapes.unbind(1), across)]  # each (B, L, M)
    weighted = torch.einsum("blm,bim->bilm", precision, shapes)
    sums = torch.stack([(weighted * part.unsqueeze(1)).sum((2, 3)) for part in left], dim=-1)  # (B, 2, 3)
    root = torch.linalg.cholesky_ex(sums[..., :2] + torch.eye(2, dtype=z.dtype, device=z.device)).L
    return torch.cholesky_solve(sums[..., 2:], root).squeeze(-1) * std


def _off_line(z: Tensor, values: Tensor, precision: Tensor) -> Tensor:
    """Subtract each boundary's weighted line through (z, values), (B, M) each, from the values: (B, L, M)."""
    offset, heading = _fit_line(z, values, precision, _CURVE_HEADING_STD)
    return values.unsqueeze(1) - offset.unsqueeze(-1) - heading.unsqueeze(-1) * z.unsqueeze(1)
