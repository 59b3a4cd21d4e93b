"""Walls beside the road in the image, from the outside inwards."""

from collections.abc import Iterator
from itertools import groupby
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.base.blocks import Blocks, make_blocks
from lanebev.render.raster.base.canvas import Canvas
from lanebev.render.raster.base.features import Features
from lanebev.render.raster.base.rays import View
from lanebev.render.raster.base.select import as_float, choose, put, take, take_channels
from lanebev.render.raster.base.tiles import tile_corners, tile_pixels
from lanebev.render.raster.light.night import headlight_irradiance
from lanebev.render.raster.objects.houses import lit_windows
from lanebev.render.raster.objects.wall_texture import wall_texture
from lanebev.render.rows import take_rows
from lanebev.render.scene.objects.surroundings import FENCE, HEDGE, HOUSES, NUM_WALLS, TREES, Walls
from lanebev.render.scene.road.alignment import elevation_at, wall_hit, wall_table
from lanebev.render.scene.world import Scene
from lanebev.tensors import join_tensors

_TILES = 8  # tiles in a block of what may be wall
_BLOCK = 256  # pixels in a block of what is: a distant rail has few
_FARTHEST = 900.0  # m
_OVERLAP = 0.5  # m that something may be nearer than a wall and still be hidden by it


class WallHits(NamedTuple):
    """Points on walls, (T, N) each; every row of points is of one wall.

    Attributes:
        pixel: int64, row-major in the batch.
        z: m.
        along: m in the world.
        up: m above the road.
        ray_x: right per metre forward.
        footprint: m per pixel.
    """

    pixel: Tensor
    z: Tensor
    along: Tensor
    up: Tensor
    ray_x: Tensor
    footprint: Tensor


class WallRows(NamedTuple):
    """The walls to which T rows of points belong.

    Attributes:
        row: (T,) int64, the scene.
        kind: (T,) int64.
        wall: (T,) of them.
    """

    row: Tensor
    kind: Tensor
    wall: Walls


class WallColours(NamedTuple):
    """The appearance of points on walls.

    Attributes:
        albedo: (T, 3, N) linear reflectance.
        alpha: (T, N) coverage.
    """

    albedo: Tensor
    alpha: Tensor


def add_walls(scene: Scene, view: View, canvas: Canvas, across: Tensor, features: Features) -> None:
    """Paint the walls beside the road, outside in, into the canvas.

    Args:
        scene: B of them.
        view: the pixels' rays.
        canvas: to paint into.
        across: (B, H·W) m in the layout's frame, of the ground in the pixels; 0 where there is none.
        features: what the scenes have; lists the walls.
    """
    if not features.walls:
        return
    entries = sorted((*features.looks[i], *entry) for i, entry in enumerate(features.walls))
    kind, _, row, wall = torch.tensor(entries).to(canvas.depth.device, non_blocking=True).unbind(1)
    looks = [(entry[0], entry[1]) for entry in entries]
    walls = Walls(*(part[row, wall] for part in scene.world.surroundings.walls))
    blocks, hits = _hits(scene, view, canvas, across, row, walls)
    if not len(blocks):
        return
    own = WallRows(row[blocks.row], kind[blocks.row], take_rows(walls, blocks.row))
    colours = _textures(own.wall, blocks, hits, looks)
    lit = _radiance(scene, own, hits, colours.albedo, features)
    if features.night:
        _add_windows(scene, own, blocks, hits, looks, lit)
    for number in range(NUM_WALLS):
        index = blocks.of_rows([i for i, entry in enumerate(entries) if entry[3] == number])
        if len(index):
            _composite(canvas, *(t.index_select(0, index) for t in (hits.pixel, hits.z, lit, colours.alpha)))


def _hits(
    scene: Scene, view: View, canvas: Canvas, across: Tensor, row: Tensor, walls: Walls
) -> tuple[Blocks, WallHits]:
    """Compute where rays meet E walls (in scenes ``row``) before the ground."""
    height = scene.lens.extrinsics.height[row]
    place_across = walls.across - scene.place.across[row]
    tall = walls.height * 1.5
    mask = _candidates(scene, view, canvas, across, row, walls.across, place_across, tall - height)
    tiles = make_blocks(mask, _TILES)
    alignment = take_rows(scene.alignment, row)
    table = wall_table(alignment, place_across)

    own = tiles.row
    pixel = tile_pixels(tiles.place - own[:, None] * mask.shape[1], view.size).flatten(1)
    pixel = pixel + (row * across.shape[1])[own, None]
    ray_x, ray_y = take(view.ray_x, pixel), take(view.ray_y, pixel)
    z, arc = wall_hit(take_rows(table, own), ray_x)
    up = height[own, None] - ray_y * z - elevation_at(take_rows(alignment, own), z)
    keep = (z < _FARTHEST) & (up > -0.3) & (up < tall[own, None])
    keep &= z < take(canvas.depth, pixel) + _OVERLAP
    kept = make_blocks(keep, _BLOCK, row=own, num_rows=len(row))
    along = arc + scene.place.along[row][own, None]
    pixel, z, along, up, ray_x = (take(t, kept.place) for t in (pixel, z, along, up, ray_x))
    footprint = (take(view.steps[3], pixel).abs() * z).clamp(min=1e-3)
    return kept, WallHits(pixel, z, along, up, ray_x, footprint)


def _candidates(
    scene: Scene,
    view: View,
    canvas: Canvas,
    across: Tensor,
    row: Tensor,
    wall_across: Tensor,
    place_across: Tensor,
    above: Tensor,
) -> Tensor:
    """Return which tiles may show a wall: of the ground beyond it, or low in the sky, (E, tiles) bool.

    The line that bounds them is nearly straight within a tile, so testing the corners suffices.
    """
    sky = tile_corners(canvas.depth.isinf().view_as(across), view.size).index_select(1, row)
    ray_x, ray_y, across = (
        tile_corners(t, view.size).index_select(1, row) for t in (view.ray_x, view.ray_y, across)
    )
    side = place_across.sign()[:, None]
    aside = place_across.abs().clamp(min=0.5)[:, None]
    sharpest = scene.alignment.curvature.abs().amax(1)[row, None]
    bent = (sharpest / aside).sqrt()  # on a bend the road turns towards its wall
    steepest = above.clamp(min=0)[:, None] * (1.3 / aside * (ray_x * side).clamp(min=0) + (bent + 0.004))
    low = -ray_y < steepest
    beyond = (across - wall_across[:, None]) * side > 0
    return ((sky & low) | (~sky & beyond)).any(0)


def _textures(walls: Walls, blocks: Blocks, hits: WallHits, looks: list[tuple[int, int]]) -> WallColours:
    """Compute colours of points on walls, sorted by their looks (kind, style), one look at a time."""
    parts = []
    for look, part in _parts(blocks, looks):
        own = take_rows(walls, part)
        parts.append(
            WallColours(*wall_texture(own, *look, hits.along[part], hits.up[part], hits.footprint[part]))
        )
    return join_tensors(torch.cat, parts)


def _parts(blocks: Blocks, looks: list[tuple[int, int]]) -> Iterator[tuple[tuple[int, int], slice]]:
    """Yield the looks of walls, sorted by them, each with the blocks that have it."""
    start = 0
    for look, group in groupby(zip(looks, blocks.counts, strict=True), lambda entry: entry[0]):
        count = sum(number for _, number in group)
        yield look, slice(start, start + count)
        start += count


def _radiance(scene: Scene, own: WallRows, hits: WallHits, albedo: Tensor, features: Features) -> Tensor:
    """Compute the linear radiance (T, 3, N) of points on walls as seen through the air."""
    light, row, kind = take_rows(scene.light, own.row), own.row, own.kind
    right, up, ahead = light.sun.unbind(1)
    facing = (-(own.wall.across - scene.place.across[row]).sign() * right).clamp(min=0)
    away = (-ahead).clamp(min=0)  # sun from behind lights what the camera sees
    soft = (kind == TREES) | (kind == HEDGE) | (kind == FENCE)
    leaves = 0.10 + 0.3 * up * away + 0.35 * away + 0.35 * facing
    facing, open_sky = choose(soft, leaves, facing), choose(soft, 0.35, 0.62)
    lit = (light.direct * facing[:, None] + light.ambient * open_sky[:, None])[..., None]
    if features.headlight:
        beam = headlight_irradiance(hits.ray_x * hits.z, hits.z) * light.headlight[:, None]
        lit = lit + 0.6 * beam[:, None]
    clear = torch.exp(-hits.z / scene.world.weather.visibility[row, None])[:, None]
    return torch.lerp(scene.world.surroundings.skyline[row, :, None], albedo * lit, clear)


def _add_windows(
    scene: Scene, own: WallRows, blocks: Blocks, hits: WallHits, looks: list[tuple[int, int]], lit: Tensor
) -> None:
    """Add light windows of houses at night; changes the radiance (T, 3, N)."""
    for (kind, _), part in _parts(blocks, looks):
        if kind == HOUSES and part.stop > part.start:
            row = own.row[part]
            on = as_float(scene.world.lights.on[row] > 0)[:, None]
            clear = on * torch.exp(-hits.z[part] / scene.world.weather.visibility[row, None])
            wall = take_rows(own.wall, part)
            windows = lit_windows(wall, hits.along[part], hits.up[part], hits.footprint[part])
            lit[part] += windows * clear[:, None]


def _composite(canvas: Canvas, pixel: Tensor, z: Tensor, colour: Tensor, alpha: Tensor) -> None:
    """Paint points of walls of which no two meet in a pixel."""
    under = take_channels(canvas.planes, pixel)
    alpha = alpha * as_float(z < under[3] + _OVERLAP)
    mixed = torch.lerp(under[:3], colour.transpose(0, 1), alpha)
    solid = torch.where(alpha > 0.5, z, torch.inf)
    put(canvas.planes, pixel, torch.cat([mixed, torch.minimum(under[3:], solid)]))
