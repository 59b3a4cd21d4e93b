"""Vertices on lane boundaries, the common output of all detectors, before pairing."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import order_true_first
from lanebev.geometry.lens import invert_distortion, placeholder_intrinsics, undistorted_sigma, usable_cameras
from lanebev.observation.vertices import take
from lanebev.torch_internals import register_pytree


@register_pytree
class BoundaryVertices(NamedTuple):
    """Points on P lane boundaries, at most V on each, in order along it.

    Attributes:
        points: (B, P, V, 2) px, (x, y) of the image as it was taken.
        weight: (B, P, V) in [0, 1], confidence that the boundary is there; 0 is padding or not seen.
        sigma: (B, P, V) px, standard deviation of a vertex' position across its boundary. The errors of any
            two vertices count as independent; if a detector's are correlated, its sigmas must be enlarged.
        boundary: (B, P) int64, index of the semantic lane boundary, left to right.
    """

    points: Tensor
    weight: Tensor
    sigma: Tensor
    boundary: Tensor


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
        points: (..., V, 2), existing ones first.
        there: (..., V) bool, whether a point exists.

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
