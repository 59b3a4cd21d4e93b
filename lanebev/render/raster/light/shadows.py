"""Shadows on the ground: of bridges, trees, walls and vehicles."""

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.base.blocks import Blocks, multiply_rows
from lanebev.render.raster.base.features import SHORTEST_SHADOW, STEEPEST, Features, shadow_lengths
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.noise import CLOUD, sample_line, sample_noise, smoothstep
from lanebev.render.raster.base.select import as_float, choose, indices_where, take
from lanebev.render.rows import take_rows
from lanebev.render.scene.light.weather import Light
from lanebev.render.scene.objects.objects import TRUCK, SceneObjects
from lanebev.render.scene.objects.surroundings import FENCE, HEDGE, RAIL, TREES, Surroundings
from lanebev.render.scene.road.pavement import Pavement
from lanebev.render.scene.world import Scene

BRIDGE_UNDERSIDE = 6.2  # m, of all bridges as far as their shadows go
_PIECE = 64  # pixels that are tested together for a vehicle's shadow


def shadows(
    scene: Scene, below: Blocks, x: Tensor, ground: Ground, features: Features
) -> tuple[Tensor, Tensor]:
    """Compute the share of the sun, and of the sky, that reaches the ground, (T, N) both.

    Args:
        scene: B of them.
        below: T blocks of points.
        x: (T, N) m, right of the camera's foot.
        ground: (T, N) points.
        features: what any of the scenes has.
    """
    row, world = below.row, scene.world
    light = take_rows(scene.light, row)
    sunlit, open_sky = _vehicle_shadows(scene.light, row, x, ground, scene.objects)
    seen = _Shaders(world.bridge[row], light, world.shade[row], take_rows(world.pavement, row))
    multiply_rows(sunlit, below, features.bridge, _bridge_shadow, seen, ground)
    multiply_rows(open_sky, below, features.bridge, _bridge_cover, seen, ground)
    if features.sun:
        multiply_rows(sunlit, below, features.crowns, _crown_shadow, seen, ground)
        around = take_rows(world.surroundings, row)
        walls = _Walls(around, shadow_lengths(around, light))
        for wall, rows in enumerate(features.shading):
            multiply_rows(sunlit, below, rows, partial(_wall_shadow, wall), walls, ground)
    return sunlit, open_sky


class _Shaders(NamedTuple):
    """The light below bridges and trees over the road, of T blocks.

    Attributes:
        bridge: (T, 2) m along, of a bridge's beginning and end.
        light: the light.
        shade: (T,) strength of the trees' shade.
        pavement: its edges.
    """

    bridge: Tensor
    light: Light
    shade: Tensor
    pavement: Pavement


class _Walls(NamedTuple):
    """Walls beside the road, and the lengths (T, W) of their shadows towards it, m."""

    around: Surroundings
    length: Tensor


def _bridge_shadow(seen: _Shaders, ground: Ground) -> Tensor:
    """Compute the share of the sun that bridges leave."""
    climb = seen.light.sun[:, 1, None].clamp(min=STEEPEST)
    soft = 0.15 + ground.reach_along
    begin, end = seen.bridge.clamp(max=1e6).unsqueeze(-1).unbind(1)
    shift = ground.along + BRIDGE_UNDERSIDE * seen.light.sun[:, 2, None] / climb
    return 1 - ((shift - begin) / soft + 0.5).clamp(0, 1) * ((end - shift) / soft + 0.5).clamp(0, 1)


def _bridge_cover(seen: _Shaders, ground: Ground) -> Tensor:
    """Compute the share of the sky that bridges leave."""
    begin, end = seen.bridge.clamp(max=1e6).unsqueeze(-1).unbind(1)
    under = smoothstep(begin - 5, begin + 4, ground.along) * smoothstep(end + 5, end - 4, ground.along)
    return 1 - 0.8 * under


def _crown_shadow(seen: _Shaders, ground: Ground) -> Tensor:
    """Compute the share of the sun that trees over the road leave: less towards its edges."""
    crown = sample_noise(CLOUD, ground.along / 110.0, ground.across / 70.0)
    gaps = sample_noise(CLOUD, ground.along / 21.0, ground.across / 16.0)
    left, right = seen.pavement.left[:, None], seen.pavement.right[:, None]
    edge = torch.minimum(ground.across - left, right - ground.across)
    dappled = smoothstep(0.2, 0.75, crown + 0.35 * gaps - 0.09 * edge.clamp(min=0) + 0.25)
    return 1 - seen.shade[:, None] * dappled


def _wall_shadow(wall: int, walls: _Walls, ground: Ground) -> Tensor:
    """Compute the share of the sun that a wall leaves."""
    around, length = walls.around, walls.length[:, wall, None]
    kind, side = around.walls.kind[:, wall, None], 1.0 if wall % 2 else -1.0
    leafy = (kind == TREES) | (kind == HEDGE)
    crowns = 0.55 + 0.2 * sample_line(ground.along / 60.0 + around.walls.seed[:, wall, None])
    reach = choose(leafy, length * crowns, length)
    inward = (around.walls.across[:, wall, None] - ground.across) * side  # m from the wall's foot
    soft = (0.05 + 0.04 * reach + ground.reach_across).clamp(min=0.01)
    shade = ((reach - inward) / soft + 0.5).clamp(0, 1) * (inward / ground.reach_across + 0.5).clamp(0, 1)
    shade = shade * as_float((kind != RAIL) | (inward > 0.45 * reach))
    strength = torch.where(leafy | (kind == FENCE), 0.85, 0.95) * (length > SHORTEST_SHADOW)
    return 1 - strength * shade


class _Outline(NamedTuple):
    """A vehicle's outline on the ground and where the sun moves it, (...) each, m."""

    x: Tensor
    z: Tensor
    sin: Tensor
    cos: Tensor
    half: Tensor
    rear: Tensor
    front: Tensor
    sun_x: Tensor
    sun_z: Tensor
    length: Tensor


def _outlines(light: Light, objects: SceneObjects) -> tuple[_Outline, Tensor]:
    """Return outlines of vehicles (B, M), and how far in X and in Z their shadows reach, (B, M) m."""
    shape, x, z = objects.shape, objects.x, objects.z
    sin, cos = objects.heading.sin(), objects.heading.cos()
    tall = shape[..., 7].amax(2) * 0.9
    sun = light.sun / light.sun[:, 1:2].clamp(min=STEEPEST)
    sun_right, sun_ahead = sun[:, 0, None], sun[:, 2, None]
    sun_x, sun_z = (sun_right * cos - sun_ahead * sin) * tall, (sun_right * sin + sun_ahead * cos) * tall
    rear, front = shape[..., 2].amin(2), shape[..., 3].amax(2)
    length = torch.hypot(sun_x, sun_z).clamp(min=0.5)
    casts = objects.valid & (objects.kind <= TRUCK) & (z < 260) & (z > -15)
    reach = (front + 1.5 + length).where(casts, -1.0)
    return _Outline(x, z, sin, cos, shape[..., 0, 0], rear, front, sun_x, sun_z, length), reach


def _vehicle_shadows(
    light: Light, row: Tensor, x: Tensor, ground: Ground, objects: SceneObjects
) -> tuple[Tensor, Tensor]:
    """Compute the share of the sun (swept rectangles) and of the sky that vehicles leave, (T, N) both."""
    shape = ground.z.shape
    x, z, reach_along = (t.reshape(-1, _PIECE) for t in (x, ground.z, ground.reach_along))
    lit, contact = torch.ones_like(x), torch.ones_like(x)
    outline, reach = _outlines(light, objects)
    row = row.repeat_interleave(shape[1] // _PIECE)
    own_x, own_z, reach = (t.index_select(0, row) for t in (outline.x, outline.z, reach))  # (pieces, M)
    near = (x.amin(1, keepdim=True) < own_x + reach) & (x.amax(1, keepdim=True) > own_x - reach)
    near &= (z.amin(1, keepdim=True) < own_z + reach) & (z.amax(1, keepdim=True) > own_z - reach)
    found = indices_where(near & (reach > 0))
    vehicles = reach.shape[1]
    piece = found // vehicles
    owner = row[piece] * vehicles + found % vehicles
    pair = _Outline(*(take(t, owner)[:, None] for t in outline))
    x, z, reach_along = (t.index_select(0, piece) for t in (x, z, reach_along))
    dx, dz, blur = x - pair.x, z - pair.z, 0.08 + reach_along
    right, ahead = dx * pair.cos - dz * pair.sin, dx * pair.sin + dz * pair.cos
    low_x, high_x = _slab(right, pair.sun_x, -pair.half, pair.half)
    low_z, high_z = _slab(ahead, pair.sun_z, pair.rear, pair.front)
    enter, leave = torch.maximum(low_x, low_z).clamp(min=0), torch.minimum(high_x, high_z).clamp(max=1)
    sunlit = 1 - ((leave - enter) * pair.length / blur + 0.3).clamp(0, 1)
    gap = torch.maximum(right.abs() - pair.half, torch.maximum(pair.rear - ahead, ahead - pair.front))
    open_sky = 1 - 0.85 * smoothstep(0.45 + blur, -0.25, gap)
    index = piece[:, None].expand_as(dx)
    lit.scatter_reduce_(0, index, sunlit, "amin")
    contact.scatter_reduce_(0, index, open_sky, "amin")
    return lit.reshape(shape), contact.reshape(shape)


def _slab(position: Tensor, speed: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the times at which position + t · speed enters and leaves [low, high]."""
    speed = choose(speed.abs() < 1e-3, 1e-3, speed)
    first, second = (low - position) / speed, (high - position) / speed
    return torch.minimum(first, second), torch.maximum(first, second)
