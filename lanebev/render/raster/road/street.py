"""The ground of a city street, and the paint on it that bounds no lane: arrows, hatching, crossings, bays."""

import torch
from torch import Tensor

from lanebev.render.raster.base.blocks import make_blocks
from lanebev.render.raster.base.coverage import band, dash_coverage, stripe_coverage
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.noise import hash01, sample_grain, smoothstep
from lanebev.render.raster.base.select import put, take, take_channels
from lanebev.render.raster.road.glyphs import GLYPH_LENGTH, GLYPH_WIDTH, glyph_coverage
from lanebev.render.raster.road.roadside import add_roadside, junction_coverage
from lanebev.render.raster.road.street_surface import ironwork, strips, strips_between, tracks
from lanebev.render.raster.road.surface import count_below
from lanebev.render.rows import take_rows
from lanebev.render.scene.places.street import BICYCLE, CYCLING, FORD, NUM_GLYPHS, PARKING, ZEBRA, Street
from lanebev.render.scene.road.layout import MAX_BOUNDARIES, Layout
from lanebev.render.scene.road.pavement import Pavement
from lanebev.render.scene.world import Scene


def city_ground(
    scene: Scene, row: Tensor, ground: Ground, albedo: Tensor, paved: Tensor, painted: Tensor, blotch: Tensor
) -> tuple[Tensor, Tensor]:
    """Put what is on streets and beside them over plain roads.

    Args:
        scene: B of them.
        row: (T,) int64, not decreasing, the scene of each line of points.
        ground: (T, N) points.
        albedo: (T, 3, N) linear reflectance of the plain road and of what is beside it.
        paved: (T, N) share of the pixel on the carriageway.
        painted: (T, N) share of the pixel under the boundaries' paint.
        blotch: (T, N) slow noise.

    Returns:
        albedo and painted of the streets.
    """
    planes = albedo.transpose(0, 1).flatten(1)
    add_roadside(scene, row, ground, paved, planes)
    road = make_blocks(paved > 0, row=row, num_rows=len(scene.place.along))
    world, place = scene.world, road.place
    base, covered = _street_ground(
        take_rows(world.street, road.row),
        take_rows(world.layout, road.row),
        take_rows(world.pavement, road.row),
        Ground(*(take(t, place) for t in ground)),
        take_channels(planes, place).transpose(0, 1),
        take(painted, place),
        take(blotch, place),
    )
    put(planes, place, base.transpose(0, 1))
    put(painted.view(1, -1), place, covered[None])
    return planes.view(3, *paved.shape).transpose(0, 1), painted


def _street_ground(
    street: Street,
    layout: Layout,
    pavement: Pavement,
    ground: Ground,
    albedo: Tensor,
    painted: Tensor,
    blotch: Tensor,
) -> tuple[Tensor, Tensor]:
    """Put what is on a street over a plain road, (B, N) points; returns albedo and painted."""
    coloured = strips(street, layout, pavement, ground.across, ground.reach_across, albedo)
    albedo = albedo + (coloured - albedo) * (1 - painted)[:, None]
    lane, inside, width, on_lane = lane_coordinates(layout, ground.across)
    dark = ironwork(street, ground, lane, inside) * on_lane * (1 - painted)
    albedo = tracks(street, ground, albedo * (1 - dark)[:, None])
    in_lanes = torch.maximum(
        _glyphs(street, ground, lane, inside, width), _hatching(street, ground, lane, inside, width)
    )
    marks = torch.maximum(in_lanes * on_lane, _across_the_road(street, layout, pavement, ground))
    marks = torch.maximum(marks, _bays(street, layout, pavement, ground))
    grain = sample_grain(ground.along / 5.0, ground.across / 2.5) / (1 + ground.reach_along / 0.05)
    worn = smoothstep(-0.6, 0.5, blotch * 0.5 + grain * 0.45 + 0.95 - 1.4 * street.wear[:, None])
    marks = marks * worn * street.opacity[:, None]
    albedo = albedo + (street.paint[..., None] - albedo) * marks[:, None]
    return albedo, torch.maximum(painted, marks)


def lane_coordinates(layout: Layout, across: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the lane (int64), m right of its middle, its width (m) and whether there is one, (B, N) each."""
    lane = count_below(layout.across, across) - 1
    lanes = layout.exists.sum(1, keepdim=True) - 1
    on_lane = (lane >= 0) & (lane < lanes)
    lane = lane.clamp(0, MAX_BOUNDARIES - 2)
    low, high = layout.across.gather(1, lane), layout.across.gather(1, lane + 1)
    return lane, across - 0.5 * (low + high), high - low, on_lane


def _glyphs(street: Street, ground: Ground, lane: Tensor, inside: Tensor, width: Tensor) -> Tensor:
    _, along, _, reach_along, reach_across = ground
    period, scale = street.glyph_period[:, None], street.glyph_scale[:, None]
    shifted = along + street.phase[:, None] + 3.0
    cell = (shifted / period).floor()
    seed = lane.to(along.dtype)
    glyph = street.glyph.gather(1, lane)
    other = (hash01(cell, seed, 11.0) * NUM_GLYPHS).long()
    glyph = torch.where((glyph >= 0) & (hash01(cell, seed, 12.0) < 0.2), other, glyph)
    glyph = glyph.masked_fill(hash01(cell, seed, 13.0) < 0.2, -1)
    length = scale * (1 + 0.3 * (hash01(cell, seed, 14.0) - 0.5))
    wide = torch.minimum(scale, width / (GLYPH_WIDTH + 0.3))
    position = shifted - cell * period - 1.0
    glyph = glyph.masked_fill((position < -1) | (position > length * GLYPH_LENGTH + 1), -1)
    return glyph_coverage(glyph, inside / wide, position / length, reach_across / wide, reach_along / length)


def _hatching(street: Street, ground: Ground, lane: Tensor, inside: Tensor, width: Tensor) -> Tensor:
    """Draw oblique stripes or chevrons that fill a lane, or grow into it from its left boundary."""
    _, along, _, reach_along, reach_across = ground
    hatching = street.hatching
    chevron = hatching.chevron[:, None]
    slope = hatching.slope[:, None]
    oblique = along + slope * torch.where(chevron > 0, inside.abs(), inside)
    reach = reach_along + slope.abs() * reach_across
    stripe = dash_coverage(
        oblique,
        (hatching.width * (1 + hatching.slope**2).sqrt()).minimum(0.6 * hatching.period)[:, None],
        hatching.period[:, None],
        reach,
    )
    start = (along + street.phase[:, None] + 40.0) % hatching.every[:, None]  # m beyond its begin
    taper = hatching.taper[:, None]
    share = torch.where(taper > 0, start * taper, width).minimum(width)
    from_left = inside + 0.5 * width
    stripe = stripe * band(from_left, 0.2 + 0 * share, share - 0.1, reach_across)
    rim = stripe_coverage(from_left - share, 0.14, reach_across) * (share < width)
    here = start < hatching.length[:, None]
    return torch.maximum(stripe, rim) * here * hatching.strength.gather(1, lane)


def _across_the_road(street: Street, layout: Layout, pavement: Pavement, ground: Ground) -> Tensor:
    """Draw stop lines, crossings and grids at the junctions."""
    _, along, across, reach_along, reach_across = ground
    there = (street.junction_length > 0)[:, None]
    period = street.junction_period[:, None]
    left = layout.across.gather(1, street.first[:, None])
    right = layout.across.gather(1, (street.first + street.own)[:, None])
    stop_width = street.stop_width[:, None]
    crossing = street.crossing[:, None]
    setback = torch.where(crossing > 0, 5.2, 0.8)
    stop = dash_coverage(
        along + street.phase[:, None] + setback + stop_width, stop_width, period, reach_along
    )
    stop = stop * band(across, left, right, reach_across) * (stop_width > 0)

    edges = band(across, pavement.left[:, None], pavement.right[:, None], reach_across)
    ahead = along + street.phase[:, None]
    half = torch.full_like(across, 0.5)
    stripes = dash_coverage(across, half, 2 * half, reach_across)
    zebra = dash_coverage(ahead + 4.4, 3.4, period, reach_along) * stripes
    pair = sum(dash_coverage(ahead + shift, 0.14, period, reach_along) for shift in (4.4, 1.2))
    ford = pair * dash_coverage(across, half, 1.5 * half, reach_across)
    walk = torch.where(crossing == ZEBRA, zebra, torch.where(crossing == FORD, ford, 0.0)) * edges

    slanted, other = (ahead + across) / 1.4, (ahead - across) / 1.4
    reach = (reach_along + reach_across) / 1.4
    cell = torch.ones_like(along)
    grid = torch.maximum(dash_coverage(slanted, 0.12, cell, reach), dash_coverage(other, 0.12, cell, reach))
    grid = grid * junction_coverage(street, along, reach_along) * edges * street.box[:, None]
    return torch.maximum(torch.maximum(stop, walk) * there, grid)


def _bays(street: Street, layout: Layout, pavement: Pavement, ground: Ground) -> Tensor:
    """Draw lines across parking strips, the outer line of cycle strips, and bicycles on them."""
    _, along, across, reach_along, reach_across = ground
    marks = torch.zeros_like(along)
    for side, low, high in strips_between(layout, pavement):
        kind = street.strip[:, side, None]
        bay = street.bay[:, side, None].clamp(min=1.0).expand_as(along)
        lines = dash_coverage(along + street.phase[:, None], 0.1, bay, reach_along)
        bays = lines * band(across, low, high, reach_across) * (kind == PARKING)
        outer = high - 0.15 if side else low + 0.15
        line = stripe_coverage(across - outer, 0.1, reach_across) * (kind == CYCLING)
        middle = 0.5 * (low + high)
        position = (along + street.phase[:, None]) % 45.0
        bicycle = torch.where(kind == CYCLING, BICYCLE, -1).expand_as(along)
        bicycle = bicycle.masked_fill((position > 5) | ((across - middle).abs() > 1.1), -1)
        bicycle = glyph_coverage(bicycle, across - middle, position, reach_across, reach_along)
        marks = torch.maximum(marks, torch.maximum(torch.maximum(bays, line), bicycle))
    return marks * (1 - junction_coverage(street, along, reach_along))
