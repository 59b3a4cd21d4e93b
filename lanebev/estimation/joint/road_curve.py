"""The middle line of the road: bend, heading and curvature at a distance, as a clothoid or as a spline."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

KNOT_SPACING = 10.0  # m
NUM_STEPS = 5
"""Steps of curvature between knots, where the shape is a spline: c at the first knot and these, 1/m."""

_SQUARE, _CUBE = KNOT_SPACING / 2, KNOT_SPACING**2 / 6  # heading and bend of a unit ramp, one spacing on


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


def road_curve(z: Tensor, shape: Tensor, phase: Tensor | None) -> RoadCurve:
    """Compute the middle line of the road, with zero bend and heading at Z = 0.

    Source: (J3).

    Args:
        z: (B, M) m.
        shape: (B, 2), c0 and c1 of a clothoid; with a phase (B, 1 + NUM_STEPS), curvature at the first knot
            and its steps from knot to knot.
        phase: (B,) m, how far the first knot lies behind the camera, or None.

    Returns:
        bend, heading and curvature at z.
    """
    if phase is None:
        c0, c1 = (part.unsqueeze(-1) for part in shape.unbind(-1))
        return RoadCurve(z * z * (c0 / 2 + c1 * z / 6), z * (c0 + c1 * z / 2), c0 + c1 * z)
    return _spline_curve(z, shape, phase)


def _spline_curve(z: Tensor, shape: Tensor, phase: Tensor) -> RoadCurve:
    """The curve of a curvature that is linear between knots: its slope changes at each knot."""
    past = _past_knots(z, phase)
    square = past * past
    steps = shape[:, 1:]
    changes = (pad(steps, (0, 1)) - pad(steps, (1, 0))).unsqueeze(1)  # (B, 1, 1 + NUM_STEPS), of the slope
    first, (turned, moved) = shape[:, :1], _behind(phase)
    turned, moved = turned * steps[:, :1], moved * steps[:, :1]
    turning = first * z
    by_square, by_cube = changes.mul(_SQUARE), changes.mul(_CUBE)
    return RoadCurve(
        bend=(z * (0.5 * turning - turned) - moved) + torch.bmm(by_cube, square * past).squeeze(1),
        heading=(turning - turned) + torch.bmm(by_square, square).squeeze(1),
        curvature=first + torch.bmm(changes, past).squeeze(1),
    )


def _past_knots(z: Tensor, phase: Tensor) -> Tensor:
    """Distances (B, 1 + NUM_STEPS, M) past the knots, in knot spacings, 0 before a knot."""
    knots = torch.arange(1 + NUM_STEPS, dtype=z.dtype, device=z.device).unsqueeze(-1)
    past = ((z + phase.unsqueeze(-1)) / KNOT_SPACING).unsqueeze(1) - knots
    return past.clamp(min=0.0)


def _behind(phase: Tensor) -> tuple[Tensor, Tensor]:
    """Heading and bend (B, 1) at the camera for a unit first step: what lies behind it, of that step only."""
    first = (phase / KNOT_SPACING).unsqueeze(-1)
    square = first * first
    return _SQUARE * square, _CUBE * (square * first)


def road_basis(z: Tensor, phase: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Compute bend, heading and curvature for a unit value of every shape parameter, each (B, K, M).

    Args:
        z: (B, M) m.
        phase: as in :func:`road_curve`.
    """
    return _polynomial(z) if phase is None else _spline(z, phase)


def _polynomial(z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Bend, heading and curvature at (B, M) for unit c0 and unit c1, each (B, 2, M)."""
    half = 0.5 * z * z
    bend, heading = torch.stack([half, half * z / 3], 1), torch.stack([z, half], 1)
    return bend, heading, torch.stack([torch.ones_like(z), z], 1)


def _spline(z: Tensor, phase: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Bend, heading and curvature at (B, M) for a unit curvature and unit steps, each (B, 1 + NUM_STEPS, M).

    A step rises from 0 at its knot to 1 at the next, so it is the difference of the ramps from both. Bend and
    heading are zero at Z = 0.
    """
    past, one = _past_knots(z, phase), z.unsqueeze(1)
    square = past * past
    turned, moved = (part.unsqueeze(-1) for part in _behind(phase))
    rise, heading, bend = (
        part[:, :-1] - part[:, 1:] for part in (past, _SQUARE * square, _CUBE * (square * past))
    )
    head_bend = bend[:, :1] - (moved + turned * one)
    return (
        torch.cat([0.5 * one * one, head_bend, bend[:, 1:]], 1),
        torch.cat([one, heading[:, :1] - turned, heading[:, 1:]], 1),
        torch.cat([torch.ones_like(one), rise], 1),
    )
