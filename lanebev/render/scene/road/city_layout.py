"""Lane boundaries of city streets."""

import torch
from torch import Tensor

from lanebev.render.scene.road.layout import (
    DASHED,
    DOUBLE,
    MAX_BOUNDARIES,
    NONE,
    SOLID_DASHED,
    WHITE,
    YELLOW,
    Layout,
    boundary_places,
    dashes_of_lines,
)
from lanebev.render.scene.sampler import BatchSampler

DASHES = [  # (length, period) m in towns
    (3.0, 9.0), (3.0, 9.0), (3.0, 4.5), (6.0, 12.0), (2.0, 6.0), (4.0, 10.0), (1.5, 4.5), (0.91, 3.66),
    (3.05, 12.19),
]  # fmt: skip
BLOCKS = [(0.5, 0.7), (0.5, 1.0), (1.0, 2.0), (1.5, 3.0)]  # broad dashes beside cycle and bus lanes


def sample_city_layout(sampler: BatchSampler, base: Layout) -> tuple[Layout, Tensor, Tensor, Tensor]:
    """Sample a street's boundaries, with narrow or wide lanes of unequal width, mostly two-way.

    Args:
        sampler: the randomness.
        base: layout of the same batch; gives what streets share with highways.

    Returns:
        the layout; (B,) int64 the ego lane, the own direction's first lane, and its number of lanes.
    """
    slots = MAX_BOUNDARIES
    own, other = sampler.pick([0, 0.42, 0.38, 0.2]), sampler.pick([0.35, 0.42, 0.23])
    right_hand = sampler.chance(0.85)
    first = torch.where(right_hand, other, 0)  # lane, and slot of its left boundary
    centre = torch.where(right_hand, other, own)[:, None]
    count = own + other + 1
    index = torch.arange(slots, device=own.device)
    exists = index < count[:, None]
    last = (count - 1)[:, None]
    outer = (index == 0) | (index == last)
    middle = (index == centre) & ~outer

    lane_width = sampler.uniform(2.6, 3.3)
    lane_width = torch.where(sampler.chance(0.3), sampler.uniform(3.0, 3.75), lane_width)
    lane_width = torch.where(sampler.chance(0.15), sampler.uniform(3.5, 3.95), lane_width)
    uneven = sampler.normal(0.2, slots - 1).clamp(-0.5, 0.5) * sampler.chance(0.7, 1)
    across = boundary_places((lane_width[:, None] + uneven).clamp(2.4, 4.3), exists)

    divider = sampler.pick([0.0, 0.12, 0.88, 0, 0, 0], slots)
    centre_line = sampler.pick([0.04, 0.24, 0.42, 0.22, 0, 0.08], slots)
    edge = sampler.pick([0.42, 0.38, 0.17, 0.03, 0, 0], slots)
    kind = torch.where(outer, edge, torch.where(middle, centre_line, divider))
    dashes = sampler.pick_from(DASHES, 1).expand(-1, slots, -1)
    dashes = torch.where(sampler.chance(0.15, slots)[..., None], sampler.pick_from(DASHES, slots), dashes)
    blocks = outer & sampler.chance(0.6, slots)
    dashes = torch.where(blocks[..., None], sampler.pick_from(BLOCKS, slots), dashes)
    dashes = dashes * sampler.uniform(0.9, 1.1, 1, 1)
    dash = dashes_of_lines(kind, dashes)
    double = (kind == DOUBLE) | (kind == SOLID_DASHED)
    width = sampler.either(0.8, (0.09, 0.15), (0.12, 0.2))[:, None]
    width = torch.where(blocks & (kind == DASHED), sampler.uniform(0.15, 0.3, slots), width)
    yellow = (middle & sampler.chance(0.3, 1)) | (outer & sampler.chance(0.05, slots))
    white, gold = dash.new_tensor(WHITE), dash.new_tensor(YELLOW)
    colour = torch.where(yellow[..., None], gold, white) * sampler.uniform(0.85, 1.1, 1, 1)
    opacity = sampler.either(0.7, (0.75, 1.0), (0.35, 0.85))[:, None]
    opacity = (opacity * sampler.uniform(0.8, 1.15, slots)).clamp(0.3, 1.0)
    layout = base._replace(
        across=across,
        exists=exists,
        marked=exists & (kind != NONE),
        lane_width=lane_width,
        stripe_width=width.expand(-1, slots).contiguous(),
        separation=torch.where(double, width * sampler.uniform(1.7, 3.0, 1), 0.0),
        dash=dash.contiguous(),
        colour=colour.expand(-1, slots, -1).contiguous(),
        opacity=torch.where(kind == NONE, 0.0, opacity),
        stud_period=torch.zeros_like(width).expand(-1, slots).contiguous(),
        symbols=base.symbols._replace(kind=torch.zeros_like(base.symbols.kind)),
    )
    ego_lane = first + (sampler.uniform(0, 1) * own).long().minimum(own - 1)
    return layout, ego_lane, first, own
