"""Reflectance of the bare road: asphalt and concrete with all that age and traffic leave on them."""

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.base.blocks import Blocks, multiply_rows
from lanebev.render.raster.base.coverage import dash_coverage, stripe_coverage
from lanebev.render.raster.base.features import Features
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.noise import (
    CRACK,
    SECOND,
    hash01,
    sample_grain,
    sample_line,
    sample_noise,
    smoothstep,
)
from lanebev.render.raster.base.select import as_float, choose, remainder
from lanebev.render.scene.road.layout import MAX_BOUNDARIES, Layout
from lanebev.render.scene.road.pavement import Pavement


class LanePlace(NamedTuple):
    """The places of points among a road's boundaries, each (B, N).

    Attributes:
        lane: int64, number of boundaries to the left.
        slot: int64, the nearest boundary.
        inside: m, right of the lane's middle; on a shoulder of a lane's middle beside the road.
        on_shoulder: bool, outside the outermost boundaries.
    """

    lane: Tensor
    slot: Tensor
    inside: Tensor
    on_shoulder: Tensor


def nearest_slot(layout: Layout, across: Tensor) -> Tensor:
    """Return the boundary nearest to ``across`` (B, N) m, (B, N) int64."""
    middles = 0.5 * (layout.across[:, 1:] + layout.across[:, :-1])
    return count_below(middles, across)


def count_below(edges: Tensor, value: Tensor) -> Tensor:
    """Count the (B, K) edges below values (B, N), (B, N) int64; for few edges faster than a search."""
    count = torch.zeros(value.shape, dtype=torch.uint8, device=value.device)
    for edge in edges.unsqueeze(-1).unbind(1):
        count += (value > edge).view(torch.uint8)
    return count.long()


def place_in_lanes(layout: Layout, across: Tensor) -> LanePlace:
    """Find the lane, and the nearest boundary, of road points.

    Args:
        layout: the boundaries.
        across: (B, N) m in the layout's frame.
    """
    lane = count_below(layout.across, across)
    count = layout.exists.sum(1, keepdim=True)
    edges = layout.across
    last = edges.gather(1, (count - 1).clamp(min=0))
    index = torch.arange(MAX_BOUNDARIES + 1, device=across.device)
    inner = torch.nn.functional.pad(0.5 * (edges[:, 1:] + edges[:, :-1]), (1, 1))
    middles = torch.where(index >= count, last + 1.8, inner)  # (B, K + 1), of each lane
    middles = torch.where(index == 0, edges[:, :1] - 1.8, middles)
    outside = (index == 0) | (index >= count)
    return LanePlace(
        lane=lane,
        slot=nearest_slot(layout, across),
        inside=across - middles.gather(1, lane),
        on_shoulder=outside.gather(1, lane),
    )


def pavement_albedo(
    road: Blocks,
    pavement: Pavement,
    layout: Layout,
    ground: Ground,
    lanes: LanePlace,
    blotch: Tensor,
    features: Features,
) -> Tensor:
    """Compute the linear reflectance of the bare surface, (B, 3, N).

    Args:
        road: B blocks of points.
        pavement: their surface.
        layout: its boundaries.
        ground: the points.
        lanes: where they lie.
        blotch: (4, B, N), see :func:`~lanebev.render.raster.base.noise.blotches`.
        features: what any of the surfaces has.
    """
    shade = 1 + _weathering(pavement, ground, lanes.inside, blotch[0])
    shade = shade * pavement.lane_tone.gather(1, lanes.lane)
    shade = shade * (1 - _lines(pavement, layout, ground, lanes, blotch, features))
    multiply_rows(shade, road, features.patch, _patches, pavement, ground, lanes)
    for side, rows in enumerate(features.gutter):
        multiply_rows(shade, road, rows, partial(_gutter, side), pavement, ground, blotch[0])
    shade = (shade * (1 - 0.5 * pavement.wet)[:, None]).clamp(min=0.08)
    colour = choose(lanes.on_shoulder[:, None], pavement.shoulder[..., None], pavement.base[..., None])
    if features.deck:
        position = remainder(ground.along + pavement.deck_phase[:, None], pavement.deck_period[:, None])
        deck = position < pavement.deck_length[:, None]
        colour = choose(deck[:, None], pavement.deck[..., None], colour)
    return (colour * shade[:, None]).clamp(0.005, 0.9)


def _weathering(pavement: Pavement, ground: Ground, inside: Tensor, mottle: Tensor) -> Tensor:
    """Compute the relative change by aggregate, blotches, streaks, tyre tracks and oil, (B, N)."""
    u, v, reach = ground.along, ground.across, ground.reach_along
    grain = sample_grain(u / 6.1, v / 6.1) / (1 + reach / 0.05)
    medium = sample_noise(SECOND, u / 61.0, v / 47.0) / (1 + reach / 0.5)
    streak = sample_noise(SECOND, u / 2300.0, v / 23.0)
    tracks = torch.exp(-(((inside.abs() - 0.85) / 0.32) ** 2))
    oil = torch.exp(-((inside / 0.45) ** 2)) * (0.8 + 0.3 * mottle)
    total = pavement.grain[:, None] * (grain + 0.5 * medium) + pavement.mottle[:, None] * mottle
    total = total + pavement.streak[:, None] * streak - pavement.oil[:, None] * oil
    band = sample_line(v / 55.0 + u / 9000.0 + pavement.joint_period[:, None])
    total = total + pavement.bands[:, None] * band
    return total - pavement.tracks[:, None] * tracks * (1 + 0.3 * mottle)


def _lines(
    pavement: Pavement, layout: Layout, ground: Ground, lanes: LanePlace, blotch: Tensor, features: Features
) -> Tensor:
    """Compute the darkening by seams, joints, cracks and skids, (B, N)."""
    along, across, slot, inside = ground.along, ground.across, lanes.slot, lanes.inside
    wobble = sample_line(along / 90.0)
    beside = (layout.across + pavement.seam_shift).gather(1, slot)  # m, where the seam is
    width = pavement.seam_width[:, None] * (1 + 0.4 * wobble).clamp(0.3)
    seam = stripe_coverage(across - beside - 0.02 * wobble, width, ground.reach_across)
    dark = (pavement.seam * (1 + pavement.tar[:, None])).gather(1, slot) * seam
    if features.middle_seam:
        distance = inside - pavement.middle_shift[:, None] - 0.03 * wobble
        dark = dark + pavement.middle_seam[:, None] * stripe_coverage(distance, width, ground.reach_across)
    if features.joint:
        period = pavement.joint_period[:, None]
        tilt = along + 0.08 * across + 0.03 * wobble
        joint = dash_coverage(tilt, 0.02 + 0 * period, period, ground.reach_along)
        dark = dark + pavement.joint[:, None] * (joint * 2.5).clamp(max=1)
    if features.crack:
        crack = sample_noise(CRACK, along / 41.0, across / 29.0) / (1 + ground.reach_along / 0.25)
        strength = (pavement.crack * (1 + pavement.tar))[:, None]
        dark = dark + strength * crack * smoothstep(-0.2, 0.8, blotch[1])
    if features.skid:
        distance = inside.abs() - 0.75 - 0.1 * wobble
        skid = stripe_coverage(distance, 0.2, ground.reach_across)
        skid = skid * smoothstep(0.9, 1.4, sample_line(along / 400.0 + 0.5))
        dark = dark + pavement.skid[:, None] * skid
    return dark.clamp(0, 0.92)


def _patches(pavement: Pavement, ground: Ground, lanes: LanePlace) -> Tensor:
    """Compute the factor (B, N) of rectangles of newer or older surface, at most one in 14 m of a lane."""
    cell = (ground.along / 14.0).floor()
    row = lanes.lane.to(cell.dtype)
    exists = hash01(cell, row, 1.0) < pavement.patch[:, None]
    middle, length = 3 + 8 * hash01(cell, row, 2.0), 0.8 + 4 * hash01(cell, row, 3.0)
    shift, width = 1.6 * (hash01(cell, row, 4.0) - 0.5), 0.8 + 1.6 * hash01(cell, row, 5.0)
    covered = stripe_coverage(ground.along - cell * 14.0 - middle, length, ground.reach_along)
    covered = covered * stripe_coverage(lanes.inside - shift, width, ground.reach_across)
    tone = 0.55 + 0.8 * hash01(cell, row, 6.0)
    return 1 + covered * (tone - 1) * as_float(exists)


def _gutter(side: int, pavement: Pavement, ground: Ground, mottle: Tensor) -> Tensor:
    """Compute the factor (B, N) of the strip along an edge, a line beside a barrier's foot, not a marking."""
    edge = (pavement.left, pavement.right)[side]
    width = pavement.gutter_width[:, side, None] * (1 + 0.15 * sample_line(ground.along / 70.0 + side))
    inwards = (ground.across - edge[:, None]) * (1 - 2 * side)
    covered = stripe_coverage(inwards - 0.5 * width, width, ground.reach_across)
    strength = covered * (0.85 + 0.15 * mottle).clamp(0, 1.3) * as_float(width > 0.01)
    return (1 + strength * (pavement.gutter[:, side, None] - 1)).clamp(min=0.1)
