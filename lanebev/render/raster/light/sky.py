"""Sky, clouds, sun and hills."""

import torch
from torch import Tensor

from lanebev.render.raster.base.colour import colour
from lanebev.render.raster.base.features import Features
from lanebev.render.raster.base.noise import CLOUD, sample_line, sample_noise, smoothstep
from lanebev.render.raster.base.select import as_float, choose
from lanebev.render.rows import take_rows
from lanebev.render.scene.objects.surroundings import Surroundings
from lanebev.render.scene.world import Scene


def sky_along(scene: Scene, row: Tensor, ray_x: Tensor, rise: Tensor, features: Features) -> Tensor:
    """Compute the linear radiance of the sky along rays, (T, 3, N).

    Args:
        scene: B of them.
        row: (T,) which scene each row of the rays belongs to.
        ray_x: (T, N) right per metre forward.
        rise: (T, N) up per metre forward.
        features: what any of the scenes has.
    """
    light = take_rows(scene.light, row)
    level = (1 + ray_x * ray_x).rsqrt()
    norm = (1 + ray_x * ray_x + rise * rise).rsqrt()
    sun_right, sun_up, sun_ahead = light.sun.unsqueeze(-1).unbind(1)
    sun = (ray_x * sun_right + rise * sun_up + sun_ahead) * norm
    sun = choose(light.direct.amax(1, keepdim=True) > 0.3, sun, -2.0)
    around = take_rows(scene.world.surroundings, row)
    azimuth = ray_x.atan() + scene.place.heading[row, None]
    return sky_radiance(around, azimuth, rise * level, sun, features)


def sky_radiance(
    surroundings: Surroundings, azimuth: Tensor, rise: Tensor, sun: Tensor, features: Features
) -> Tensor:
    """Compute the linear radiance of sky and hills, (B, 3, N).

    Args:
        surroundings: surroundings of the road.
        azimuth: (B, N) rad in the world, right positive.
        rise: (B, N) tangent of the elevation.
        sun: (B, N) cosine of the angle to the sun, below -1 where there is none.
        features: what any of the scenes has.
    """
    haze = surroundings.skyline[..., None]
    blend = (rise.clamp(min=0) * 3.2).clamp(0, 1).sqrt()[:, None]
    sky = haze + (surroundings.zenith[..., None] - haze) * blend
    if features.cloud:
        flat = 1 / (rise.clamp(min=0.0) + 0.09)
        u, v = azimuth.sin() * flat * 0.05, azimuth.cos() * flat * 0.05
        density = sample_noise(CLOUD, u, v) + 0.4 * sample_noise(CLOUD, u * 4 + 0.3, v * 4)
        cover = surroundings.cloud[:, None]
        cloud = smoothstep(1.4 - 2.4 * cover, 2.2 - 2.0 * cover, density) * as_float(cover > 0)
        cloud = cloud * smoothstep(0.0, 0.1, rise)
        bright = surroundings.skyline.amax(1)[:, None] * 1.08
        white = bright - 0.16 * density.clamp(0, 2) * bright
        sky = sky + (white[:, None] - sky) * (0.9 * cloud)[:, None]
    if features.sun:
        near = sun.clamp(min=0)
        fourth = near.square().square()
        glow = 0.5 * fourth * fourth.square() + 6 * torch.exp(400 * (near - 1))
        sky = sky + glow[:, None] * colour(sky, 1.0, 0.93, 0.8)
    for ridge, distance in ((0, 0.75), (1, 0.5)):
        height = surroundings.hill_height[:, ridge, None]
        top = height * (1 + 0.45 * sample_line(azimuth * (1 / 6.2832) + 0.4 * ridge))
        green = surroundings.hill_colour[..., None] * haze.amax(1, keepdim=True)
        alpha = smoothstep(0.002, -0.002, rise - top) * as_float(height > 0)
        sky = sky + (haze * distance + (1 - distance) * green - sky) * alpha[:, None]
    return sky
