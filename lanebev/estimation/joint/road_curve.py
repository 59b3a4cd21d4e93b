"""The middle line of the road: bend, heading and curvature at a distance, as a clothoid or as a spline."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.tensors import constant

KNOT_SPACING = 10.0  # m
NUM_STEPS = 5
"""Steps of curvature between knots, where the shape is a spline: c at the first knot and these, 1/m."""

_SQUARE, _CUBE = KNOT_SPACING / 2, KNOT_SPACING**2 / 6  # heading and bend of a unit ramp, one spacing on
_KNOTS = tuple(map(float, range(1 + NUM_STEPS)))  # knot spacings, from the first
_BEGIN_AND_END = tuple(
    tuple(float(k == j) - (k == j + 1) for k in range(1 + NUM_STEPS)) for j in range(NUM_STEPS)
)


class Clothoid(NamedTuple):
    """Coefficients of a clothoid, each (B, 1): the curvature at Z = 0, 1/m, and its rate, 1/m²."""

    curvature: Tensor
    rate: Tensor


class Spline(NamedTuple):
    """Coefficients of a curvature that is linear between knots.

    Attributes:
        first: (B, 1) 1/m, curvature at the first knot.
        past: (B, 1 + NUM_STEPS, 1), how far the camera is past each knot, in knot spacings.
        changes: (B, 1, 1 + NUM_STEPS) 1/m, by which the slope per knot spacing changes at each knot.
        turned: (B, 1), heading at the camera because of the step that began behind it.
        moved: (B, 1) m, bend, likewise.
    """

    first: Tensor
    past: Tensor
    changes: Tensor
    turned: Tensor
    moved: Tensor


class RoadCurve(NamedTuple):
    """The road's middle line at some distances.

    Attributes:
        bend: (B, M) m, b(Z).
        heading: (B, M), b'(Z).
        curvature: (B, M) 1/m, b''(Z).
    """

    bend: Tensor
    heading: Tensor
    curvature: Tensor


def road_shape(shape: Tensor, phase: Tensor | None) -> Clothoid | Spline:
    """Compute the coefficients of the road's middle line.

    Args:
        shape: (B, 2), c0 and c1 of a clothoid; with a phase (B, 1 + NUM_STEPS), curvature at the first knot
            and its steps from knot to knot.
        phase: (B,) m, how far the first knot lies behind the camera, or None.
    """
    if phase is None:
        return Clothoid(shape[:, :1], shape[:, 1:])
    steps, past = shape[:, 1:], phase.unsqueeze(-1) / KNOT_SPACING
    heading, bend = _behind(past)
    return Spline(
        first=shape[:, :1],
        past=(past - constant(_KNOTS, like=past)).unsqueeze(-1),
        changes=(steps @ constant(_BEGIN_AND_END, like=steps)).unsqueeze(1),
        turned=heading * steps[:, :1],
        moved=bend * steps[:, :1],
    )


def road_curve(z: Tensor, road: Clothoid | Spline) -> RoadCurve:
    """Compute bend, heading and curvature of the road's middle line at z (B, M) m, bend and heading 0 at 0.

    Source: (J3).
    """
    if isinstance(road, Clothoid):
        c0, c1 = road
        return RoadCurve(z * z * (c0 / 2 + c1 * z / 6), z * (c0 + c1 * z / 2), c0 + c1 * z)
    past = _past_knots(z, road)
    square, turning = past * past, road.first * z
    bend = torch.addcmul(-road.moved, z, torch.sub(0.5 * turning, road.turned))
    return RoadCurve(
        bend=torch.baddbmm(bend.unsqueeze(1), road.changes, square * past, alpha=_CUBE).squeeze(1),
        heading=torch.baddbmm(
            (turning - road.turned).unsqueeze(1), road.changes, square, alpha=_SQUARE
        ).squeeze(1),
        curvature=torch.baddbmm(road.first.unsqueeze(1), road.changes, past).squeeze(1),
    )


def curve_by_shape(z: Tensor, by_bend: Tensor, by_heading: Tensor, road: Clothoid | Spline) -> Tensor:
    """Compute the derivative of a function of bend and heading by every shape parameter, (B, K, M).

    Args:
        z: (B, M) m.
        by_bend: (B, M), its derivative by the bend.
        by_heading: (B, M), likewise.
        road: whose knots count.
    """
    first = z * torch.addcmul(by_heading, by_bend, z, value=0.5)
    if isinstance(road, Clothoid):
        return torch.stack([first, 0.5 * z * z * (by_bend * z / 3 + by_heading)], 1)
    past = _past_knots(z, road)
    of_square, of_cube = (_SQUARE * by_heading).unsqueeze(1), (_CUBE * by_bend).unsqueeze(1)
    ramps = past * past * torch.addcmul(of_square, of_cube, past)
    steps = ramps[:, :-1] - ramps[:, 1:]  # a step rises from 0 at its knot to 1 at the next
    heading, bend = _behind(road.past[:, 0])
    head = steps[:, 0] - torch.addcmul(by_bend * bend, heading, torch.addcmul(by_heading, by_bend, z))
    return torch.cat([torch.stack([first, head], 1), steps[:, 1:]], 1)


def _past_knots(z: Tensor, road: Spline) -> Tensor:
    """Distances (B, 1 + NUM_STEPS, M) past the knots, in knot spacings, 0 before a knot."""
    return torch.add(road.past, z.unsqueeze(1), alpha=1 / KNOT_SPACING).clamp_(min=0.0)


def _behind(past: Tensor) -> tuple[Tensor, Tensor]:
    """Heading and bend (B, 1) at the camera for a unit first step, of which ``past`` spacings are behind."""
    square = past * past
    return _SQUARE * square, _CUBE * (square * past)
