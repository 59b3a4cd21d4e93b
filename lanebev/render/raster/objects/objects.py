"""Objects on the road in the image, far to near.

What an object may cover is tested in tiles of 8 x 8 pixels: one ray to the pixel inside, four along the
outlines.
"""

from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.base.canvas import Canvas
from lanebev.render.raster.base.rays import View
from lanebev.render.raster.base.select import as_float, choose, indices_where, put, take, take_channels
from lanebev.render.raster.base.tiles import TILE, TILE_PIXELS
from lanebev.render.raster.objects.hexahedra import NEVER, Hexahedra, entered_face, entry_depth, plane_times
from lanebev.render.raster.objects.shading import object_radiance
from lanebev.render.rows import take_rows
from lanebev.render.scene.world import Scene
from lanebev.tensors import constant, map_tensors

_SUBPIXELS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))  # rotated grid
_OVERLAP = 0.6  # m that something may be nearer than an object and still be hidden by it
_EDGE = 0.6  # px by which an object is taken to be larger, and smaller, to find its outline


class Tiles(NamedTuple):
    """Tiles of pixels that objects may cover, P of them, sorted by the objects' rank.

    Attributes:
        owner: (P,) int64, the object, row-major in (B, M).
        rank: (P,) int64, of the object among those of its row, far to near.
        pixel: (P, 64) int64, row-major in the batch.
        inside: (P, 64) bool, inside of the object's bounding box.
    """

    owner: Tensor
    rank: Tensor
    pixel: Tensor
    inside: Tensor


class Hits(NamedTuple):
    """First intersections of N rays with objects, sorted by the objects' rank.

    Attributes:
        owner: (N,) int64, the object, row-major in (B, M).
        rank: (N,) int64, of the object among those of its row, far to near.
        pixel: (N,) int64, row-major in the batch.
        share: (N,) of the pixel that the object covers.
        depth: (N,) m, Z.
        face: (N,) int64, plus 6 on the second hexahedron.
    """

    owner: Tensor
    rank: Tensor
    pixel: Tensor
    share: Tensor
    depth: Tensor
    face: Tensor


def add_objects(scene: Scene, view: View, solids: Hexahedra, canvas: Canvas) -> None:
    """Paint all objects into the canvas, far to near."""
    tiles = _tiles(scene, solids.box, view.size)
    if not len(tiles.owner):
        return
    hits = _unhidden(canvas, _hits(scene, view, solids, canvas, tiles))
    row = hits.owner // scene.objects.x.shape[1]
    objects = take_rows(map_tensors(lambda each: each.flatten(0, 1), scene.objects), hits.owner)
    ray_x, ray_y = take(view.ray_x, hits.pixel), take(view.ray_y, hits.pixel)
    up = scene.lens.extrinsics.height[row] - ray_y * hits.depth - objects.ground
    lit = object_radiance(
        objects, take_rows(scene.light, row), hits.depth, hits.face % 6, hits.face >= 6, ray_x, up
    )
    clear = torch.exp(-hits.depth / scene.world.weather.visibility[row])[:, None]
    haze = scene.world.surroundings.skyline[row]
    _composite(canvas, hits, haze + (lit - haze) * clear, scene.objects.x.shape[1])


def _tiles(scene: Scene, box: Tensor, size: tuple[int, int]) -> Tiles:
    """Cut the objects' bounding boxes into tiles. Asks the device for their number once."""
    height, width = size
    objects, device = scene.objects, scene.objects.x.device
    batch, slots = objects.x.shape
    order = objects.z.argsort(dim=1, descending=True, stable=True)
    index = (order + torch.arange(batch, device=device)[:, None] * slots).T.flatten()  # rank by rank
    left, top, right, bottom = box.flatten(0, 1)[index].unbind(1)
    columns, rows = (right - left + (TILE - 1)) // TILE, (bottom - top + (TILE - 1)) // TILE
    count = columns * rows
    total = int(count.sum())
    source = torch.arange(len(index), device=device).repeat_interleave(count, output_size=total)
    number = torch.arange(total, device=device) - (count.cumsum(0) - count)[source]
    within = torch.arange(TILE_PIXELS, device=device)
    across = columns[source]
    x = (left[source] + number % across * TILE)[:, None] + within % TILE
    y = (top[source] + number // across * TILE)[:, None] + within // TILE
    inside = (x < right[source, None]) & (y < bottom[source, None])
    owner = index[source]
    pixel = (owner // slots * (height * width))[:, None] + y.clamp(max=height - 1) * width
    return Tiles(owner, source // batch, pixel + x.clamp(max=width - 1), inside)


def _hits(scene: Scene, view: View, solids: Hexahedra, canvas: Canvas, tiles: Tiles) -> Hits:
    """Intersect the rays of tiles with their objects: one to a pixel inside, four along the outlines."""
    normal = solids.normal.flatten(0, 1).flatten(1, 2).permute(2, 1, 0).contiguous()  # (3, 12, B M)
    distance = solids.distance.flatten(0, 1).flatten(1, 2).T.contiguous()  # (12, B M)
    depth = scene.objects.z.flatten()

    planes, apart = (t.index_select(-1, tiles.owner)[..., None] for t in (normal, distance))
    ray_x, ray_y = take(view.ray_x, tiles.pixel), take(view.ray_y, tiles.pixel)
    steps = take_channels(view.steps.flatten(1), tiles.pixel)
    margin = _EDGE * steps.abs().amax(0) * (depth.clamp(min=0)[tiles.owner, None] + 1.0)
    limit = take(canvas.depth, tiles.pixel).clamp(max=0.5 * NEVER) + _OVERLAP  # the sky is no hit
    time, moved = plane_times(planes, apart, ray_x, ray_y)
    enters = as_float(moved < 0)
    outer_time = time + moved * margin
    outer = entry_depth(outer_time, enters).amin(0)
    inner = entry_depth(time - moved * margin, enters).amin(0)

    found = indices_where((outer < limit) & tiles.inside)
    tile = found // (TILE_PIXELS)
    owner, share, first = tiles.owner[tile], torch.ones_like(found, dtype=outer.dtype), take(outer, found)
    crossed, entered = (take_channels(t.flatten(1), found) for t in (outer_time, enters))
    face = entered_face(crossed, entered, first)
    edge = indices_where(take(inner, found) >= NEVER)
    at, own = found.index_select(0, edge), owner.index_select(0, edge)
    planes, apart = (t.index_select(-1, own)[..., None, :] for t in (normal, distance))
    ray_x, ray_y, limit = (take(t, at) for t in (ray_x, ray_y, limit))
    step = take_channels(steps.flatten(1), at)
    share[edge], first[edge], face[edge] = _subpixels(planes, apart, ray_x, ray_y, limit, step)
    return Hits(owner, tiles.rank[tile], take(tiles.pixel, found), share, first, face)


def _subpixels(
    normal: Tensor, distance: Tensor, ray_x: Tensor, ray_y: Tensor, limit: Tensor, step: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the share of pixels that objects cover before a limit, least Z and its face, (N,) each."""
    shift = constant(_SUBPIXELS, step)[..., None]
    fine_x = ray_x + shift[:, 0] * step[0] + shift[:, 1] * step[2]  # (4, N)
    fine_y = ray_y + shift[:, 0] * step[1] + shift[:, 1] * step[3]
    time, moved = plane_times(normal, distance, fine_x, fine_y)
    enters = as_float(moved < 0)
    depth = entry_depth(time, enters).amin(0)
    seen = as_float(depth < limit)
    nearest = torch.lerp(constant((NEVER,), step)[0], depth, seen).amin(0)
    face = entered_face(time, enters, nearest.expand_as(depth)).amax(0).clamp(min=0)
    return seen.mean(0), nearest, face


def _unhidden(canvas: Canvas, hits: Hits) -> Hits:
    """Remove hits that cover nothing, and those behind another object that fills the pixel."""
    opaque = choose(hits.share > 0.99, hits.depth, NEVER)
    front = take(canvas.depth.scatter_reduce(0, hits.pixel, opaque, "amin"), hits.pixel)
    seen = indices_where((hits.share > 0) & (hits.depth < front + _OVERLAP))
    return Hits(*(t.index_select(0, seen) for t in hits))


def _composite(canvas: Canvas, hits: Hits, colour: Tensor, slots: int) -> None:
    """Paint hits far to near: those of one rank meet in no pixel. Asks the device for their numbers once."""
    ones = torch.ones_like(hits.rank)
    counts = hits.rank.new_zeros(slots).index_add_(0, hits.rank, ones).tolist()
    for end, count in zip(accumulate(counts), counts, strict=True):
        if not count:
            continue
        part = slice(end - count, end)
        pixel, share, z = hits.pixel[part], hits.share[part], hits.depth[part]
        under = take_channels(canvas.planes, pixel)
        mixed = torch.lerp(under[:3], colour[part].T, share)
        distance = torch.stack([z, torch.minimum(z, under[4])])
        put(canvas.planes, pixel, torch.cat([mixed, torch.where(share > 0.4, distance, under[3:])]))
