"""Objects in a street's surface: tram rails, coloured cycle lanes, manhole covers, cuts."""

import torch
from torch import Tensor

from lanebev.render.raster.base.coverage import band, beyond, dash_coverage, stripe_coverage
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.noise import hash01, sample_grain
from lanebev.render.scene.places.street import Street
from lanebev.render.scene.road.layout import Layout
from lanebev.render.scene.road.pavement import Pavement

RAIL_GAUGE = 1.435  # m


def tracks(street: Street, ground: Ground, albedo: Tensor) -> Tensor:
    """Draw tram rails in their bed over a reflectance (B, 3, N)."""
    _, along, across, reach_along, reach_across = ground
    aside = across - street.tram.across[:, None]
    on = street.tram.strength[:, None]
    bed = (1 - beyond(aside.abs(), 1.25, reach_across)) * street.tram.bed[:, None] * (on > 0)
    stones = sample_grain(along / 11.0, across / 11.0) / (1 + reach_along / 0.1)
    sleeper = dash_coverage(along, 0.26, torch.full_like(along, 0.65), reach_along)
    ballast = street.tram.ballast[:, None] * (0.5 * stones - 0.45 * sleeper)
    surface = street.tram.colour[..., None] * (1 + 0.1 * stones + ballast).clamp(min=0.2)[:, None]
    albedo = albedo + (surface - albedo) * bed[:, None]
    rail = stripe_coverage(aside.abs() - 0.5 * RAIL_GAUGE, 0.07, reach_across)
    groove = stripe_coverage(aside.abs() - 0.5 * RAIL_GAUGE + 0.06, 0.05, reach_across)
    albedo = albedo + (0.32 - albedo) * (on * rail)[:, None]
    return albedo * (1 - 0.85 * on * groove)[:, None]


def strips(
    street: Street, layout: Layout, pavement: Pavement, across: Tensor, reach: Tensor, albedo: Tensor
) -> Tensor:
    """Draw coloured cycle lanes between the outer boundaries and the kerbs over a reflectance (B, 3, N)."""
    for side, low, high in strips_between(layout, pavement):
        cover = band(across, low + 0.15, high, reach) * street.strip_opacity[:, side, None]
        albedo = albedo + (street.strip_colour[:, side, :, None] - albedo) * cover[:, None]
    return albedo


def strips_between(layout: Layout, pavement: Pavement) -> list[tuple[int, Tensor, Tensor]]:
    """Return side and limits (B, 1), m, of the strips beside the outer boundaries."""
    last = layout.last_across()[:, None]
    return [(0, pavement.left[:, None], -0.15 + 0 * last), (1, last, pavement.right[:, None])]


def ironwork(street: Street, ground: Ground, lane: Tensor, inside: Tensor) -> Tensor:
    """Compute the darkening by manhole covers and by sealed cuts about old trenches, (B, N) in [0, 1].

    Args:
        street: how many there are.
        ground: (B, N) points.
        lane: (B, N) int64.
        inside: (B, N) m right of the lane's middle.
    """
    _, along, _, reach_along, reach_across = ground
    row = lane.to(along.dtype)
    cell = (along / 16.0).floor()
    middle = cell * 16.0 + 2 + 12 * hash01(cell, row, 21.0)
    ahead, aside = along - middle, inside - 1.6 * (hash01(cell, row, 22.0) - 0.5)
    reach = torch.hypot(reach_along * (ahead.abs() + 0.1), reach_across * (aside.abs() + 0.1))
    reach = reach / torch.hypot(ahead.abs() + 0.1, aside.abs() + 0.1)
    cover = ((0.33 - torch.hypot(ahead, aside)) / reach + 0.5).clamp(0, 1)
    ring = cover * (0.55 + 0.3 * (torch.hypot(ahead, aside) > 0.26))
    covers = ring * (hash01(cell, row, 23.0) < street.manholes[:, None])

    cell = (along / 23.0).floor()
    half = 1.0 + 7.0 * hash01(cell, row, 24.0)
    ahead = along - (cell + 0.5) * 23.0
    edge = 0.25 + 1.1 * hash01(cell, row, 25.0)
    long = stripe_coverage(inside.abs() - edge, 0.035, reach_across) * (ahead.abs() < half)
    short = stripe_coverage(ahead.abs() - half, 0.035, reach_along) * (inside.abs() < edge)
    cuts = torch.maximum(long, short) * (hash01(cell, row, 26.0) < street.cuts[:, None])
    return torch.maximum(covers, 0.75 * cuts)
