"""The road's surface: asphalt and concrete with everything that age and traffic leave on it."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.road.layout import MAX_BOUNDARIES, Layout
from lanebev.render.scene.sampler import BatchSampler


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


def _tone(sampler: BatchSampler, concrete: Tensor, bright: Tensor) -> Tensor:
    """Sample the reflectance of asphalt or concrete, (B, 3)."""
    level = torch.where(concrete, sampler.uniform(0.20, 0.40), sampler.uniform(0.045, 0.17))
    level = torch.where(bright, sampler.uniform(0.33, 0.50), level)
    warm = torch.where(concrete, sampler.uniform(-0.01, 0.07), sampler.uniform(-0.04, 0.04))
    warm = torch.where(bright, sampler.uniform(0.02, 0.12), warm)
    tint = torch.stack([1 + warm, 1 + 0.3 * warm, 1 - warm], dim=1) + sampler.normal(0.008, 3)
    return level[:, None] * tint


def _edges(sampler: BatchSampler, median: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sample the shoulders' widths (m), and the gutters' factors and widths (m), left and right, (B, 2)."""
    narrow, full = sampler.chance(0.3, 2), sampler.chance(0.4, 2)  # full: about as wide as a lane
    shoulder = torch.where(full, sampler.uniform(2.2, 3.7, 2), sampler.uniform(1.0, 4.0, 2))
    shoulder = torch.where(narrow, sampler.uniform(0.2, 1.0, 2), shoulder)
    shoulder[:, 0] = torch.where(median, sampler.uniform(1.5, 3.7), shoulder[:, 0])
    gutter = sampler.either(0.7, (1.1, 2.2), (0.4, 0.9), 2)
    gutter_width = sampler.sometimes(0.5, 0.05, 0.6, 2)
    gutter[:, 0] = torch.where(median, sampler.uniform(1.2, 2.4), gutter[:, 0])
    gutter_width[:, 0] = torch.where(median, sampler.uniform(0.05, 0.25), gutter_width[:, 0])
    return shoulder, gutter, gutter_width


def sample_pavement(
    sampler: BatchSampler, layout: Layout, dotted: Tensor, bright: Tensor, wet: Tensor, median: Tensor
) -> Pavement:
    """Sample a random surface under a layout.

    Args:
        sampler: the randomness.
        layout: the boundaries.
        dotted: (B,) bool, Californian concrete is likely.
        bright: (B,) bool, sun-bleached beige concrete.
        wet: (B,) in [0, 1].
        median: (B,) bool, a barrier stands along the left edge, with a bright strip at its foot.
    """
    concrete = torch.where(dotted, sampler.chance(0.75), sampler.chance(0.25)) | bright
    base = _tone(sampler, concrete, bright)
    other = _tone(sampler, sampler.chance(0.4), bright & sampler.chance(0.5))
    same = sampler.chance(0.6)[:, None]
    tone = 1 + sampler.normal(0.06, MAX_BOUNDARIES + 1) * sampler.chance(0.6, 1)
    shoulder, gutter, gutter_width = _edges(sampler, median)
    old = sampler.uniform(0, 1)  # how old the road is
    even = torch.where(bright, sampler.chance(0.6), sampler.chance(0.3))
    rough = torch.where(even, sampler.uniform(0.0, 0.3), 1.0)
    seams = torch.where(concrete, sampler.chance(0.75), sampler.chance(0.35))
    seam = torch.where(seams[:, None], sampler.uniform(0.2, 0.95, 1), 0.0) * sampler.uniform(
        0.3, 1.0, MAX_BOUNDARIES
    )
    return Pavement(
        left=-shoulder[:, 0],
        right=layout.last_across() + shoulder[:, 1],
        base=base,
        shoulder=torch.where(same, base * sampler.uniform(0.8, 1.1, 1), other),
        deck=_tone(sampler, ~concrete, bright),
        deck_period=sampler.uniform(250, 700),
        deck_length=sampler.sometimes(0.2, 15, 120),
        deck_phase=sampler.uniform(-90, 40),
        lane_tone=tone.clamp(0.75, 1.25),
        grain=sampler.uniform(0.04, 0.22) * (0.4 + 0.6 * rough),
        mottle=sampler.uniform(0.01, 0.08) * rough,
        streak=sampler.uniform(0.01, 0.08) * rough,
        bands=sampler.sometimes(0.6, 0.0, 0.13) * rough,
        tracks=sampler.uniform(-0.12, 0.2) * rough,
        oil=sampler.sometimes(0.6, 0.0, 0.35) * rough,
        seam=seam,
        seam_shift=sampler.normal(0.15, MAX_BOUNDARIES)
        + 0.17 * torch.where(sampler.chance(0.5, 1), 1.0, -1.0),
        seam_width=sampler.uniform(0.012, 0.05),
        middle_seam=sampler.sometimes(0.2, 0.1, 0.7),
        middle_shift=sampler.uniform(-1.2, 1.2),
        joint=torch.where(concrete, sampler.chance(0.7), sampler.chance(0.06)) * sampler.uniform(0.05, 0.5),
        joint_period=sampler.uniform(3.5, 7.5),
        crack=torch.where(sampler.chance(0.5), sampler.uniform(0.0, 0.6) * old, 0.0),
        tar=sampler.sometimes(0.3, 0.3, 0.9),
        patch=sampler.sometimes(0.35, 0.02, 0.2),
        skid=sampler.sometimes(0.25, 0.1, 0.5),
        gutter=gutter,
        gutter_width=gutter_width,
        wet=wet,
    )
