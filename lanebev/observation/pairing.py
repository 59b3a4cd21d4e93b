"""Vertices on lane boundaries to line segments: one road from any detector to a calibrator."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import order_true_first
from lanebev.geometry.lens import (
    invert_distortion,
    placeholder_intrinsics,
    undistorted_sigma,
    usable_cameras,
)
from lanebev.geometry.precision import full_precision
from lanebev.observation.vertices import take
from lanebev.types import LaneSegments, register_pytree


@register_pytree
class BoundaryVertices(NamedTuple):
    """Points on P lane boundaries, at most V on each, in order along it.

    Attributes:
        points: (B, P, V, 2) px, (x, y) of the image as it was taken.
        weight: (B, P, V) in [0, 1], confidence that the boundary is there; 0 is padding or not seen.
        sigma: (B, P, V) px, standard deviation of a vertex' position across its boundary. The errors of any
            two vertices are independent: where a detector's are not, its sigmas are larger by as much.
        boundary: (B, P) int64, index of the semantic lane boundary, left to right.
    """

    points: Tensor
    weight: Tensor
    sigma: Tensor
    boundary: Tensor


@full_precision
def segments_from_vertices(
    vertices: BoundaryVertices,
    intrinsics: Tensor,
    distortion: Tensor | None = None,
    model: str = "pinhole",
) -> LaneSegments:
    """Pair the vertices of each boundary to line segments in undistorted pixels.

    Source: Sects. VI-A and VI-B, representative vertices sampled and paired. Deviation: not at random, which
    uses some vertices often and many never. Of K vertices of a boundary, vertex i is paired with vertex
    i + ceil(K/2): each is used once, so that the errors of all end points are independent, and every segment
    is half as long as the boundary. Its weight is the smaller one, its variance the mean of its ends'.

    Args:
        vertices: (B, P, V).
        intrinsics: (B, 3, 3) px.
        distortion: (B, D) of the lens, or None for images without distortion.
        model: "pinhole", "fisheye" or "omni".

    Returns:
        segments with N = P·(V // 2), in the widest dtype of the arguments. A vertex that the lens cannot
        have imaged, and every vertex of a row whose lens is not usable, is left out.
    """
    vertices = move_to_front(vertices)
    if distortion is not None and distortion.shape[-1] > 0:
        vertices = move_to_front(undistort_vertices(vertices, intrinsics, distortion, model))
    return pair_vertices(vertices)


def move_to_front(vertices: BoundaryVertices) -> BoundaryVertices:
    """Move the vertices with a weight to the front of their boundary, in order; the rest become zeros."""
    order = order_true_first(vertices.weight > 0)  # (B, P, V)
    weight = vertices.weight.gather(-1, order)
    there = weight > 0
    return BoundaryVertices(
        points=torch.where(there.unsqueeze(-1), take(vertices.points, order), 0.0),
        weight=torch.where(there, weight, 0.0),
        sigma=torch.where(there, vertices.sigma.gather(-1, order), 1.0),
        boundary=vertices.boundary,
    )


def line_directions(points: Tensor, there: Tensor) -> Tensor:
    """Compute the direction of a line at its vertices, from the vertex before to the one after.

    Args:
        points: (..., V, 2), those that are there in front.
        there: (..., V) bool.

    Returns:
        (..., V, 2), of any length; 0 at a vertex that has no neighbours.
    """
    after = torch.cat([points[..., 1:, :], points[..., -1:, :]], dim=-2)
    last = ~torch.cat([there[..., 1:], torch.zeros_like(there[..., :1])], dim=-1)
    before = torch.cat([points[..., :1, :], points[..., :-1, :]], dim=-2)
    return torch.where(last.unsqueeze(-1), points, after) - before


def undistort_vertices(
    vertices: BoundaryVertices, intrinsics: Tensor, distortion: Tensor, model: str = "pinhole"
) -> BoundaryVertices:
    """Convert vertices, their sigmas too, from pixels of the image as taken to undistorted ones.

    Args:
        vertices: (B, P, V), those with a weight in front.
        intrinsics: (B, 3, 3) px.
        distortion: (B, D).
        model: "pinhole", "fisheye" or "omni".

    Returns:
        vertices, of weight zero where the lens cannot have imaged them or is not usable.
    """
    shape = vertices.weight.shape[1:]
    good = usable_cameras(intrinsics) & distortion.isfinite().all(-1)  # (B,)
    intrinsics = torch.where(good[:, None, None], intrinsics, placeholder_intrinsics(intrinsics))
    lens = (intrinsics, torch.where(good.unsqueeze(-1), distortion, 0.0), model)
    flat, valid = invert_distortion(vertices.points.flatten(1, 2), *lens)
    points = flat.unflatten(1, shape)
    kept = valid.unflatten(1, shape) & good[:, None, None] & (vertices.weight > 0)
    along = line_directions(points, vertices.weight > 0)
    sigma = undistorted_sigma(vertices.sigma.flatten(1), flat, along.flatten(1, 2), *lens)
    weight = torch.where(kept, vertices.weight, 0.0)
    return vertices._replace(points=points, weight=weight, sigma=sigma.unflatten(1, shape))


def pair_vertices(vertices: BoundaryVertices) -> LaneSegments:
    """Pair vertex i of K with vertex i + ceil(K/2), see :func:`segments_from_vertices`.

    Args:
        vertices: (B, P, V), those with a weight in front.

    Returns:
        segments with N = P·(V // 2), in the pixels of the vertices.
    """
    points, weight, sigma, boundary = vertices
    batch, lines, most = weight.shape
    count = (weight > 0).sum(-1, keepdim=True)  # (B, P, 1)
    half = count // 2
    first = torch.arange(most // 2, device=points.device).expand(batch, lines, -1)  # (B, P, V // 2)
    second = (first + count - half).clamp(max=most - 1)
    seen = first < half
    ends = torch.stack([take(points, first), take(points, second)], dim=-2)  # (B, P, V // 2, 2, 2)
    smaller = torch.minimum(weight.gather(-1, first), weight.gather(-1, second))
    variance = 0.5 * (sigma.gather(-1, first).square() + sigma.gather(-1, second).square())
    return LaneSegments(
        endpoints=torch.where(seen[..., None, None], ends, 0.0).flatten(1, 2),
        boundary=boundary.unsqueeze(-1).expand_as(first).flatten(1),
        weight=torch.where(seen, smaller, 0.0).flatten(1),
        sigma=torch.where(seen, variance, 1.0).sqrt().flatten(1),
    )
