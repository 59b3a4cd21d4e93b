"""The ground of all kinds of road, over that of a plain one."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.render.raster.markings import dash_coverage, stripe_coverage
from lanebev.render.raster.street import roadside, street_paint, strips, tracks
from lanebev.render.raster.winter import snow_cover
from lanebev.render.scene.works import NUM_OLD, Works
from lanebev.render.scene.world import World


def varied_ground(
    world: World,
    eye_across: Tensor,
    eye_height: Tensor,
    along: Tensor,
    across: Tensor,
    reach_along: Tensor,
    reach_across: Tensor,
    albedo: Tensor,
    paved: Tensor,
    painted: Tensor,
    blotch: Tensor,
) -> tuple[Tensor, Tensor]:
    """The ground of all kinds of road over that of a plain one.

    Args:
        world: what there is.
        eye_across: (B,) m, the camera's place.
        eye_height: (B,) m.
        along: (B, N) m in the world.
        across: (B, N) m in the layout's frame.
        reach_along: (B, N) m per pixel.
        reach_across: (B, N) m per pixel.
        albedo: (B, 3, N) linear reflectance of the plain road and its verge.
        paved: (B, N) share of the pixel on the carriageway.
        painted: (B, N) share of it under the boundaries' paint.
        blotch: (B, N) slow noise.

    Returns:
        albedo and painted, as these kinds have them.
    """
    layout, pavement = world.layout, world.pavement
    reach = (reach_along, reach_across)
    if somewhere(world.kinds.city):
        street = world.street
        beside, share = roadside(street, pavement, along, across, *reach, eye_across, eye_height)
        albedo = albedo + (beside - albedo) * (share * (1 - paved))[:, None]
        coloured = strips(street, layout, pavement, across, reach_across, albedo)
        albedo = albedo + (coloured - albedo) * (1 - painted)[:, None]
        albedo = tracks(street, across, reach_across, albedo)
        marks = street_paint(street, layout, pavement, along, across, *reach, blotch)
        albedo = albedo + (street.paint[..., None] - albedo) * marks[:, None]
        painted = torch.maximum(painted, marks)
    if somewhere(world.kinds.works):
        old, scars = old_lines(world.works, along, across, *reach)
        old, scars = (part * paved * (1 - painted) for part in (old, scars))
        albedo = albedo * (1 - scars)[:, None]
        albedo = albedo + (world.works.colour[..., None] - albedo) * old[:, None]
        painted = torch.maximum(painted, old)
    if somewhere(world.kinds.snow):
        cover = snow_cover(world.winter, layout, pavement, along, across, *reach, blotch)
        field = world.winter.on[:, None] * world.winter.verge[:, None] * (1 - paved)
        cover = torch.maximum(cover * paved, field * (0.85 + 0.15 * blotch).clamp(0, 1))
        albedo = albedo + (world.winter.colour[..., None] - albedo) * cover[:, None]
        painted = painted * (1 - cover)
    return albedo, painted


def somewhere(mask: Tensor) -> bool:
    """Whether a mask holds anywhere, on the CPU, where asking costs nothing; elsewhere it is taken to."""
    return mask.device.type != "cpu" or bool(mask.any())


def old_lines(
    works: Works, along: Tensor, across: Tensor, reach_along: Tensor, reach_across: Tensor
) -> tuple[Tensor, Tensor]:
    """Coverage by lines that are not in force, and darkening where some were taken off, (B, N) both."""
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
