"""Arrows, words and diamonds painted inside the lanes."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.render.raster.markings import stripe_coverage
from lanebev.render.raster.noise import hash01
from lanebev.render.scene.layout import MAX_BOUNDARIES, Layout

NO_SYMBOL, ARROW, TURN, WORD, DIAMOND = range(5)
_LENGTH = 5.0  # m, of a symbol along the road
_LETTER = (0.42, 2.4)  # m, a letter's pitch across and its height along the road


def symbols(
    layout: Layout, along: Tensor, across: Tensor, reach_along: Tensor, reach_across: Tensor
) -> Tensor:
    """Coverage of a pixel by symbols, (B, N).

    Args:
        layout: of the road; the symbol of lane k stands between boundaries k and k + 1.
        along: (B, N) m in the world.
        across: (B, N) m in the layout's frame.
        reach_along: (B, N) m per pixel.
        reach_across: (B, N) m per pixel.
    """
    covered = torch.zeros_like(along)
    if not bool((layout.symbol > NO_SYMBOL).any()):
        return covered
    lane = (torch.searchsorted(layout.across, across.contiguous()) - 1).clamp(0, MAX_BOUNDARIES - 2)
    low, high = layout.across.gather(1, lane), layout.across.gather(1, lane + 1)
    period = layout.symbol_period[:, None]
    position = (along + layout.symbol_phase[:, None]) % period
    kind = layout.symbol.gather(1, lane)
    there = (kind > NO_SYMBOL) & (position < _LENGTH + 2) & (across > low) & (across < high)
    row, at = there.nonzero(as_tuple=True)
    if not len(at):
        return covered
    x = (across - 0.5 * (low + high))[row, at]
    y = position[row, at] - 1.0
    kind, wide, far = kind[row, at], reach_across[row, at], reach_along[row, at]
    seed = ((along + layout.symbol_phase[:, None]) / period).floor()[row, at] + 7.0 * lane[row, at]
    shapes = torch.stack(
        [
            _arrow(x, y, wide, far),
            _turn(x, y, wide, far),
            _word(x, y, wide, far, seed),
            _diamond(x, y, wide, far),
        ]
    )
    value = shapes.gather(0, (kind - 1)[None])[0]
    covered[row, at] = value * layout.symbol_opacity[row]
    return covered


def _arrow(x: Tensor, y: Tensor, wide: Tensor, far: Tensor) -> Tensor:
    """A stem of 3 m and a head of 1.6 m."""
    stem = stripe_coverage(x, torch.full_like(x, 0.16), wide) * stripe_coverage(
        y - 1.5, torch.full_like(x, 3.0), far
    )
    room = 0.42 * (4.6 - y) / 1.6 - x.abs()
    head = (room / wide + 0.5).clamp(0, 1) * ((y - 3.0) / far + 0.5).clamp(0, 1)
    return torch.maximum(stem, head)


def _turn(x: Tensor, y: Tensor, wide: Tensor, far: Tensor) -> Tensor:
    """A stem that leads to a head pointing right."""
    stem = stripe_coverage(x + 0.3, torch.full_like(x, 0.16), wide) * stripe_coverage(
        y - 1.6, torch.full_like(x, 3.2), far
    )
    bar = stripe_coverage(x - 0.0, torch.full_like(x, 0.6), wide) * stripe_coverage(
        y - 3.0, torch.full_like(x, 0.5), far
    )
    room = 1.1 * (0.75 - x) / 0.5 - (y - 3.0).abs()
    head = (room / far + 0.5).clamp(0, 1) * ((x - 0.25) / wide + 0.5).clamp(0, 1)
    return torch.maximum(torch.maximum(stem, bar), head)


def _word(x: Tensor, y: Tensor, wide: Tensor, far: Tensor, seed: Tensor) -> Tensor:
    """Four letters of a stroke or three each, tall enough to be read from a car."""
    letter = (x / _LETTER[0]).floor()
    u, v = x / _LETTER[0] - letter, y / _LETTER[1]
    inside = (letter >= -2) & (letter < 2) & (v > 0) & (v < 1)
    pick = hash01(letter, seed, 3.0)
    left = stripe_coverage((u - 0.2) * _LETTER[0], torch.full_like(x, 0.1), wide) * (pick < 0.85)
    right = stripe_coverage((u - 0.75) * _LETTER[0], torch.full_like(x, 0.1), wide) * (pick > 0.3)
    bars = [
        stripe_coverage((v - height) * _LETTER[1], torch.full_like(x, 0.3), far)
        * (u > 0.1)
        * (u < 0.85)
        * chosen
        for height, chosen in ((0.08, pick < 0.6), (0.5, pick > 0.4), (0.92, (pick < 0.3) | (pick > 0.6)))
    ]
    strokes = torch.stack([left, right, *bars]).amax(0)
    return strokes * inside


def _diamond(x: Tensor, y: Tensor, wide: Tensor, far: Tensor) -> Tensor:
    """The outline of a rhombus, 1 m by 4 m."""
    size = x.abs() / 0.5 + (y - 2.0).abs() / 2.0
    reach = torch.hypot(wide / 0.5, far / 2.0)
    return (((1.0 - size) / reach + 0.5).clamp(0, 1)) * (((size - 0.68) / reach + 0.5).clamp(0, 1))
