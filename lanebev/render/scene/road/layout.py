"""The boundaries of a road, their places and their paint."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.sampler import BatchSampler
from lanebev.types import NUM_BOUNDARIES

MAX_BOUNDARIES = 8  # painted on the road; six of them, about the ego lane, are the labelled ones
WHITE, YELLOW = (0.80, 0.80, 0.78), (0.72, 0.46, 0.06)
DASHES = [  # (length, period) m: US, California, Germany twice, UK, France, Japan, China, exits, towns
    (3.05, 12.19), (3.05, 12.19), (2.13, 7.32), (6.0, 18.0), (6.0, 12.0), (2.0, 9.0), (3.0, 13.0),
    (8.0, 20.0), (6.0, 15.0), (0.91, 3.66), (3.0, 4.5), (3.0, 9.0), (4.0, 12.0),
]  # fmt: skip
NONE, SOLID, DASHED, DOUBLE, STUDS, SOLID_DASHED = range(6)


class Gaps(NamedTuple):
    """Where boundaries are not painted: over the first ``length`` m of each ``period`` m, (B, K) each.

    Attributes:
        period: m.
        length: m; 0 is none.
        phase: m.
    """

    period: Tensor
    length: Tensor
    phase: Tensor


class Symbols(NamedTuple):
    """What is painted in lanes of highways, (B,) unless said otherwise.

    Attributes:
        kind: (B, K) int64, in the lane right of each boundary, see raster/road/symbols.py; 0 is nothing.
        period: m.
        phase: m.
        opacity: [0, 1].
    """

    kind: Tensor
    period: Tensor
    phase: Tensor
    opacity: Tensor


class Layout(NamedTuple):
    """A road's boundaries, (B, K) each unless said otherwise, left to right.

    Attributes:
        across: m, place of each boundary; the first is at 0. Slots beyond the last lie far away.
        exists: bool.
        marked: bool; an unmarked boundary is an edge without paint.
        lane_width: (B,) m, nominal.
        stripe_width: m.
        separation: m between the centres of a double's two stripes; 0 for a single one.
        dash: (B, K, 2, 2) m, (length, period) of the left and the right stripe; length = period is solid.
        dash_phase: m.
        colour: (B, K, 3) linear reflectance.
        opacity: [0, 1], how much paint is left.
        wear: [0, 1], how unevenly it went.
        stud_period: m; 0 is none. A group of four dots, 1.22 m apart, then a gap, as in California.
        stud_group: m, length of a group.
        gaps: where there is no paint.
        ghost: [0, 1] strength of an old line, repainted beside this one.
        ghost_shift: m from the boundary to it.
        symbols: in lanes.
    """

    across: Tensor
    exists: Tensor
    marked: Tensor
    lane_width: Tensor
    stripe_width: Tensor
    separation: Tensor
    dash: Tensor
    dash_phase: Tensor
    colour: Tensor
    opacity: Tensor
    wear: Tensor
    stud_period: Tensor
    stud_group: Tensor
    gaps: Gaps
    ghost: Tensor
    ghost_shift: Tensor
    symbols: Symbols

    def last_across(self) -> Tensor:
        """Return the place of the last boundary, (B,) m."""
        return self.across.masked_fill(~self.exists, 0.0).amax(1)


def sample_layout(sampler: BatchSampler, dotted: Tensor, faint: Tensor) -> Layout:
    """Sample a random road.

    Args:
        sampler: the randomness.
        dotted: (B,) bool, lanes are divided by studs as in California.
        faint: (B,) bool, thin worn paint of little contrast.
    """
    slots = MAX_BOUNDARIES
    few_or_many = sampler.pick([0, 0, 1, 2, 3, 3, 3, 0.6, 0.6])
    many = sampler.pick([0, 0, 0, 0.2, 1, 2, 2, 1, 0.5])
    count = torch.where(dotted, many, few_or_many)  # boundaries
    lane_width = sampler.either(0.6, (3.4, 3.8), (2.7, 4.0))
    uneven = torch.where(sampler.chance(0.45), 0.09, 0.0)[:, None]
    uneven = uneven * sampler.normal(1.0, slots - 1).clamp(-2, 2)
    index = torch.arange(slots)
    exists = index < count[:, None]
    across = boundary_places((lane_width[:, None] + uneven).clamp(2.6, 4.2), exists)

    last = (count - 1)[:, None]
    outer = (index == 0) | (index == last)
    kind = _kinds_of_lines(sampler, dotted, outer)
    dash = dashes_of_lines(kind, _dashes(sampler))
    double = (kind == DOUBLE) | (kind == SOLID_DASHED)
    width, colour, opacity = _paint(sampler, faint, outer)
    stud_period, stud_group = _studs(sampler, kind)
    has_gaps = sampler.chance(0.07, slots) & (kind != NONE)
    return Layout(
        across=across,
        exists=exists,
        marked=exists & (kind != NONE),
        lane_width=lane_width,
        stripe_width=width.expand(-1, slots).contiguous(),
        separation=torch.where(double, width * sampler.uniform(1.6, 2.6, 1), 0.0),
        dash=dash.contiguous(),
        dash_phase=sampler.uniform(0, 20, 1)
        + torch.where(sampler.chance(0.2, 1), sampler.uniform(0, 20, slots), 0.0),
        colour=colour.clamp(0.02, 0.95).expand(-1, slots, -1).contiguous(),
        opacity=torch.where((kind == STUDS) | (kind == NONE), 0.0, opacity),
        wear=sampler.either(0.5, (0.0, 0.3), (0.2, 0.65))[:, None].repeat(1, slots),
        stud_period=stud_period,
        stud_group=stud_group,
        gaps=Gaps(
            period=sampler.uniform(150, 500, slots),
            length=torch.where(has_gaps, sampler.uniform(15, 90, slots), 0.0),
            phase=sampler.uniform(-60, 40, slots),
        ),
        ghost=sampler.sometimes(0.1, 0.1, 0.45, 1).expand(-1, slots).contiguous(),
        ghost_shift=sampler.uniform(-0.5, 0.5, slots),
        symbols=Symbols(
            kind=torch.where(
                sampler.chance(0.15, 1) & sampler.chance(0.6, slots), sampler.pick([0, 3, 1, 2, 1], slots), 0
            ),
            period=sampler.uniform(25, 150),
            phase=sampler.uniform(0, 150),
            opacity=sampler.uniform(0.5, 1.0),
        ),
    )


def boundary_places(widths: Tensor, exists: Tensor) -> Tensor:
    """Return the places (B, K) m of boundaries by lane widths (B, K - 1) m; missing ones lie far away."""
    across = torch.nn.functional.pad(widths.cumsum(1), (1, 0))
    return torch.where(exists, across, 1e3 + 10.0 * torch.arange(MAX_BOUNDARIES))


def _kinds_of_lines(sampler: BatchSampler, dotted: Tensor, outer: Tensor) -> Tensor:
    """Sample the kind of line, NONE to SOLID_DASHED, of edges (outer) and dividers, (B, K) int64."""
    slots = MAX_BOUNDARIES
    edge = sampler.pick([0.09, 0.66, 0.06, 0.12, 0.03, 0.04], slots)
    divider = torch.where(
        dotted[:, None],
        sampler.pick([0.0, 0.01, 0.30, 0.02, 0.67, 0.0], 1),
        sampler.pick([0.0, 0.05, 0.83, 0.03, 0.05, 0.04], 1),
    )
    odd_one = sampler.pick([0.0, 0.3, 0.25, 0.2, 0.2, 0.05], slots)
    divider = torch.where(sampler.chance(0.12, slots), odd_one, divider)
    return torch.where(outer, edge, divider)


def _paint(sampler: BatchSampler, faint: Tensor, outer: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sample width (B, K) m, colour (B, K, 3) and opacity (B, K) of the lines."""
    slots = MAX_BOUNDARIES
    width = sampler.either(0.75, (0.10, 0.16), (0.14, 0.30))[:, None]
    width = width * torch.where(outer, sampler.uniform(1.0, 1.35, 1), torch.ones(1))
    width = torch.where(faint[:, None], sampler.uniform(0.09, 0.14, 1), width)
    first = torch.arange(slots) == 0
    yellow = (first & sampler.chance(0.6, 1)) | sampler.chance(0.03, slots)
    colour = torch.where(yellow[..., None], torch.tensor(YELLOW), torch.tensor(WHITE))
    colour = colour * sampler.uniform(0.85, 1.1, 1, 1) + sampler.normal(0.015, 1, 3)
    opacity = sampler.either(0.55, (0.75, 1.0), (0.4, 0.85))[:, None]
    opacity = (opacity * sampler.uniform(0.75, 1.15, slots)).clamp(0.3, 1.0)
    return width, colour, torch.where(faint[:, None], sampler.uniform(0.4, 0.9, 1), opacity)


def _dashes(sampler: BatchSampler) -> Tensor:
    """Sample (length, period) of the dashes, (B, K, 2) m: mostly the same for all lines of a road."""
    dashes = sampler.pick_from(DASHES, 1)
    other = sampler.pick_from(DASHES, MAX_BOUNDARIES)
    dashes = torch.where(sampler.chance(0.1, MAX_BOUNDARIES)[..., None], other, dashes)
    return dashes * sampler.uniform(0.9, 1.1, 1, 1)


def _studs(sampler: BatchSampler, kind: Tensor) -> tuple[Tensor, Tensor]:
    """Sample period and length of the groups of studs, (B, K) m each: dots, or single reflectors in paint."""
    dots = kind == STUDS
    reflectors = sampler.chance(0.35, 1) & sampler.chance(0.8, MAX_BOUNDARIES) & (kind != NONE)
    is_long = sampler.uniform(0.0, 1.0)[:, None] < 0.85
    period = torch.where(dots | reflectors, torch.where(is_long, 14.63, 7.32), 0.0)
    return period, torch.where(dots, torch.where(is_long, 4.6, 7.4), 0.3)


def dashes_of_lines(kind: Tensor, dashes: Tensor) -> Tensor:
    """Return (length, period) of the left and the right stripe of each boundary, (B, K, 2, 2) m.

    Args:
        kind: (B, K) int64, of both stripes; of SOLID_DASHED the left one is dashed.
        dashes: (B, K, 2) m, (length, period) where a stripe is dashed.
    """
    solid = dashes[..., 1:].expand_as(dashes)
    right = (kind == DASHED)[..., None]
    left = right | (kind == SOLID_DASHED)[..., None]
    return torch.stack([torch.where(left, dashes, solid), torch.where(right, dashes, solid)], dim=2)


def presence(layout: Layout, slot: Tensor, along: Tensor) -> Tensor:
    """Return where boundary ``slot`` (B, N) is marked at arc lengths ``along`` (B, N), (B, N) in {0, 1}."""
    period, length, phase = (values.gather(1, slot) for values in layout.gaps)
    return layout.marked.float().gather(1, slot) * (((along + phase) % period) >= length)


def labelled_slots(layout: Layout, ego_lane: Tensor) -> tuple[Tensor, Tensor]:
    """Return the slots of the six labelled boundaries about the ego lane.

    Args:
        layout: the road.
        ego_lane: (B,) int64, index of the boundary on the ego lane's left.

    Returns:
        (B, L) int64 slots, clamped; (B, L) bool, there is such a boundary.
    """
    index = torch.arange(NUM_BOUNDARIES, device=ego_lane.device)
    slot = ego_lane[:, None] + index - (NUM_BOUNDARIES // 2 - 1)
    inside = (slot >= 0) & (slot < MAX_BOUNDARIES)
    slot = slot.clamp(0, MAX_BOUNDARIES - 1)
    return slot, inside & layout.exists.gather(1, slot)
