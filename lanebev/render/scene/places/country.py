"""Country roads: narrow, mostly without any paint, where no boundary is the right answer."""

import math

import torch
from torch import Tensor

from lanebev.batch import select_rows
from lanebev.render.scene.objects.surroundings import (
    EARTHS,
    FENCE,
    GREENS,
    HEDGE,
    NOTHING,
    NUM_WALLS,
    RAIL,
    SLOPE,
    TREES,
    Surroundings,
)
from lanebev.render.scene.road.layout import DASHED, MAX_BOUNDARIES, NONE, SOLID, Layout, dashes_of_lines
from lanebev.render.scene.road.pavement import Pavement
from lanebev.render.scene.sampler import BatchSampler

_BARE, _MIDDLE, _EDGES = range(3)  # the lines that are painted


def country_layout(
    sampler: BatchSampler, country: Tensor, layout: Layout, ego_lane: Tensor
) -> tuple[Layout, Tensor]:
    """Sample one or two narrow lanes where country (B,) holds; three in four have no paint."""
    lanes = 1 + sampler.chance(0.7).long()
    index = torch.arange(MAX_BOUNDARIES, device=lanes.device)
    exists = index <= lanes[:, None]
    width = torch.where(lanes == 1, sampler.uniform(2.6, 4.2), sampler.uniform(2.2, 3.2))
    across = torch.where(exists, width[:, None] * index, 1e3 + 10.0 * index)
    style = sampler.pick([0.74, 0.14, 0.12])[:, None]
    middle = (index == 1) & (lanes == 2)[:, None]
    outer = (index == 0) | (index == lanes[:, None])
    kind = torch.where((style == _MIDDLE) & middle, torch.where(sampler.chance(0.7, 1), DASHED, SOLID), NONE)
    kind = torch.where((style == _EDGES) & outer, torch.where(sampler.chance(0.7, 1), SOLID, DASHED), kind)
    dashes = torch.stack([sampler.uniform(1.5, 5.0, 1), sampler.uniform(6.0, 12.0, 1)], 2)
    narrow = layout._replace(
        across=across,
        exists=exists,
        marked=exists & (kind != NONE),
        lane_width=width,
        stripe_width=sampler.uniform(0.08, 0.14, 1).expand(-1, MAX_BOUNDARIES).contiguous(),
        separation=torch.zeros_like(layout.separation),
        dash=dashes_of_lines(kind, dashes.expand(-1, MAX_BOUNDARIES, -1)),
        opacity=torch.where(kind == NONE, 0.0, sampler.uniform(0.4, 1.0, 1)),
        stud_period=torch.zeros_like(layout.stud_period),
        ghost=torch.zeros_like(layout.ghost),
        symbols=layout.symbols._replace(kind=torch.zeros_like(layout.symbols.kind)),
    )
    lane = (sampler.chance(0.85) & (lanes == 2)).long()
    return select_rows(country, narrow, layout), torch.where(country, lane, ego_lane)


def country_pavement(sampler: BatchSampler, country: Tensor, layout: Layout, pavement: Pavement) -> Pavement:
    """Sample old asphalt up to the grass, at times gravel or earth, where country (B,) holds."""
    last = layout.last_across()
    shoulder = sampler.uniform(0.0, 0.5, 2)
    gravel = sampler.chance(0.2)[:, None]
    base = torch.where(gravel, sampler.pick_from(EARTHS) * sampler.uniform(0.7, 1.4, 1), pavement.base)
    old = pavement._replace(
        left=-shoulder[:, 0],
        right=last + shoulder[:, 1],
        base=base,
        shoulder=base * sampler.uniform(0.8, 1.2, 1),
        gutter_width=torch.zeros_like(pavement.gutter_width),
        crack=sampler.uniform(0.0, 0.7),
        patch=sampler.sometimes(0.6, 0.05, 0.35),
        tracks=sampler.uniform(-0.25, 0.3),
        mottle=sampler.uniform(0.03, 0.14),
        deck_length=torch.zeros_like(pavement.deck_length),
    )
    return select_rows(country, old, pavement)


def country_surroundings(
    sampler: BatchSampler, country: Tensor, pavement: Pavement, around: Surroundings
) -> Surroundings:
    """Sample fields, hedges and trees near a narrow road, where country (B,) holds."""
    near = sampler.pick([0.55, 0.2, 0.15, 0.1], 2)
    near = near.new_tensor([NOTHING, HEDGE, RAIL, FENCE])[near]
    middle = near.new_tensor([NOTHING, TREES, HEDGE, SLOPE])[sampler.pick([0.35, 0.35, 0.15, 0.15], 2)]
    far = near.new_tensor([NOTHING, TREES, SLOPE])[sampler.pick([0.25, 0.55, 0.2], 2)]
    kind = torch.cat([far, middle, near], 1)
    gap = torch.cat([sampler.uniform(12, 40, 2), sampler.uniform(2, 9, 2), sampler.uniform(0.3, 1.5, 2)], 1)
    edge = torch.stack([pavement.left, pavement.right], 1).repeat(1, 3)
    height = torch.where(
        kind == TREES, sampler.uniform(5, 15, NUM_WALLS), sampler.uniform(0.7, 3.0, NUM_WALLS)
    )
    height = torch.where(kind == SLOPE, sampler.uniform(1.0, 8.0, NUM_WALLS), height)
    height = torch.where(kind == RAIL, 0.75, height)
    earth = (kind == SLOPE) | (kind == FENCE)
    colour = torch.where(
        earth[..., None], sampler.pick_from(EARTHS, NUM_WALLS), sampler.pick_from(GREENS, NUM_WALLS)
    )
    colour = torch.where((kind == RAIL)[..., None], sampler.uniform(0.1, 0.4, NUM_WALLS, 1), colour)
    fields = around._replace(
        walls=around.walls._replace(
            across=edge + gap * gap.new_tensor([-1.0, 1.0] * 3),
            kind=kind,
            height=height,
            colour=colour * sampler.uniform(0.7, 1.3, NUM_WALLS, 1),
        ),
        opposite=torch.full_like(around.opposite, -math.inf),
    )
    return select_rows(country, fields, around)
