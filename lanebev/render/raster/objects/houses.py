"""House fronts: plaster, windows, shops, roofs; and which windows are lit at night."""

import torch
from torch import Tensor

from lanebev.render.raster.base.colour import colour as colour_of
from lanebev.render.raster.base.noise import CLOUD, hash01, sample_noise, smoothstep
from lanebev.render.scene.objects.surroundings import Walls

_FLOOR = 3.1  # m


def _share(position: Tensor, length: Tensor | float, period: Tensor | float, footprint: Tensor) -> Tensor:
    """Compute the share of a pixel inside pieces of a length in the middle of every period, (B, N); all m."""
    distance = ((position / period) % 1.0 - 0.5).abs() * period
    inside = ((0.5 * length - distance) / footprint + 0.5).clamp(0, 1)
    coarse = smoothstep(0.4, 1.0, footprint / period)
    return inside + (length / period - inside) * coarse


def house_front(wall: Walls, along: Tensor, up: Tensor, footprint: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute reflectance, coverage and lit windows of a row of houses.

    Args:
        wall: (B,) of them.
        along: (B, N) m.
        up: (B, N) m above the road.
        footprint: (B, N) m per pixel.

    Returns:
        (B, 3, N); (B, N) in [0, 1]; (B, N) share of lit glass, the brighter the lighter.
    """
    colour, height, seed = wall.colour[..., None], wall.height[:, None], wall.seed[:, None]
    wide = 9.0 + 16.0 * seed
    house = (along / wide + 7 * seed).floor()
    row = (seed * 97.0).floor()
    tall = height * (0.65 + 0.4 * hash01(house, row, 1.0))
    gone = hash01(house, row, 2.0) < 0.16
    inside = (along / wide + 7 * seed - house) * wide
    tone = 0.65 + 0.6 * hash01(house, row, 3.0)
    warm = (hash01(house, row, 4.0) - 0.5)[:, None] * colour_of(colour, 0.5, 0.1, -0.4)
    stain = 1 + 0.08 * sample_noise(CLOUD, along / 40.0 + seed, up / 25.0)
    albedo = colour * (tone * stain)[:, None] * (1 + warm)

    spacing = 2.0 + 1.6 * hash01(house, row, 5.0)
    pane = spacing * (0.35 + 0.4 * hash01(house, row, 6.0))
    shop = (up < _FLOOR) & (hash01(house, row, 7.0) < 0.45)
    columns = torch.where(shop, _share(inside, 3.4, 4.2, footprint), _share(inside, pane, spacing, footprint))
    rows = torch.where(shop, _share(up, 2.3, _FLOOR, footprint), _share(up, 1.5, _FLOOR, footprint))
    below_roof = ((tall - 0.6 - up) / footprint + 0.5).clamp(0, 1)
    glass = columns * rows * below_roof
    tint = 0.03 + 0.10 * hash01((inside / spacing).floor(), (up / _FLOOR).floor(), 8.0)
    albedo = albedo + (tint[:, None] - albedo) * (0.92 * glass)[:, None]
    roof = (hash01(house, row, 9.0) < 0.5) * smoothstep(0.0, 0.1, up - 0.82 * tall)
    tiles = colour_of(albedo, 0.10, 0.05, 0.04) * (0.4 + 0.7 * tone)[:, None]
    albedo = albedo + (tiles - albedo) * roof[:, None]

    cell = (inside / torch.where(shop, 4.2, spacing)).floor() + 31.0 * house
    bright = hash01(cell, (up / _FLOOR).floor() + row, 10.0)
    lit = torch.where(shop, 1.6 * (bright > 0.25), (bright > 0.72) * (0.15 + 0.7 * hash01(cell, row, 11.0)))
    covered = ((tall - up) / footprint + 0.5).clamp(0, 1) * (up / footprint + 0.5).clamp(0, 1) * ~gone
    return albedo.clamp(0.01, 0.85), covered, glass * lit * (1 - roof)


def lit_windows(wall: Walls, along: Tensor, up: Tensor, footprint: Tensor) -> Tensor:
    """Compute the radiance of the windows of walls of houses at night, (B, 3, N)."""
    _, _, lit = house_front(wall, along, up, footprint)
    return (0.5 * wall.seed[:, None] * lit)[:, None] * colour_of(lit, 1.0, 0.8, 0.5)
