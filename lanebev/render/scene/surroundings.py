"""What stands beside and above the road: verge, walls that follow it, hills, sky."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.houses import house_front
from lanebev.render.raster.noise import (
    CLOUD,
    GRAIN,
    hash01,
    sample_grain,
    sample_line,
    sample_noise,
    smoothstep,
)
from lanebev.render.scene.sampler import Dice

NUM_WALLS = 6  # left and right, from the outside inwards
NOTHING, CONCRETE, RAIL, TREES, FENCE, SLOPE, HEDGE, HOUSES = range(8)

GREENS = [
    (0.05, 0.10, 0.025),
    (0.07, 0.12, 0.04),
    (0.035, 0.06, 0.02),
    (0.10, 0.13, 0.05),
    (0.03, 0.05, 0.025),
]
EARTHS = [(0.30, 0.24, 0.12), (0.36, 0.28, 0.14), (0.25, 0.20, 0.14), (0.22, 0.20, 0.17), (0.10, 0.15, 0.05)]


class Surroundings(NamedTuple):
    """Beside a road, (B, W) unless said otherwise.

    Attributes:
        wall_across: m, place of each wall in the layout's frame.
        wall_kind: int64, NOTHING, CONCRETE, RAIL, TREES, FENCE, SLOPE or HEDGE.
        wall_height: m.
        wall_colour: (B, W, 3) linear reflectance.
        wall_seed: shifts the noise.
        wall_toe: factor of a concrete barrier's sloping foot, which faces the sky; 1 is none.
        verge: (B, 2, 3) linear reflectance of the ground beside the pavement, left and right.
        zenith: (B, 3) linear radiance of the sky.
        skyline: (B, 3) linear radiance at the horizon.
        cloud: (B,) share of the sky.
        opposite: (B,) m, right edge of the opposite carriageway in the layout's frame; -infinite: none.
        opposite_colour: (B, 3) linear reflectance of it.
        hill_height: (B, 2) rad, two ridges.
        hill_colour: (B, 3).
    """

    wall_across: Tensor
    wall_kind: Tensor
    wall_height: Tensor
    wall_colour: Tensor
    wall_seed: Tensor
    wall_toe: Tensor
    verge: Tensor
    zenith: Tensor
    skyline: Tensor
    cloud: Tensor
    opposite: Tensor
    opposite_colour: Tensor
    hill_height: Tensor
    hill_colour: Tensor


def sample_surroundings(
    dice: Dice, left: Tensor, right: Tensor, grey: Tensor, opposite: Tensor, median: Tensor
) -> Surroundings:
    """Random surroundings of a pavement.

    Args:
        dice: the randomness.
        left: (B,) m, the pavement's left edge.
        right: (B,) m, its right edge.
        grey: (B,) in [0, 1], how overcast it is.
        opposite: (B,) m, the opposite carriageway's right edge; -infinite: none.
        median: (B,) bool, a concrete barrier stands along the left edge, darker than others.
    """
    far = [
        torch.where(dice.chance(0.75), dice.pick([0, 0, 0, 5, 0, 2.5, 0.5]), 0) for _ in range(2)
    ]  # trees, slopes, hedges
    middle = [torch.where(dice.chance(0.45), dice.pick([0, 0, 0, 3, 3, 2, 2]), 0) for _ in range(2)]
    near = [dice.pick([2, 6, 1.5]), dice.pick([4, 3, 2.5])]  # the median has a barrier more often
    kind = torch.stack([far[0], far[1], middle[0], middle[1], near[0], near[1]], dim=1)
    divided = opposite.isfinite()
    kind[:, 2] = torch.where(divided, NOTHING, kind[:, 2])
    kind[:, 4] = torch.where(median, CONCRETE, kind[:, 4])
    close = dice.uniform(0.05, 1.2, 2) * dice.pick_from([0.0, 1.0], 2)  # at the pavement's edge, or behind it
    close[:, 0] = torch.where(median, 0.0, close[:, 0])
    gap = torch.cat([dice.uniform(14, 45, 2), dice.uniform(4, 14, 2), close], dim=1)
    sides = torch.tensor([-1.0, 1.0] * 3)
    across = torch.stack([left, right] * 3, dim=1) + sides * gap

    across[:, 0] = torch.where(divided, torch.minimum(across[:, 0], opposite - 16), across[:, 0])
    low = dice.pick_from([0.55, 0.81, 0.9, 1.07, 1.4], NUM_WALLS)
    tall = dice.uniform(4.0, 14.0, NUM_WALLS)
    height = torch.where(kind == CONCRETE, low, tall)
    height = torch.where(kind == RAIL, dice.uniform(0.7, 0.85, NUM_WALLS), height)
    height = torch.where((kind == FENCE) | (kind == HEDGE), dice.uniform(1.2, 4.5, NUM_WALLS), height)
    green, earth = dice.pick_from(GREENS, NUM_WALLS), dice.pick_from(EARTHS, NUM_WALLS)
    paleness = dice.uniform(0.07, 0.5, NUM_WALLS, 1)
    paleness[:, 4] = torch.where(median[:, None], dice.uniform(0.04, 0.25, 1), paleness[:, 4])
    grey_wall = paleness * torch.tensor([1.0, 0.98, 0.94])
    colour = torch.where(((kind == TREES) | (kind == HEDGE))[..., None], green, grey_wall)
    colour = torch.where((kind == SLOPE)[..., None], earth, colour)
    colour = colour * dice.uniform(0.7, 1.3, NUM_WALLS, 1)

    blue = dice.uniform(0.18, 0.45, 1) * torch.tensor([0.30, 0.60, 1.0]) * (1 + dice.normal(0.06, 3))
    pale = torch.stack([dice.uniform(0.28, 0.52), dice.uniform(0.36, 0.54), dice.uniform(0.44, 0.6)], dim=1)
    overcast = dice.uniform(0.35, 0.7, 1) * torch.tensor([0.97, 1.0, 1.03])
    mix = grey[:, None]
    verge = torch.where(dice.chance(0.5, 1, 1), dice.pick_from(GREENS, 2), dice.pick_from(EARTHS, 2))
    return Surroundings(
        wall_across=across,
        wall_kind=kind,
        wall_height=height,
        wall_colour=colour,
        wall_seed=dice.uniform(0, 1, NUM_WALLS),
        wall_toe=torch.where(dice.chance(0.6, NUM_WALLS), dice.uniform(1.1, 3.0, NUM_WALLS), 1.0),
        verge=verge * dice.uniform(0.7, 1.3, 1, 1),
        zenith=blue * (1 - mix) + 0.9 * overcast * mix,
        skyline=pale * (1 - mix) + overcast * mix,
        cloud=torch.where(dice.chance(0.35), dice.uniform(0.0, 0.8), 0.0),
        opposite=opposite,
        opposite_colour=dice.uniform(0.06, 0.3, 1) * torch.tensor([1.0, 0.99, 0.96]),
        hill_height=torch.where(dice.chance(0.6, 2), dice.uniform(0.0, 0.09, 2), -0.05),
        hill_colour=(0.5 * dice.pick_from(GREENS) + 0.5 * dice.pick_from(EARTHS)),
    )


def verge_albedo(
    surroundings: Surroundings, along: Tensor, across: Tensor, reach: Tensor, patches: Tensor
) -> Tensor:
    """Linear reflectance of the ground beside the pavement, (B, 3, N)."""
    colour = torch.where(
        (across > 0)[:, None], surroundings.verge[:, 1, :, None], surroundings.verge[:, 0, :, None]
    )
    tufts = sample_grain(GRAIN, along / 19.0, across / 17.0) / (1 + reach / 0.15)
    shade = (1 + 0.3 * tufts + 0.22 * patches).clamp(0.25, 2.0)
    dry = colour.new_tensor([1.25, 1.05, 0.8])[:, None]
    colour = colour * shade[:, None] * torch.where((patches > 0.7)[:, None], dry, 1.0)
    inside = surroundings.opposite[:, None] - across  # m into the opposite carriageway
    other = (inside > 0) & (inside < 13.5)
    line = ((inside - 1.0).abs() < 0.1) | ((inside - 12.2).abs() < 0.1)
    line = line | (((inside - 4.7).abs() < 0.07) | ((inside - 8.4).abs() < 0.07)) & ((along % 12.0) < 3.0)
    grey = surroundings.opposite_colour[..., None] * (1 + 0.1 * tufts + 0.06 * patches)[:, None]
    grey = torch.where(line[:, None], 0.5, grey)
    return torch.where(other[:, None], grey, colour)


def wall_texture(
    surroundings: Surroundings, wall: int, along: Tensor, up: Tensor, footprint: Tensor
) -> tuple[Tensor, Tensor]:
    """Reflectance and coverage of one wall; all rows of the batch have the same kind of it.

    Args:
        surroundings: of the road.
        wall: its index.
        along: (B, N) m in the world.
        up: (B, N) m above the road.
        footprint: (B, N) m per pixel.

    Returns:
        (B, 3, N) and (B, N) in [0, 1].
    """
    kind = int(surroundings.wall_kind[0, wall])
    height, seed = surroundings.wall_height[:, wall, None], surroundings.wall_seed[:, wall, None]
    colour = surroundings.wall_colour[:, wall, :, None]

    def below(top: Tensor) -> Tensor:
        return ((top - up) / footprint + 0.5).clamp(0, 1)

    inside = (up / footprint + 0.5).clamp(0, 1)
    if kind == HOUSES:
        return house_front(colour, height, seed, along, up, footprint)[:2]
    if kind == CONCRETE:
        panel = dash_like(along, 0.03, 6.0, footprint)
        stain = sample_noise(CLOUD, along / 30.0 + seed, up / 9.0)
        foot = smoothstep(0.0, 0.35, up / height)
        shade = (0.65 + 0.4 * foot + 0.14 * stain) * (1 - 0.5 * panel)
        toe = surroundings.wall_toe[:, wall, None]
        shade = torch.where(toe > 1, (1.05 + 0.14 * stain) * (1 + (toe - 1) * below(0.4 * height)), shade)
        return (colour * shade[:, None]).clamp(max=0.85), inside * below(height)
    if kind == RAIL:
        beam = below(height) * (1 - below(height - 0.31))
        post = dash_like(along, 0.14, 2.0, footprint) * below(height)
        wave = 0.8 + 0.35 * torch.cos((height - up) * 40.0) / (1 + footprint / 0.05)
        return colour * torch.where(beam > 0.3, wave, 0.5)[:, None], inside * torch.maximum(beam, post)
    if kind == FENCE:
        stain = sample_noise(CLOUD, along / 60.0 + seed, up / 20.0)
        panel = dash_like(along, 0.15, 5.0, footprint)
        return colour * (0.9 + 0.12 * stain - 0.3 * panel)[:, None], inside * below(height)
    if kind == SLOPE:
        top = height * (0.75 + 0.3 * sample_line(along / 420.0 + seed).clamp(-1.5, 1.5))
        tufts = sample_noise(CLOUD, along / 60.0 + seed, up / 25.0)
        bush = smoothstep(0.5, 0.9, sample_noise(CLOUD, along / 90.0, up / 60.0 + seed))
        colour = (
            colour
            * (1 + 0.2 * tufts)[:, None]
            * (1 - bush[:, None] * colour.new_tensor([0.75, 0.6, 0.7])[:, None])
        )
        return colour, inside * below(top)
    return _foliage(colour, height, seed, along, up, footprint, kind)


def _foliage(
    colour: Tensor, height: Tensor, seed: Tensor, along: Tensor, up: Tensor, footprint: Tensor, kind: int
) -> tuple[Tensor, Tensor]:
    """A row of trees or bushes: crowns by noise on their outline, lit from above, holes of sky."""
    wide = 260.0 if kind == TREES else 90.0
    style = int(float(seed.flatten()[0]) * 97) % 3 if kind == TREES else 0
    leaves = sample_noise(CLOUD, along / 33.0 + seed, up / 33.0)
    fine = sample_grain(GRAIN, along / 22.0, up / 22.0 + seed) / (1 + footprint / 0.15)
    if style == 0:
        outline = sample_line(along / wide + seed) + 0.13 * sample_line(along / 37.0 + 0.4)
        top = height * (0.62 + 0.33 * outline).clamp(0.1, 1.4)
    else:
        top = _crowns(along, height, seed, conifer=style == 2)
    edge = (top - up) / height + 0.09 * leaves + 0.015 * fine
    alpha = smoothstep(-0.01, 0.02 + 0.5 * footprint / height, edge)
    light = 0.55 + 0.5 * (up / top.clamp(min=0.5)).clamp(0, 1) + 0.28 * leaves + 0.2 * fine
    trunk = kind == TREES
    ground = smoothstep(0.0, 0.6, up) if trunk else 1.0
    return colour * (light * ground).clamp(0.12, 1.8)[:, None], alpha * (up > -0.1)


def _crowns(along: Tensor, height: Tensor, seed: Tensor, conifer: bool) -> Tensor:
    """(B, N) m, outline of single trees of random place, size and shape over some undergrowth."""
    spacing = height * (0.45 if conifer else 0.8)
    u = along / spacing
    row = (seed * 97.0).floor()
    top = height * (0.12 + 0.08 * sample_line(along / 50.0 + seed))
    for shift in (-1, 0, 1):
        cell = u.floor() + shift
        centre = cell + 0.2 + 0.6 * hash01(cell, row, 1.0)
        tall = height * (0.35 + 0.75 * hash01(cell, row, 2.0) ** 1.5)
        apart = (u - centre) / (0.3 + 0.45 * hash01(cell, row, 3.0))
        if conifer:
            shape = 1 - apart.abs() * 1.5
        else:
            shape = 0.25 + 0.75 * (1 - apart * apart).clamp(min=0).sqrt()
        top = torch.maximum(top, tall * torch.where(apart.abs() < 1, shape, 0.0))
    return top


def dash_like(along: Tensor, length: float, period: float, footprint: Tensor) -> Tensor:
    """(B, N) coverage of things ``length`` long every ``period`` metres, softened by the footprint."""
    distance = ((along / period + 0.5) % 1.0 - 0.5).abs() * period
    share = length / (length + footprint)
    return share * ((0.5 * length - distance) / footprint + 0.5).clamp(0, 1) + (1 - share) * length / period


def sky_radiance(surroundings: Surroundings, azimuth: Tensor, rise: Tensor, sun: Tensor) -> Tensor:
    """Linear radiance of sky and hills, (B, 3, N).

    Args:
        surroundings: of the road.
        azimuth: (B, N) rad in the world, right positive.
        rise: (B, N) tangent of the elevation.
        sun: (B, N) cosine of the angle to the sun, below -1 where there is none.
    """
    blend = (rise.clamp(min=0) * 3.2).clamp(0, 1).sqrt()[:, None]
    sky = surroundings.skyline[..., None] * (1 - blend) + surroundings.zenith[..., None] * blend
    flat = 1 / (rise.clamp(min=0.0) + 0.09)
    u, v = azimuth.sin() * flat * 0.05, azimuth.cos() * flat * 0.05
    density = sample_noise(CLOUD, u, v) + 0.4 * sample_noise(CLOUD, u * 4 + 0.3, v * 4)
    cover = surroundings.cloud[:, None]
    cloud = (
        smoothstep(1.4 - 2.4 * cover, 2.2 - 2.0 * cover, density) * smoothstep(0.0, 0.1, rise) * (cover > 0)
    )
    bright = surroundings.skyline.amax(1)[:, None, None] * 1.08
    sky = sky + (bright - 0.16 * density[:, None].clamp(0, 2) * bright - sky) * (0.9 * cloud)[:, None]
    glow = sun.clamp(min=0) ** 12 * 0.5 + sun.clamp(min=0) ** 400 * 6
    sky = sky + glow[:, None] * sky.new_tensor([1.0, 0.93, 0.8])[:, None]
    haze = surroundings.skyline[..., None]
    for ridge, distance in ((0, 0.75), (1, 0.5)):
        noise = sample_line(azimuth * (1 / 6.2832) + 0.4 * ridge)
        top = surroundings.hill_height[:, ridge, None] * (1 + 0.45 * noise)
        colour = haze * distance + (1 - distance) * surroundings.hill_colour[..., None] * haze.amax(
            1, keepdim=True
        )
        alpha = smoothstep(0.002, -0.002, rise - top) * (surroundings.hill_height[:, ridge, None] > 0)
        sky = sky + (colour - sky) * alpha[:, None]
    return sky
