"""Paint on the road, anti-aliased analytically: coverage from road coordinates and pixel footprint."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.render.raster.noise import GRAIN, sample_grain, smoothstep
from lanebev.render.scene.layout import Layout, presence

PSF = 0.5  # px, standard deviation of the pixel's Gaussian: keeps thin stripes' centroids unbiased
STUD_SPACING, STUD_SIZE, STUD_HEIGHT = 1.22, 0.11, 0.020  # m, Botts' dots


def stripe_coverage(distance: Tensor, width: Tensor, footprint: Tensor) -> Tensor:
    """Share of a pixel that a stripe covers: a box of the stripe's width under a Gaussian pixel.

    Args:
        distance: m from the stripe's centre line.
        width: m.
        footprint: m per pixel, across the stripe.
    """
    scale = 1 / (PSF * 2**0.5 * footprint)
    half = 0.5 * width
    return 0.5 * (torch.erf((distance + half) * scale) - torch.erf((distance - half) * scale))


def dash_coverage(along: Tensor, length: Tensor, period: Tensor, footprint: Tensor) -> Tensor:
    """Share of a pixel that a periodic dash covers, exactly integrated over the footprint along the road."""
    reach = 0.5 * footprint.clamp(min=1e-3)

    def painted_up_to(s: Tensor) -> Tensor:
        whole = (s / period).floor()
        return whole * length + torch.minimum(s - whole * period, length)

    return (painted_up_to(along + reach) - painted_up_to(along - reach)) / (2 * reach)


def nearest_slot(layout: Layout, across: Tensor) -> Tensor:
    """(B, N) int64: the boundary nearest to ``across`` (B, N) m."""
    middles = 0.5 * (layout.across[:, 1:] + layout.across[:, :-1])
    return torch.searchsorted(middles, across.contiguous())


def paint(
    layout: Layout,
    along: Tensor,
    across: Tensor,
    reach_along: Tensor,
    reach_across: Tensor,
    grazing: Tensor,
    blotch: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Paint and studs over road points.

    Args:
        layout: the road's boundaries.
        along: (B, N) m, arc length in the world.
        across: (B, N) m, in the layout's frame.
        reach_along: (B, N) m per pixel.
        reach_across: (B, N) m per pixel.
        grazing: (B, N) distance over camera height: how much longer a raised stud looks.
        blotch: (B, N) slow noise: where the paint is worn.

    Returns:
        coverage of paint and of studs (B, N) each in [0, 1], and the paint's colour (B, 3, N).
    """
    slot = nearest_slot(layout, across)

    def of(values: Tensor) -> Tensor:
        return values.gather(1, slot)

    distance = across - of(layout.across)
    width, apart = of(layout.stripe_width), 0.5 * of(layout.separation)
    phase = along + of(layout.dash_phase)
    dash = layout.dash.flatten(2).gather(1, slot[..., None].expand(-1, -1, 4))  # (B, N, 4)
    left, right = (
        stripe_coverage(distance + shift, width, reach_across)
        * dash_coverage(phase, dash[..., i], dash[..., i + 1], reach_along)
        for shift, i in ((apart, 0), (-apart, 2))
    )
    here = presence(layout, slot, along)
    worn = _wear(along, across, of(layout.wear), reach_along, blotch)
    stripes = torch.where(apart > 0, left + right, left).clamp(max=1) * of(layout.opacity) * worn
    ghost = of(layout.ghost) * stripe_coverage(distance - of(layout.ghost_shift), width, reach_across)
    ghost = (
        ghost * dash_coverage(phase + 3.7, dash[..., 0], dash[..., 1], reach_along) * (worn - 0.3).clamp(0)
    )

    period = of(layout.stud_period)
    studs = stripe_coverage(distance, period.new_tensor(STUD_SIZE), reach_across)
    studs = studs * _stud_pattern(phase, period, of(layout.stud_group), reach_along, grazing)
    colour = layout.colour.gather(1, slot[..., None].expand(-1, -1, 3)).mT  # (B, 3, N)
    return torch.maximum(stripes, ghost) * here, studs * here * (period > 0), colour


def _stud_pattern(along: Tensor, period: Tensor, group: Tensor, reach: Tensor, grazing: Tensor) -> Tensor:
    period = period.clamp(min=1.0)
    seen = STUD_SIZE + STUD_HEIGHT * grazing
    spacing = torch.full_like(along, STUD_SPACING)
    position = along % period
    dots = dash_coverage(position, torch.minimum(seen, 0.8 * spacing), spacing, reach)
    return dots * dash_coverage(along, group, period, reach)


def _wear(along: Tensor, across: Tensor, wear: Tensor, reach: Tensor, patches: Tensor) -> Tensor:
    """(B, N) in [0, 1] remaining paint: patches worn off by the tyres, grain showing through."""
    grain = sample_grain(GRAIN, along / 5.0, across / 2.5) / (1 + reach / 0.05)
    return smoothstep(-0.6, 0.5, patches * 0.5 + grain * 0.45 + 0.95 - 1.6 * wear)
