"""Linear radiance of every pixel: sky, ground, walls, things, in the order of their distance."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.alignment import Alignment, elevation_at, ground_hit, road_from_local, wall_hit
from lanebev.render.lens import Lens
from lanebev.render.markings import paint
from lanebev.render.noise import CLOUD, blotches, sample_noise, smoothstep
from lanebev.render.pavement import pavement_albedo
from lanebev.render.photometry import headlight_irradiance
from lanebev.render.scene import Place, World
from lanebev.render.solids import TRUCK, Light, Solids, draw
from lanebev.render.surroundings import (
    NOTHING,
    NUM_WALLS,
    SLOPE,
    TREES,
    sky_radiance,
    verge_albedo,
    wall_texture,
)

STUD_ALBEDO = 0.62
_GROUND_LIMIT = 1800.0  # m; beyond, everything is air


class Painted(NamedTuple):
    """A painted view of one scene.

    Attributes:
        radiance: (1, 3, H, W) linear.
        blocked: (1, H, W) m, Z of the nearest thing that is not the road; infinite: none.
        road_level: (1,) mean radiance of the road before the camera.
        nearest: (1,) m, Z of the nearest road in the image.
    """

    radiance: Tensor
    blocked: Tensor
    road_level: Tensor
    nearest: Tensor


class _Ground(NamedTuple):
    """Ground under pixels, each (1, N)."""

    x: Tensor
    z: Tensor
    along: Tensor  # m in the world
    across: Tensor  # m in the layout's frame
    reach_along: Tensor
    reach_across: Tensor


def paint_view(
    world: World,
    place: Place,
    alignment: Alignment,
    lens: Lens,
    solids: Solids,
    light: Light,
    rays: Tensor,
    steps: Tensor,
) -> Painted:
    """One scene, B = 1: a row at a time stays in the processor's cache and skips what it has not.

    Args:
        world: of the scene.
        place: of the camera.
        alignment: seen from there.
        lens: the camera.
        solids: things in the local road frame.
        light: in the local road frame.
        rays: (1, 2, H, W), see :func:`~lanebev.render.lens.pixel_rays`.
        steps: (1, 4, H, W).
    """
    height, width = rays.shape[2:]
    size = (height, width)
    swing, drop = rays[:, 0].flatten(1), -rays[:, 1].flatten(1)  # (1, H·W)
    camera_height = lens.extrinsics.height

    radiance = torch.zeros(1, 3, height * width)
    depth, slope = ground_hit(alignment, camera_height, drop)
    depth = torch.where(depth < _GROUND_LIMIT, depth, math.inf)
    blocked = torch.full_like(depth, math.inf)

    above = depth[0].isinf().nonzero()[:, 0]
    radiance[:, :, above] = _sky(world, place, light, swing[:, above], -drop[:, above])
    below = depth[0].isfinite().nonzero()[:, 0]
    ground = _ground(
        place,
        alignment,
        swing[:, below],
        drop[:, below],
        depth[:, below],
        slope[:, below],
        steps.flatten(2)[:, :, below],
    )
    lit = _ground_radiance(
        world, place, light, ground, solids, camera_height, swing[:, below], drop[:, below]
    )
    haze = world.surroundings.skyline
    clear = torch.exp(-ground.z / world.weather.visibility[:, None])[:, None]
    radiance[:, :, below] = haze[..., None] * (1 - clear) + lit * clear

    near = (
        (ground.z[0] < 40)
        & (ground.across[0] > world.pavement.left)
        & (ground.across[0] < world.pavement.right)
    )
    road_level = lit.mean(1)[:, near].mean(1) if bool(near.any()) else lit.mean((1, 2))
    ahead = ground.across.new_zeros(1, height * width)
    ahead[:, below] = ground.across
    _add_walls(
        world, place, alignment, light, camera_height, swing, drop, ahead, radiance, depth, blocked, steps
    )

    radiance, blocked = radiance.unflatten(2, size), blocked.unflatten(1, size)
    draw(
        radiance,
        depth.unflatten(1, size),
        blocked,
        solids,
        rays,
        steps,
        lens,
        camera_height,
        light,
        haze,
        world.weather.visibility,
    )
    nearest = ground.z.amin(1).clamp(0.8, 8.0) if len(below) else torch.full((1,), 3.0)
    return Painted(radiance, blocked, road_level, nearest)


def _sky(world: World, place: Place, light: Light, swing: Tensor, rise: Tensor) -> Tensor:
    norm = (1 + swing * swing + rise * rise).rsqrt()
    sun = (swing * light.sun[:, 0:1] + rise * light.sun[:, 1:2] + light.sun[:, 2:3]) * norm
    sun = torch.where(light.direct.amax(1, keepdim=True) > 0.3, sun, -2.0)
    level = rise / (1 + swing * swing).sqrt()
    return sky_radiance(world.surroundings, swing.atan() + place.heading[:, None], level, sun)


def _ground(
    place: Place, alignment: Alignment, swing: Tensor, drop: Tensor, z: Tensor, slope: Tensor, steps: Tensor
) -> _Ground:
    """Road coordinates and, from the rays' change per pixel, the pixels' footprints."""
    x = swing * z
    point = road_from_local(alignment, x, z)
    fall = -z / (drop + slope)

    def footprint(d_swing: Tensor, d_up: Tensor) -> tuple[Tensor, Tensor]:
        dz = -fall * d_up
        dx = z * d_swing + swing * dz
        return point.sin * dx + point.cos * dz, point.cos * dx - point.sin * dz

    along_x, across_x = footprint(steps[:, 0], steps[:, 1])
    along_y, across_y = footprint(steps[:, 2], steps[:, 3])
    return _Ground(
        x=x,
        z=z,
        along=point.along + place.along[:, None],
        across=point.across + place.across[:, None],
        reach_along=torch.hypot(along_x, along_y).clamp(min=1e-3),
        reach_across=torch.hypot(across_x, across_y).clamp(min=1e-4),
    )


def _ground_radiance(
    world: World,
    place: Place,
    light: Light,
    ground: _Ground,
    solids: Solids,
    camera_height: Tensor,
    swing: Tensor,
    drop: Tensor,
) -> Tensor:
    """(1, 3, N) linear radiance of the ground."""
    blotch = blotches(ground.along, ground.across)
    ragged = 0.15 * blotch[3]
    inside = torch.minimum(ground.across - world.pavement.left, world.pavement.right - ground.across)
    paved = ((inside + ragged) / ground.reach_across + 0.5).clamp(0, 1)
    albedo = torch.empty(1, 3, ground.z.shape[1])
    coverage, studs = torch.zeros_like(ground.z), torch.zeros_like(ground.z)
    road = (paved[0] > 0).nonzero()[:, 0]
    if len(road):
        part, stain = _Ground(*(t[:, road] for t in ground)), blotch[:, :, road]
        reach = (part.reach_along, part.reach_across)
        bare = pavement_albedo(world.pavement, world.layout, part.along, part.across, *reach, stain)
        grazing = part.z / camera_height[:, None]
        paint_on, studs_on, colour = paint(world.layout, part.along, part.across, *reach, grazing, stain[2])
        studs_on = studs_on * (1 - paint_on)
        bare = bare + (colour - bare) * paint_on[:, None] + (STUD_ALBEDO - bare) * studs_on[:, None]
        albedo[:, :, road], coverage[:, road], studs[:, road] = bare, paint_on, studs_on
    beside = (paved[0] < 1).nonzero()[:, 0]
    if len(beside):
        part = _Ground(*(t[:, beside] for t in ground))
        verge = verge_albedo(
            world.surroundings, part.along, part.across, part.reach_along, blotch[0][:, beside]
        )
        share = paved[:, None, beside]
        albedo[:, :, beside] = torch.where(share > 0, verge + (albedo[:, :, beside] - verge) * share, verge)

    sunlit, open_sky = _shadows(world, light, ground, solids)
    lit = light.direct[..., None] * (light.sun[:, 1, None] * sunlit)[:, None]
    lit = lit + light.ambient[..., None] * open_sky[:, None]
    retro = 1 + 2.5 * coverage + 8.0 * studs
    beam = headlight_irradiance(ground.x, ground.z) * light.headlight[:, None] * retro
    lit = lit + beam[:, None] * lit.new_tensor([1.0, 0.95, 0.85])[:, None]
    return (
        albedo * lit + _gloss(world, light, ground, swing, drop, sunlit, open_sky, blotch[2]) * paved[:, None]
    )


def _gloss(
    world: World,
    light: Light,
    ground: _Ground,
    swing: Tensor,
    drop: Tensor,
    sunlit: Tensor,
    open_sky: Tensor,
    puddle: Tensor,
) -> Tensor:
    """Mirrored sun and, on wet roads, sky; (1, 3, N)."""
    norm = (1 + swing * swing + drop * drop).rsqrt()
    sun = (swing * light.sun[:, 0:1] + drop * light.sun[:, 1:2] + light.sun[:, 2:3]) * norm
    sparkle = 0.35 * sun.clamp(min=0) ** 24 * sunlit
    puddles = smoothstep(-0.5, 1.2, puddle)
    mirror = world.pavement.wet[:, None] * (0.05 + 0.3 * (1 - drop * norm) ** 8) * (0.35 + 0.65 * puddles)
    sky = world.surroundings.skyline[..., None]
    shine = light.direct[..., None] * (sparkle * (0.4 + world.pavement.wet[:, None]))[:, None]
    return shine + sky * (mirror * (0.3 + 0.7 * open_sky))[:, None]


def _shadows(world: World, light: Light, ground: _Ground, solids: Solids) -> tuple[Tensor, Tensor]:
    """Share of the sun, and of the sky, that reaches the ground, (1, N) both."""
    climb = light.sun[:, 1, None].clamp(min=0.12)
    sunlit, open_sky = torch.ones_like(ground.z), torch.ones_like(ground.z)
    soft = 0.15 + ground.reach_along
    if bool(world.bridge.isfinite().all()):
        begin, end = world.bridge[:, 0, None], world.bridge[:, 1, None]
        shift = ground.along + 6.2 * light.sun[:, 2, None] / climb
        sunlit = 1 - ((shift - begin) / soft + 0.5).clamp(0, 1) * ((end - shift) / soft + 0.5).clamp(0, 1)
        under = smoothstep(begin - 5, begin + 4, ground.along) * smoothstep(end + 5, end - 4, ground.along)
        open_sky = 1 - 0.8 * under
    if bool((world.shade > 0).all()):
        crown = sample_noise(CLOUD, ground.along / 110.0, ground.across / 70.0)
        gaps = sample_noise(CLOUD, ground.along / 21.0, ground.across / 16.0)
        edge = torch.minimum(ground.across - world.pavement.left, world.pavement.right - ground.across)
        cover = smoothstep(0.35, 0.65, crown + 0.35 * gaps - 0.09 * edge.clamp(min=0) + 0.25)
        sunlit = sunlit * (1 - world.shade[:, None] * cover)
    lit, contact = _vehicle_shadows(light, ground, solids)
    return sunlit * lit, open_sky * contact


def _vehicle_shadows(light: Light, ground: _Ground, solids: Solids) -> tuple[Tensor, Tensor]:
    """What vehicles leave of the sun (a swept rectangle) and of the sky (dark below them), (1, N) both."""
    lit, contact = torch.ones_like(ground.z), torch.ones_like(ground.z)
    climb = light.sun[:, 1].clamp(min=0.12)
    for m in (solids.valid & (solids.kind <= TRUCK) & (solids.z < 260)).nonzero()[:, 1].tolist():
        shape = solids.shape[:, m]
        half, rear, front = shape[:, 0, 0], shape[:, :, 2].amin(1), shape[:, :, 3].amax(1)
        tall = shape[:, :, 7].amax(1) * 0.9
        sin, cos = solids.heading[:, m].sin(), solids.heading[:, m].cos()
        sun_x = (light.sun[:, 0] * cos - light.sun[:, 2] * sin) / climb * tall
        sun_z = (light.sun[:, 0] * sin + light.sun[:, 2] * cos) / climb * tall
        length = torch.hypot(sun_x, sun_z).clamp(min=0.5)
        dx, dz = ground.x - solids.x[:, m], ground.z - solids.z[:, m]
        part = (torch.maximum(dx.abs(), dz.abs()) < front + 2 + length)[0].nonzero()[:, 0]
        if not len(part):
            continue
        dx, dz, blur = dx[:, part], dz[:, part], 0.08 + ground.reach_along[:, part]
        right, ahead = dx * cos - dz * sin, dx * sin + dz * cos
        low_x, high_x = _slab(right, sun_x, -half, half)
        low_z, high_z = _slab(ahead, sun_z, rear, front)
        enter = torch.maximum(low_x, low_z).clamp(min=0)
        leave = torch.minimum(high_x, high_z).clamp(max=1)
        lit[:, part] *= 1 - ((leave - enter) * length / blur + 0.3).clamp(0, 1)
        gap = torch.maximum(right.abs() - half, torch.maximum(rear - ahead, ahead - front))
        contact[:, part] *= 1 - 0.85 * smoothstep(0.45 + blur, -0.25, gap)
    return lit, contact


def _slab(position: Tensor, speed: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Times at which position + t · speed enters and leaves [low, high]."""
    speed = torch.where(speed.abs() < 1e-3, 1e-3, speed)
    first, second = (low - position) / speed, (high - position) / speed
    return torch.minimum(first, second), torch.maximum(first, second)


def _add_walls(
    world: World,
    place: Place,
    alignment: Alignment,
    light: Light,
    camera_height: Tensor,
    swing: Tensor,
    drop: Tensor,
    across: Tensor,
    radiance: Tensor,
    depth: Tensor,
    blocked: Tensor,
    steps: Tensor,
) -> None:
    """Paint the walls beside the road, outside in; changes radiance, depth and blocked."""
    surroundings = world.surroundings
    pixel = steps[:, 3].flatten(1).abs()  # rise per pixel down, at one metre
    away = torch.maximum(across - world.pavement.right, world.pavement.left - across) > 0
    candidates = (away | depth.isinf())[0].nonzero()[:, 0]
    sky, across, outward, climb = (t[:, candidates] for t in (depth.isinf(), across, swing, -drop))
    sharpest = alignment.curvature.abs().amax(1)[:, None]
    for wall in range(NUM_WALLS):
        kind = int(surroundings.wall_kind[0, wall])
        if kind == NOTHING:
            continue
        place_across = surroundings.wall_across[:, wall] - place.across
        side = place_across.sign()
        tall = surroundings.wall_height[:, wall] * 1.5
        aside = place_across.abs().clamp(min=0.5)[:, None]
        beyond = (across - surroundings.wall_across[:, wall, None]) * side[:, None] > 0
        bent = (sharpest / aside).sqrt()  # on a bend the road turns towards its wall
        steepest = 1.3 / aside * (outward * side[:, None]).clamp(min=0) + (bent + 0.004)
        low = climb < (tall - camera_height).clamp(min=0)[:, None] * steepest
        part = candidates[torch.where(sky, low, beyond)[0]]
        if not len(part):
            continue
        z, arc = wall_hit(alignment, place_across, swing[:, part])
        finite = z < 900.0
        z = z.where(finite, 1.0)
        up = camera_height[:, None] - drop[:, part] * z - elevation_at(alignment, z)
        keep = (finite & (up > -0.3) & (up < tall[:, None]) & (z < depth[:, part] + 0.5))[0].nonzero()[:, 0]
        if not len(keep):
            continue
        part, z, arc, up = part[keep], z[:, keep], arc[:, keep], up[:, keep]
        along = arc + place.along[:, None]
        albedo, alpha = wall_texture(surroundings, wall, along, up, (pixel[:, part] * z).clamp(min=1e-3))
        faces = (-side * light.sun[:, 0]).clamp(min=0)[:, None]
        if kind >= TREES and kind != SLOPE:
            faces = 0.45 * light.sun[:, 1, None] + 0.5 * faces
        lit = light.direct[..., None] * faces[:, None] + light.ambient[..., None] * 0.62
        beam = headlight_irradiance(swing[:, part] * z, z) * light.headlight[:, None] * 0.6
        lit = albedo * (lit + beam[:, None])
        clear = torch.exp(-z / world.weather.visibility[:, None])[:, None]
        lit = surroundings.skyline[..., None] * (1 - clear) + lit * clear
        radiance[:, :, part] += (lit - radiance[:, :, part]) * alpha[:, None]
        solid = alpha > 0.5
        depth[:, part] = torch.where(solid, torch.minimum(depth[:, part], z), depth[:, part])
        blocked[:, part] = torch.where(solid, torch.minimum(blocked[:, part], z), blocked[:, part])
