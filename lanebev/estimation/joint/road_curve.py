"""The middle line of the road: bend, heading and curvature at a distance, as a clothoid or as a spline."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

KNOT_SPACING = 10.0  # m
NUM_STEPS = 5
"""Steps of curvature between knots, where the shape is a spline: c at the first knot and these, 1/m."""


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
    """The curve of a curvature that is linear between knots, from the first knot, then from Z = 0."""
    table = (shape @ torch.as_tensor(_KNOT_VALUES).to(shape)).unflatten(-1, (4, 1 + NUM_STEPS))
    start = phase.unsqueeze(-1)
    beyond = torch.cat([z + start, start], dim=-1)  # (B, M + 1) m past the first knot; the last is the camera
    interval = (beyond / KNOT_SPACING).floor().clamp(0, NUM_STEPS)
    along = beyond - KNOT_SPACING * interval
    index = interval.long().unsqueeze(1).expand(-1, 4, -1)
    bend, heading, curvature, rate = table.gather(2, index).unbind(
        1
    )  # (B, M + 1) each, at the last knot passed
    bend = bend + along * (heading + along * (curvature / 2 + along * (rate / 6)))
    heading = heading + along * (curvature + along * (rate / 2))
    curvature = curvature + along * rate
    turned = heading[:, -1:]
    return RoadCurve(bend[:, :-1] - bend[:, -1:] - turned * z, heading[:, :-1] - turned, curvature[:, :-1])


def _knot_values() -> NDArray[np.float64]:
    """(K, 4 K): bend, heading, curvature and its rate at every knot, for unit shape parameters."""
    last = 1 + NUM_STEPS
    curvature = np.triu(np.ones((last, last)))  # [parameter, knot]
    rate = np.eye(last, k=-1) / KNOT_SPACING
    heading, bend = np.zeros((last, last)), np.zeros((last, last))
    for k in range(1, last):
        before, after = curvature[:, k - 1], curvature[:, k]
        heading[:, k] = heading[:, k - 1] + KNOT_SPACING * (before + after) / 2
        bend[:, k] = bend[:, k - 1] + KNOT_SPACING * heading[:, k - 1]
        bend[:, k] += KNOT_SPACING**2 * (before / 3 + after / 6)
    return np.concatenate([bend, heading, curvature, rate], axis=1)


_KNOT_VALUES = _knot_values()


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

    A step rises from 0 at its knot to 1 at the next. Bend and heading are zero at Z = 0.
    """
    knots = KNOT_SPACING * torch.arange(NUM_STEPS, dtype=z.dtype, device=z.device) - phase.unsqueeze(-1)
    past = z.unsqueeze(1) - knots.unsqueeze(-1)  # (B, NUM_STEPS, M)
    rise = (past / KNOT_SPACING).clamp(0.0, 1.0)
    beyond = (past - KNOT_SPACING).clamp(min=0.0)
    squared = rise * rise
    heading = (0.5 * KNOT_SPACING) * squared + beyond
    bend = (KNOT_SPACING**2 / 6) * (squared * rise) + (0.5 * KNOT_SPACING) * beyond + 0.5 * beyond * beyond
    first = (phase / KNOT_SPACING)[:, None, None]  # what lies behind the camera, of the first step only
    turned = 0.5 * KNOT_SPACING * first * first
    behind = KNOT_SPACING**2 / 6 * first**3 + turned * z.unsqueeze(1)
    head_bend, head_heading = bend[:, :1] - behind, heading[:, :1] - turned
    one = z.unsqueeze(1)
    return (
        torch.cat([0.5 * one * one, head_bend, bend[:, 1:]], 1),
        torch.cat([one, head_heading, heading[:, 1:]], 1),
        torch.cat([torch.ones_like(one), rise], 1),
    )
