"""The inverse of a lens: which point of the ideal z = 1 plane was imaged where.

Every solver here runs a fixed number of steps on all points at once, so that rows of a batch do not
influence each other and the steps export. Its gradient is that of the solution (implicit function theorem),
not of the steps that found it.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.geometry.distortion import (
    Linearised,
    brown_conrady,
    coordinates_first,
    fisheye_distance,
    lift_unified_plane,
    radial_scale,
    squared_radius,
    transform_plane,
    upright_homography,
)

_TABLE_BITS = 7  # of the table of distances from the centre: 2^7 intervals up to the lens's reach
_ANGLE_STEPS = 6  # Newton from the table: quadratic, to 1e-15 rad
_PLANE_STEPS = 10  # Newton from the radial solution: 4 for real lenses, more near where they fold over
_TOLERANCE = 1e-5  # error of a solution on the z = 1 plane: 0.01 px at a focal length of 1000 px


def undistort_plane(plane: Tensor, distortion: Tensor, model: str, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the points of the ideal z = 1 plane from their distorted images.

    Args:
        plane: (B, N, 2) as imaged.
        distortion: (B, D), D above 0.
        model: "pinhole", "fisheye" or "omni".
        reach: (B,), see :func:`lanebev.geometry.distortion.max_undistorted_radius`.

    Returns:
        (B, N, 2) ideal, and (B, N) bool, false where no such point lies within ``reach``; the points there
        are finite, near where the lens folds over, and have no gradient.
    """
    reach = reach.detach()
    if model == "fisheye":
        return _invert_kannala_brandt(plane, distortion, reach)
    if model == "omni":
        xi = distortion[..., :1]
        on_plane = reach / (1 + xi[..., 0].detach() * (1 + reach * reach).sqrt())
        sphere, valid = _invert_brown_conrady(plane, distortion[..., 1:], on_plane)
        ideal, front = lift_unified_plane(sphere, xi)
        return ideal, valid & front
    if distortion.shape[-1] > 12:
        plane, finite = transform_plane(plane, upright_homography(distortion[..., 12:]))
        ideal, valid = _invert_brown_conrady(plane, distortion[..., :12], reach)
        return ideal, valid & finite
    return _invert_brown_conrady(plane, distortion, reach)


class Bracket(NamedTuple):
    """Find the argument at which an increasing function has a value, by a table of the function.

    Attributes:
        low, high: (B, N) nodes on both sides.
        linear: (B, N) between them, by linear interpolation; the last node where the value is not reached.
    """

    low: Tensor
    high: Tensor
    linear: Tensor


def bracket_increasing(nodes: Tensor, values: Tensor, target: Tensor) -> Bracket:
    """Find where a tabulated increasing function takes a value, by bisection.

    Args:
        nodes: (B, 2^k + 1), rising.
        values: (B, 2^k + 1) of the function there.
        target: (B, N).
    """
    index = torch.zeros_like(target, dtype=torch.int64)
    step = (nodes.shape[-1] - 1) // 2
    while step:
        middle = index + step
        index = torch.where(values.gather(-1, middle) <= target, middle, index)
        step //= 2
    low, high = nodes.gather(-1, index), nodes.gather(-1, index + 1)
    below, above = values.gather(-1, index), values.gather(-1, index + 1)
    share = (target - below) / torch.where(above > below, above - below, 1.0)
    return Bracket(low, high, low + share.clamp(0.0, 1.0) * (high - low))


def _nodes(upper: Tensor) -> Tensor:
    """Return (B, 2^k + 1) evenly spaced values from 0 to ``upper`` (B,)."""
    count = 2**_TABLE_BITS + 1
    return upper.unsqueeze(-1) * torch.linspace(0.0, 1.0, count, dtype=upper.dtype, device=upper.device)


def _invert_kannala_brandt(plane: Tensor, distortion: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Invert θ_d = θ (1 + k1 θ² + …) and take the tangent."""
    constant, target = distortion.detach(), squared_radius(plane.detach()).sqrt()
    angles = _nodes(reach.atan())
    low, high, angle = bracket_increasing(angles, fisheye_distance(angles, constant)[0], target)
    for _ in range(_ANGLE_STEPS):
        value, slope = fisheye_distance(angle, constant)
        newton = angle - (value - target) / torch.where(slope > 0, slope, 1.0)
        angle = torch.minimum(torch.maximum(newton, low), high)
    value, slope = fisheye_distance(angle, constant)
    valid = ((value - target).abs() < _TOLERANCE * (1 + target)) & (slope > 0)
    valid = valid & (angle < angles[..., -1:])
    plane = torch.where(valid.unsqueeze(-1), plane, plane.detach())
    squared = squared_radius(plane)
    centre = squared < 1e-16  # sqrt has no gradient there, and the lens no effect
    distance = torch.where(centre, 1.0, squared).sqrt()
    error = fisheye_distance(torch.where(valid, angle, 0.0), distortion)[0] - distance
    solved = torch.where(valid, angle - error / torch.where(valid, slope, 1.0), angle)  # implicit gradient
    scale = torch.where(centre, 1.0, solved.tan() / distance)
    return plane * scale.unsqueeze(-1), valid


def _invert_brown_conrady(plane: Tensor, distortion: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Solve f(u) = p by damped Newton steps from the radial solution."""
    image = coordinates_first(plane)
    constant, target = distortion.detach(), image.detach()
    seen, limit = _length(target), reach.unsqueeze(-1)
    found = _newton(_radial_start(target, seen, constant, reach), target, constant, limit)
    there = brown_conrady(found, constant)
    valid = (_length(there.value - target) < _TOLERANCE * (1 + seen)) & (there.determinant() > 0)
    valid = valid & (_length(found) < limit)
    there = brown_conrady(torch.where(valid, found, 0.0), distortion)
    error = there.value - torch.where(valid, image, 0.0)
    step = _solve(Linearised(*(part.detach() for part in there)), error)
    ideal = torch.where(valid, found - step, found)  # the step is none, its gradient the implicit one
    return ideal.movedim(0, -1), valid


def _radial_start(target: Tensor, seen: Tensor, distortion: Tensor, reach: Tensor) -> Tensor:
    """Invert the radial part alone, of points (2, B, N) at a distance (B, N), by a table."""
    nodes = _nodes(reach)
    values = nodes * radial_scale(nodes * nodes, distortion)[0]
    radius = bracket_increasing(nodes, values, seen).linear
    return target * torch.where(seen > 1e-9, radius / seen.clamp(min=1e-9), 1.0)


def _newton(start: Tensor, target: Tensor, distortion: Tensor, limit: Tensor) -> Tensor:
    """Solve f(u) = p, (2, B, N), by Newton's method within a radius (B, 1).

    A step that makes the error larger, or leaves the radius, is halved.
    """
    best, trial = start, start
    least = torch.full_like(start[0], torch.inf)
    step = torch.zeros_like(start)
    for _ in range(_PLANE_STEPS):
        at = brown_conrady(trial, distortion)
        error = at.value - target
        squared = (error * error).sum(0)
        better = (squared < least) & ((trial * trial).sum(0) <= limit * limit)
        least = torch.where(better, squared, least)
        best = torch.where(better, trial, best)
        step = torch.where(better, _solve(at, error), 0.5 * step)
        trial = best - step
    return best


def _solve(at: Linearised, vector: Tensor) -> Tensor:
    """Solve J x = v, (2, B, N), by Cramer's rule; where J is singular the solution is large."""
    determinant = at.determinant()
    determinant = torch.where(determinant.abs() > 1e-9, determinant, 1e-9)
    return (at.diagonal.flip(0) * vector - at.cross * vector.flip(0)) / determinant


def _length(plane: Tensor) -> Tensor:
    return (plane * plane).sum(0).sqrt()
