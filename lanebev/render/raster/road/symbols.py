"""Arrows, words and diamonds painted inside the lanes."""

import torch
from torch import Tensor

from lanebev.render.raster.base.coverage import stripe_coverage
from lanebev.render.raster.base.footprint import Ground
from lanebev.render.raster.base.noise import hash01
from lanebev.render.raster.base.select import remainder
from lanebev.render.scene.road.layout import MAX_BOUNDARIES, Layout

NO_SYMBOL, ARROW, TURN, WORD, DIAMOND = range(5)
_LENGTH = 5.0  # m, of a symbol along the road
_LETTER = (0.42, 2.4)  # m, a letter's pitch across and its height along the road


def symbols(layout: Layout, ground: Ground, lane: Tensor) -> Tensor:
    """Compute the coverage of a pixel by symbols, (B, N).

    Args:
        layout: layout of the road; the symbol of lane k stands between boundaries k and k + 1.
        ground: the points.
        lane: (B, N) int64, number of boundaries to their left.
    """
    covered = torch.zeros_like(ground.along)
    between = (lane - 1).clamp(0, MAX_BOUNDARIES - 2)
    painted = layout.symbols
    period, phase = painted.period[:, None], painted.phase[:, None]
    position = remainder(ground.along + phase, period)
    inner = (lane >= 1) & (lane < MAX_BOUNDARIES)
    there = (painted.kind > NO_SYMBOL).gather(1, between) & (position < _LENGTH + 2) & inner
    row, at = there.nonzero(as_tuple=True)
    if not len(at):
        return covered
    lane = between[row, at]
    x = ground.across[row, at] - 0.5 * (layout.across[row, lane] + layout.across[row, lane + 1])
    y = position[row, at] - 1.0
    kind, wide, far = painted.kind[row, lane], ground.reach_across[row, at], ground.reach_along[row, at]
    seed = ((ground.along + phase) / period)[row, at].floor() + 7.0 * lane
    shapes = torch.stack(
        [
            _arrow(x, y, wide, far),
            _turn(x, y, wide, far),
            _word(x, y, wide, far, seed),
            _diamond(x, y, wide, far),
        ]
    )
    value = shapes.gather(0, (kind - 1)[None])[0]
    covered[row, at] = value * painted.opacity[row]
    return covered


def _arrow(x: Tensor, y: Tensor, wide: Tensor, far: Tensor) -> Tensor:
    """Draw a stem of 3 m and a head of 1.6 m."""
    stem = stripe_coverage(x, 0.16, wide) * stripe_coverage(y - 1.5, 3.0, far)
    gap = 0.42 * (4.6 - y) / 1.6 - x.abs()
    head = (gap / wide + 0.5).clamp(0, 1) * ((y - 3.0) / far + 0.5).clamp(0, 1)
    return torch.maximum(stem, head)


def _turn(x: Tensor, y: Tensor, wide: Tensor, far: Tensor) -> Tensor:
    """Draw a stem that leads to a head pointing right."""
    stem = stripe_coverage(x + 0.3, 0.16, wide) * stripe_coverage(y - 1.6, 3.2, far)
    bar = stripe_coverage(x, 0.6, wide) * stripe_coverage(y - 3.0, 0.5, far)
    gap = 1.1 * (0.75 - x) / 0.5 - (y - 3.0).abs()
    head = (gap / far + 0.5).clamp(0, 1) * ((x - 0.25) / wide + 0.5).clamp(0, 1)
    return torch.maximum(torch.maximum(stem, bar), head)


def _word(x: Tensor, y: Tensor, wide: Tensor, far: Tensor, seed: Tensor) -> Tensor:
    """Draw four letters of one stroke or three each, tall enough to be read from a car."""
    letter = (x / _LETTER[0]).floor()
    u, v = x / _LETTER[0] - letter, y / _LETTER[1]
    inside = (letter >= -2) & (letter < 2) & (v > 0) & (v < 1)
    pick = hash01(letter, seed, 3.0)
    left = stripe_coverage((u - 0.2) * _LETTER[0], 0.1, wide) * (pick < 0.85)
    right = stripe_coverage((u - 0.75) * _LETTER[0], 0.1, wide) * (pick > 0.3)
    bars = [
        stripe_coverage((v - height) * _LETTER[1], 0.3, far) * (u > 0.1) * (u < 0.85) * chosen
        for height, chosen in ((0.08, pick < 0.6), (0.5, pick > 0.4), (0.92, (pick < 0.3) | (pick > 0.6)))
    ]
    strokes = torch.stack([left, right, *bars]).amax(0)
    return strokes * inside


def _diamond(x: Tensor, y: Tensor, wide: Tensor, far: Tensor) -> Tensor:
    """Draw the outline of a rhombus, 1 m by 4 m."""
    size = x.abs() / 0.5 + (y - 2.0).abs() / 2.0
    reach = torch.hypot(wide / 0.5, far / 2.0)
    return (((1.0 - size) / reach + 0.5).clamp(0, 1)) * (((size - 0.68) / reach + 0.5).clamp(0, 1))
