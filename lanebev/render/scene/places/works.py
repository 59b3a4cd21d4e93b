"""Road works: yellow lines in force over white ones that are not, cones and barriers."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import select_rows
from lanebev.render.scene.objects.objects import POLE
from lanebev.render.scene.objects.traffic import Traffic
from lanebev.render.scene.road.layout import (
    DASHED,
    MAX_BOUNDARIES,
    NONE,
    SOLID,
    WHITE,
    Layout,
    dashes_of_lines,
)
from lanebev.render.scene.sampler import BatchSampler

NUM_OLD = 4  # old white lines


class Works(NamedTuple):
    """Old lines under those in force, (B, O) unless said otherwise.

    Attributes:
        strength: how much of an old line is left, [0, 1].
        across: m in the layout's frame where it crosses along = 0.
        drift: m across per metre along.
        dash: (B, O, 2) m, (length, period).
        width: m.
        scar: strength of dark scars where lines were taken off.
        colour: (B, 3) linear reflectance.
        phase: (B,) m.
    """

    strength: Tensor
    across: Tensor
    drift: Tensor
    dash: Tensor
    width: Tensor
    scar: Tensor
    colour: Tensor
    phase: Tensor


def sample_works(sampler: BatchSampler, works: Tensor, layout: Layout) -> tuple[Layout, Works]:
    """Sample narrow lanes between yellow lines, with remains of the old ones, where works (B,) holds."""
    slots = MAX_BOUNDARIES
    index = torch.arange(slots, device=works.device)
    last = layout.exists.sum(1, keepdim=True) - 1
    outer = (index == 0) | (index == last)
    kind = torch.where(sampler.chance(0.45, slots), SOLID, DASHED)
    kind = torch.where(outer, torch.where(sampler.chance(0.85, slots), SOLID, NONE), kind)
    widths = (sampler.uniform(2.6, 3.4, 1) + sampler.normal(0.12, slots - 1)).clamp(2.4, 3.7)
    across = torch.nn.functional.pad(widths.cumsum(1), (1, 0))
    across = torch.where(layout.exists, across, layout.across)
    dashes = torch.stack([sampler.uniform(1.0, 6.0, 1), sampler.uniform(7.0, 14.0, 1)], 2)
    gold = sampler.chance(0.85, 1)
    colour = torch.where(
        gold[..., None], layout.colour.new_tensor([0.78, 0.52, 0.03]), layout.colour.new_tensor(WHITE)
    )
    yellow = layout._replace(
        across=across,
        marked=layout.exists & (kind != NONE),
        lane_width=widths.mean(1),
        stripe_width=sampler.uniform(0.10, 0.18, 1).expand(-1, slots).contiguous(),
        separation=torch.zeros_like(layout.separation),
        dash=dashes_of_lines(kind, dashes.expand(-1, slots, -1)),
        colour=(colour * sampler.uniform(0.8, 1.15, 1, 1)).expand(-1, slots, -1).contiguous(),
        opacity=torch.where(kind == NONE, 0.0, sampler.uniform(0.75, 1.0, 1)),
        wear=sampler.uniform(0.0, 0.25, 1).expand(-1, slots).contiguous(),
        stud_period=torch.zeros_like(layout.stud_period),
        ghost=torch.zeros_like(layout.ghost),
    )
    first = sampler.uniform(-2.5, 2.0, 1)
    spacing = sampler.uniform(3.2, 3.8, 1)
    old = torch.arange(NUM_OLD, device=works.device)
    whole = sampler.chance(0.4, NUM_OLD)[..., None]
    dash = torch.where(whole, sampler.uniform(9.0, 9.0, 1, 1), sampler.pick_from([3.0, 4.0, 6.0], 1, 1))
    dash = torch.cat([dash, torch.where(whole, dash, sampler.uniform(9.0, 18.0, 1, 1))], 2)
    faint = torch.where(gold, 1.0, 0.3)  # else old white lines would look like the valid white ones
    left = Works(
        strength=works[:, None]
        * faint
        * torch.where(sampler.chance(0.75, NUM_OLD), sampler.uniform(0.25, 1.0, 1), 0.0),
        across=first + spacing * old,
        drift=torch.where(sampler.chance(0.4, 1), sampler.normal(0.012, 1), 0.0).expand(-1, NUM_OLD),
        dash=dash,
        width=sampler.uniform(0.10, 0.2, 1).expand(-1, NUM_OLD),
        scar=works[:, None] * sampler.sometimes(0.3, 0.2, 0.7, 1).expand(-1, NUM_OLD),
        colour=layout.colour.new_tensor(WHITE) * sampler.uniform(0.75, 1.05, 1),
        phase=sampler.uniform(0, 40),
    )
    return select_rows(works, yellow, layout), left


def works_traffic(
    sampler: BatchSampler, works: Tensor, layout: Layout, traffic: Traffic, count: int
) -> Traffic:
    """Put cones, beacons or barriers in the last ``count`` places of the traffic, where works (B,) holds."""
    style = sampler.pick([0.4, 0.35, 0.25])[:, None]
    one = torch.ones_like(traffic.along[:, -count:])
    half = torch.where(style == 0, 0.17, torch.where(style == 1, 0.13, 0.25)) * one
    top = torch.where(style == 0, 0.03, torch.where(style == 1, 0.13, 0.1)) * one
    deep = torch.where(style == 0, 0.17, torch.where(style == 1, 0.03, 1.0)) * one
    deep_top = torch.where(style == 0, 0.03, deep)
    high = torch.where(style == 0, 0.75, torch.where(style == 1, 1.15, 0.85)) * one
    body = torch.stack([half, top, -deep, deep, -deep_top, deep_top, 0 * one, high], -1)
    turn = torch.arange(count, device=works.device)
    spacing = torch.where(style == 2, 2.3, sampler.uniform(4.0, 14.0, 1))
    last = layout.last_across()
    across = torch.where(sampler.chance(0.6), last + sampler.uniform(0.3, 1.0), -sampler.uniform(0.3, 1.0))
    red = one.new_tensor([0.5, 0.06, 0.02])
    white = one.new_tensor([0.6, 0.6, 0.6])
    colour = torch.where(((turn % 2 == 0) & (style == 2))[..., None], white, red)
    mine = traffic._replace(
        along=sampler.uniform(3, 30, 1) + spacing * turn,
        across=(across[:, None] + sampler.normal(0.06, count)),
        speed=0 * one,
        shape=torch.stack([body, torch.zeros_like(body)], 2),
        kind=torch.full_like(one, POLE, dtype=torch.long),
        colour=colour.expand(len(one), count, 3),
        braking=torch.zeros_like(one, dtype=torch.bool),
        valid=sampler.chance(0.75, 1).expand(-1, count),
    )
    rest = Traffic(*(t[:, :-count] for t in traffic))
    tail = select_rows(works, mine, Traffic(*(t[:, -count:] for t in traffic)))
    return Traffic(*(torch.cat(pair, 1) for pair in zip(rest, tail, strict=True)))
