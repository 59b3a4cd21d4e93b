"""A street's ground: kerbs and what lies beyond them, tracks, and paint that bounds no lane."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.render.raster.coverage import dash_coverage, stripe_coverage
from lanebev.render.raster.glyphs import GLYPH_LENGTH, GLYPH_WIDTH, glyph_coverage
from lanebev.render.raster.noise import GRAIN, hash01, sample_grain, smoothstep
from lanebev.render.scene.glyphs import NUM_GLYPHS
from lanebev.render.scene.layout import MAX_BOUNDARIES, Layout
from lanebev.render.scene.pavement import Pavement
from lanebev.render.scene.street import CYCLING, FORD, KERB, PARKING, PATH, WALK, ZEBRA, Street

RAIL_GAUGE = 1.435  # m


def band(position: Tensor, low: Tensor | float, high: Tensor | float, reach: Tensor) -> Tensor:
    """Share of a pixel between ``low`` and ``high``, all m, over a box of ``reach`` m."""
    top = torch.minimum(position + 0.5 * reach, torch.as_tensor(high))
    return ((top - torch.maximum(position - 0.5 * reach, torch.as_tensor(low))) / reach).clamp(0, 1)


def beyond(position: Tensor, edge: Tensor, reach: Tensor) -> Tensor:
    """Share of a pixel that lies beyond an edge."""
    return ((position - edge) / reach + 0.5).clamp(0, 1)


def roadside(
    street: Street,
    pavement: Pavement,
    along: Tensor,
    across: Tensor,
    reach_along: Tensor,
    reach_across: Tensor,
    eye_across: Tensor,
    eye_height: Tensor,
) -> tuple[Tensor, Tensor]:
    """Kerbs, grass, cycle paths and pavements beside the carriageway.

    A point at height k above the road is seen where the ray through it meets the road, farther from the
    camera by the factor H / (H - k): so the kerb's face and all beyond it are drawn on the road's plane.

    Args:
        street: what there is.
        pavement: its edges are the kerbs' feet; its surface covers junctions.
        along: (B, N) m in the world.
        across: (B, N) m in the layout's frame, on the road's plane.
        reach_along: (B, N) m per pixel.
        reach_across: (B, N) m per pixel.
        eye_across: (B,) m, the camera's place.
        eye_height: (B,) m, the camera's height.

    Returns:
        (B, 3, N) linear reflectance and (B, N) coverage.
    """
    colour, alpha = torch.zeros_like(across)[:, None].repeat(1, 3, 1), torch.zeros_like(across)
    grain = sample_grain(GRAIN, along / 7.0, across / 7.0) / (1 + reach_along / 0.06)
    for side, sign, edge in ((0, -1.0, pavement.left), (1, 1.0, pavement.right)):
        foot = ((edge - eye_across) * sign).clamp(min=0.2)[:, None]
        raised = street.kerb_height[:, side].minimum(0.5 * eye_height)
        zoom = (eye_height / (eye_height - raised))[:, None]
        away = (across - eye_across[:, None]) * sign
        inner = away / zoom - foot  # m beyond the kerb's edge, on the raised plane
        fine_across, fine_along = reach_across / zoom, reach_along / zoom
        ends = street.strips[:, side].cumsum(1)  # (B, 4)

        tone = street.colours[:, side, KERB, :, None] * (1 + 0.1 * grain)[:, None]
        tone = _blocks(street, along, reach_along, tone)
        joints = dash_coverage(along, torch.full_like(along, 0.02), torch.ones_like(along), fine_along)
        tone = tone * (1 - 0.45 * joints)[:, None]
        for strip in range(KERB + 1, WALK + 1):
            step = beyond(inner, ends[:, strip - 1, None], fine_across)[:, None]
            next_tone = street.colours[:, side, strip, :, None] * (1 + 0.12 * grain)[:, None]
            if strip == WALK:
                next_tone = next_tone * _slabs(street, along, inner, fine_along, fine_across)[:, None]
            tone = tone + (next_tone - tone) * step
        line = stripe_coverage(inner - ends[:, PATH, None], torch.full_like(inner, 0.1), fine_across)
        line = line * (street.path_line[:, side] * (street.strips[:, side, PATH] > 0))[:, None]
        tone = tone + (street.paint[..., None] - tone) * line[:, None]

        face = band(away, foot, foot * zoom, reach_across) * (1 - beyond(inner, 0 * foot, fine_across))
        tone = tone * (1 + face * (street.kerb_shade[:, side, None] - 1))[:, None]
        there = beyond(away, foot, reach_across) * (1 - beyond(inner, ends[:, WALK, None], fine_across))
        there = there * street.kerbed[:, None] * (ends[:, WALK, None] > 0)
        colour = colour + (tone - colour) * (there > alpha)[:, None]
        alpha = torch.maximum(alpha, there)
    crossroad = junction_coverage(street, along, reach_along)
    asphalt = pavement.base[..., None] * (1 + 0.12 * grain)[:, None]
    colour = colour + (asphalt - colour) * crossroad[:, None]
    return colour.clamp(0.005, 0.9), torch.maximum(alpha, crossroad)


def _blocks(street: Street, along: Tensor, reach: Tensor, tone: Tensor) -> Tensor:
    """Kerbs painted alternately white and dark."""
    length = street.kerb_blocks[:, None].clamp(min=0.1)
    white = dash_coverage(along, length.expand_as(along), 2 * length.expand_as(along), reach)
    painted = 0.04 + 0.6 * white[:, None] * street.paint[..., None]
    return torch.where((street.kerb_blocks > 0)[:, None, None], painted, tone)


def _slabs(street: Street, along: Tensor, inner: Tensor, reach_along: Tensor, reach_across: Tensor) -> Tensor:
    """(B, N) factor of slabs' joints and of their different tones."""
    size = street.slab.clamp(min=0.2)[:, None].expand_as(along)
    gap = torch.full_like(along, 0.012)
    joint = torch.maximum(
        dash_coverage(along, gap, size, reach_along), dash_coverage(inner, gap, size, reach_across)
    )
    tone = 0.12 * (hash01((along / size).floor(), (inner / size).floor(), 4.0) - 0.5)
    factor = 1 - 0.5 * joint + tone * (size / (size + reach_along))
    return torch.where((street.slab > 0)[:, None], factor, 1.0)


def junction_coverage(street: Street, along: Tensor, reach: Tensor) -> Tensor:
    """(B, N) share of a pixel on a junction."""
    length, period = street.junction_length[:, None], street.junction_period[:, None]
    return dash_coverage(along + street.phase[:, None], length, period, reach)


def tracks(street: Street, across: Tensor, reach_across: Tensor, albedo: Tensor) -> Tensor:
    """Tram rails in their bed over a reflectance (B, 3, N)."""
    aside = across - street.tram_across[:, None]
    on = street.tram[:, None]
    bed = band(aside.abs(), 0.0, 1.25, reach_across) * street.tram_bed[:, None] * (on > 0)
    albedo = albedo + (street.tram_colour[..., None] - albedo) * bed[:, None]
    rail = stripe_coverage(aside.abs() - 0.5 * RAIL_GAUGE, torch.full_like(aside, 0.07), reach_across)
    groove = stripe_coverage(
        aside.abs() - 0.5 * RAIL_GAUGE + 0.06, torch.full_like(aside, 0.05), reach_across
    )
    albedo = albedo + (0.32 - albedo) * (on * rail)[:, None]
    return albedo * (1 - 0.85 * on * groove)[:, None]


def strips(
    street: Street, layout: Layout, pavement: Pavement, across: Tensor, reach: Tensor, albedo: Tensor
) -> Tensor:
    """Coloured cycle lanes between the outer boundaries and the kerbs, over a reflectance (B, 3, N)."""
    for side, low, high in _between(layout, pavement):
        cover = band(across, low + 0.15, high, reach) * street.strip_opacity[:, side, None]
        albedo = albedo + (street.strip_colour[:, side, :, None] - albedo) * cover[:, None]
    return albedo


def _between(layout: Layout, pavement: Pavement) -> list[tuple[int, Tensor, Tensor]]:
    """Side and limits (B, 1), m, of the strips beside the outer boundaries."""
    last = layout.across.masked_fill(~layout.exists, 0.0).amax(1, keepdim=True)
    return [(0, pavement.left[:, None], -0.15 + 0 * last), (1, last, pavement.right[:, None])]


def street_paint(
    street: Street,
    layout: Layout,
    pavement: Pavement,
    along: Tensor,
    across: Tensor,
    reach_along: Tensor,
    reach_across: Tensor,
    blotch: Tensor,
) -> Tensor:
    """Coverage of a pixel by paint that bounds no lane, (B, N).

    Args:
        street: what is painted.
        layout: the lanes.
        pavement: the carriageway's edges.
        along: (B, N) m in the world.
        across: (B, N) m in the layout's frame.
        reach_along: (B, N) m per pixel.
        reach_across: (B, N) m per pixel.
        blotch: (B, N) slow noise: where the paint is worn.
    """
    lane = torch.searchsorted(layout.across, across.contiguous()) - 1
    lanes = layout.exists.sum(1, keepdim=True) - 1
    on_lane = (lane >= 0) & (lane < lanes)
    lane = lane.clamp(0, MAX_BOUNDARIES - 2)
    low, high = layout.across.gather(1, lane), layout.across.gather(1, lane + 1)
    inside = across - 0.5 * (low + high)
    reach = (reach_along, reach_across)
    marks = torch.maximum(
        _glyphs(street, lane, along, inside, high - low, *reach),
        _hatching(street, lane, along, inside, high - low, *reach),
    )
    marks = torch.maximum(marks * on_lane, _across_the_road(street, layout, pavement, along, across, *reach))
    marks = torch.maximum(marks, _bays(street, layout, pavement, along, across, *reach))
    grain = sample_grain(GRAIN, along / 5.0, across / 2.5) / (1 + reach_along / 0.05)
    worn = smoothstep(-0.6, 0.5, blotch * 0.5 + grain * 0.45 + 0.95 - 1.4 * street.wear[:, None])
    return marks * worn * street.opacity[:, None]


def _glyphs(
    street: Street,
    lane: Tensor,
    along: Tensor,
    inside: Tensor,
    width: Tensor,
    reach_along: Tensor,
    reach_across: Tensor,
) -> Tensor:
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


def _hatching(
    street: Street,
    lane: Tensor,
    along: Tensor,
    inside: Tensor,
    width: Tensor,
    reach_along: Tensor,
    reach_across: Tensor,
) -> Tensor:
    """Oblique stripes or chevrons that fill a lane, or grow into it from its left boundary."""
    chevron = street.hatch_chevron[:, None]
    slope = street.hatch_slope[:, None]
    oblique = along + slope * torch.where(chevron > 0, inside.abs(), inside)
    reach = reach_along + slope.abs() * reach_across
    stripe = dash_coverage(
        oblique,
        (street.hatch_width * (1 + street.hatch_slope**2).sqrt()).minimum(0.6 * street.hatch_period)[:, None],
        street.hatch_period[:, None],
        reach,
    )
    start = (along + street.phase[:, None] + 40.0) % street.hatch_every[:, None]  # m beyond its begin
    taper = street.hatch_taper[:, None]
    share = torch.where(taper > 0, start * taper, width).minimum(width)
    from_left = inside + 0.5 * width
    stripe = stripe * band(from_left, 0.2 + 0 * share, share - 0.1, reach_across)
    rim = stripe_coverage(from_left - share, torch.full_like(share, 0.14), reach_across) * (share < width)
    here = start < street.hatch_length[:, None]
    return torch.maximum(stripe, rim) * here * street.hatch.gather(1, lane)


def _across_the_road(
    street: Street,
    layout: Layout,
    pavement: Pavement,
    along: Tensor,
    across: Tensor,
    reach_along: Tensor,
    reach_across: Tensor,
) -> Tensor:
    """Stop lines, crossings and grids at the junctions."""
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
    zebra = dash_coverage(ahead + 4.4, torch.full_like(along, 3.4), period, reach_along) * stripes
    thin = torch.full_like(along, 0.14)
    pair = dash_coverage(ahead + 4.4, thin, period, reach_along) + dash_coverage(
        ahead + 1.2, thin, period, reach_along
    )
    ford = pair * dash_coverage(across, half, 1.5 * half, reach_across)
    walk = torch.where(crossing == ZEBRA, zebra, torch.where(crossing == FORD, ford, 0.0)) * edges

    slanted, other = (ahead + across) / 1.4, (ahead - across) / 1.4
    reach = (reach_along + reach_across) / 1.4
    line, cell = torch.full_like(along, 0.12), torch.ones_like(along)
    grid = torch.maximum(dash_coverage(slanted, line, cell, reach), dash_coverage(other, line, cell, reach))
    grid = grid * junction_coverage(street, along, reach_along) * edges * street.box[:, None]
    return torch.maximum(torch.maximum(stop, walk) * there, grid)


def _bays(
    street: Street,
    layout: Layout,
    pavement: Pavement,
    along: Tensor,
    across: Tensor,
    reach_along: Tensor,
    reach_across: Tensor,
) -> Tensor:
    """Lines across parking strips, the outer line of cycle strips, and bicycles on them."""
    marks = torch.zeros_like(along)
    for side, low, high in _between(layout, pavement):
        kind = street.strip[:, side, None]
        bay = street.bay[:, side, None].clamp(min=1.0).expand_as(along)
        lines = dash_coverage(along + street.phase[:, None], torch.full_like(along, 0.1), bay, reach_along)
        bays = lines * band(across, low, high, reach_across) * (kind == PARKING)
        outer = high - 0.15 if side else low + 0.15
        line = stripe_coverage(across - outer, torch.full_like(across, 0.1), reach_across) * (kind == CYCLING)
        middle = 0.5 * (low + high)
        position = (along + street.phase[:, None]) % 45.0
        bicycle = torch.where(kind == CYCLING, 10, -1).expand_as(along)
        bicycle = bicycle.masked_fill((position > 5) | ((across - middle).abs() > 1.1), -1)
        bicycle = glyph_coverage(bicycle, across - middle, position, reach_across, reach_along)
        marks = torch.maximum(marks, torch.maximum(torch.maximum(bays, line), bicycle))
    return marks * (1 - junction_coverage(street, along, reach_along))
