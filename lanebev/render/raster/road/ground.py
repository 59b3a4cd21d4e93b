"""The radiance of the ground in pixels."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.base.blocks import Blocks, make_blocks
from lanebev.render.raster.base.colour import colour
from lanebev.render.raster.base.features import Features, KindRows
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.noise import blotches, smoothstep
from lanebev.render.raster.base.select import lines_of, put, take, take_channels
from lanebev.render.raster.light.night import headlight_irradiance, night_irradiance
from lanebev.render.raster.light.shadows import shadows
from lanebev.render.raster.road.markings import near_marking, paint
from lanebev.render.raster.road.street import city_ground
from lanebev.render.raster.road.surface import LanePlace, pavement_albedo, place_in_lanes
from lanebev.render.raster.road.symbols import symbols
from lanebev.render.raster.road.verge import verge_albedo
from lanebev.render.raster.road.winter import snow_ground
from lanebev.render.raster.road.works import works_ground
from lanebev.render.rows import take_rows
from lanebev.render.scene.world import Scene

STUD_ALBEDO = 0.62


class Surface(NamedTuple):
    """The ground's surface at M points; functions change it in place.

    Attributes:
        albedo: (3, M) linear reflectance.
        coverage: (2, M) by paint and by studs, 0 to 1.
    """

    albedo: Tensor
    coverage: Tensor


def ground_radiance(
    scene: Scene, below: Blocks, ground: Ground, ray_x: Tensor, ray_y: Tensor, features: Features
) -> Tensor:
    """Compute the linear radiance of the ground, (T, 3, N).

    Args:
        scene: B of them.
        below: the pixels on the ground, in blocks.
        ground: (T, N) points in them.
        ray_x: (T, N) right per metre forward.
        ray_y: (T, N) down per metre forward.
        features: what any of the scenes has.
    """
    row, world = below.row, scene.world
    if features.night:
        smear = (world.lights.on * world.lights.smear)[row, None]
        ground = ground._replace(reach_along=torch.hypot(ground.reach_along, smear))
    pavement, light = scene.world.pavement, take_rows(scene.light, row)
    blotch = blotches(ground.along, ground.across)
    left, right = pavement.left[row, None], pavement.right[row, None]
    inside = torch.minimum(ground.across - left, right - ground.across)
    inside = inside + 0.15 * blotch[3] * (1 - world.street.kerbed[row, None])
    paved = (inside / ground.reach_across + 0.5).clamp(0, 1)
    surface = _plain_surface(scene, row, ground, paved, blotch, features)
    _add_kinds(scene, below, ground, surface, paved, blotch[2], features)
    albedo, coverage = (part.view(-1, *paved.shape) for part in surface)

    x = ray_x * ground.z
    sunlit, open_sky = shadows(scene, below, x, ground, features)
    lit = light.direct[..., None] * (light.sun[:, 1, None] * sunlit)[:, None]
    lit = lit + light.ambient[..., None] * open_sky[:, None]
    _add_headlights(scene, below, x, ground, coverage, features.rows, lit)
    gloss = _gloss(scene, row, ray_x, ray_y, sunlit, open_sky, blotch[2], features)
    return albedo.transpose(0, 1) * lit + gloss * paved[:, None]


def _add_headlights(
    scene: Scene, below: Blocks, x: Tensor, ground: Ground, coverage: Tensor, rows: KindRows, lit: Tensor
) -> None:
    """Add the own headlights, and at night street lamps, to the irradiance (T, 3, N); changes it.

    Args:
        scene: B of them.
        below: the points, in blocks.
        x: (T, N) m, right of the camera's foot.
        ground: (T, N) points.
        coverage: (2, T, N) by paint, which throws the headlights' light back, and by studs, which do so more.
        rows: on which rows there are which kinds.
        lit: irradiance over pi.
    """
    for name, own_rows in (("headlight", rows.headlight), ("night", rows.night)):
        index = below.of_rows(own_rows)
        if not len(index):
            continue
        row = below.row.index_select(0, index)
        own_x, painted, studded, under = (lines_of(t, index) for t in (x, *coverage, lit))
        z, along, across = (lines_of(t, index) for t in ground[:3])
        retro = 1 + 2.5 * painted + 8.0 * studded
        if name == "headlight":
            beam = headlight_irradiance(own_x, z) * retro
            beam = beam * scene.light.headlight[row, None]
            light = under + beam[:, None] * colour(beam, 1.0, 0.95, 0.85)
        else:
            lamps, beam = night_irradiance(take_rows(scene.world.lights, row), own_x, z, along, across)
            light = under + lamps + beam * retro[:, None]
        lit.index_copy_(0, index, light)


def _plain_surface(
    scene: Scene, row: Tensor, ground: Ground, paved: Tensor, blotch: Tensor, features: Features
) -> Surface:
    """Make the surface of a plain road and of the ground beside it, at T·N points."""
    batch, points = len(scene.place.along), paved.numel()
    surface = Surface(paved.new_zeros(3, points), paved.new_zeros(2, points))
    albedo = surface.albedo

    road = make_blocks(paved > 0, row=row, num_rows=batch)
    part = Ground(*(take(t, road.place) for t in ground))
    stain = take_channels(blotch[:3].flatten(1), road.place)
    layout = take_rows(scene.world.layout, road.row)
    pavement = take_rows(scene.world.pavement, road.row)
    lanes = place_in_lanes(layout, part.across)
    bare = pavement_albedo(road, pavement, layout, part, lanes, stain, features)
    put(albedo, road.place, bare.transpose(0, 1))
    _add_paint(scene, road, part, lanes, stain[2], features, surface)

    beside = make_blocks(paved < 1, row=row, num_rows=batch)
    part = Ground(*(take(t, beside.place) for t in ground))
    around = take_rows(scene.world.surroundings, beside.row)
    verge = verge_albedo(around, part, take(blotch[0], beside.place)).transpose(0, 1)
    inner = take_channels(albedo, beside.place)
    put(albedo, beside.place, verge + (inner - verge) * take(paved, beside.place))
    return surface


def _add_kinds(
    scene: Scene,
    below: Blocks,
    ground: Ground,
    surface: Surface,
    paved: Tensor,
    stain: Tensor,
    features: Features,
) -> None:
    """Put what only some kinds of road have on their ground; changes the surface."""
    kinds = features.rows
    for rows, change in ((kinds.city, city_ground), (kinds.works, works_ground), (kinds.snow, snow_ground)):
        index = below.of_rows(rows)
        if not len(index):
            continue
        row = below.row.index_select(0, index)
        part = Ground(*(lines_of(t, index) for t in ground))
        own, painted = (t.view(len(t), *paved.shape) for t in surface)
        base, paint_on = own.index_select(1, index).transpose(0, 1), painted[0].index_select(0, index)
        road, blotch = lines_of(paved, index), lines_of(stain, index)
        base, paint_on = change(scene, row, part, base, road, paint_on, blotch)
        own.index_copy_(1, index, base.transpose(0, 1))
        painted[0].index_copy_(0, index, paint_on)


def _add_paint(
    scene: Scene,
    road: Blocks,
    ground: Ground,
    lanes: LanePlace,
    stain: Tensor,
    features: Features,
    surface: Surface,
) -> None:
    """Paint markings on the road; changes the surface.

    Args:
        scene: B of them.
        road: the points on the road, in blocks.
        ground: the points.
        lanes: their places in the lanes.
        stain: how worn the paint is there.
        features: what any of the scenes has.
        surface: of all points.
    """
    layout = scene.world.layout
    of_road = take_rows(layout, road.row)
    near = near_marking(of_road, ground, lanes.slot)
    if features.symbols:
        covered = symbols(of_road, ground, lanes.lane)
        near |= covered > 0
    marked = make_blocks(near, row=road.row, num_rows=len(layout.across))
    part = Ground(*(take(t, marked.place) for t in ground))
    slot, where = take(lanes.slot, marked.place), take(road.place, marked.place)
    grazing = part.z / scene.lens.extrinsics.height[marked.row, None]
    own = take_rows(layout, marked.row)
    paint_on, studs_on, tone = paint(own, part, slot, grazing, take(stain, marked.place), features)
    studs_on = studs_on * (1 - paint_on)
    if features.symbols:
        paint_on = torch.maximum(paint_on, take(covered, marked.place))
    bare = take_channels(surface.albedo, where)
    painted = bare + (tone.transpose(0, 1) - bare) * paint_on + (STUD_ALBEDO - bare) * studs_on
    put(surface.albedo, where, painted)
    put(surface.coverage, where, torch.stack([paint_on, studs_on]))


def _gloss(
    scene: Scene,
    row: Tensor,
    ray_x: Tensor,
    ray_y: Tensor,
    sunlit: Tensor,
    open_sky: Tensor,
    puddle: Tensor,
    features: Features,
) -> Tensor:
    """Compute the mirrored sun and, on wet roads, the mirrored sky, (T, 3, N)."""
    light, wet = take_rows(scene.light, row), scene.world.pavement.wet[row, None]
    norm = (1 + ray_x.square() + ray_y.square()).rsqrt()
    sun_right, sun_up, sun_ahead = light.sun.unsqueeze(-1).unbind(1)
    sun = (ray_x * sun_right + ray_y * sun_up + sun_ahead) * norm
    eighth = sun.clamp(min=0).square().square().square()
    sparkle = 0.35 * eighth.square() * eighth * sunlit
    gloss = light.direct[..., None] * (sparkle * (0.4 + wet))[:, None]
    if features.wet:
        puddles = 0.35 + 0.65 * smoothstep(-0.5, 1.2, puddle)
        mirror = wet * (0.05 + 0.3 * (1 - ray_y * norm).square().square().square()) * puddles
        sky = scene.world.surroundings.skyline[row, :, None]
        gloss = gloss + sky * (mirror * (0.3 + 0.7 * open_sky))[:, None]
    return gloss
