"""Everything beside and above the road: verge, walls that follow it, hills, sky."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.sampler import BatchSampler

NUM_WALLS = 6  # left and right, from the outside inwards
NOTHING, CONCRETE, RAIL, TREES, FENCE, SLOPE, HEDGE, HOUSES = range(8)
STYLES = 3  # styles of trees: a dense row, single crowns, conifers

GREENS = [
    (0.05, 0.10, 0.025), (0.07, 0.12, 0.04), (0.035, 0.06, 0.02), (0.10, 0.13, 0.05), (0.03, 0.05, 0.025),
]  # fmt: skip
EARTHS = [(0.30, 0.24, 0.12), (0.36, 0.28, 0.14), (0.25, 0.20, 0.14), (0.22, 0.20, 0.17), (0.10, 0.15, 0.05)]


class Walls(NamedTuple):
    """Walls along roads, (B, W) each or, of some of several scenes, (E,); unless said otherwise.

    Attributes:
        across: m, place in the layout's frame.
        kind: int64, NOTHING, CONCRETE, RAIL, TREES, FENCE, SLOPE, HEDGE or HOUSES.
        height: m.
        colour: (..., 3) linear reflectance.
        seed: in [0, 1), shifts the noise.
        toe: factor of a concrete barrier's sloping foot, which faces the sky; 1 is none.
    """

    across: Tensor
    kind: Tensor
    height: Tensor
    colour: Tensor
    seed: Tensor
    toe: Tensor


class Surroundings(NamedTuple):
    """Beside a road.

    Attributes:
        walls: (B, W).
        verge: (B, 2, 3) linear reflectance of the ground beside the pavement, left and right.
        zenith: (B, 3) linear radiance of the sky.
        skyline: (B, 3) linear radiance at the horizon.
        cloud: (B,) share of the sky.
        opposite: (B,) m, right edge of the opposite carriageway in the layout's frame; -infinite: none.
        opposite_colour: (B, 3) linear reflectance of it.
        hill_height: (B, 2) rad, two ridges.
        hill_colour: (B, 3).
    """

    walls: Walls
    verge: Tensor
    zenith: Tensor
    skyline: Tensor
    cloud: Tensor
    opposite: Tensor
    opposite_colour: Tensor
    hill_height: Tensor
    hill_colour: Tensor


def sample_surroundings(
    sampler: BatchSampler, left: Tensor, right: Tensor, grey: Tensor, opposite: Tensor, median: Tensor
) -> Surroundings:
    """Sample random surroundings of a pavement.

    Args:
        sampler: the randomness.
        left: (B,) m, the pavement's left edge.
        right: (B,) m, its right edge.
        grey: (B,) in [0, 1], how overcast it is.
        opposite: (B,) m, the opposite carriageway's right edge; -infinite: none.
        median: (B,) bool, a concrete barrier stands along the left edge, darker than others.
    """
    kind, across = _places_of_walls(sampler, left, right, opposite, median)
    height, colour = _sizes_and_colours(sampler, kind, median)
    zenith, skyline = _sky(sampler, grey[:, None])
    verge = torch.where(sampler.chance(0.5, 1, 1), sampler.pick_from(GREENS, 2), sampler.pick_from(EARTHS, 2))
    return Surroundings(
        walls=Walls(
            across=across,
            kind=kind,
            height=height,
            colour=colour,
            seed=sampler.uniform(0, 1, NUM_WALLS),
            toe=sampler.sometimes(0.6, 1.1, 3.0, NUM_WALLS, otherwise=1.0),
        ),
        verge=verge * sampler.uniform(0.7, 1.3, 1, 1),
        zenith=zenith,
        skyline=skyline,
        cloud=sampler.sometimes(0.35, 0.0, 0.8),
        opposite=opposite,
        opposite_colour=sampler.uniform(0.06, 0.3, 1) * torch.tensor([1.0, 0.99, 0.96]),
        hill_height=sampler.sometimes(0.6, 0.0, 0.09, 2, otherwise=-0.05),
        hill_colour=(0.5 * sampler.pick_from(GREENS) + 0.5 * sampler.pick_from(EARTHS)),
    )


def _places_of_walls(
    sampler: BatchSampler, left: Tensor, right: Tensor, opposite: Tensor, median: Tensor
) -> tuple[Tensor, Tensor]:
    """Sample the kind of the six walls, int64, and their place across, m: far, middle and near, (B, 6)."""
    trees = [0, 0, 0, 5, 0, 2.5, 0.5]  # with slopes and hedges
    far = [torch.where(sampler.chance(0.75), sampler.pick(trees), 0) for _ in range(2)]
    middle = [torch.where(sampler.chance(0.45), sampler.pick([0, 0, 0, 3, 3, 2, 2]), 0) for _ in range(2)]
    near = [sampler.pick([2, 6, 1.5]), sampler.pick([4, 3, 2.5])]  # the median has a barrier more often
    kind = torch.stack([*far, *middle, *near], dim=1)
    divided = opposite.isfinite()
    kind[:, 2] = torch.where(divided, NOTHING, kind[:, 2])
    kind[:, 4] = torch.where(median, CONCRETE, kind[:, 4])
    # near ones stand at the pavement's edge, or behind it
    close = sampler.uniform(0.05, 1.2, 2) * sampler.pick_from([0.0, 1.0], 2)
    close[:, 0] = torch.where(median, 0.0, close[:, 0])
    gap = torch.cat([sampler.uniform(14, 45, 2), sampler.uniform(4, 14, 2), close], dim=1)
    across = torch.stack([left, right] * 3, dim=1) + torch.tensor([-1.0, 1.0] * 3) * gap
    across[:, 0] = torch.where(divided, torch.minimum(across[:, 0], opposite - 16), across[:, 0])
    return kind, across


def _sizes_and_colours(sampler: BatchSampler, kind: Tensor, median: Tensor) -> tuple[Tensor, Tensor]:
    """Sample heights (B, 6) m and colours (B, 6, 3) of walls by their kind."""
    low = sampler.pick_from([0.55, 0.81, 0.9, 1.07, 1.4], NUM_WALLS)
    tall = sampler.uniform(4.0, 14.0, NUM_WALLS)
    height = torch.where(kind == CONCRETE, low, tall)
    height = torch.where(kind == RAIL, sampler.uniform(0.7, 0.85, NUM_WALLS), height)
    height = torch.where((kind == FENCE) | (kind == HEDGE), sampler.uniform(1.2, 4.5, NUM_WALLS), height)
    green, earth = sampler.pick_from(GREENS, NUM_WALLS), sampler.pick_from(EARTHS, NUM_WALLS)
    paleness = sampler.uniform(0.07, 0.5, NUM_WALLS, 1)
    paleness[:, 4] = torch.where(median[:, None], sampler.uniform(0.04, 0.25, 1), paleness[:, 4])
    grey_wall = paleness * torch.tensor([1.0, 0.98, 0.94])
    colour = torch.where(((kind == TREES) | (kind == HEDGE))[..., None], green, grey_wall)
    colour = torch.where((kind == SLOPE)[..., None], earth, colour)
    colour = colour * sampler.uniform(0.7, 1.3, NUM_WALLS, 1)
    return height, colour


def _sky(sampler: BatchSampler, grey: Tensor) -> tuple[Tensor, Tensor]:
    """Sample the sky's radiance (B, 3) above and at the horizon; grey is (B, 1) in [0, 1]."""
    blue = sampler.uniform(0.18, 0.45, 1) * torch.tensor([0.30, 0.60, 1.0]) * (1 + sampler.normal(0.06, 3))
    pale = torch.stack(
        [sampler.uniform(0.28, 0.52), sampler.uniform(0.36, 0.54), sampler.uniform(0.44, 0.6)], dim=1
    )
    overcast = sampler.uniform(0.35, 0.7, 1) * torch.tensor([0.97, 1.0, 1.03])
    zenith = blue * (1 - grey) + 0.9 * overcast * grey
    return zenith, pale * (1 - grey) + overcast * grey
