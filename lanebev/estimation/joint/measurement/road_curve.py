"""The middle line of the road: bend, heading and curvature at a distance, as a clothoid or as a spline."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.tensors import constant

KNOT_SPACING = 10.0  # m
NUM_STEPS = 5
"""Steps of curvature between knots, where the shape is a spline: c at the first knot and these, 1/m."""

_SQUARE, _CUBE = KNOT_SPACING / 2, KNOT_SPACING**2 / 6  # heading and bend of a unit ramp, one spacing on
_KNOTS = tuple(map(float, range(1 + NUM_STEPS)))  # knot spacings, from the first
_BEGIN_AND_END = tuple(
    tuple(float(k == j) - (k == j + 1) for k in range(1 + NUM_STEPS)) for j in range(NUM_STEPS)
)
_POWERS = ((3.0,), (2.0,), (1.0,), (0.0,))  # powers of the distance past a knot, for each coefficient
_BY_RAMP = tuple(  # the coefficients by a ramp from each knot on; the first is not ahead, see road_shape
    (factor * first, *[factor] * NUM_STEPS)
    for factor, first in ((_CUBE, 0.0), (_SQUARE, 0.0), (1.0, 1.0), (1 / KNOT_SPACING, 1.0))
)
_BY_CURVATURE = ((0.0,), (0.0,), (1.0,), (0.0,))


class Road(NamedTuple):
    """The middle line of the road, a polynomial of the third degree between knots.

    Attributes:
        pieces: (B, 4, K), the coefficients a (m), b, c (1/m) and m (1/m²) from each knot on: the bend is
            a + b Z + c Z²/2 + m Z³/6. A clothoid is one piece, a = b = 0, c and m the curvature and its rate.
        past: (B, 1 + NUM_STEPS, 1), how far the camera is past each knot, in knot spacings; a clothoid: None.
    """

    pieces: Tensor
    past: Tensor | None


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


def road_shape(shape: Tensor, phase: Tensor | None) -> Road:
    """Compute the coefficients of the road's middle line.

    Source: (J3), in which the knots that are passed count. Bend and heading are 0 at the camera, so the first
    knot, which is not ahead, changes only the curvature and its rate.

    Args:
        shape: (B, 2), c0 and c1 of a clothoid; with a phase (B, 1 + NUM_STEPS), curvature at the first knot
            and its steps from knot to knot.
        phase: (B,) m, how far the first knot lies behind the camera, or None.
    """
    if phase is None:
        return Road(pad(shape, (2, 0)).unsqueeze(-1), None)
    past = phase.unsqueeze(-1) / KNOT_SPACING - constant(_KNOTS, like=phase)  # (B, K)
    changes = shape[:, 1:] @ constant(_BEGIN_AND_END, like=shape)  # (B, K), of the slope at every knot
    ramps = past.unsqueeze(1).pow(constant(_POWERS, like=past)) * constant(_BY_RAMP, like=past)
    first = shape[:, :1, None] * constant(_BY_CURVATURE, like=shape)
    pieces = torch.add((ramps * changes.unsqueeze(1)).cumsum(-1), first)
    return Road(pieces, past.unsqueeze(-1))


def road_curve(z: Tensor, road: Road) -> RoadCurve:
    """Compute bend, heading and curvature of the road's middle line at z (B, M) m, bend and heading 0 at 0.

    Source: (J3).
    """
    a, b, c, m = _pieces_at(z, road).unbind(1)
    ramp = m * z
    return RoadCurve(
        bend=torch.addcmul(a, z, torch.addcmul(b, z, torch.add(c, ramp, alpha=1 / 3), value=0.5)),
        heading=torch.addcmul(b, z, torch.add(c, ramp, alpha=0.5)),
        curvature=c + ramp,
    )


def _pieces_at(z: Tensor, road: Road) -> Tensor:
    """Return the coefficients (B, 4, M) of the road's piece in which z (B, M) m lies; (B, 4, 1): clothoid."""
    if road.past is None:
        return road.pieces
    passed = torch.add(road.past[:, 0], z, alpha=1 / KNOT_SPACING).long().clamp(0, NUM_STEPS)
    return road.pieces.gather(2, passed.unsqueeze(1).expand(-1, 4, -1))


def curve_by_shape(z: Tensor, by_bend: Tensor, by_heading: Tensor, road: Road) -> tuple[Tensor, ...]:
    """Compute the derivative of a function of bend and heading by the shape parameters.

    Args:
        z: (B, M) m.
        by_bend: (B, M), its derivative by the bend.
        by_heading: (B, M), likewise.
        road: whose knots count.

    Returns:
        the rows (B, ..., M) of the K parameters in order, one or several a tensor.
    """
    first = z * torch.addcmul(by_heading, by_bend, z, value=0.5)
    if road.past is None:
        return first.unsqueeze(1), (0.5 * z * z * (by_bend * z / 3 + by_heading)).unsqueeze(1)
    past = torch.add(road.past, z.unsqueeze(1), alpha=1 / KNOT_SPACING).clamp_(min=0.0)
    of_square, of_cube = (_SQUARE * by_heading).unsqueeze(1), (_CUBE * by_bend).unsqueeze(1)
    ramps = torch.addcmul(of_square, of_cube, past).mul_(past * past)
    steps = ramps[:, :-1] - ramps[:, 1:]  # a step rises from 0 at its knot to 1 at the next
    heading, bend = _behind(road.past[:, 0])
    head = steps[:, 0] - torch.addcmul(by_bend * bend, heading, torch.addcmul(by_heading, by_bend, z))
    return first.unsqueeze(1), head.unsqueeze(1), steps[:, 1:]


def _behind(past: Tensor) -> tuple[Tensor, Tensor]:
    """Compute heading and bend (B, 1) at the camera for a unit first step, ``past`` spacings behind."""
    square = past * past
    return _SQUARE * square, _CUBE * (square * past)
