"""City streets: what is painted between lane boundaries, and the strips beside the carriageway."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.objects.surroundings import GREENS
from lanebev.render.scene.road.layout import MAX_BOUNDARIES, WHITE, Layout
from lanebev.render.scene.sampler import BatchSampler
from lanebev.tensors import map_tensors

PLAIN, PARKING, CYCLING = range(3)  # strips between the outer boundary and the kerb
NO_CROSSING, ZEBRA, FORD = range(3)  # a ford: two dashed lines
KERB, GREEN, PATH, WALK = range(4)  # strips from the kerb outwards
# what is painted in lanes: arrows, signs and words
AHEAD, AHEAD_SLIM, LEFT, RIGHT, AHEAD_LEFT, AHEAD_RIGHT, LEFT_RIGHT, MERGE_LEFT, MERGE_RIGHT = range(9)
ARROWS = (AHEAD, AHEAD_SLIM, LEFT, RIGHT, AHEAD_LEFT, AHEAD_RIGHT, LEFT_RIGHT, MERGE_LEFT, MERGE_RIGHT)
TEETH, BICYCLE, DIAMOND, CROSS = range(9, 13)
TEXTS = ("BUS", "30", "50", "STOP", "SLOW", "P", "TAXI", "SCHOOL")
WORDS = tuple(range(13, 13 + len(TEXTS)))
NUM_GLYPHS = 13 + len(TEXTS)


class Hatching(NamedTuple):
    """Oblique stripes that fill a lane, (B,) unless said otherwise.

    Attributes:
        strength: (B, K) in [0, 1], right of each boundary.
        width: m, of a stripe.
        period: m.
        slope: m along per metre across.
        chevron: 1: stripes meet in the middle.
        length: m of every ``every``; beyond it the lane is plain.
        every: m.
        taper: m across per metre along by which the hatching grows; 0: it fills the lane at once.
    """

    strength: Tensor
    width: Tensor
    period: Tensor
    slope: Tensor
    chevron: Tensor
    length: Tensor
    every: Tensor
    taper: Tensor


class Tram(NamedTuple):
    """A tram's track in the street, (B,) unless said otherwise; strengths are in [0, 1].

    Attributes:
        strength: of the rails.
        across: m, middle of the track.
        bed: strength of the track's own bed.
        colour: (B, 3) linear reflectance of it.
        ballast: strength of its stones and sleepers.
    """

    strength: Tensor
    across: Tensor
    bed: Tensor
    colour: Tensor
    ballast: Tensor


class Street(NamedTuple):
    """Parts of a street besides lane boundaries, (B,) unless said otherwise; strengths are in [0, 1].

    Attributes:
        kerbed: 1 where kerbs bound the carriageway; 0: the pavement's edge is ragged.
        own: int64, number of lanes of the own direction.
        first: int64, slot of the own direction's leftmost boundary.
        strip: (B, 2) int64, PLAIN, PARKING or CYCLING, left and right.
        strip_colour: (B, 2, 3) linear reflectance.
        strip_opacity: (B, 2) of that colour.
        bay: (B, 2) m, length of a parking bay along the road.
        kerb_height: (B, 2) m.
        kerb_shade: (B, 2) factor of the kerb's vertical face.
        kerb_blocks: m, length of alternately painted pieces; 0: not painted.
        strips: (B, 2, 4) m, widths of KERB, GREEN, PATH and WALK.
        colours: (B, 2, 4, 3) linear reflectance of them.
        slab: m, size of the walk's slabs; 0: none.
        path_line: (B, 2) strength of a line along the path's outer edge.
        junction_period: m.
        junction_length: m; 0 is none.
        phase: m; a junction begins where along + phase is a multiple of the period.
        stop_width: m; 0 is none.
        crossing: int64, NO_CROSSING, ZEBRA or FORD.
        box: strength of a grid of yellow lines on the junction.
        glyph: (B, K) int64, painted in the lane right of each boundary; negative: nothing.
        glyph_period: m.
        glyph_scale: factor of a glyph's size.
        hatching: of lanes.
        tram: its track.
        manholes: probability of a cover in 16 m of a lane.
        cuts: probability of a sealed cut in 23 m of a lane.
        weeds: strength of weeds along the kerb.
        paint: (B, 3) linear reflectance.
        opacity: opacity of the paint.
        wear: [0, 1].
    """

    kerbed: Tensor
    own: Tensor
    first: Tensor
    strip: Tensor
    strip_colour: Tensor
    strip_opacity: Tensor
    bay: Tensor
    kerb_height: Tensor
    kerb_shade: Tensor
    kerb_blocks: Tensor
    strips: Tensor
    colours: Tensor
    slab: Tensor
    path_line: Tensor
    junction_period: Tensor
    junction_length: Tensor
    phase: Tensor
    stop_width: Tensor
    crossing: Tensor
    box: Tensor
    glyph: Tensor
    glyph_period: Tensor
    glyph_scale: Tensor
    hatching: Hatching
    tram: Tram
    manholes: Tensor
    cuts: Tensor
    weeds: Tensor
    paint: Tensor
    opacity: Tensor
    wear: Tensor


def sample_street(
    sampler: BatchSampler, layout: Layout, ego_lane: Tensor, first: Tensor, own: Tensor
) -> Street:
    """Sample the paint between a street's boundaries and what is beside it.

    Args:
        sampler: the randomness.
        layout: the boundaries.
        ego_lane: (B,) int64.
        first: (B,) int64, the own direction's first lane.
        own: (B,) int64, its number of lanes.
    """
    index = torch.arange(MAX_BOUNDARIES, device=own.device)
    strip = sampler.pick([0.5, 0.27, 0.23], 2)
    tints = sampler.pick_from(
        [(0.22, 0.06, 0.045), (0.17, 0.05, 0.05), (0.05, 0.14, 0.07), (0.04, 0.09, 0.2)], 2
    )
    strips, colours = _strips_beside(sampler, tints)
    glyph = _glyphs(sampler, layout, ego_lane)
    beside = ego_lane[:, None] + torch.where(sampler.chance(0.65), -1, 1)[:, None]
    lanes = layout.exists.sum(1, keepdim=True) - 1
    hatched = (index == beside) & (beside >= 0) & (beside < lanes) & sampler.chance(0.3, 1)
    track = sampler.chance(0.13)
    lane = first + torch.where(sampler.chance(0.6), 0, -1)  # in the own direction's first lane or beside it
    low, high = (layout.across.gather(1, (lane + i).clamp(min=0)[:, None])[:, 0] for i in (0, 1))
    junction = sampler.chance(0.55)
    return Street(
        kerbed=sampler.uniform(1.0, 1.0),
        own=own,
        first=first,
        strip=strip,
        strip_colour=tints,
        strip_opacity=torch.where(
            (strip == CYCLING) & sampler.chance(0.45, 2), sampler.uniform(0.4, 1.0, 2), 0.0
        ),
        bay=sampler.either(0.75, (5.0, 7.0), (2.3, 2.8), 2),
        kerb_height=sampler.either(0.8, (0.05, 0.18), (0.0, 0.05), 2),
        kerb_shade=sampler.uniform(0.35, 1.2, 2),
        kerb_blocks=sampler.sometimes(0.08, 0.5, 1.5),
        strips=strips,
        colours=colours,
        slab=sampler.sometimes(0.5, 0.3, 1.2),
        path_line=sampler.sometimes(0.5, 0.5, 1.0, 2),
        junction_period=sampler.uniform(90, 320),
        junction_length=torch.where(junction, sampler.uniform(7, 25), 0.0),
        phase=sampler.uniform(-70, 15),
        stop_width=sampler.sometimes(0.6, 0.25, 0.6),
        crossing=sampler.pick([0.45, 0.25, 0.3]),
        box=sampler.sometimes(0.12, 0.5, 1.0),
        glyph=glyph,
        glyph_period=sampler.uniform(14, 60),
        glyph_scale=sampler.uniform(0.7, 1.3),
        hatching=_hatching(sampler, hatched),
        tram=_tram(sampler, track, low, high),
        manholes=sampler.sometimes(0.6, 0.05, 0.4),
        cuts=sampler.sometimes(0.45, 0.1, 0.6),
        weeds=sampler.sometimes(0.5, 0.2, 1.0),
        paint=layout.colour.new_tensor(WHITE) * sampler.uniform(0.8, 1.1, 1),
        opacity=sampler.uniform(0.55, 1.0),
        wear=layout.wear[:, 0],
    )


def _hatching(sampler: BatchSampler, hatched: Tensor) -> Hatching:
    """Sample hatching in some lanes (B, K)."""
    return Hatching(
        strength=torch.where(hatched, sampler.uniform(0.7, 1.0, 1), 0.0),
        width=sampler.uniform(0.25, 0.7),
        period=sampler.uniform(1.4, 4.0),
        slope=sampler.uniform(0.5, 2.5) * torch.where(sampler.chance(0.5), 1.0, -1.0),
        chevron=sampler.chance(0.3).float(),
        length=sampler.uniform(25, 120),
        every=sampler.uniform(120, 300),
        taper=sampler.sometimes(0.5, 0.03, 0.12),
    )


def _tram(sampler: BatchSampler, track: Tensor, low: Tensor, high: Tensor) -> Tram:
    """Sample tracks where there are some, (B,) bool, in or left of a lane from low to high, (B,) m."""
    return Tram(
        strength=torch.where(track, sampler.uniform(0.5, 1.0), 0.0),
        across=torch.where(sampler.chance(0.65), 0.5 * (low + high), low - sampler.uniform(2.0, 4.5)),
        bed=sampler.sometimes(0.6, 0.4, 1.0),
        colour=torch.where(
            sampler.chance(0.3, 1), sampler.pick_from(GREENS), sampler.uniform(0.06, 0.3, 1).expand(-1, 3)
        ),
        ballast=sampler.sometimes(0.4, 0.4, 1.2),
    )


def _strips_beside(sampler: BatchSampler, tints: Tensor) -> tuple[Tensor, Tensor]:
    """Sample widths (B, 2, 4) m and colours (B, 2, 4, 3) of kerb, green, path and pavement on both sides.

    Args:
        sampler: the randomness.
        tints: (B, 2, 3), colours of painted paths.
    """
    stone = sampler.uniform(0.1, 0.45, 2, 1) * (1 + sampler.normal(0.03, 2, 3))
    path = torch.where(sampler.chance(0.5, 2)[..., None], tints, sampler.uniform(0.06, 0.25, 2, 1))
    walk = sampler.uniform(0.07, 0.38, 2, 1) * (1 + sampler.normal(0.04, 2, 3))
    green = sampler.pick_from(GREENS, 2) * sampler.uniform(0.7, 1.4, 2, 1)
    walks, paths, greens = sampler.chance(0.75, 2), sampler.chance(0.3, 2), sampler.chance(0.4, 2)
    widths = [
        sampler.sometimes(0.9, 0.1, 0.32, 2),
        torch.where(greens, sampler.uniform(0.3, 3.5, 2), 0.0),
        torch.where(paths, sampler.uniform(1.0, 2.2, 2), 0.0),
        torch.where(walks, sampler.uniform(0.9, 4.5, 2), 0.0),
    ]
    return torch.stack(widths, dim=2), torch.stack([stone, green, path, walk], dim=2)


def _glyphs(sampler: BatchSampler, layout: Layout, ego_lane: Tensor) -> Tensor:
    """Sample the arrow, word or sign in the lane right of each boundary, (B, K) int64; -1 is none."""
    slots = MAX_BOUNDARIES
    index = torch.arange(slots, device=ego_lane.device)
    signed = sampler.chance(0.55, 1)
    lane_in = (index >= ego_lane[:, None] - 3) & (index < layout.exists.sum(1, keepdim=True) - 1)
    glyph = sampler.pick([1.0] * len(ARROWS), slots)
    other = sampler.pick_from([float(g) for g in (*WORDS, BICYCLE, CROSS)], slots).long()
    glyph = torch.where(sampler.chance(0.15, slots), other, glyph)
    return torch.where(signed & lane_in & sampler.chance(0.75, slots), glyph, -1)


def no_street(street: Street) -> Street:
    """Return an empty street for each of the worlds of these."""
    empty: Street = map_tensors(torch.zeros_like, street)
    one = torch.ones_like(empty.phase)
    return empty._replace(
        glyph=empty.glyph - 1,
        glyph_scale=one,
        glyph_period=100 * one,
        junction_period=100 * one,
        hatching=empty.hatching._replace(width=one, period=one, every=100 * one),
    )
