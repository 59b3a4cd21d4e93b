"""Shadows on the ground: of bridges, trees, walls and vehicles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from lanebev.render.raster.noise import CLOUD, sample_line, sample_noise, smoothstep
from lanebev.render.raster.solids import TRUCK, Light, Solids
from lanebev.render.scene.surroundings import FENCE, HEDGE, NOTHING, NUM_WALLS, RAIL, SLOPE, TREES
from lanebev.render.scene.world import World

if TYPE_CHECKING:
    from lanebev.render.raster.ground import Ground

BRIDGE_UNDERSIDE = 6.2  # m, of all bridges as far as their shadows go


def shadows(world: World, light: Light, ground: Ground, solids: Solids) -> tuple[Tensor, Tensor]:
    """Share of the sun, and of the sky, that reaches the ground, (1, N) both."""
    sunlit, open_sky = torch.ones_like(ground.z), torch.ones_like(ground.z)
    sunny = bool((light.direct > 0.02).any())
    if bool(world.bridge.isfinite().all()):
        shade, under = _bridge_shadow(world, light, ground)
        sunlit, open_sky = sunlit * (1 - shade), open_sky * (1 - 0.8 * under)
    if bool((world.shade > 0).all()) and sunny:
        sunlit = sunlit * (1 - world.shade[:, None] * _crown_shadow(world, ground))
    if sunny:
        sunlit = sunlit * _wall_shadows(world, light, ground)
    lit, contact = _vehicle_shadows(light, ground, solids)
    return sunlit * lit, open_sky * contact


def _bridge_shadow(world: World, light: Light, ground: Ground) -> tuple[Tensor, Tensor]:
    climb = light.sun[:, 1, None].clamp(min=0.12)
    soft = 0.15 + ground.reach_along
    begin, end = world.bridge[:, 0, None], world.bridge[:, 1, None]
    shift = ground.along + BRIDGE_UNDERSIDE * light.sun[:, 2, None] / climb
    shade = ((shift - begin) / soft + 0.5).clamp(0, 1) * ((end - shift) / soft + 0.5).clamp(0, 1)
    under = smoothstep(begin - 5, begin + 4, ground.along) * smoothstep(end + 5, end - 4, ground.along)
    return shade, under


def _crown_shadow(world: World, ground: Ground) -> Tensor:
    """Dappled shade of trees that reach over the road, thicker towards its edges."""
    crown = sample_noise(CLOUD, ground.along / 110.0, ground.across / 70.0)
    gaps = sample_noise(CLOUD, ground.along / 21.0, ground.across / 16.0)
    edge = torch.minimum(ground.across - world.pavement.left, world.pavement.right - ground.across)
    return smoothstep(0.2, 0.75, crown + 0.35 * gaps - 0.09 * edge.clamp(min=0) + 0.25)


def _wall_shadows(world: World, light: Light, ground: Ground) -> Tensor:
    """Bands along the road beside walls that stand between it and the sun."""
    sunlit = torch.ones_like(ground.z)
    slant = light.sun[:, 0] / light.sun[:, 1].clamp(min=0.12)  # sideways per metre of height
    around = world.surroundings
    for wall in range(NUM_WALLS):
        kind = int(around.wall_kind[0, wall])
        side = 1.0 if wall % 2 else -1.0
        length = around.wall_height[:, wall] * slant * side
        if kind in (NOTHING, SLOPE) or float(length) < 0.05:
            continue
        inward = (around.wall_across[:, wall, None] - ground.across) * side  # m from the wall's foot
        if kind in (TREES, HEDGE):
            length = length * (
                0.55 + 0.2 * sample_line(ground.along / 60.0 + around.wall_seed[:, wall, None])
            )
        soft = 0.05 + 0.04 * length + ground.reach_across
        shade = ((length - inward) / soft + 0.5).clamp(0, 1) * (inward / ground.reach_across + 0.5).clamp(
            0, 1
        )
        if kind == RAIL:
            shade = shade * (inward > 0.45 * length)
        sunlit = sunlit * (1 - (0.85 if kind in (TREES, HEDGE, FENCE) else 0.95) * shade)
    return sunlit


def _vehicle_shadows(light: Light, ground: Ground, solids: Solids) -> tuple[Tensor, Tensor]:
    """What vehicles leave of the sun (a swept rectangle) and of the sky (dark below them), (1, N) both."""
    lit, contact = torch.ones_like(ground.z), torch.ones_like(ground.z)
    casts = (solids.valid & (solids.kind <= TRUCK) & (solids.z < 260) & (solids.z > -15)).nonzero()[:, 1]
    if not len(casts):
        return lit, contact
    shape, heading = solids.shape[0, casts], solids.heading[0, casts]  # (V, 2, 8), (V,)
    half, rear, front = shape[:, 0, 0], shape[:, :, 2].amin(1), shape[:, :, 3].amax(1)
    tall = shape[:, :, 7].amax(1) * 0.9
    sin, cos = heading.sin(), heading.cos()
    sun = light.sun[0] / light.sun[0, 1].clamp(min=0.12)
    sun_x, sun_z = (sun[0] * cos - sun[2] * sin) * tall, (sun[0] * sin + sun[2] * cos) * tall
    length = torch.hypot(sun_x, sun_z).clamp(min=0.5)

    dx, dz = ground.x - solids.x[0, casts, None], ground.z - solids.z[0, casts, None]  # (V, N)
    which, at = (torch.maximum(dx.abs(), dz.abs()) < (front + 1.5 + length)[:, None]).nonzero(as_tuple=True)
    dx, dz, blur = dx[which, at], dz[which, at], 0.08 + ground.reach_along[0, at]
    table = torch.stack([sin, cos, half, rear, front, sun_x, sun_z, length])[:, which]
    sin, cos, half, rear, front, sun_x, sun_z, length = table
    right, ahead = dx * cos - dz * sin, dx * sin + dz * cos
    low_x, high_x = _slab(right, sun_x, -half, half)
    low_z, high_z = _slab(ahead, sun_z, rear, front)
    enter = torch.maximum(low_x, low_z).clamp(min=0)
    leave = torch.minimum(high_x, high_z).clamp(max=1)
    sunlit = 1 - ((leave - enter) * length / blur + 0.3).clamp(0, 1)
    gap = torch.maximum(right.abs() - half, torch.maximum(rear - ahead, ahead - front))
    open_sky = 1 - 0.85 * smoothstep(0.45 + blur, -0.25, gap)
    lit[0].scatter_reduce_(0, at, sunlit, "amin")
    contact[0].scatter_reduce_(0, at, open_sky, "amin")
    return lit, contact


def _slab(position: Tensor, speed: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Times at which position + t · speed enters and leaves [low, high]."""
    speed = torch.where(speed.abs() < 1e-3, 1e-3, speed)
    first, second = (low - position) / speed, (high - position) / speed
    return torch.minimum(first, second), torch.maximum(first, second)
