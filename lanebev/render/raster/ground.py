"""The ground in the image: where every pixel meets it, and how bright it is there."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.markings import paint
from lanebev.render.raster.night import night_irradiance, smeared
from lanebev.render.raster.noise import blotches, smoothstep
from lanebev.render.raster.photometry import headlight_irradiance
from lanebev.render.raster.shadows import shadows
from lanebev.render.raster.solids import Light, Solids
from lanebev.render.raster.symbols import symbols
from lanebev.render.raster.varied import varied_ground
from lanebev.render.scene.alignment import Alignment, road_from_local
from lanebev.render.scene.pavement import pavement_albedo
from lanebev.render.scene.surroundings import verge_albedo
from lanebev.render.scene.world import Place, World

STUD_ALBEDO = 0.62


class Ground(NamedTuple):
    """Ground under pixels, each (1, N)."""

    x: Tensor
    z: Tensor
    along: Tensor  # m in the world
    across: Tensor  # m in the layout's frame
    reach_along: Tensor
    reach_across: Tensor


def ground_under(
    place: Place, alignment: Alignment, swing: Tensor, drop: Tensor, z: Tensor, slope: Tensor, steps: Tensor
) -> Ground:
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
    return Ground(
        x=x,
        z=z,
        along=point.along + place.along[:, None],
        across=point.across + place.across[:, None],
        reach_along=torch.hypot(along_x, along_y).clamp(min=1e-3),
        reach_across=torch.hypot(across_x, across_y).clamp(min=1e-4),
    )


def ground_radiance(
    world: World,
    place: Place,
    light: Light,
    ground: Ground,
    solids: Solids,
    camera_height: Tensor,
    swing: Tensor,
    drop: Tensor,
) -> Tensor:
    """(1, 3, N) linear radiance of the ground."""
    ground = ground._replace(reach_along=smeared(ground.reach_along, world.lights))
    blotch = blotches(ground.along, ground.across)
    ragged = 0.15 * blotch[3] * (1 - world.street.kerbed[:, None])
    inside = torch.minimum(ground.across - world.pavement.left, world.pavement.right - ground.across)
    paved = ((inside + ragged) / ground.reach_across + 0.5).clamp(0, 1)
    albedo = torch.empty(1, 3, ground.z.shape[1])
    coverage, studs = torch.zeros_like(ground.z), torch.zeros_like(ground.z)
    road = (paved[0] > 0).nonzero()[:, 0]
    if len(road):
        part, stain = Ground(*(t[:, road] for t in ground)), blotch[:, :, road]
        reach = (part.reach_along, part.reach_across)
        bare = pavement_albedo(world.pavement, world.layout, part.along, part.across, *reach, stain)
        grazing = part.z / camera_height[:, None]
        paint_on, studs_on, colour = paint(world.layout, part.along, part.across, *reach, grazing, stain[2])
        studs_on = studs_on * (1 - paint_on)
        paint_on = torch.maximum(paint_on, symbols(world.layout, part.along, part.across, *reach))
        bare = bare + (colour - bare) * paint_on[:, None] + (STUD_ALBEDO - bare) * studs_on[:, None]
        albedo[:, :, road], coverage[:, road], studs[:, road] = bare, paint_on, studs_on
    beside = (paved[0] < 1).nonzero()[:, 0]
    if len(beside):
        part = Ground(*(t[:, beside] for t in ground))
        verge = verge_albedo(
            world.surroundings, part.along, part.across, part.reach_along, blotch[0][:, beside]
        )
        share = paved[:, None, beside]
        albedo[:, :, beside] = torch.where(share > 0, verge + (albedo[:, :, beside] - verge) * share, verge)

    here = (ground.along, ground.across, ground.reach_along, ground.reach_across)
    albedo, coverage = varied_ground(
        world, place.across, camera_height, *here, albedo, paved, coverage, blotch[2]
    )
    sunlit, open_sky = shadows(world, light, ground, solids)
    lit = light.direct[..., None] * (light.sun[:, 1, None] * sunlit)[:, None]
    lit = lit + light.ambient[..., None] * open_sky[:, None]
    if bool(light.headlight > 0):
        retro = 1 + 2.5 * coverage + 8.0 * studs
        beam = headlight_irradiance(ground.x, ground.z) * light.headlight[:, None] * retro
        lit = (
            lit
            + ((1 - world.lights.on)[:, None] * beam)[:, None] * lit.new_tensor([1.0, 0.95, 0.85])[:, None]
        )
        lamps, own = night_irradiance(world.lights, ground.x, ground.z, ground.along, ground.across)
        lit = lit + lamps + own * retro[:, None]
    gloss = _gloss(world, light, swing, drop, sunlit, open_sky, blotch[2])
    return albedo * lit + gloss * paved[:, None]


def _gloss(
    world: World,
    light: Light,
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
