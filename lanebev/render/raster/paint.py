"""Linear radiance of every pixel: sky, ground, walls, things, in the order of their distance."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.ground import ground_radiance, ground_under
from lanebev.render.raster.lens import Lens
from lanebev.render.raster.solids import Light, Solids, draw
from lanebev.render.raster.walls import add_walls
from lanebev.render.scene.alignment import Alignment, ground_hit
from lanebev.render.scene.surroundings import sky_radiance
from lanebev.render.scene.world import Place, World

_GROUND_LIMIT = 1800.0  # m; beyond, everything is air


class Painted(NamedTuple):
    """A painted view of one scene.

    Attributes:
        radiance: (1, 3, H, W) linear.
        blocked: (1, H, W) m, Z of the nearest thing that is not the road; infinite: none.
        road_level: (1,) radiance of the road before the camera.
        nearest: (1,) m, Z of the nearest road in the image.
    """

    radiance: Tensor
    blocked: Tensor
    road_level: Tensor
    nearest: Tensor


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
        rays: (1, 2, H, W), see :func:`~lanebev.render.raster.lens.pixel_rays`.
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
    ground = ground_under(
        place,
        alignment,
        swing[:, below],
        drop[:, below],
        depth[:, below],
        slope[:, below],
        steps.flatten(2)[:, :, below],
    )
    lit = ground_radiance(world, place, light, ground, solids, camera_height, swing[:, below], drop[:, below])
    haze = world.surroundings.skyline
    clear = torch.exp(-ground.z / world.weather.visibility[:, None])[:, None]
    radiance[:, :, below] = haze[..., None] * (1 - clear) + lit * clear

    near = (
        (ground.z[0] < 40)
        & (ground.across[0] > world.pavement.left)
        & (ground.across[0] < world.pavement.right)
    )
    metered = lit.mean(1)[:, near] if bool(near.any()) else lit.mean(1)
    road_level = metered.square().mean(1).sqrt()  # the root mean square: bright parts count for more
    ahead = ground.across.new_zeros(1, height * width)
    ahead[:, below] = ground.across
    add_walls(
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
