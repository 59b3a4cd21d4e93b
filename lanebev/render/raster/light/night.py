"""Light at night: irradiance by lamps and headlights, lights in the image, their glare and mirrors."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lanebev.render.raster.base.noise import sample_line, smoothstep
from lanebev.render.raster.base.rays import View
from lanebev.render.scene.light.night import NUM_LAMPS, Lights
from lanebev.render.scene.objects.objects import TRUCK
from lanebev.render.scene.road.alignment import elevation_at, local_from_road, z_from_arc
from lanebev.render.scene.world import Scene
from lanebev.tensors import constant, join_tensors

_GLARE_GRID, _MIRROR_GRID = (8, 8), (4, 2)  # px of the image to one of the coarse pictures
_FAR = 1000.0  # m, where distant lights are put
_BRIGHT = 4.0  # radiance of a lamp; the own beam on the road is about 0.1


class Sprites(NamedTuple):
    """Lights in the image, (B, S) each unless said otherwise.

    Attributes:
        point: (B, S, 3) m, right, down, forward from the camera, in road directions.
        size: m, radius.
        colour: (B, S, 3) radiance.
        glare: factor of the halo.
    """

    point: Tensor
    size: Tensor
    colour: Tensor
    glare: Tensor


def headlight_irradiance(x: Tensor, z: Tensor) -> Tensor:
    """Compute the relative irradiance of usual dipped headlights on the road at (x, z) m, (B, N)."""
    distance = z.clamp(min=0.5)
    spread = torch.exp(-(((x - 0.02 * distance) / (1.8 + 0.22 * distance)) ** 2))
    pools = 1 + 0.5 * torch.exp(-(((x.abs() - 0.9 - 0.05 * distance) / (0.7 + 0.05 * distance)) ** 2))
    reach = (1 - torch.exp(-((distance / 5.0) ** 2))) / (1 + (distance / 14.0) ** 2)
    return 1.2 * spread * pools * reach


def low_beam(lights: Lights, x: Tensor, z: Tensor) -> Tensor:
    """Compute the relative irradiance of each night's own dipped headlights at (x, z) m, (B, N)."""
    ahead = z.clamp(min=0.5)
    wide = lights.beam_width[:, :1] + lights.beam_width[:, 1:] * ahead
    aside = (x - 0.03 * ahead) / wide
    flat_top = 1 / (1 + aside.abs() ** 4)
    fall = 1 / (1 + (ahead / lights.beam_reach[:, None]) ** lights.beam_fall[:, None])
    start = 1 - torch.exp(-((ahead / 4.0) ** 2))
    end = smoothstep(1.25, 0.75, ahead / (lights.beam_end[:, None] * (1 + 0.15 * aside)))
    rays = 1 + lights.beam_rays[:, None] * sample_line(x / (ahead + 3.0) * 0.11 + 0.5)
    return 1.3 * flat_top * fall * start * end * rays.clamp(min=0.2)


def lamp_light(lights: Lights, along: Tensor, across: Tensor) -> Tensor:
    """Compute the street lamps' relative irradiance of the road, (B, N); 1 below unit power."""
    period, high = lights.lamp_period[:, None], lights.lamp_height[:, None]
    offset = (along - lights.lamp_phase[:, None]) / period
    offset = (offset - offset.round()) * period
    total = torch.zeros_like(along)
    for side in range(2):
        aside = across - lights.lamp_across[:, side, None]
        for step in (-1, 0, 1):
            apart = (offset + step * period) ** 2 + aside**2
            share = (1 + apart / high**2) ** -1.5
            total = total + lights.lamp[:, side, None] * share
    return total


def night_irradiance(
    lights: Lights, x: Tensor, z: Tensor, along: Tensor, across: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute the irradiance of the road by street lamps, and by the own beam, (B, 3, N) both."""
    lamps = lights.lamp_colour[..., None] * lamp_light(lights, along, across)[:, None]
    beam = (lights.beam[:, None] * low_beam(lights, x, z))[:, None] * lights.beam_colour[..., None]
    return lamps, beam


def _sprites(scene: Scene) -> Sprites:
    """Return all lights that a camera may see."""
    parts = [_street_lamps(scene), _vehicle_lamps(scene), _town(scene.world.lights)]
    return join_tensors(lambda each: torch.cat(each, 1), parts)


def _street_lamps(scene: Scene) -> Sprites:
    lights, place, alignment = scene.world.lights, scene.place, scene.alignment
    index = torch.arange(NUM_LAMPS, device=lights.on.device)
    first = (lights.lamp_phase - place.along) % lights.lamp_period
    arc = (first[:, None] + index * lights.lamp_period[:, None]).repeat(1, 2)
    across = (lights.lamp_across - place.across[:, None]).repeat_interleave(NUM_LAMPS, 1)
    x, z, _ = local_from_road(alignment, z_from_arc(alignment, arc), across)
    down = scene.lens.extrinsics.height[:, None] - elevation_at(alignment, z) - lights.lamp_height[:, None]
    power = lights.lamp.repeat_interleave(NUM_LAMPS, 1)
    shine = (_BRIGHT * (power > 0) * (0.4 + power))[..., None] * lights.lamp_colour[:, None]
    return Sprites(torch.stack([x, down, z], -1), 0 * z + 0.25, shine, 0.6 + 0.4 * power)


def _vehicle_lamps(scene: Scene) -> Sprites:
    """Return two lamps of every vehicle: red ones of those ahead, white ones of oncoming ones."""
    objects = scene.objects
    body = objects.shape[..., 0, :]
    sin, cos = objects.heading.sin(), objects.heading.cos()
    coming = cos < 0
    end = torch.where(coming, body[..., 3] + 0.05, body[..., 2] - 0.05)
    points, shines = [], []
    shown = objects.valid & (objects.kind <= TRUCK)
    red, white = constant((1.0, 0.03, 0.02), body), constant((1.0, 0.93, 0.8), body)
    for side in (-0.8, 0.8):
        aside = side * body[..., 0]
        x, z = objects.x + aside * cos + end * sin, objects.z - aside * sin + end * cos
        down = scene.lens.extrinsics.height[:, None] - objects.ground - torch.where(coming, 0.68, 0.85)
        points.append(torch.stack([x, down, z], -1))
        tail = 0.25 + 0.6 * objects.braking.float()
        strength = torch.where(coming, 1.5, tail) * shown * scene.world.lights.on[:, None]
        shines.append(_BRIGHT * strength[..., None] * torch.where(coming[..., None], white, red))
    shine = torch.cat(shines, 1)
    glare = torch.where(coming, 1.0, 0.25 + 0.25 * objects.braking.float()).repeat(1, 2)
    return Sprites(torch.cat(points, 1), 0 * glare + 0.08, shine, glare)


def _town(lights: Lights) -> Sprites:
    azimuth, rise = lights.spot_place.unbind(-1)
    point = torch.stack([azimuth * _FAR, -rise * _FAR, torch.full_like(rise, _FAR)], dim=-1)
    shine = _BRIGHT * lights.spot[..., None] * lights.spot_colour
    return Sprites(point, lights.spot_size * _FAR, shine, 0.3 * torch.ones_like(rise))


def add_lights(scene: Scene, view: View, radiance: Tensor, blocked: Tensor) -> Tensor:
    """Put lights of the night, their glare and their mirror images into the radiance.

    Args:
        scene: B of them.
        view: the pixels' rays.
        radiance: (B, 3, H, W) linear.
        blocked: (B, H, W) m, Z of the nearest thing that is not the road.

    Returns:
        (B, 3, H, W).
    """
    lights, lens, sprites = scene.world.lights, scene.lens, _sprites(scene)
    size = (radiance.shape[2], radiance.shape[3])
    height, width = size
    z = sprites.point[..., 2]
    pixel = lens.pixels_as_taken(sprites.point, size)
    inside = (
        (pixel > -0.04 * width).all(-1) & (pixel[..., 0] < 1.04 * width) & (pixel[..., 1] < 1.04 * height)
    )
    column, row = pixel[..., 0].round().clamp(0, width - 1), pixel[..., 1].round().clamp(0, height - 1)
    at = (row * width + column).long()
    clear = blocked.flatten(1).gather(1, at) > z - 1.5
    seen = inside & (z > 1.0) & (clear | (z < 3.0))
    colour = sprites.colour * seen[..., None]
    focal = lens.intrinsics[:, 0, 0, None]
    radius = (sprites.size * focal / z.clamp(min=1.0)).clamp(min=0.0012 * width)
    radiance = radiance + _discs(colour, pixel, radius.clamp(max=0.02 * width), size)
    halo = colour * (sprites.glare * lights.halo[:, None])[..., None]
    radiance = radiance + _glare(halo, pixel, radius, lights, size)
    mirrored = sprites.point * constant((1.0, -1.0, 1.0), z)
    eye = lens.extrinsics.height[:, None]
    mirrored = mirrored + torch.stack([0 * z, 2 * eye.expand_as(z), 0 * z], -1)
    below = lens.pixels_as_taken(mirrored, size)
    road = ((view.ray_y > 0.004).view(blocked.shape) & blocked.isinf())[:, None]
    return radiance + _mirror(colour * lights.mirror[:, None, None], below, radius, size) * road


def _discs(colour: Tensor, pixel: Tensor, radius: Tensor, size: tuple[int, int]) -> Tensor:
    """Draw soft discs, (B, 3, H, W), each over a window of fixed size about its middle."""
    height, width = size
    reach = max(3, width // 36)
    span = torch.arange(-reach, reach + 1, device=colour.device)
    dy, dx = (t.flatten() for t in torch.meshgrid(span, span, indexing="ij"))
    middle = pixel.round()
    x, y = middle[..., 0, None] + dx, middle[..., 1, None] + dy  # (B, S, K)
    distance = torch.hypot(x - pixel[..., 0, None], y - pixel[..., 1, None]) / radius[..., None]
    value = torch.exp(-(distance**2) * 1.2)
    value = value * ((x >= 0) & (x < width) & (y >= 0) & (y < height))
    at = (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)).long().flatten(1)
    out = colour.new_zeros(len(colour), 3, height * width)
    light = (colour.mT[..., None] * value[:, None]).flatten(2)
    out = out.scatter_reduce(2, at[:, None].expand(-1, 3, -1), light, "amax")  # a sum would hang on its order
    return torch.unflatten(out, 2, size)


def _grid(size: tuple[int, int], cell: tuple[int, int], like: Tensor) -> tuple[Tensor, Tensor]:
    rows, columns = -(-size[0] // cell[0]), -(-size[1] // cell[1])
    y = (torch.arange(rows, device=like.device, dtype=like.dtype) + 0.5) * cell[0] - 0.5
    x = (torch.arange(columns, device=like.device, dtype=like.dtype) + 0.5) * cell[1] - 0.5
    return y[:, None], x[None]


def _glare(colour: Tensor, pixel: Tensor, radius: Tensor, lights: Lights, size: tuple[int, int]) -> Tensor:
    """Draw wide halos and streaks about lights, (B, 3, H, W)."""
    y, x = _grid(size, _GLARE_GRID, pixel)
    dx, dy = x - pixel[..., 0, None, None], y - pixel[..., 1, None, None]  # (B, S, h, w)
    wide = (lights.halo_size * size[1])[:, None, None, None] + radius[..., None, None]
    value = 0.35 / (1 + (dx * dx + dy * dy) / wide**2) ** 1.5
    turn = lights.streak[:, 1, None, None, None]
    aside, ahead = dx * turn.sin() - dy * turn.cos(), dx * turn.cos() + dy * turn.sin()
    line = torch.exp(-((aside / (0.25 * wide + 2.0)) ** 2)) / (1 + (ahead / (5 * wide)) ** 2)
    value = value + 0.3 * lights.streak[:, :1, None, None] * line
    picture = torch.einsum("bsc,bshw->bchw", colour, value)
    return functional.interpolate(picture, size, mode="bilinear", align_corners=False)


def _mirror(colour: Tensor, pixel: Tensor, radius: Tensor, size: tuple[int, int]) -> Tensor:
    """Draw upright streaks at mirrored lights, (B, 3, H, W)."""
    y, x = _grid(size, _MIRROR_GRID, pixel)
    dx, dy = x - pixel[..., 0, None, None], y - pixel[..., 1, None, None]
    wide = 1.5 * radius[..., None, None] + 0.004 * size[1]
    tall = 0.16 * size[0] + 2 * radius[..., None, None]
    value = 0.05 * torch.exp(-((dx / wide) ** 2)) / (1 + (dy / tall) ** 2) ** 1.5
    picture = torch.einsum("bsc,bshw->bchw", colour, value)
    return functional.interpolate(picture, size, mode="bilinear", align_corners=False)
