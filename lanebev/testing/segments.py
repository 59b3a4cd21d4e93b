"""Line segments of lane boundaries seen from a known pose."""

from collections.abc import Sequence

import torch
from torch import Tensor

from lanebev.estimation.checks import padded
from lanebev.estimation.joint.measurement.observations import boundary_places
from lanebev.estimation.joint.measurement.road_curve import road_points, road_shape
from lanebev.geometry.road import image_from_road_points
from lanebev.observation.segments import LaneSegments
from lanebev.tensors import join_tensors
from lanebev.types import Extrinsics

INTRINSICS = torch.tensor([[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
"""(3, 3) px, for an image of 1280 × 720."""

POSE = (0.03, -0.02, 0.015, 1.45)
"""Pitch, yaw, roll (rad) and height (m) of :func:`lanes` by default."""

_NEWTON_STEPS = 6  # to the arc at which a boundary is at a given distance
_NEAR, _FAR, _DEPTH = 7.0, 25.0, 10.0  # m: ends of :func:`lanes` lie at 7 to 17 and at 25 to 35


def project_boundaries(
    params: Tensor,
    boundary: Tensor,
    z: Tensor,
    intrinsics: Tensor,
    lane_width: float = 3.7,
    num_boundaries: int = 6,
) -> Tensor:
    """Project the end points of segments on lane boundaries into the image, without noise.

    The boundaries are parallel to a clothoid, see :mod:`lanebev.estimation.joint.measurement.road_curve`.

    Args:
        params: (B, 7) pitch, yaw, roll, height, offset, c0, c1.
        boundary: (B, N) int64, 0..L-1.
        z: (B, N, 2) m, distance of both ends.
        intrinsics: (B, 3, 3) px.
        lane_width: m.
        num_boundaries: L.

    Returns:
        (B, N, 2, 2) px.
    """
    offset = params[:, 4:5]
    place = (boundary_places(lane_width, num_boundaries, params).gather(1, boundary) + offset).unsqueeze(-1)
    line, place, z = road_shape(params[:, 5:], None), place.expand_as(z).flatten(1), z.flatten(1)
    at = road_points(z, line)
    for _ in range(_NEWTON_STEPS):
        missed = z - (at.z - place * at.sin)
        at = road_points(at.arc + missed / (at.cos * (1 - at.curvature * place)), line)
    x = at.x + place * at.cos
    road = torch.stack([x, z], dim=-1)
    pixels, _ = image_from_road_points(road, intrinsics, Extrinsics.unstack(params[:, :4]))
    endpoints: Tensor = pixels.unflatten(1, (-1, 2))
    return endpoints


def noisy_segments(
    endpoints: Tensor, boundary: Tensor, sigma: float, generator: torch.Generator
) -> LaneSegments:
    """Add Gaussian noise to exact end points and state its standard deviation, 0.1 px at least.

    Args:
        endpoints: (B, N, 2, 2) px.
        boundary: (B, N) int64.
        sigma: px; 0 adds none.
        generator: generator of the noise.
    """
    noise = torch.randn(endpoints.shape, generator=generator, dtype=endpoints.dtype)
    weight = torch.ones(boundary.shape, dtype=endpoints.dtype)
    return LaneSegments(
        endpoints + sigma * noise, boundary.clone(), weight, torch.full_like(weight, max(sigma, 0.1))
    )


def lanes(
    pose: Sequence[float] = POSE,
    boundaries: Sequence[int] = (0, 1, 2, 3, 4, 5),
    per: int = 8,
    noise: float = 0.5,
    seed: int = 0,
    width: float = 3.7,
    offset: float = 0.3,
    bend: float = 0.0,
) -> LaneSegments:
    """Draw segments of a batch of one, taken by the camera of ``INTRINSICS``.

    Args:
        pose: pitch, yaw, roll in rad, height in m.
        boundaries: indices in sight.
        per: segments of each.
        noise: px, standard deviation of an end point.
        seed: seed of distances and noise.
        width: m, of every lane.
        offset: m, of the camera to the right of the ego lane's middle.
        bend: 1/m, curvature of the road.
    """
    generator = torch.Generator().manual_seed(seed)
    boundary = torch.tensor(boundaries).repeat_interleave(per)[None]
    z = torch.rand(*boundary.shape, 2, generator=generator, dtype=torch.float64) * _DEPTH
    z = z + torch.tensor([_NEAR, _FAR])
    params = torch.tensor([[*pose, -offset, bend, 0.0]], dtype=torch.float64)
    endpoints = project_boundaries(params, boundary, z, INTRINSICS[None], width)
    return noisy_segments(endpoints, boundary, noise, generator)


def no_lanes() -> LaneSegments:
    """Return a row in which nothing was seen: segments of weight zero."""
    segments = lanes()
    return segments._replace(weight=torch.zeros_like(segments.weight))


def stack_rows(*rows: LaneSegments) -> LaneSegments:
    """Make one batch of rows with different numbers of segments, padded with weight zero to the longest."""
    longest = max(row.weight.shape[1] for row in rows)
    return join_tensors(torch.cat, [padded(row, longest) for row in rows])
