"""The ground of all kinds of road, over that of a plain one."""

import torch
from torch import Tensor

from lanebev.render.raster.base.blocks import make_blocks
from lanebev.render.raster.base.coverage import dash_coverage, stripe_coverage
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.select import put, take, take_channels
from lanebev.render.raster.road.roadside import roadside
from lanebev.render.raster.road.street import lane_coordinates, street_paint
from lanebev.render.raster.road.street_surface import ironwork, strips, tracks
from lanebev.render.raster.road.winter import snow_cover
from lanebev.render.rows import take_rows
from lanebev.render.scene.places.street import Street
from lanebev.render.scene.places.winter import Winter
from lanebev.render.scene.places.works import NUM_OLD, Works
from lanebev.render.scene.road.layout import Layout
from lanebev.render.scene.road.pavement import Pavement
from lanebev.render.scene.world import Scene


def add_roadside(scene: Scene, row: Tensor, ground: Ground, paved: Tensor, albedo: Tensor) -> None:
    """Put what is beside streets over a plain verge; changes the linear reflectance (3, T, N).

    Args:
        scene: B of them.
        row: (T,) int64, not decreasing, the scene of each line of points.
        ground: (T, N) points.
        paved: (T, N) share of the pixel on the carriageway.
        albedo: linear reflectance of the plain road and its verge.
    """
    beside = make_blocks(paved < 1, row=row, num_rows=len(scene.place.along))
    own = beside.row
    colours, share = roadside(
        take_rows(scene.world.street, own),
        take_rows(scene.world.pavement, own),
        Ground(*(take(t, beside.place) for t in ground)),
        scene.place.across[own],
        scene.lens.extrinsics.height[own],
    )
    planes = albedo.view(3, -1)
    under = take_channels(planes, beside.place)
    share = share * (1 - take(paved, beside.place))
    put(planes, beside.place, under + (colours.transpose(0, 1) - under) * share)


def add_street(
    scene: Scene, row: Tensor, ground: Ground, paved: Tensor, albedo: Tensor, painted: Tensor, blotch: Tensor
) -> None:
    """Put what is on streets over plain roads; changes the linear reflectance and the coverage by paint.

    Args:
        scene: B of them.
        row: (T,) int64, not decreasing, the scene of each line of points.
        ground: (T, N) points.
        paved: (T, N) share of the pixel on the carriageway.
        albedo: (3, T, N) linear reflectance of the plain road.
        painted: (T, N) share of the pixel under the boundaries' paint.
        blotch: (T, N) slow noise.
    """
    road = make_blocks(paved > 0, row=row, num_rows=len(scene.place.along))
    world, place = scene.world, road.place
    planes = albedo.view(3, -1)
    base, covered = city_ground(
        take_rows(world.street, road.row),
        take_rows(world.layout, road.row),
        take_rows(world.pavement, road.row),
        Ground(*(take(t, place) for t in ground)),
        take_channels(planes, place).transpose(0, 1),
        take(painted, place),
        take(blotch, place),
    )
    put(planes, place, base.transpose(0, 1))
    put(painted.view(1, -1), place, covered[None])


def city_ground(
    street: Street,
    layout: Layout,
    pavement: Pavement,
    ground: Ground,
    albedo: Tensor,
    painted: Tensor,
    blotch: Tensor,
) -> tuple[Tensor, Tensor]:
    """Put what is on a street over a plain road.

    Args:
        street: what it has.
        layout: its boundaries.
        pavement: its edges.
        ground: (B, N) points.
        albedo: (B, 3, N) linear reflectance of the plain road and of what is beside it.
        painted: (B, N) share of the pixel under the boundaries' paint.
        blotch: (B, N) slow noise.

    Returns:
        albedo and painted of the street.
    """
    coloured = strips(street, layout, pavement, ground.across, ground.reach_across, albedo)
    albedo = albedo + (coloured - albedo) * (1 - painted)[:, None]
    lane, inside, _, on_lane = lane_coordinates(layout, ground.across)
    dark = ironwork(street, ground, lane, inside) * on_lane * (1 - painted)
    albedo = tracks(street, ground, albedo * (1 - dark)[:, None])
    marks = street_paint(street, layout, pavement, ground, blotch)
    albedo = albedo + (street.paint[..., None] - albedo) * marks[:, None]
    return albedo, torch.maximum(painted, marks)


def works_ground(
    works: Works, ground: Ground, albedo: Tensor, paved: Tensor, painted: Tensor
) -> tuple[Tensor, Tensor]:
    """Put old lines on the ground of road works; for the arguments see :func:`city_ground`."""
    old, scars = old_lines(works, ground)
    old, scars = (part * paved * (1 - painted) for part in (old, scars))
    albedo = albedo * (1 - scars)[:, None]
    albedo = albedo + (works.colour[..., None] - albedo) * old[:, None]
    return albedo, torch.maximum(painted, old)


def snow_ground(
    winter: Winter,
    layout: Layout,
    pavement: Pavement,
    ground: Ground,
    albedo: Tensor,
    paved: Tensor,
    painted: Tensor,
    blotch: Tensor,
) -> tuple[Tensor, Tensor]:
    """Put snow on the ground; for the arguments see :func:`city_ground`."""
    cover = snow_cover(winter, layout, pavement, ground, blotch)
    field = winter.on[:, None] * winter.verge[:, None] * (1 - paved)
    cover = torch.maximum(cover * paved, field * (0.85 + 0.15 * blotch).clamp(0, 1))
    return albedo + (winter.colour[..., None] - albedo) * cover[:, None], painted * (1 - cover)


def old_lines(works: Works, ground: Ground) -> tuple[Tensor, Tensor]:
    """Compute the coverage by lines that are not valid, and the darkening by removed ones, (B, N) both."""
    _, along, across, reach_along, reach_across = ground
    paint, scars = torch.zeros_like(along), torch.zeros_like(along)
    ahead = along + works.phase[:, None]
    for line in range(NUM_OLD):
        sideways = works.drift[:, line, None] * (ahead % 400.0 - 100.0)
        distance = across - works.across[:, line, None] - sideways
        width = works.width[:, line, None].expand_as(distance)
        length, period = works.dash[:, line, :1], works.dash[:, line, 1:]
        stripe = stripe_coverage(distance, width, reach_across)
        stripe = stripe * dash_coverage(ahead, length, period, reach_along)
        paint = torch.maximum(paint, stripe * works.strength[:, line, None])
        beside = stripe_coverage(distance - 1.1, 1.6 * width, reach_across)
        beside = beside * dash_coverage(ahead + 4.0, length, period, reach_along)
        scars = torch.maximum(scars, beside * works.scar[:, line, None])
    return paint, scars
