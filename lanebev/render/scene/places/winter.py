"""Snow and slush: at the edges, over stretches of the lines, between the wheel tracks."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.road.layout import MAX_BOUNDARIES, Gaps, Layout
from lanebev.render.scene.sampler import BatchSampler


class Winter(NamedTuple):
    """Snow on the ground, (B,) unless said otherwise.

    Attributes:
        on: 1 where there is any.
        colour: (B, 3) linear reflectance of it on the road.
        verge: cover of the ground beside the road, [0, 1].
        edge: (B, 2) m by which it reaches in from the pavement's edges, left and right.
        ragged: m of that edge's waves.
        line: half width, m, of the snow that lies over a boundary where its paint is not seen.
        film: cover between the wheel tracks, [0, 1].
        track: half width of a wheel track, m.
    """

    on: Tensor
    colour: Tensor
    verge: Tensor
    edge: Tensor
    ragged: Tensor
    line: Tensor
    film: Tensor
    track: Tensor


def sample_winter(sampler: BatchSampler, snow: Tensor) -> Winter:
    """Sample random snow where snow (B,) bool holds."""
    level = sampler.either(0.6, (0.45, 0.85), (0.18, 0.45))
    blue = sampler.uniform(-0.02, 0.06)
    return Winter(
        on=snow.float(),
        colour=level[:, None] * torch.stack([1 - blue, 1 + 0 * blue, 1 + blue], 1),
        verge=sampler.sometimes(0.85, 0.6, 1.0, otherwise=0.1),
        edge=sampler.uniform(-0.5, 1.6, 2),
        ragged=sampler.uniform(0.05, 0.5),
        line=sampler.uniform(0.15, 0.7),
        film=sampler.sometimes(0.6, 0.1, 0.8),
        track=sampler.uniform(0.25, 0.55),
    )


def snowed_layout(sampler: BatchSampler, snow: Tensor, layout: Layout) -> Layout:
    """Return a layout whose boundaries are hidden over long stretches, where snow (B,) holds."""
    slots = MAX_BOUNDARIES
    long = sampler.uniform(10, 60, slots)
    covered = snow[:, None] & sampler.chance(0.6, slots)
    period = long / sampler.uniform(0.25, 0.9, 1)
    hidden = Gaps(period, long, sampler.uniform(0, 60, slots))
    gaps = (torch.where(covered, *pair) for pair in zip(hidden, layout.gaps, strict=True))
    return layout._replace(gaps=Gaps(*gaps))
