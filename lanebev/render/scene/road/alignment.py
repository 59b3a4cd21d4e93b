"""The road's course: centreline with clothoids, elevation, and where rays meet road and walls.

Local road frame: origin on the road below the camera, X right, Z along the road there. All tables have
the same knots in Z, dense near the camera, so a look-up is arithmetic and two gathers.
"""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

KNOT_SCALE, KNOT_GROWTH, NUM_KNOTS = 20.0, 0.02, 232  # 0.4 m apart at the camera, 2 % of Z far out; 2 km
FINE = 4  # steps of the integration between two knots
BEYOND = 1e6  # m
MAX_HEADING = 0.9  # rad; beyond it the centreline would not be a function of Z


def knots(count: int = NUM_KNOTS, growth: float = KNOT_GROWTH) -> Tensor:
    """Return the knots, (K,) m, float64."""
    return KNOT_SCALE * torch.expm1(torch.arange(count, dtype=torch.float64) * growth)


@lru_cache(maxsize=8)
def _knots_on(device: torch.device) -> Tensor:
    """Return the knots on a device, (K,) m, float32."""
    return knots().float().to(device)


def _at(table: Tensor, index: Tensor) -> Tensor:
    """Return the entries of a table (K,) at indices of any shape."""
    return table.index_select(0, index.flatten()).view(index.shape)


class Alignment(NamedTuple):
    """Tables over the knots in Z, each (B, K).

    Attributes:
        x: m, lateral position of the centreline through the camera's foot.
        slope: dX/dZ.
        bend: d²X/dZ², 1/m.
        arc: m, arc length from the camera's foot.
        curvature: 1/m, positive to the right.
        elevation: m above the tangent plane.
    """

    x: Tensor
    slope: Tensor
    bend: Tensor
    arc: Tensor
    curvature: Tensor
    elevation: Tensor


def arc_nodes() -> Tensor:
    """Return the arc lengths of :func:`build_alignment`'s curvature and elevation, (A,) m, float64."""
    return knots(NUM_KNOTS * FINE, KNOT_GROWTH / FINE)


def build_alignment(curvature: Tensor, elevation: Tensor) -> Alignment:
    """Compute a road's alignment by integrating its curvature.

    Args:
        curvature: (B, A) 1/m at :func:`arc_nodes`.
        elevation: (B, A) m at :func:`arc_nodes`, zero with zero slope at the first.

    Returns:
        float32 tables. Where the heading would leave ±0.9 rad the road goes on straight.
    """
    arc = arc_nodes()
    step = arc.diff()
    heading = _integral(curvature.double(), step)
    curvature = torch.where(heading.abs() < MAX_HEADING, curvature.double(), 0.0)
    heading = _integral(curvature, step)
    x, z = _integral(heading.sin(), step), _integral(heading.cos(), step)

    target = knots().expand(len(curvature), -1).contiguous()
    right = torch.searchsorted(z.contiguous(), target).clamp(1, z.shape[1] - 1)
    z0, z1 = z.gather(1, right - 1), z.gather(1, right)
    part = (target - z0) / (z1 - z0)

    def at_knots(table: Tensor) -> Tensor:
        low, high = table.gather(1, right - 1), table.gather(1, right)
        return low + (high - low) * part

    psi, kappa = at_knots(heading), at_knots(curvature)
    # second order within a fine step: x is integrated, not merely interpolated
    x0, psi0 = x.gather(1, right - 1), heading.gather(1, right - 1)
    x_knot = x0 + (target - z0) * 0.5 * (psi0.tan() + psi.tan())
    tables = (
        x_knot,
        psi.tan(),
        kappa / psi.cos() ** 3,
        at_knots(arc.expand_as(x).contiguous()),
        kappa,
        at_knots(elevation.double()),
    )
    return Alignment(*(t.float() for t in tables))


def _integral(values: Tensor, step: Tensor) -> Tensor:
    area = (0.5 * (values[:, 1:] + values[:, :-1]) * step).cumsum(1)
    return torch.nn.functional.pad(area, (1, 0))


class RoadPoint(NamedTuple):
    """Road coordinates of points, each (B, N).

    Attributes:
        along: m, arc length from the camera's foot.
        across: m, right of the centreline through the camera's foot.
        sin: sine of the road's heading there.
        cos: cosine of the road's heading there.
        curvature: 1/m.
    """

    along: Tensor
    across: Tensor
    sin: Tensor
    cos: Tensor
    curvature: Tensor


def _nearest_knot(z: Tensor) -> tuple[Tensor, Tensor]:
    """Return the index of the nearest knot and the distance from it, (B, N) both."""
    index = (z.clamp(min=0) * (1 / KNOT_SCALE)).log1p().mul(1 / KNOT_GROWTH).round().clamp(0, NUM_KNOTS - 1)
    index = index.long()
    return index, z - _at(_knots_on(z.device), index)


def _centreline(alignment: Alignment, z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Compute x, sin and cos of the heading, arc and curvature at z, by Taylor expansion from a knot."""
    index, dz = _nearest_knot(z)
    slope, bend = alignment.slope.gather(1, index), alignment.bend.gather(1, index)
    x = alignment.x.gather(1, index) + dz * (slope + 0.5 * bend * dz)
    here = slope + bend * dz
    cos = (1 + here * here).rsqrt()
    mean = slope + 0.5 * bend * dz
    arc = alignment.arc.gather(1, index) + dz * (1 + mean * mean).sqrt()
    return x, here * cos, cos, arc, alignment.curvature.gather(1, index)


def road_from_local(alignment: Alignment, x: Tensor, z: Tensor) -> RoadPoint:
    """Convert local X, Z to arc length and offset; exact where the curvature is constant over the offset.

    Args:
        alignment: (B, K) tables.
        x: (B, N) m.
        z: (B, N) m.
    """
    x_centre, sin, cos, arc, curvature = _centreline(alignment, z)
    ahead, aside = (x - x_centre) * sin, (x - x_centre) * cos
    lever = 1 - curvature * aside
    across = (2 * aside - curvature * (aside * aside + ahead * ahead)) / (
        1 + (lever * lever + (curvature * ahead) ** 2).sqrt()
    )
    along = arc + ahead / lever
    turn = curvature * (along - arc)  # the heading changes from the point at z to the foot of the normal
    return RoadPoint(along, across, sin + turn * cos, cos - turn * sin, curvature)


def local_from_road(alignment: Alignment, z_centre: Tensor, across: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Convert points beside the centreline at z_centre to local X, Z, and return their arc length.

    Args:
        alignment: (B, K) tables.
        z_centre: (B, N) m, where the normal leaves the centreline.
        across: (B, N) m to the right.
    """
    x, sin, cos, arc, _ = _centreline(alignment, z_centre)
    return x + across * cos, z_centre - across * sin, arc


def z_from_arc(alignment: Alignment, arc: Tensor) -> Tensor:
    """Convert arc length (B, N) to Z of the centreline; behind the camera the road is straight."""
    index = torch.searchsorted(alignment.arc.contiguous(), arc.contiguous()).clamp(1, NUM_KNOTS - 1)
    low, high = alignment.arc.gather(1, index - 1), alignment.arc.gather(1, index)
    z = _knots_on(arc.device)
    part = (arc - low) / (high - low)
    return torch.where(arc < 0, arc, z[index - 1] + part * (z[index] - z[index - 1]))


def elevation_at(alignment: Alignment, z: Tensor) -> Tensor:
    """Compute the elevation above the tangent plane, (B, N) m, linear between knots."""
    position = (z.clamp(min=0) * (1 / KNOT_SCALE)).log1p() * (1 / KNOT_GROWTH)
    index = position.long().clamp(0, NUM_KNOTS - 2)
    knot = _knots_on(z.device)
    part = ((z - _at(knot, index)) * _at(1 / knot.diff(), index)).clamp(0, 1)
    return alignment.elevation.gather(1, index) + alignment.elevation.diff(dim=1).gather(1, index) * part


def lowest_slopes(alignment: Alignment, height: Tensor) -> Tensor:
    """Compute the least fall per metre ahead of rays from the camera to the road up to each knot, (B, K - 1).

    Not increasing; a ray meets the road if and only if it falls by more than the last.

    Args:
        alignment: (B, K) tables.
        height: (B,) m, of the camera.
    """
    z = _knots_on(height.device)
    return ((height[:, None] - alignment.elevation[:, 1:]) / z[1:]).cummin(1).values


def ground_hit(alignment: Alignment, height: Tensor, ray_y: Tensor) -> tuple[Tensor, Tensor]:
    """Compute where rays meet the road surface.

    Args:
        alignment: (B, K) tables.
        height: (B,) m, of the camera.
        ray_y: (B, N) fall of the ray per metre forward, more than the last of :func:`lowest_slopes`.

    Returns:
        (B, N) Z, m; and (B, N) the road's own slope dE/dZ there.
    """
    z = _knots_on(height.device)
    lowest = lowest_slopes(alignment, height)
    index = torch.searchsorted(-lowest, -ray_y).clamp(max=NUM_KNOTS - 2)
    rise = alignment.elevation.diff(dim=1) / z.diff()
    slope, start = rise.gather(1, index), alignment.elevation.gather(1, index)
    return (height[:, None] - start + _at(z, index) * slope) / (ray_y + slope), slope


def hidden_by_crest(alignment: Alignment, height: Tensor, z: Tensor) -> Tensor:
    """Return whether the road at z is behind a crest, (B, N) bool."""
    table, lowest = _knots_on(z.device), lowest_slopes(alignment, height)
    index = torch.searchsorted(table, z.contiguous()).clamp(1, NUM_KNOTS - 1) - 1
    before = lowest.gather(1, (index - 1).clamp(min=0))
    drop = (height[:, None] - elevation_at(alignment, z)) / z.clamp(min=0.1)
    return (index > 0) & (drop > before + 1e-4)


class WallTable(NamedTuple):
    """A vertical wall that follows the road, at the knots, (B, K) each.

    Attributes:
        x: m.
        z: m.
        arc: m.
        lowest: least move to the wall's side per metre forward of any ray that meets the wall by this knot.
        side: (B,) 1 on the right, -1 on the left.
    """

    x: Tensor
    z: Tensor
    arc: Tensor
    lowest: Tensor
    side: Tensor


def wall_table(alignment: Alignment, across: Tensor) -> WallTable:
    """Compute the tables of walls by which :func:`wall_hit` intersects rays.

    Args:
        alignment: (B, K) tables.
        across: (B,) m, the wall's place right of the centreline through the camera's foot; not zero.
    """
    z_centre = _knots_on(across.device).expand_as(alignment.x)
    x, z, arc = local_from_road(alignment, z_centre, across[:, None].expand_as(z_centre))
    side = across.sign()
    needed = torch.where(z > 0.05, x * side[:, None] / z.clamp(min=0.05), 1e4)
    return WallTable(x, z, arc, needed.cummin(1).values, side)


def wall_hit(table: WallTable, ray_x: Tensor) -> tuple[Tensor, Tensor]:
    """Compute where rays meet a wall.

    Args:
        table: table of the walls.
        ray_x: (B, N) the ray's move to the right per metre forward.

    Returns:
        (B, N) Z, m, at least ``BEYOND`` where the ray meets nothing; and (B, N) arc length, m.
    """
    index = torch.searchsorted(-table.lowest, -(ray_x * table.side[:, None]))
    hit = (index < NUM_KNOTS) & (index > 0)
    index = index.clamp(1, NUM_KNOTS - 1)
    x0, z0, arc0 = (t.gather(1, index - 1) for t in (table.x, table.z, table.arc))
    x1, z1, arc1 = (t.gather(1, index) for t in (table.x, table.z, table.arc))
    gradient = (x1 - x0) / (z1 - z0)
    apart = ray_x - gradient
    hit &= apart.abs() > 1e-6
    share = hit.view(torch.uint8).float()  # arithmetic instead of torch.where: a tenth of its time on a CPU
    z_hit = (x0 - gradient * z0) * share / (apart * share + (1 - share))
    part = ((z_hit - z0) / (z1 - z0)).clamp(0, 1)
    return z_hit + (1 - share) * BEYOND, arc0 + part * (arc1 - arc0)
