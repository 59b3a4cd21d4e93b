"""The middle line of the road: its points and headings along the arc, of a curvature that is given."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.tensors import constant, made_once

KNOT_SPACING = 5.0  # m
NUM_STEPS = 10
"""Steps of curvature between knots, where the shape is a spline: c at the first knot and these, 1/m."""

_SPACING = 2.5  # m between nodes
_NODES = 85  # up to 210 m
_LARGEST_HEADING = 1.2  # rad; from there on the middle line is taken as straight
_LEAST_RATIO = 0.3  # of the distance from the centre of curvature to the radius, in a step along the arc
_HALF = KNOT_SPACING / 2  # heading of a unit step, one spacing past its knot


class Road(NamedTuple):
    """The middle line of the road, which begins at the camera in the direction of Z.

    Attributes:
        nodes: (B, 5, G), at points ``_SPACING`` apart along the arc: heading (rad, positive to the right), X,
            Z (m), curvature (1/m) and its rate up to the next (1/m²).
        origin: (B, 1) m, arc from the first node to the camera.
        spline: whether the shape is a spline, else a clothoid.
    """

    nodes: Tensor
    origin: Tensor
    spline: bool


class RoadPoints(NamedTuple):
    """Points of the road's middle line.

    Attributes:
        arc: (B, M) m, from the camera.
        x: (B, M) m, right of the camera.
        z: (B, M) m, ahead.
        sin: (B, M), of the heading.
        cos: (B, M), likewise.
        curvature: (B, M) 1/m.
        turned: (B, M) rad, change of the heading since the node before.
    """

    arc: Tensor
    x: Tensor
    z: Tensor
    sin: Tensor
    cos: Tensor
    curvature: Tensor
    turned: Tensor


def road_shape(shape: Tensor, phase: Tensor | None) -> Road:
    """Compute the middle line of a shape.

    Source: (J3). The curvature is linear between nodes, so the heading is exact; X and Z are summed over the
    intervals between nodes, each a chord in the direction of its mean heading.

    Args:
        shape: (B, 2), c0 (1/m) and c1 (1/m²) of a clothoid; with a phase (B, 1 + NUM_STEPS), curvature at
            the first knot and its steps from knot to knot.
        phase: (B,) m, how far the first knot lies behind the camera, or None.
    """
    spline = phase is not None
    origin = torch.zeros_like(shape[:, :1]) if phase is None else phase.unsqueeze(-1)
    tables = _by_unit_shape(spline, shape.dtype, shape.device)
    before = shape.unsqueeze(1) @ _heading_by_shape(origin, torch.zeros_like(origin), spline)  # (B, 1, 1)
    headings, bent = (shape @ tables).movedim(0, 1).split(2, dim=1)  # (B, 2, G) each
    headings = headings - before  # at the nodes, and the means between them
    straight = headings[:, :1].abs() > _LARGEST_HEADING
    headings = headings.clamp(-_LARGEST_HEADING, _LARGEST_HEADING)
    mean, turned = headings[:, 1:, :-1], headings[:, :1].diff(dim=-1)
    chords = _SPACING * _chord(turned) * torch.cat([mean.sin(), mean.cos()], dim=1)
    places = pad(chords.cumsum(-1), (1, 0))
    nodes = torch.cat([headings[:, :1], places, bent.masked_fill(straight, 0.0)], dim=1)
    road = Road(nodes, origin, spline)
    camera = road_points(torch.zeros_like(origin), road)
    moved = torch.stack([camera.x, camera.z], dim=1)  # (B, 2, 1)
    return road._replace(nodes=nodes - pad(moved, (0, 0, 1, 2)))


def road_points(arc: Tensor, road: Road) -> RoadPoints:
    """Compute the points of the middle line at arcs (B, M) m from the camera."""
    cell, way = _cells(arc, road)
    heading, x, z, curvature, rate = road.nodes.gather(2, cell.unsqueeze(1).expand(-1, 5, -1)).unbind(1)
    turned = way * torch.addcmul(curvature, rate, way, value=0.5)
    mean = torch.addcmul(heading, way, torch.addcmul(curvature, rate, way, value=1 / 3), value=0.5)
    heading, chord = heading + turned, way * _chord(turned)
    return RoadPoints(
        arc=arc,
        x=torch.addcmul(x, chord, mean.sin()),
        z=torch.addcmul(z, chord, mean.cos()),
        sin=heading.sin(),
        cos=heading.cos(),
        curvature=torch.addcmul(curvature, rate, way),
        turned=turned,
    )


def arc_beside(x: Tensor, z: Tensor, near: RoadPoints) -> Tensor:
    """Compute the arc (B, M) m at which points are beside the middle line, by a Newton step.

    Source: the line from a point of the road to the nearest one of its middle line is perpendicular to it.

    Args:
        x: (B, M) m, of points of the road.
        z: (B, M) m, likewise.
        near: points of the middle line, from which the step starts.
    """
    right, ahead = x - near.x, z - near.z
    lateral = torch.addcmul(right * near.cos, ahead, near.sin, value=-1)
    along = torch.addcmul(right * near.sin, ahead, near.cos)
    arc = near.arc + along / (1 - near.curvature * lateral).clamp(min=_LEAST_RATIO)
    return arc.clamp(-KNOT_SPACING, _SPACING * (_NODES - 1))


def lateral_by_shape(at: RoadPoints, road: Road) -> Tensor:
    """Compute the derivative of the lateral position of the middle line by the parameters of its shape.

    Source: with ψ the heading and ψ_j its derivative by parameter j, the point at the arc s moves across the
    line by ∫₀ˢ cos(ψ(s) - ψ(u)) ψ_j(u) du, here the sum over the intervals of :func:`road_shape`.

    Returns:
        (B, K, M) m.
    """
    zero = torch.zeros_like(road.origin)
    before = _heading_by_shape(road.origin, zero, road.spline)  # (B, K, 1)
    heading, mean, _, _ = _by_unit_shape(road.spline, at.arc.dtype, at.arc.device)
    turned, longer = (mean - before)[..., :-1], heading.diff(dim=-1)  # (…, K, G - 1), of the intervals
    turn, right, ahead = road.nodes[:, :3].diff(dim=-1).unsqueeze(2).unbind(1)  # (B, 1, G - 1)
    longer = -turn / 12 * longer  # of a chord
    sums = torch.cat([ahead * turned + right * longer, ahead * longer - right * turned], dim=1).cumsum(-1)
    sums = pad(sums, (1, 0))  # (B, 2 K, G)
    nodes = torch.cat([road.nodes[:, 1:3], sums], dim=1)

    def moved(points: RoadPoints) -> tuple[Tensor, ...]:
        cell, way = _cells(points.arc, road)
        sizes = [1, 1, before.shape[1], before.shape[1]]
        of_nodes = nodes.gather(2, cell.unsqueeze(1).expand(-1, sum(sizes), -1))
        x, z, across, along = of_nodes.split_with_sizes(sizes, dim=1)
        # a chord is shorter the more it turns; that moves its end across as a mean heading farther on does
        back = way * (0.5 - points.turned.square() / 24)
        turn = _heading_by_shape(points.arc + road.origin - back, way, road.spline) - before
        return across, along, turn, points.x.unsqueeze(1) - x, points.z.unsqueeze(1) - z

    across, along, turn, right, ahead = moved(road_points(zero, road))
    first, second = torch.addcmul(across, ahead, turn), torch.addcmul(along, right, turn, value=-1)
    across, along, turn, right, ahead = moved(at)
    sin, cos = at.sin.unsqueeze(1), at.cos.unsqueeze(1)
    by_nodes = torch.addcmul(cos * (across - first), sin, along - second, value=-1)
    return torch.addcmul(by_nodes, torch.addcmul(cos * ahead, sin, right), turn)


def _chord(turned: Tensor) -> Tensor:
    """Compute the ratio of chord to arc, to second order in the angle by which it turns, rad."""
    return torch.addcmul(torch.ones_like(turned), turned, turned, value=-1 / 24)


def _cells(arc: Tensor, road: Road) -> tuple[Tensor, Tensor]:
    """Return the node (B, M) before each arc (B, M) m, and the way (B, M) m from it."""
    u = arc + road.origin
    cell = (u / _SPACING).long().clamp(0, _NODES - 1)
    return cell, torch.add(u, cell, alpha=-_SPACING)


def _heading_by_shape(u: Tensor, width: Tensor, spline: bool) -> Tensor:
    """Compute the derivative of the mean heading of an interval by the shape.

    Args:
        u: (B, M) m, middle of the interval, from the first node; no knot is within an interval.
        width: (B, M) m, of the interval; 0 gives the heading at u.
        spline: see :class:`Road`.

    Returns:
        (B, K, M) m.
    """
    u, square = u.unsqueeze(1), (width * width / 12).unsqueeze(1)  # the mean of u² is u² + width² / 12
    if not spline:
        return torch.cat([u, 0.5 * torch.addcmul(square, u, u)], dim=1)
    knots = constant(tuple(map(float, range(1 + NUM_STEPS))), like=u)
    past = torch.add(-knots.unsqueeze(-1), u, alpha=1 / KNOT_SPACING).clamp(min=0.0)
    ramps = torch.addcmul(past * past, past.sign(), square, value=KNOT_SPACING**-2)
    return torch.cat([u, _HALF * (ramps[:, :-1] - ramps[:, 1:])], dim=1)


@made_once
def _by_unit_shape(spline: bool, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the derivatives by the shape at the nodes, (4, K, G).

    They are those of the heading at the node, of its mean up to the next one, of the curvature, and its rate.
    """
    nodes = _SPACING * torch.arange(_NODES, dtype=dtype, device=device).unsqueeze(0)
    width = torch.full_like(nodes, _SPACING)
    heading = _heading_by_shape(nodes, torch.zeros_like(nodes), spline)[0]
    mean = _heading_by_shape(nodes + 0.5 * _SPACING, width, spline)[0]
    if spline:
        knots = KNOT_SPACING * torch.arange(NUM_STEPS, dtype=dtype, device=device).unsqueeze(-1)
        others = ((nodes - knots) / KNOT_SPACING).clamp(0.0, 1.0)
    else:
        others = nodes
    curvature = torch.cat([torch.ones_like(nodes), others])
    rate = curvature.diff(dim=-1) / _SPACING
    return torch.stack([heading, mean, curvature, torch.cat([rate, rate[:, -1:]], dim=-1)])
