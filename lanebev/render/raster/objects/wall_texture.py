"""The appearance of walls beside the road, by kind."""

import torch
from torch import Tensor

from lanebev.render.raster.base.colour import colour
from lanebev.render.raster.base.noise import (
    CLOUD,
    hash01,
    sample_grain,
    sample_line,
    sample_noise,
    smoothstep,
)
from lanebev.render.raster.base.select import as_float, choose
from lanebev.render.raster.objects.houses import house_front
from lanebev.render.scene.objects.surroundings import (
    CONCRETE,
    FENCE,
    HEDGE,
    HOUSES,
    RAIL,
    SLOPE,
    TREES,
    Walls,
)


def wall_texture(
    wall: Walls, kind: int, style: int, along: Tensor, up: Tensor, footprint: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute reflectance and coverage of walls of one kind.

    Args:
        wall: (B,) of them.
        kind: CONCRETE, RAIL, TREES, FENCE, SLOPE, HEDGE or HOUSES.
        style: style of trees: a dense row, single crowns or conifers.
        along: (B, N) m in the world.
        up: (B, N) m above the road.
        footprint: (B, N) m per pixel.

    Returns:
        (B, 3, N) and (B, N) in [0, 1].
    """
    if kind in (TREES, HEDGE):
        return _foliage(wall, kind, style, along, up, footprint)
    build = {CONCRETE: _concrete, RAIL: _rail, FENCE: _fence, SLOPE: _slope, HOUSES: _houses}[kind]
    return build(wall, along, up, footprint)


def _below(top: Tensor, up: Tensor, footprint: Tensor) -> Tensor:
    """Compute the share of a pixel below a height."""
    return ((top - up) / footprint + 0.5).clamp(0, 1)


def _concrete(wall: Walls, along: Tensor, up: Tensor, footprint: Tensor) -> tuple[Tensor, Tensor]:
    """Draw panels with stains; some with a sloping, brighter foot."""
    height, toe = wall.height[:, None], wall.toe[:, None]
    panel = periodic_coverage(along, 0.03, 6.0, footprint)
    stain = sample_noise(CLOUD, along / 30.0 + wall.seed[:, None], up / 9.0)
    foot = smoothstep(0.0, 0.35, up / height)
    upright = (0.65 + 0.4 * foot + 0.14 * stain) * (1 - 0.5 * panel)
    sloping = (1.05 + 0.14 * stain) * (1 + (toe - 1) * _below(0.4 * height, up, footprint))
    shade = choose(toe > 1, sloping, upright)
    return (wall.colour[..., None] * shade[:, None]).clamp(max=0.85), _standing(height, up, footprint)


def _standing(height: Tensor, up: Tensor, footprint: Tensor) -> Tensor:
    """Compute the share of a pixel between the ground and a height."""
    return (up / footprint + 0.5).clamp(0, 1) * _below(height, up, footprint)


def _rail(wall: Walls, along: Tensor, up: Tensor, footprint: Tensor) -> tuple[Tensor, Tensor]:
    """Draw a beam on posts."""
    height = wall.height[:, None]
    below = _below(height, up, footprint)
    beam = below * (1 - _below(height - 0.31, up, footprint))
    post = periodic_coverage(along, 0.14, 2.0, footprint) * below
    wave = 0.8 + 0.35 * torch.cos((height - up) * 40.0) / (1 + footprint / 0.05)
    shade = choose(beam > 0.3, wave, 0.5)
    on_ground = (up / footprint + 0.5).clamp(0, 1)
    return wall.colour[..., None] * shade[:, None], on_ground * torch.maximum(beam, post)


def _fence(wall: Walls, along: Tensor, up: Tensor, footprint: Tensor) -> tuple[Tensor, Tensor]:
    """Draw panels between posts."""
    stain = sample_noise(CLOUD, along / 60.0 + wall.seed[:, None], up / 20.0)
    panel = periodic_coverage(along, 0.15, 5.0, footprint)
    shade = 0.9 + 0.12 * stain - 0.3 * panel
    return wall.colour[..., None] * shade[:, None], _standing(wall.height[:, None], up, footprint)


def _slope(wall: Walls, along: Tensor, up: Tensor, footprint: Tensor) -> tuple[Tensor, Tensor]:
    """Draw an embankment with tufts and bushes."""
    seed = wall.seed[:, None]
    top = wall.height[:, None] * (0.75 + 0.3 * sample_line(along / 420.0 + seed).clamp(-1.5, 1.5))
    tufts = sample_noise(CLOUD, along / 60.0 + seed, up / 25.0)
    bush = smoothstep(0.5, 0.9, sample_noise(CLOUD, along / 90.0, up / 60.0 + seed))
    shade = (1 + 0.2 * tufts)[:, None] * (1 - bush[:, None] * colour(bush, 0.75, 0.6, 0.7))
    return wall.colour[..., None] * shade, _standing(top, up, footprint)


def _houses(wall: Walls, along: Tensor, up: Tensor, footprint: Tensor) -> tuple[Tensor, Tensor]:
    """Draw house fronts."""
    return house_front(wall, along, up, footprint)[:2]


def _foliage(
    wall: Walls, kind: int, style: int, along: Tensor, up: Tensor, footprint: Tensor
) -> tuple[Tensor, Tensor]:
    """Draw a row of trees or bushes: crowns by noise on their outline, lit from above, with holes of sky."""
    height, seed = wall.height[:, None], wall.seed[:, None]
    leaves = sample_noise(CLOUD, along / 33.0 + seed, up / 33.0)
    fine = sample_grain(along / 22.0, up / 22.0 + seed) / (1 + footprint / 0.15)
    if kind == HEDGE or style == 0:
        outline = sample_line(along / (260.0 if kind == TREES else 90.0) + seed)
        outline = outline + 0.13 * sample_line(along / 37.0 + 0.4)
        top = height * (0.62 + 0.33 * outline).clamp(0.1, 1.4)
    else:
        top = _crowns(along, height, seed, conifer=style == 2)
    edge = (top - up) / height + 0.09 * leaves + 0.015 * fine
    alpha = smoothstep(-0.01, 0.02 + 0.5 * footprint / height, edge)
    light = 0.55 + 0.5 * (up / top.clamp(min=0.5)).clamp(0, 1) + 0.28 * leaves + 0.2 * fine
    if kind == TREES:
        light = light * smoothstep(0.0, 0.6, up)  # dark between the trunks
    return wall.colour[..., None] * light.clamp(0.12, 1.8)[:, None], alpha * as_float(up > -0.1)


def _crowns(along: Tensor, height: Tensor, seed: Tensor, conifer: bool) -> Tensor:
    """Compute the outline of single trees of random place, size and shape over undergrowth, (B, N) m."""
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
        top = torch.maximum(top, tall * shape * as_float(apart.abs() < 1))
    return top


def periodic_coverage(along: Tensor, length: float, period: float, footprint: Tensor) -> Tensor:
    """Compute the coverage of things ``length`` long every ``period`` m, softened, (B, N)."""
    distance = (along / period - (along / period).round()).abs() * period
    share = length / (length + footprint)
    return share * ((0.5 * length - distance) / footprint + 0.5).clamp(0, 1) + (1 - share) * length / period
