"""Old lines on the ground of road works."""

import torch
from torch import Tensor

from lanebev.render.raster.base.coverage import dash_coverage, stripe_coverage
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.rows import take_rows
from lanebev.render.scene.places.works import NUM_OLD, Works
from lanebev.render.scene.world import Scene


def works_ground(
    scene: Scene, row: Tensor, ground: Ground, albedo: Tensor, paved: Tensor, painted: Tensor, _: Tensor
) -> tuple[Tensor, Tensor]:
    """Put old lines on the ground; arguments as of :func:`~lanebev.render.raster.road.street.city_ground`."""
    works = take_rows(scene.world.works, row)
    old, scars = _old_lines(works, ground)
    old, scars = (part * paved * (1 - painted) for part in (old, scars))
    albedo = albedo * (1 - scars)[:, None]
    albedo = albedo + (works.colour[..., None] - albedo) * old[:, None]
    return albedo, torch.maximum(painted, old)


def _old_lines(works: Works, ground: Ground) -> tuple[Tensor, Tensor]:
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
