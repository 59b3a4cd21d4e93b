"""Independent random views: training material."""

import math
from contextlib import nullcontext

import torch
from torch import Tensor

from lanebev.geometry.precision import autocast_off
from lanebev.geometry.vanishing_point import vanishing_point
from lanebev.render.course import sample_alignment
from lanebev.render.frame import RenderedFrame
from lanebev.render.raster.base.features import features_of
from lanebev.render.raster.paint import paint_view, prepare
from lanebev.render.raster.sensor.sensor import take_image
from lanebev.render.rows import send, take_rows
from lanebev.render.scene.camera.lens import (
    Lens,
    sample_distortion,
    sample_extrinsics,
    sample_intrinsics,
    varied_extrinsics,
    varied_intrinsics,
)
from lanebev.render.scene.camera.window import WindowConfig, window_from_native
from lanebev.render.scene.sampler import BatchSampler
from lanebev.render.scene.world import Place, Scene, World, moved_along, sample_world, scene_at
from lanebev.render.truth import frame_truth
from lanebev.tensors import one_thread

_ROWS_ON_CPU, _ROWS_ELSEWHERE = 1, 64  # scenes rendered together: on a processor, what its cache holds


def render_scenes(
    host: Scene,
    size: tuple[int, int],
    seeds: list[int],
    *,
    device: torch.device | str | None = None,
    rows: int | None = None,
    ideal_sensor: bool = False,
) -> RenderedFrame:
    """Render scenes, and return the images with their truth.

    Args:
        host: B scenes on the CPU.
        size: image (height, width).
        seeds: B of them, of each image's rain and noise.
        device: where to render, by default the CPU.
        rows: how many scenes are rendered together; by default 1 on a CPU, whose cache then holds them, and
            64 elsewhere.
        ideal_sensor: leave out rain, blur, noise and compression.
    """
    where = torch.device(device or "cpu")
    rows = rows or (_ROWS_ON_CPU if where.type == "cpu" else _ROWS_ELSEWHERE)
    alone = (
        nullcontext() if where.type == "cpu" else one_thread()
    )  # elsewhere the host computes only small tensors
    with autocast_off(where), alone:
        scene = send(host, where)
        prepared = prepare(scene, size)
        parts = []
        for start in range(0, len(host.place.along), rows):
            cut = slice(start, start + rows)
            own = take_rows(host, cut)
            part = own if scene is host else take_rows(scene, cut)
            features = features_of(own)
            generators = [torch.Generator(where).manual_seed(seed) for seed in seeds[cut]]
            painted = paint_view(part, take_rows(prepared, cut), size, features)
            image = take_image(painted, part, own, features, generators, ideal_sensor)
            parts.append((image, painted.blocked, painted.nearest))
        image, blocked, nearest = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
        return frame_truth(image, blocked, scene, nearest)


def sample_place(sampler: BatchSampler, world: World, ego_lane: Tensor) -> tuple[World, Place]:
    """Sample places in the ego lane, at times near its border or over it, and the worlds about them."""
    across = world.layout.across
    left, right = (across.gather(1, ego_lane[:, None] + i)[:, 0] for i in (0, 1))
    start = sampler.uniform(0, 3000)  # elsewhere in the endless textures
    changing = sampler.chance(0.15)
    centred = sampler.normal(0.25).clamp(-0.8, 0.8)
    anywhere = sampler.uniform(-0.5, 0.5) * (right - left)
    place = Place(
        along=start,
        across=0.5 * (left + right) + torch.where(changing, anywhere, centred) + world.glass.side,
        ego_lane=ego_lane,
        heading=sampler.uniform(-math.pi, math.pi),
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
    rows: int | None = None,
) -> RenderedFrame:
    """Render random scenes, poses, lenses and weather, one image each.

    The same state of the generator gives the same scenes on every device, and on one device the same images
    bit for bit. What a row shows depends on the batch size, since all rows draw from one generator.

    Args:
        batch_size: B.
        image_size: (H, W).
        generator: the only source of randomness, of any device.
        device: where to render, and where the result is; by default the CPU.
        window: render windows about the horizon of images with more pixels; by default whole images. The
            intrinsics are then those of the window; a lens's distortion is the same on the z = 1 plane.
        model: "pinhole" (Brown-Conrady, D = 5) or "fisheye" (Kannala-Brandt, D = 4) lenses.
        kind: kind of road, one of :data:`~lanebev.render.scene.kinds.KINDS`.
        ideal_sensor: leave out rain, blur, noise and compression.
        rows: how many scenes are rendered together, see :func:`render_scenes`.

    Raises:
        ValueError: no images asked for, an image smaller than 16 px, an unknown lens model or kind.
    """
    scene, seeds = sample_views(batch_size, image_size, generator, window=window, model=model, kind=kind)
    return render_scenes(scene, image_size, seeds, device=device, rows=rows, ideal_sensor=ideal_sensor)


@one_thread()
def sample_views(
    batch_size: int,
    image_size: tuple[int, int],
    generator: torch.Generator,
    *,
    window: WindowConfig | None = None,
    model: str = "pinhole",
    kind: str = "any",
) -> tuple[Scene, list[int]]:
    """Sample on the CPU what :func:`render_views` renders from the same arguments: B scenes and B seeds."""
    if batch_size < 1 or min(image_size) < 16:
        raise ValueError(
            f"expected batch_size >= 1 and image_size >= (16, 16), got {batch_size} and {tuple(image_size)}"
        )
    generator = _on_cpu(generator)
    sampler = BatchSampler(batch_size, generator)
    world, ego_lane = sample_world(sampler, kind)
    world, place = sample_place(sampler, world, ego_lane)
    alignment = sample_alignment(sampler)
    faulty = world.kinds.camera
    intrinsics = sample_intrinsics(sampler, image_size)
    intrinsics = varied_intrinsics(sampler, faulty, intrinsics, image_size)
    distortion = sample_distortion(sampler, intrinsics, image_size, model)
    pose = varied_extrinsics(sampler, faulty, sample_extrinsics(sampler))
    lens = Lens(intrinsics, distortion, model, pose)
    if window is not None:
        world, lens = _through_window(sampler, window, image_size, world, lens)
    scene = scene_at(world, place, alignment, lens)
    return scene, torch.randint(2**62, (batch_size,), generator=generator).tolist()


def _through_window(
    sampler: BatchSampler, config: WindowConfig, size: tuple[int, int], world: World, lens: Lens
) -> tuple[World, Lens]:
    """Look through windows: other intrinsics, and blur that is as much larger as the native pixels are."""
    scale = sampler.uniform(*config.scale)
    pitch, yaw = lens.extrinsics[:2]
    horizon = vanishing_point(pitch, yaw, lens.intrinsics, lens.distortion, lens.model)
    matrix = window_from_native(sampler, config, scale, size, horizon)
    zoom = scale.clamp(max=1.0) ** -sampler.uniform(0.0, 1.0)  # native images have as many pixels, or more
    sensor = world.sensor._replace(blur=world.sensor.blur * zoom)
    return world._replace(sensor=sensor), lens._replace(intrinsics=matrix @ lens.intrinsics)


def _on_cpu(generator: torch.Generator) -> torch.Generator:
    """Return the generator itself, or one on the CPU with a seed drawn from one on another device."""
    if generator.device.type == "cpu":
        return generator
    seed = torch.randint(2**62, (), generator=generator, device=generator.device)
    return torch.Generator().manual_seed(int(seed))
