"""Walls beside the road in the image, from the outside inwards."""

from __future__ import annotations

from itertools import accumulate, groupby
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.blocks import Blocks, make_blocks
from lanebev.render.raster.canvas import Canvas
from lanebev.render.raster.features import Features
from lanebev.render.raster.ground import headlight_irradiance
from lanebev.render.raster.houses import lit_windows
from lanebev.render.raster.rays import View
from lanebev.render.raster.select import as_float, put, take, take_channels
from lanebev.render.raster.wall_texture import wall_texture
from lanebev.render.scene.alignment import elevation_at, wall_hit, wall_table
from lanebev.render.scene.sampler import select_rows
from lanebev.render.scene.surroundings import HOUSES, NUM_WALLS, SLOPE, TREES, Wall, walls_of
from lanebev.render.scene.world import Scene

_BLOCK = 256  # pixels: a distant rail has few
_FARTHEST = 900.0  # m
_OVERLAP = 0.5  # m that something may be nearer than a wall and still be hidden by it


class WallHits(NamedTuple):
    """Points on walls, (T, N) each; every row of points is of one wall.

    Attributes:
        pixel: int64, row-major in the batch.
        z: m.
        arc: m from the camera's foot.
        up: m above the road.
        ray_x: right per metre forward.
    """

    pixel: Tensor
    z: Tensor
    arc: Tensor
    up: Tensor
    ray_x: Tensor


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
    looks = sorted((*features.looks[i], *entry) for i, entry in enumerate(features.walls))
    entries = torch.tensor(looks).to(canvas.depth.device, non_blocking=True)
    row, wall = entries[:, 2], entries[:, 3]
    walls = walls_of(scene.world.surroundings, row, wall)
    blocks, hits = _hits(scene, view, canvas, across, row, walls)
    if not len(blocks):
        return
    starts = [0, *accumulate(blocks.counts)]
    colours, alphas = [], []
    for (kind, style), group in groupby(range(len(looks)), lambda e: tuple(looks[e][:2])):
        members = list(group)
        part = slice(starts[members[0]], starts[members[-1] + 1])
        own = select_rows(walls, blocks.row[part])
        seen = WallHits(*(t[part] for t in hits))
        lit, alpha = _radiance(scene, view, row[blocks.row[part]], own, seen, (kind, style), features)
        colours.append(lit)
        alphas.append(alpha)
    colour, alpha = torch.cat(colours), torch.cat(alphas)
    for number in range(NUM_WALLS):
        chosen = [
            t for e, look in enumerate(looks) if look[3] == number for t in range(starts[e], starts[e + 1])
        ]
        if chosen:
            index = torch.tensor(chosen).to(colour.device, non_blocking=True)
            _composite(canvas, *(t.index_select(0, index) for t in (hits.pixel, hits.z, colour, alpha)))


def _hits(
    scene: Scene, view: View, canvas: Canvas, across: Tensor, row: Tensor, walls: Wall
) -> tuple[Blocks, WallHits]:
    """Where rays meet E walls (in scenes ``row``) before the ground."""
    height = scene.lens.extrinsics.height[row]
    place_across = walls.across - scene.place.across[row]
    tall = walls.height * 1.5
    mask = _candidates(scene, view, canvas, across, row, walls.across, place_across, tall - height)
    blocks = make_blocks(mask, _BLOCK)
    alignment = select_rows(scene.alignment, row)
    table = wall_table(alignment, place_across)

    pixel = (
        blocks.place + ((row - torch.arange(len(row), device=row.device)) * mask.shape[1])[blocks.row, None]
    )
    ray_x, ray_y = take(view.ray_x, pixel), take(view.ray_y, pixel)
    z, arc = wall_hit(select_rows(table, blocks.row), ray_x)
    up = height[blocks.row, None] - ray_y * z - elevation_at(select_rows(alignment, blocks.row), z)
    keep = (
        (z < _FARTHEST)
        & (up > -0.3)
        & (up < tall[blocks.row, None])
        & (z < take(canvas.depth, pixel) + _OVERLAP)
    )
    kept = make_blocks(keep, _BLOCK, row=blocks.row, num_rows=len(row))
    return kept, WallHits(*(take(t, kept.place) for t in (pixel, z, arc, up, ray_x)))


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
    """(E, H·W) bool: pixels that may show a wall: of the ground beyond it, or low enough in the sky."""
    side = place_across.sign()[:, None]
    aside = place_across.abs().clamp(min=0.5)[:, None]
    sharpest = scene.alignment.curvature.abs().amax(1)[row, None]
    bent = (sharpest / aside).sqrt()  # on a bend the road turns towards its wall
    outward = (view.ray_x.index_select(0, row) * side).clamp(min=0)
    steepest = above.clamp(min=0)[:, None] * (1.3 / aside * outward + (bent + 0.004))
    low = -view.ray_y.index_select(0, row) < steepest
    beyond = (across.index_select(0, row) - wall_across[:, None]) * side > 0
    sky = canvas.depth.isinf().view_as(across).index_select(0, row)
    return (sky & low) | (~sky & beyond)


def _radiance(
    scene: Scene,
    view: View,
    row: Tensor,
    wall: Wall,
    hits: WallHits,
    look: tuple[int, int],
    features: Features,
) -> tuple[Tensor, Tensor]:
    """Linear radiance (T, 3, N) as seen through the air, and coverage (T, N), of walls of one look."""
    kind, style = look
    light = select_rows(scene.light, row)
    along = hits.arc + scene.place.along[row, None]
    footprint = (take(view.steps[3], hits.pixel).abs() * hits.z).clamp(min=1e-3)
    albedo, alpha = wall_texture(wall, kind, style, along, hits.up, footprint)
    side = (wall.across - scene.place.across[row]).sign()
    faces, open_sky = (-side * light.sun[:, 0]).clamp(min=0), 0.62
    if kind >= TREES and kind not in (SLOPE, HOUSES):
        away = (-light.sun[:, 2]).clamp(min=0)  # sun from behind lights what the camera sees
        faces = 0.10 + 0.3 * light.sun[:, 1] * away + 0.35 * away + 0.35 * faces
        open_sky = 0.35
    lit = (light.direct * faces[:, None] + light.ambient * open_sky)[..., None]
    if features.headlight:
        beam = headlight_irradiance(hits.ray_x * hits.z, hits.z) * light.headlight[:, None]
        lit = lit + 0.6 * beam[:, None]
    lit = albedo * lit
    if kind == HOUSES and features.night:
        glow = lit_windows(wall, along, hits.up, footprint)
        lit = lit + glow * (scene.world.lights.on[row] > 0)[:, None, None]
    clear = torch.exp(-hits.z / scene.world.weather.visibility[row, None])[:, None]
    haze = scene.world.surroundings.skyline[row, :, None]
    return haze + (lit - haze) * clear, alpha


def _composite(canvas: Canvas, pixel: Tensor, z: Tensor, colour: Tensor, alpha: Tensor) -> None:
    """Paint points of walls of which no two meet in a pixel."""
    depth, blocked = take_channels(canvas.distance, pixel)
    alpha = alpha * as_float(z < depth + _OVERLAP)
    under = take_channels(canvas.radiance, pixel)
    put(canvas.radiance, pixel, under + (colour.transpose(0, 1) - under) * alpha)
    solid = torch.where(alpha > 0.5, z, torch.inf)
    put(canvas.distance, pixel, torch.stack([torch.minimum(depth, solid), torch.minimum(blocked, solid)]))
