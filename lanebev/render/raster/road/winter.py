"""Snow over the ground of a road."""

import torch
from torch import Tensor

from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.noise import CLOUD, SECOND, sample_grain, sample_noise, smoothstep
from lanebev.render.raster.road.surface import count_below, nearest_slot
from lanebev.render.rows import take_rows
from lanebev.render.scene.places.winter import Winter
from lanebev.render.scene.road.layout import MAX_BOUNDARIES, Layout, presence
from lanebev.render.scene.road.pavement import Pavement
from lanebev.render.scene.world import Scene


def snow_cover(winter: Winter, layout: Layout, pavement: Pavement, ground: Ground, blotch: Tensor) -> Tensor:
    """Compute the share of a pixel under snow, (B, N); none where a boundary's paint is visible.

    Args:
        winter: the snow.
        layout: the boundaries.
        pavement: its edges.
        ground: (B, N) points.
        blotch: (B, N) slow noise.
    """
    _, along, across, reach_along, reach_across = ground
    torn = sample_noise(CLOUD, along / 47.0, across / 23.0)
    wave = winter.ragged[:, None] * (0.5 * blotch + 0.4 * torn)
    inward = torch.minimum(
        across - pavement.left[:, None] - winter.edge[:, :1],
        pavement.right[:, None] - across - winter.edge[:, 1:],
    )
    soft = 0.12 + reach_across
    edge = smoothstep(soft, -soft, inward + wave)

    slot = nearest_slot(layout, across)
    there = layout.exists.gather(1, slot)
    here = presence(layout, slot, along) * there
    distance = (across - layout.across.gather(1, slot)).abs()
    ridge = smoothstep(soft, -soft, distance - winter.line[:, None] - 0.6 * wave) * (1 - here) * there

    lane = (count_below(layout.across, across) - 1).clamp(0, MAX_BOUNDARIES - 2)
    middle = 0.5 * (layout.across.gather(1, lane) + layout.across.gather(1, lane + 1))
    wheel = ((across - middle).abs() - 0.8).abs() - winter.track[:, None]
    patchy = smoothstep(-0.6, 0.8, blotch + 0.6 * sample_noise(SECOND, along / 19.0, across / 7.0))
    film = winter.film[:, None] * smoothstep(-0.15, 0.25, wheel) * patchy
    grain = sample_grain(along / 9.0, across / 9.0) / (1 + reach_along / 0.08)
    bare = 1 - here * smoothstep(0.55, 0.3, distance)  # wind and salt keep what is labelled in sight
    cover = torch.maximum(edge, torch.maximum(ridge, film)) * bare
    return (cover * (0.9 + 0.15 * grain)).clamp(0, 1) * winter.on[:, None]


def snow_ground(
    scene: Scene, row: Tensor, ground: Ground, albedo: Tensor, paved: Tensor, painted: Tensor, blotch: Tensor
) -> tuple[Tensor, Tensor]:
    """Put snow on the ground; arguments as of :func:`~lanebev.render.raster.road.street.city_ground`."""
    winter, layout = take_rows(scene.world.winter, row), take_rows(scene.world.layout, row)
    pavement = take_rows(scene.world.pavement, row)
    cover = snow_cover(winter, layout, pavement, ground, blotch)
    field = winter.on[:, None] * winter.verge[:, None] * (1 - paved)
    cover = torch.maximum(cover * paved, field * (0.85 + 0.15 * blotch).clamp(0, 1))
    return albedo + (winter.colour[..., None] - albedo) * cover[:, None], painted * (1 - cover)
