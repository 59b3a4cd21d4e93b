"""Segments prepared for the joint estimators, and the places of the boundaries that they are on."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.estimation.checks import as_lane_width, check_segments, mask_invalid_rows
from lanebev.geometry.lens import cam_from_image
from lanebev.observation.segments import LaneSegments
from lanebev.tensors import constant, map_tensors


class Observations(NamedTuple):
    """Prepared segments, weight zero for bad entries. M = 2 N end points.

    Attributes:
        pixels: (B, 3, M), (x, y, 1) of the end points; end point e of segment n is entry e N + n.
        boundary: (B, N) int64, 0..L-1.
        weight: (B, N) in [0, 1].
        sigma: (B, N) px.
        focal: (B,) px, of x.
        cam_from_image: (B, 3, 3), K⁻¹.
    """

    pixels: Tensor
    boundary: Tensor
    weight: Tensor
    sigma: Tensor
    focal: Tensor
    cam_from_image: Tensor

    def repeated(self, count: int) -> Observations:
        """Return each row ``count`` times, one after the other."""
        return map_tensors(lambda part: part.repeat_interleave(count, dim=0), self)


def observe(segments: LaneSegments, intrinsics: Tensor, num_boundaries: int) -> Observations:
    """Prepare segments and intrinsics for the joint estimators.

    Unusable segments, and all segments of a row without usable intrinsics, get weight 0 and placeholder
    numbers, so that no row or gradient becomes NaN.

    Args:
        segments: (B, N) line segments.
        intrinsics: (B, 3, 3).
        num_boundaries: L.

    Raises:
        ValueError: shapes that do not fit.
    """
    check_segments(segments, intrinsics)
    anything = intrinsics.new_ones(intrinsics.shape[0], 1)  # lane widths don't matter here
    return observations(*mask_invalid_rows(segments, intrinsics, anything, num_boundaries)[:2])


def observations(segments: LaneSegments, intrinsics: Tensor) -> Observations:
    """Prepare what went through :func:`~lanebev.estimation.checks.mask_invalid_rows`."""
    pixels = segments.endpoints.permute(0, 3, 2, 1).flatten(2)  # (B, 2, M)
    return Observations(
        pixels=pad(pixels, (0, 0, 0, 1), value=1.0),
        boundary=segments.boundary,
        weight=segments.weight,
        sigma=segments.sigma,
        focal=intrinsics[:, 0, 0],
        cam_from_image=cam_from_image(intrinsics),
    )


def per_end(value: Tensor) -> Tensor:
    """Repeat values (…, N) of segments for their end points, (…, M)."""
    return torch.cat([value, value], dim=-1)


def by_ends(value: Tensor) -> Tensor:
    """Split values (…, M) of end points by the segments' ends, (…, 2, N)."""
    ends: Tensor = value.unflatten(-1, (2, -1))
    return ends


def boundary_places(lane_width: float | Tensor, num_boundaries: int, like: Tensor) -> Tensor:
    """Compute X of each boundary from the middle of the ego lane, that between boundaries L/2 - 1 and L/2.

    Args:
        lane_width: float, (B,) or (B, L-1) m.
        num_boundaries: L.
        like: (B, ...) tensor that gives batch size, dtype and device.

    Returns:
        (B, L) m.

    Raises:
        ValueError: lane_width of another shape.
    """
    widths = as_lane_width(lane_width, like, num_boundaries)
    return widths @ constant(_places_by_widths(num_boundaries), like=widths)


def ego_lane_width(positions: Tensor) -> Tensor:
    """Return the width (B,) m of the ego lane, by the positions (B, L) m of the boundaries."""
    ego = positions.shape[-1] // 2 - 1
    return positions[:, ego + 1] - positions[:, ego]


@lru_cache(maxsize=16)
def _places_by_widths(num_boundaries: int) -> tuple[tuple[float, ...], ...]:
    """Return X of each boundary from the ego lane's middle by the width of each lane, (L-1) × L."""
    lanes, ego = range(num_boundaries - 1), num_boundaries // 2 - 1
    middle = [0.5 * ((lane < ego) + (lane <= ego)) for lane in lanes]
    return tuple(tuple((lane < k) - middle[lane] for k in range(num_boundaries)) for lane in lanes)
