"""Independent random views: training material."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lanebev.render.frame import RenderedFrame
from lanebev.render.raster.effects import rain
from lanebev.render.raster.glass import behind_glass, recorded
from lanebev.render.raster.lens import (
    Lens,
    pixel_rays,
    sample_distortion,
    sample_extrinsics,
    sample_intrinsics,
)
from lanebev.render.raster.night import add_lights, night_light, sprites
from lanebev.render.raster.paint import paint_view
from lanebev.render.raster.photometry import add_bonnet, add_noise, blur, compress, expose, light_of
from lanebev.render.raster.tunnel import add_ceiling, tunnel_light
from lanebev.render.scene.alignment import Alignment, build_alignment
from lanebev.render.scene.sampler import Dice, map_tensors, row_of
from lanebev.render.scene.traffic import place_solids
from lanebev.render.scene.varied import varied_extrinsics, varied_intrinsics
from lanebev.render.scene.window import (
    WindowConfig,
    sample_window_scale,
    vanishing_pixel,
    window_from_native,
)
from lanebev.render.scene.world import Place, World, moved_along, sample_course, sample_world
from lanebev.render.truth import frame_truth


def render_place(
    world: World,
    place: Place,
    alignment: Alignment,
    lens: Lens,
    size: tuple[int, int],
    generator: torch.Generator,
    ideal_sensor: bool = False,
) -> RenderedFrame:
    """Cameras at places in worlds.

    Args:
        world: B of them.
        place: of the cameras.
        alignment: the road's course, seen from there.
        lens: the cameras.
        size: image (height, width).
        generator: of the sensor's noise.
        ideal_sensor: leave out blur, noise and compression.
    """
    solids = place_solids(world.traffic, alignment, place.along, place.across)
    light = night_light(light_of(world.weather, place.heading), world.lights)
    light = tunnel_light(light, world.tunnel)
    rays, steps = pixel_rays(lens, size)
    images, covers, nearest = [], [], []
    for b in range(len(place.along)):  # one scene at a time: see paint_view
        one, sensor, lamp = row_of(world, b), row_of(world.sensor, b), row_of(light, b)
        cut = slice(b, b + 1)
        lens_b = Lens(lens.intrinsics[cut], lens.distortion[cut], lens.model, row_of(lens.extrinsics, b))
        painted = paint_view(
            one,
            row_of(place, b),
            row_of(alignment, b),
            lens_b,
            row_of(solids, b),
            lamp,
            rays[cut],
            steps[cut],
        )
        if bool(one.tunnel.on > 0):
            course = (row_of(place, b), row_of(alignment, b), lens_b, rays[cut])
            painted = painted._replace(
                radiance=add_ceiling(painted.radiance, painted.blocked, one.tunnel, *course)
            )
        if bool(one.lights.on > 0):
            lights = sprites(one.lights, row_of(place, b), row_of(alignment, b), lens_b, row_of(solids, b))
            lit = add_lights(painted.radiance, painted.blocked, one.lights, lights, lens_b, rays[cut])
            painted = painted._replace(radiance=lit)
        if bool(sensor.bonnet > 0):
            add_bonnet(painted.radiance, painted.blocked, sensor, lamp, one.surroundings.skyline)
        image = expose(painted.radiance, sensor, painted.road_level)
        if not ideal_sensor:
            if bool(one.weather.wet > 0):
                image = rain(image, float(one.weather.wet), generator)
            changed = bool((one.kinds.camera | one.kinds.night).any())
            image = behind_glass(image, one.glass) if changed else image
            image = blur(image, float(sensor.blur) * size[1] / 640)
            image = add_noise(image, sensor, generator)
            image = compress(recorded(image, one.glass) if changed else image, sensor.jpeg)
        images.append(image)
        covers.append(painted.blocked)
        nearest.append(painted.nearest)
    image, blocked = torch.cat(images), torch.cat(covers)
    return frame_truth(image, blocked, world.layout, place, alignment, lens, solids, torch.cat(nearest))


def sample_place(dice: Dice, world: World, ego_lane: Tensor) -> tuple[World, Place]:
    """Random places in the ego lane, at times close to its border or over it, and the worlds about them."""
    across = world.layout.across
    left, right = (across.gather(1, ego_lane[:, None] + i)[:, 0] for i in (0, 1))
    start = dice.uniform(0, 3000)  # elsewhere in the endless textures
    changing = dice.chance(0.15)
    centred = dice.normal(0.25).clamp(-0.8, 0.8)
    anywhere = dice.uniform(-0.5, 0.5) * (right - left)
    place = Place(
        along=start,
        across=0.5 * (left + right) + torch.where(changing, anywhere, centred),
        ego_lane=ego_lane,
        heading=dice.uniform(-math.pi, math.pi),
    )
    return moved_along(world, start), place


@torch.no_grad()
def render_views(
    batch_size: int,
    image_size: tuple[int, int],
    generator: torch.Generator,
    *,
    device: torch.device | str | None = None,
    window: WindowConfig | None = None,
    model: str = "pinhole",
    kind: str = "any",
    ideal_sensor: bool = False,
) -> RenderedFrame:
    """Random scenes, poses, lenses and weather, one image each.

    Args:
        batch_size: B.
        image_size: (H, W).
        generator: the only source of randomness.
        device: where to render, and where the result is; by default the CPU.
        window: render windows about the horizon of images with more pixels; by default whole images. The
            intrinsics are then those of the window; a lens's distortion is the same on the z = 1 plane.
        model: "pinhole" (Brown-Conrady, D = 5) or "fisheye" (Kannala-Brandt, D = 4) lenses.
        kind: what the worlds show, one of :data:`~lanebev.render.scene.kinds.KINDS`.
        ideal_sensor: leave out blur, noise and compression.

    Raises:
        ValueError: no images asked for, an image smaller than 16 px, an unknown lens model or kind.
    """
    if batch_size < 1 or min(image_size) < 16:
        raise ValueError(
            f"expected batch_size >= 1 and image_size >= (16, 16), got {batch_size} and {tuple(image_size)}"
        )
    dice = Dice(batch_size, generator)
    world, ego_lane = sample_world(dice, kind)
    world, place = sample_place(dice, world, ego_lane)
    alignment = build_alignment(*sample_course(dice))
    intrinsics = varied_intrinsics(dice, world.kinds.camera, sample_intrinsics(dice, image_size), image_size)
    distortion = sample_distortion(dice, intrinsics, image_size, model)
    pose = varied_extrinsics(dice, world.kinds.camera, sample_extrinsics(dice))
    lens = Lens(intrinsics, distortion, model, pose)
    if window is not None:
        scale = sample_window_scale(dice, window)
        horizon = vanishing_pixel(intrinsics, distortion, model, lens.extrinsics)
        matrix = window_from_native(dice, window, scale, image_size, horizon)
        lens = lens._replace(intrinsics=matrix @ intrinsics)
        zoom = scale.clamp(max=1.0) ** -dice.uniform(
            0.0, 1.0
        )  # from a native image of more, or as few, pixels
        world = world._replace(sensor=world.sensor._replace(blur=world.sensor.blur * zoom))
    frame = render_place(world, place, alignment, lens, image_size, generator, ideal_sensor)
    return map_tensors(lambda tensor: tensor.to(device), frame)
