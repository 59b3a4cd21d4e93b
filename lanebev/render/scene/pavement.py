"""The road's surface: asphalt and concrete with everything that age and traffic leave on it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.raster.markings import dash_coverage, nearest_slot, stripe_coverage
from lanebev.render.raster.noise import (
    CRACK,
    GRAIN,
    SECOND,
    hash01,
    sample_grain,
    sample_line,
    sample_noise,
    smoothstep,
)
from lanebev.render.scene.layout import MAX_BOUNDARIES, Layout
from lanebev.render.scene.sampler import Dice


class Pavement(NamedTuple):
    """A road's surface, (B,) each unless said otherwise; strengths are shares of the reflectance.

    Attributes:
        left: m, left edge of the pavement in the layout's frame.
        right: m, right edge.
        base: (B, 3) linear reflectance.
        shoulder: (B, 3) linear reflectance outside the outer boundaries.
        deck: (B, 3) of stretches of another material (bridges, repaving).
        deck_period: m.
        deck_length: m; 0 is none.
        deck_phase: m.
        lane_tone: (B, K + 1) factor of each lane.
        grain: strength of the aggregate.
        mottle: strength of blotches.
        streak: strength of streaks along the road.
        bands: strength of broad bands along the road.
        tracks: strength of tyre tracks, negative where polished bright.
        oil: strength of the dark strip in the lane's middle.
        seam: (B, K) strength of the longitudinal seam beside each boundary.
        seam_shift: (B, K) m from the boundary to it.
        seam_width: m.
        middle_seam: strength of a seam inside lanes.
        middle_shift: m from the lane's middle to it.
        joint: strength of transverse joints.
        joint_period: m.
        crack: strength.
        tar: strength of tar on the cracks and seams.
        patch: probability that a 14 m stretch of a lane has a patch.
        skid: strength of tyre skids.
        gutter: (B, 2) factor of the strip along the left and right edge: dust, or another pour.
        gutter_width: (B, 2) m; 0 is none.
        wet: [0, 1].
    """

    left: Tensor
    right: Tensor
    base: Tensor
    shoulder: Tensor
    deck: Tensor
    deck_period: Tensor
    deck_length: Tensor
    deck_phase: Tensor
    lane_tone: Tensor
    grain: Tensor
    mottle: Tensor
    streak: Tensor
    bands: Tensor
    tracks: Tensor
    oil: Tensor
    seam: Tensor
    seam_shift: Tensor
    seam_width: Tensor
    middle_seam: Tensor
    middle_shift: Tensor
    joint: Tensor
    joint_period: Tensor
    crack: Tensor
    tar: Tensor
    patch: Tensor
    skid: Tensor
    gutter: Tensor
    gutter_width: Tensor
    wet: Tensor


def _tone(dice: Dice, concrete: Tensor, bright: Tensor) -> Tensor:
    """(B, 3) reflectance of asphalt or concrete."""
    level = torch.where(concrete, dice.uniform(0.20, 0.40), dice.uniform(0.045, 0.17))
    level = torch.where(bright, dice.uniform(0.33, 0.50), level)
    warm = torch.where(concrete, dice.uniform(-0.01, 0.07), dice.uniform(-0.04, 0.04))
    warm = torch.where(bright, dice.uniform(0.02, 0.12), warm)
    tint = torch.stack([1 + warm, 1 + 0.3 * warm, 1 - warm], dim=1) + dice.normal(0.008, 3)
    return level[:, None] * tint


def sample_pavement(
    dice: Dice, layout: Layout, dotted: Tensor, bright: Tensor, wet: Tensor, median: Tensor
) -> Pavement:
    """A random surface under a layout.

    Args:
        dice: the randomness.
        layout: the boundaries.
        dotted: (B,) bool, Californian concrete is likely.
        bright: (B,) bool, sun-bleached beige concrete.
        wet: (B,) in [0, 1].
        median: (B,) bool, a barrier stands along the left edge, with a bright strip at its foot.
    """
    concrete = torch.where(dotted, dice.chance(0.75), dice.chance(0.25)) | bright
    base, other = _tone(dice, concrete, bright), _tone(dice, dice.chance(0.4), bright & dice.chance(0.5))
    same = dice.chance(0.6)[:, None]
    tone = 1 + dice.normal(0.06, MAX_BOUNDARIES + 1) * dice.chance(0.6, 1)
    width = layout.across.masked_fill(~layout.exists, 0.0).amax(1)
    narrow, full = dice.chance(0.3, 2), dice.chance(0.4, 2)  # a full one is as wide as a lane, or nearly
    shoulder = torch.where(full, dice.uniform(2.2, 3.7, 2), dice.uniform(1.0, 4.0, 2))
    shoulder = torch.where(narrow, dice.uniform(0.2, 1.0, 2), shoulder)
    shoulder[:, 0] = torch.where(median, dice.uniform(1.5, 3.7), shoulder[:, 0])
    gutter = torch.where(dice.chance(0.7, 2), dice.uniform(1.1, 2.2, 2), dice.uniform(0.4, 0.9, 2))
    gutter_width = torch.where(dice.chance(0.5, 2), dice.uniform(0.05, 0.6, 2), 0.0)
    gutter[:, 0] = torch.where(median, dice.uniform(1.2, 2.4), gutter[:, 0])
    gutter_width[:, 0] = torch.where(median, dice.uniform(0.05, 0.25), gutter_width[:, 0])
    old = dice.uniform(0, 1)  # how old the road is
    even = torch.where(bright, dice.chance(0.6), dice.chance(0.3))
    rough = torch.where(even, dice.uniform(0.0, 0.3), 1.0)
    seams = torch.where(concrete, dice.chance(0.75), dice.chance(0.35))
    seam = torch.where(seams[:, None], dice.uniform(0.2, 0.95, 1), 0.0) * dice.uniform(
        0.3, 1.0, MAX_BOUNDARIES
    )
    return Pavement(
        left=-shoulder[:, 0],
        right=width + shoulder[:, 1],
        base=base,
        shoulder=torch.where(same, base * dice.uniform(0.8, 1.1, 1), other),
        deck=_tone(dice, ~concrete, bright),
        deck_period=dice.uniform(250, 700),
        deck_length=torch.where(dice.chance(0.2), dice.uniform(15, 120), 0.0),
        deck_phase=dice.uniform(-90, 40),
        lane_tone=tone.clamp(0.75, 1.25),
        grain=dice.uniform(0.04, 0.22) * (0.4 + 0.6 * rough),
        mottle=dice.uniform(0.01, 0.08) * rough,
        streak=dice.uniform(0.01, 0.08) * rough,
        bands=torch.where(dice.chance(0.6), dice.uniform(0.0, 0.13), 0.0) * rough,
        tracks=dice.uniform(-0.12, 0.2) * rough,
        oil=torch.where(dice.chance(0.6), dice.uniform(0.0, 0.35), 0.0) * rough,
        seam=seam,
        seam_shift=dice.normal(0.15, MAX_BOUNDARIES) + 0.17 * torch.where(dice.chance(0.5, 1), 1.0, -1.0),
        seam_width=dice.uniform(0.012, 0.05),
        middle_seam=torch.where(dice.chance(0.2), dice.uniform(0.1, 0.7), 0.0),
        middle_shift=dice.uniform(-1.2, 1.2),
        joint=torch.where(concrete, dice.chance(0.7), dice.chance(0.06)) * dice.uniform(0.05, 0.5),
        joint_period=dice.uniform(3.5, 7.5),
        crack=torch.where(dice.chance(0.5), dice.uniform(0.0, 0.6) * old, 0.0),
        tar=torch.where(dice.chance(0.3), dice.uniform(0.3, 0.9), 0.0),
        patch=torch.where(dice.chance(0.35), dice.uniform(0.02, 0.2), 0.0),
        skid=torch.where(dice.chance(0.25), dice.uniform(0.1, 0.5), 0.0),
        gutter=gutter,
        gutter_width=gutter_width,
        wet=wet,
    )


def pavement_albedo(
    pavement: Pavement,
    layout: Layout,
    along: Tensor,
    across: Tensor,
    reach_along: Tensor,
    reach_across: Tensor,
    blotch: Tensor,
) -> Tensor:
    """Linear reflectance of the bare surface, (B, 3, N).

    Args:
        pavement: the surface.
        layout: its boundaries.
        along: (B, N) m in the world.
        across: (B, N) m in the layout's frame.
        reach_along: (B, N) m per pixel.
        reach_across: (B, N) m per pixel.
        blotch: (4, B, N), see :func:`~lanebev.render.raster.noise.blotches`.
    """
    lane = torch.searchsorted(layout.across, across.contiguous())  # 0: left of the first boundary
    count = layout.exists.sum(1, keepdim=True)
    on_shoulder = (lane == 0) | (lane >= count)
    last = layout.across.gather(1, (count - 1).clamp(min=0))
    low = layout.across.gather(1, (lane - 1).clamp(min=0))
    high = layout.across.gather(1, lane.clamp(max=MAX_BOUNDARIES - 1))
    middle = torch.where(
        lane == 0, -1.8 + 0 * low, torch.where(lane >= count, last + 1.8, 0.5 * (low + high))
    )
    inside = across - middle

    shade = pavement.lane_tone.gather(1, lane) * (
        1 + _weathering(pavement, along, across, inside, reach_along, blotch[0])
    )
    shade = shade * (1 - _lines(pavement, layout, along, across, inside, reach_along, reach_across, blotch))
    shade = shade * _patches(pavement, lane, along, inside, reach_along, reach_across)
    shade = shade * _gutters(pavement, along, across, reach_across, blotch[0])

    deck = ((along + pavement.deck_phase[:, None]) % pavement.deck_period[:, None]) < pavement.deck_length[
        :, None
    ]
    colour = torch.where(on_shoulder[:, None], pavement.shoulder[..., None], pavement.base[..., None])
    colour = torch.where(deck[:, None], pavement.deck[..., None], colour)
    darkening = 1 - 0.5 * pavement.wet
    return (colour * (shade * darkening[:, None]).clamp(min=0.08)[:, None]).clamp(0.005, 0.9)


def _weathering(
    pavement: Pavement, along: Tensor, across: Tensor, inside: Tensor, reach: Tensor, mottle: Tensor
) -> Tensor:
    """(B, N) relative change by aggregate, blotches, streaks, tyre tracks and oil."""
    u, v = along, across
    grain = sample_grain(GRAIN, u / 6.1, v / 6.1) / (1 + reach / 0.05)
    medium = sample_noise(SECOND, u / 61.0, v / 47.0) / (1 + reach / 0.5)
    streak = sample_noise(SECOND, u / 2300.0, v / 23.0)
    tracks = torch.exp(-(((inside.abs() - 0.85) / 0.32) ** 2))
    oil = torch.exp(-((inside / 0.45) ** 2)) * (0.8 + 0.3 * mottle)
    total = pavement.grain[:, None] * (grain + 0.5 * medium) + pavement.mottle[:, None] * mottle
    total = total + pavement.streak[:, None] * streak - pavement.oil[:, None] * oil
    total = total + pavement.bands[:, None] * sample_line(
        across / 55.0 + along / 9000.0 + pavement.joint_period[:, None]
    )
    return total - pavement.tracks[:, None] * tracks * (1 + 0.3 * mottle)


def _lines(
    pavement: Pavement,
    layout: Layout,
    along: Tensor,
    across: Tensor,
    inside: Tensor,
    reach_along: Tensor,
    reach_across: Tensor,
    blotch: Tensor,
) -> Tensor:
    """(B, N) darkening by seams, joints, cracks and skids."""
    slot = nearest_slot(layout, across)
    wobble = sample_line(along / 90.0)
    seam = pavement.seam.gather(1, slot)
    distance = across - layout.across.gather(1, slot) - pavement.seam_shift.gather(1, slot) - 0.02 * wobble
    width = pavement.seam_width[:, None] * (1 + 0.4 * wobble).clamp(0.3)
    dark = seam * stripe_coverage(distance, width, reach_across) * (1 + pavement.tar[:, None])
    dark = dark + pavement.middle_seam[:, None] * stripe_coverage(
        inside - pavement.middle_shift[:, None] - 0.03 * wobble, width, reach_across
    )

    period = pavement.joint_period[:, None]
    tilt = along + 0.08 * across + 0.03 * wobble
    joint = dash_coverage(tilt, 0.02 + 0 * period, period, reach_along)
    dark = dark + pavement.joint[:, None] * (joint * 2.5).clamp(max=1)

    crack = sample_noise(CRACK, along / 41.0, across / 29.0) / (1 + reach_along / 0.25)
    where = smoothstep(-0.2, 0.8, blotch[1])
    dark = dark + pavement.crack[:, None] * crack * where * (1 + pavement.tar[:, None])

    skid = stripe_coverage(inside.abs() - 0.75 - 0.1 * wobble, torch.full_like(across, 0.2), reach_across)
    skid = skid * smoothstep(0.9, 1.4, sample_line(along / 400.0 + 0.5))
    return (dark + pavement.skid[:, None] * skid).clamp(0, 0.92)


def _patches(
    pavement: Pavement, lane: Tensor, along: Tensor, inside: Tensor, reach_along: Tensor, reach_across: Tensor
) -> Tensor:
    """(B, N) factor: rectangles of newer or older surface, one at most in 14 m of a lane."""
    cell = (along / 14.0).floor()
    row = lane.to(along.dtype)
    exists = hash01(cell, row, 1.0) < pavement.patch[:, None]
    middle, length = 3 + 8 * hash01(cell, row, 2.0), 0.8 + 4 * hash01(cell, row, 3.0)
    shift, width = 1.6 * (hash01(cell, row, 4.0) - 0.5), 0.8 + 1.6 * hash01(cell, row, 5.0)
    covered = stripe_coverage(along - cell * 14.0 - middle, length, reach_along)
    covered = covered * stripe_coverage(inside - shift, width, reach_across)
    tone = 0.55 + 0.8 * hash01(cell, row, 6.0)
    return torch.where(exists, 1 + covered * (tone - 1), 1.0)


def _gutters(
    pavement: Pavement, along: Tensor, across: Tensor, reach_across: Tensor, mottle: Tensor
) -> Tensor:
    """(B, N) factor of the strips along both edges: a line beside a barrier's foot that is no marking."""
    tone = torch.ones_like(across)
    for side, edge in ((0, pavement.left), (1, pavement.right)):
        width = pavement.gutter_width[:, side, None] * (1 + 0.15 * sample_line(along / 70.0 + side))
        inwards = (across - edge[:, None]) * (1 - 2 * side)
        covered = stripe_coverage(inwards - 0.5 * width, width, reach_across)
        strength = covered * (0.85 + 0.15 * mottle).clamp(0, 1.3) * (width > 0.01)
        tone = tone * (1 + strength * (pavement.gutter[:, side, None] - 1))
    return tone.clamp(min=0.1)
