"""Linear radiance of every pixel: sky, ground, walls, objects, in the order of their distance."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.base.blocks import Blocks, make_blocks
from lanebev.render.raster.base.canvas import Canvas, empty_canvas
from lanebev.render.raster.base.features import Features
from lanebev.render.raster.base.footprint import Ground, ground_under
from lanebev.render.raster.base.rays import View, coarse_plane, pixel_rays
from lanebev.render.raster.base.select import as_float, put, take, take_channels
from lanebev.render.raster.light.night import add_lights
from lanebev.render.raster.light.sky import sky_along
from lanebev.render.raster.objects.hexahedra import Hexahedra, hexahedra
from lanebev.render.raster.objects.objects import add_objects
from lanebev.render.raster.objects.tunnel import add_ceiling
from lanebev.render.raster.objects.walls import add_walls
from lanebev.render.raster.road.ground import ground_radiance
from lanebev.render.rows import take_rows
from lanebev.render.scene.road.alignment import ground_hit, lowest_slopes
from lanebev.render.scene.world import Scene

_METERED = 40.0  # m of road by which the exposure is set


class Prepared(NamedTuple):
    """The parts of B scenes that are the same for all pixels.

    Attributes:
        plane: (B, 2, rows, columns), see :func:`~lanebev.render.raster.base.rays.coarse_plane`.
        solids: the objects.
    """

    plane: Tensor
    solids: Hexahedra


class Painted(NamedTuple):
    """Painted views of B scenes.

    Attributes:
        radiance: (B, 3, H, W) linear.
        blocked: (B, H, W) m, Z of the nearest thing that is not the road; infinite: none.
        road_level: (B,) radiance of the road before the camera.
        nearest: (B,) m, Z of the nearest road in the image.
    """

    radiance: Tensor
    blocked: Tensor
    road_level: Tensor
    nearest: Tensor


def prepare(scene: Scene, size: tuple[int, int]) -> Prepared:
    """Compute what does not go by pixels, for scenes of which parts are painted together."""
    return Prepared(coarse_plane(scene.lens, size), hexahedra(scene.objects, scene.lens, size))


def paint_view(scene: Scene, prepared: Prepared, size: tuple[int, int], features: Features) -> Painted:
    """Render scenes to linear radiance."""
    view = pixel_rays(scene.lens, prepared.plane, size)
    canvas = empty_canvas(view.ray_y.numel(), view.ray_y.device)
    lowest = lowest_slopes(scene.alignment, scene.lens.extrinsics.height)[:, -1:]
    on_ground = view.ray_y > lowest
    _add_sky(scene, view, canvas, make_blocks(~on_ground), features)
    below = make_blocks(on_ground)
    ground, lit = _add_ground(scene, view, canvas, below, features)
    across = torch.zeros_like(canvas.depth)
    put(across[None], below.place, ground.across[None])
    add_walls(scene, view, canvas, across.view_as(view.ray_x), features)
    add_objects(scene, view, prepared.solids, canvas)
    shape = (len(lowest), *view.size)
    radiance, blocked = canvas.radiance.view(3, *shape).transpose(0, 1), canvas.blocked.view(shape)
    _change_rows(scene, view, radiance, blocked, features.rows.tunnel, add_ceiling)
    _change_rows(scene, view, radiance, blocked, features.rows.night, add_lights)
    return Painted(
        radiance=radiance,
        blocked=blocked,
        road_level=_road_level(scene, below, ground, lit),
        nearest=_nearest(below, ground, len(lowest)),
    )


def _add_sky(scene: Scene, view: View, canvas: Canvas, above: Blocks, features: Features) -> None:
    ray_x, rise = take(view.ray_x, above.place), -take(view.ray_y, above.place)
    put(canvas.radiance, above.place, sky_along(scene, above.row, ray_x, rise, features).transpose(0, 1))


def _add_ground(
    scene: Scene, view: View, canvas: Canvas, below: Blocks, features: Features
) -> tuple[Ground, Tensor]:
    """Paint the ground; returns where it is and its radiance (T, 3, S) before the air's."""
    alignment, place = take_rows(scene.alignment, below.row), take_rows(scene.place, below.row)
    ray_x, ray_y = take(view.ray_x, below.place), take(view.ray_y, below.place)
    z, slope = ground_hit(alignment, scene.lens.extrinsics.height[below.row], ray_y)
    steps = take_channels(view.steps.flatten(1), below.place)
    ground = ground_under(place, alignment, ray_x, ray_y, z, slope, steps)
    lit = ground_radiance(scene, below, ground, ray_x, ray_y, features)
    clear = torch.exp(-z / scene.world.weather.visibility[below.row, None])[:, None]
    haze = scene.world.surroundings.skyline[below.row, :, None]
    put(canvas.radiance, below.place, torch.lerp(haze, lit, clear).transpose(0, 1))
    put(canvas.planes[3:4], below.place, z[None])
    return ground, lit


def _change_rows(
    scene: Scene,
    view: View,
    radiance: Tensor,
    blocked: Tensor,
    rows: list[int],
    effect: Callable[[Scene, View, Tensor, Tensor], Tensor],
) -> None:
    """Change the radiance of some rows by an effect of their scenes, rays, radiance and blocked."""
    if not rows:
        return
    index = torch.tensor(rows).to(radiance.device, non_blocking=True)
    own = view._replace(ray_x=view.ray_x.index_select(0, index), ray_y=view.ray_y.index_select(0, index))
    under, hidden = radiance.index_select(0, index), blocked.index_select(0, index)
    radiance.index_copy_(0, index, effect(take_rows(scene, index), own, under, hidden))


def _road_level(scene: Scene, below: Blocks, ground: Ground, lit: Tensor) -> Tensor:
    """Compute the root mean square radiance of the road before the camera, (B,): bright parts count more."""
    pavement = scene.world.pavement
    left, right = pavement.left[below.row, None], pavement.right[below.row, None]
    near = (ground.z < _METERED) & (ground.across > left) & (ground.across < right)
    every, on_road = as_float(below.real()), as_float(below.real() & near)
    grey = lit.mean(1).square()
    sums = torch.stack([(grey * on_road).sum(1), on_road.sum(1), (grey * every).sum(1), every.sum(1)])
    road, road_count, all_of_it, count = below.sum_rows(sums)
    mean = torch.where(road_count > 0, road / road_count.clamp(min=1), all_of_it / count.clamp(min=1))
    return mean.sqrt()


def _nearest(below: Blocks, ground: Ground, batch: int) -> Tensor:
    """Compute Z of the nearest road in the image, (B,) m; 3 where there is none."""
    nearest = ground.z.new_full((batch,), torch.inf)
    nearest = nearest.scatter_reduce(0, below.row, ground.z.amin(1).clamp(0.8, 8.0), "amin")
    return nearest.where(nearest.isfinite(), 3.0)
