"""Paint on the road, anti-aliased analytically: coverage from road coordinates and pixel footprint."""

import torch
from torch import Tensor

from lanebev.render.raster.base.coverage import dash_coverage, stripe_coverage
from lanebev.render.raster.base.features import Features
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.noise import sample_grain, smoothstep
from lanebev.render.raster.base.select import as_float, remainder
from lanebev.render.scene.road.layout import Layout, presence

STUD_SPACING, STUD_SIZE, STUD_HEIGHT = 1.22, 0.11, 0.020  # m, Botts' dots
_TAIL = 2.5  # px beside a stripe at which nothing is left of it: five standard deviations of the pixel


def near_marking(layout: Layout, ground: Ground, slot: Tensor) -> Tensor:
    """Return which points any paint or stud of the nearest boundary can reach, (B, N) bool.

    Args:
        layout: the road's boundaries.
        ground: the points.
        slot: (B, N) the nearest boundary.
    """
    stripe = 0.5 * (layout.stripe_width + layout.separation)
    ghost = torch.where(layout.ghost > 0, layout.ghost_shift.abs() + 0.5 * layout.stripe_width, 0.0)
    reach = torch.maximum(stripe, ghost).clamp(min=STUD_SIZE)
    distance = (ground.across - layout.across.gather(1, slot)).abs()
    return distance < reach.gather(1, slot) + _TAIL * ground.reach_across


def paint(
    layout: Layout, ground: Ground, slot: Tensor, grazing: Tensor, blotch: Tensor, features: Features
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the coverage of road points by paint and by studs.

    Args:
        layout: the road's boundaries.
        ground: the points.
        slot: (B, N) the nearest boundary.
        grazing: (B, N) distance over camera height: how much longer a raised stud looks.
        blotch: (B, N) slow noise: where the paint is worn.
        features: what any of the roads has.

    Returns:
        coverage of paint and of studs (B, N) each in [0, 1], and the paint's colour (B, 3, N).
    """

    def of(values: Tensor) -> Tensor:
        return values.gather(1, slot)

    reach_along, reach_across = ground.reach_along, ground.reach_across
    distance, width = ground.across - of(layout.across), of(layout.stripe_width)
    phase = ground.along + of(layout.dash_phase)

    def stripe(shift: Tensor | float, index: int) -> Tensor:
        length, period = (of(layout.dash[:, :, index, i]) for i in (0, 1))
        along = dash_coverage(phase, length, period, reach_along)
        return stripe_coverage(distance + shift, width, reach_across) * along

    if features.double:
        apart = 0.5 * of(layout.separation)
        left = stripe(apart, 0)
        stripes = (left + stripe(-apart, 1) * as_float(apart > 0)).clamp(max=1)
    else:
        stripes = stripe(0.0, 0)
    worn = _wear(ground, of(layout.wear), blotch)
    covered = stripes * of(layout.opacity) * worn
    if features.ghost:
        old = of(layout.ghost) * stripe_coverage(distance - of(layout.ghost_shift), width, reach_across)
        length, period = (of(layout.dash[:, :, 0, i]) for i in (0, 1))
        old = old * dash_coverage(phase + 3.7, length, period, reach_along)
        covered = torch.maximum(covered, old * (worn - 0.3).clamp(0))
    here = presence(layout, slot, ground.along)
    studs = torch.zeros_like(distance)
    if features.studs:
        period = of(layout.stud_period)
        pattern = _stud_pattern(phase, period, of(layout.stud_group), reach_along, grazing)
        across = stripe_coverage(distance, STUD_SIZE, reach_across)
        studs = across * pattern * here * as_float(period > 0)
    colour = torch.stack([of(layout.colour[..., i]) for i in range(3)], dim=1)
    return covered * here, studs, colour


def _stud_pattern(along: Tensor, period: Tensor, group: Tensor, reach: Tensor, grazing: Tensor) -> Tensor:
    period = period.clamp(min=1.0)
    seen = (STUD_SIZE + STUD_HEIGHT * grazing).clamp(max=0.8 * STUD_SPACING)
    dots = dash_coverage(remainder(along, period), seen, seen.new_full((), STUD_SPACING), reach)
    return dots * dash_coverage(along, group, period, reach)


def _wear(ground: Ground, wear: Tensor, patches: Tensor) -> Tensor:
    """Compute the remaining paint, (B, N) in [0, 1]: patches are worn off by tyres, grain shows through."""
    grain = sample_grain(ground.along / 5.0, ground.across / 2.5) / (1 + ground.reach_along / 0.05)
    return smoothstep(-0.6, 0.5, patches * 0.5 + grain * 0.45 + 0.95 - 1.6 * wear)
