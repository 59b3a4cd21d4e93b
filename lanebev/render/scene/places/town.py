"""The changes of a scene to one in a city: edges, houses, parked and oncoming vehicles."""

import math

import torch
from torch import Tensor

from lanebev.batch import select_rows
from lanebev.render.scene.objects.surroundings import (
    FENCE,
    GREENS,
    HEDGE,
    HOUSES,
    NOTHING,
    NUM_WALLS,
    TREES,
    Surroundings,
)
from lanebev.render.scene.objects.traffic import CAR_COLOURS, NUM_VEHICLES, Traffic, vehicle_shapes
from lanebev.render.scene.places.street import CYCLING, KERB, PARKING, PLAIN, Street
from lanebev.render.scene.road.layout import MAX_BOUNDARIES, Layout
from lanebev.render.scene.road.pavement import Pavement
from lanebev.render.scene.sampler import BatchSampler

NUM_PARKED = 10
_COMING = -25.0  # m/s relative to the camera; below -20 a vehicle faces it
_PLASTER = [(0.5, 0.45, 0.36), (0.42, 0.4, 0.36), (0.22, 0.1, 0.07), (0.3, 0.29, 0.28), (0.5, 0.36, 0.2)]


def street_edges(
    sampler: BatchSampler, city: Tensor, street: Street, layout: Layout, pavement: Pavement
) -> Pavement:
    """Sample kerbs near the outer boundaries or beyond a parking or cycling strip, where city (B,) holds."""
    plain = sampler.either(0.7, (0.05, 0.5), (0.3, 1.5), 2)
    gap = torch.where(street.strip == CYCLING, sampler.uniform(1.1, 2.2, 2), plain)
    bay = torch.where(street.bay > 4.0, sampler.uniform(1.9, 2.6, 2), sampler.uniform(4.3, 5.2, 2))
    gap = torch.where(street.strip == PARKING, bay, gap)
    last = layout.last_across()
    edged = pavement._replace(
        left=-gap[:, 0],
        right=last + gap[:, 1],
        shoulder=torch.where(
            sampler.chance(0.75, 1), pavement.base * sampler.uniform(0.85, 1.15, 1), pavement.shoulder
        ),
        patch=torch.where(sampler.chance(0.5), sampler.uniform(0.05, 0.3), pavement.patch),
        tar=torch.where(sampler.chance(0.4), sampler.uniform(0.3, 0.9), pavement.tar),
        gutter_width=sampler.sometimes(0.5, 0.1, 0.4, 2),
        gutter=sampler.uniform(0.5, 1.8, 2),
    )
    return select_rows(city, edged, pavement)


def kerb_boundaries(city: Tensor, street: Street, layout: Layout, pavement: Pavement) -> Layout:
    """Make a kerb the lane's boundary where it bounds a lane with nothing painted and no strip between.

    Without it most narrow streets have one boundary, the painted line in their middle, and no pose.
    """
    index = torch.arange(MAX_BOUNDARIES, device=city.device)
    last = layout.exists.sum(1, keepdim=True) - 1
    bare = (street.strip == PLAIN) & (street.strips[:, :, KERB] > 0)  # (B, 2)
    left, right = (index == 0) & bare[:, :1], (index == last) & bare[:, 1:]
    kerb = (left | right) & layout.exists & ~layout.marked & city[:, None]
    foot = torch.where(left, pavement.left[:, None], pavement.right[:, None])
    return layout._replace(
        across=torch.where(kerb, foot, layout.across),
        marked=layout.marked | kerb,
        opacity=torch.where(kerb, 0.0, layout.opacity),
        ghost=torch.where(kerb, 0.0, layout.ghost),
        stud_period=torch.where(kerb, 0.0, layout.stud_period),
    )


def street_surroundings(
    sampler: BatchSampler, city: Tensor, street: Street, pavement: Pavement, around: Surroundings
) -> Surroundings:
    """Sample houses, hedges and trees beyond the pavements, where city (B,) holds."""
    walks = street.strips.sum(2)
    divided = (street.first == 0) & sampler.chance(0.45)
    opposite = torch.where(divided, pavement.left - walks[:, 0], -math.inf)
    near = torch.stack([NOTHING + 0 * street.own] * 2, 1)
    pick = sampler.pick([0.66, 0.16, 0.18], 2)
    near = torch.where(pick == 1, HEDGE, torch.where(pick == 2, FENCE, near))
    pick = sampler.pick([0.25, 0.45, 0.18, 0.12], 2)
    middle = torch.where(pick == 1, HOUSES, torch.where(pick == 2, TREES, torch.where(pick == 3, HEDGE, 0)))
    pick = sampler.pick([0.2, 0.4, 0.4], 2)
    far = torch.where(pick == 1, HOUSES, torch.where(pick == 2, TREES, 0))
    kind = torch.cat([far, middle, near], 1)
    left = (torch.arange(NUM_WALLS, device=kind.device) % 2 == 0) & divided[:, None]
    kind = torch.where(left, torch.where(kind == HEDGE, kind, NOTHING), kind)
    gap = torch.cat([sampler.uniform(12, 32, 2), sampler.uniform(0.3, 7, 2), sampler.uniform(0.1, 0.7, 2)], 1)
    sides = gap.new_tensor([-1.0, 1.0] * 3)
    edge = torch.stack([pavement.left, pavement.right], 1)
    across = (edge + walks * sides[:2]).repeat(1, 3) + sides * gap
    height = torch.where(kind == HOUSES, sampler.uniform(5, 22, NUM_WALLS), sampler.uniform(4, 13, NUM_WALLS))
    low = (kind == HEDGE) | (kind == FENCE)
    height = torch.where(low, sampler.uniform(0.7, 3.0, NUM_WALLS), height)
    plaster = sampler.pick_from(_PLASTER, NUM_WALLS) * sampler.uniform(0.4, 1.1, NUM_WALLS, 1)
    leaves = sampler.pick_from(GREENS, NUM_WALLS) * sampler.uniform(0.7, 1.3, NUM_WALLS, 1)
    green = ((kind == HEDGE) | (kind == TREES))[..., None]
    ground = torch.where(
        sampler.chance(0.5, 2)[..., None], street.colours[:, :, 1], street.colours[:, :, 3]
    )  # grass, or as the walk
    town = around._replace(
        verge=ground * sampler.uniform(0.6, 1.2, 2, 1),
        walls=around.walls._replace(
            across=across, kind=kind, height=height, colour=torch.where(green, leaves, plaster)
        ),
        opposite=opposite,
        hill_height=around.hill_height.clamp(max=0.03),
    )
    return select_rows(city, town, around)


def city_traffic(
    sampler: BatchSampler, city: Tensor, street: Street, layout: Layout, pavement: Pavement, traffic: Traffic
) -> Traffic:
    """Add oncoming vehicles in their own lanes and parked ones, none on hatching."""
    across = traffic.across[:, :NUM_VEHICLES]
    lane = (torch.searchsorted(layout.across, across.contiguous()) - 1).clamp(0, MAX_BOUNDARIES - 1)
    coming = (lane < street.first[:, None]) | (lane >= (street.first + street.own)[:, None])
    coming = coming & city[:, None]
    speed, valid = traffic.speed.clone(), traffic.valid.clone()
    pace = sampler.uniform(_COMING - 8, _COMING, NUM_VEHICLES)
    speed[:, :NUM_VEHICLES] = torch.where(coming, pace, speed[:, :NUM_VEHICLES])
    valid[:, :NUM_VEHICLES] &= ~((street.hatching.strength.gather(1, lane) > 0) & city[:, None])
    gantries = slice(traffic.along.shape[1] - 10, traffic.along.shape[1] - 7)
    valid[:, gantries] &= ~(city & sampler.chance(0.8))[:, None]
    moving = traffic._replace(speed=speed, valid=valid)
    parked = _sample_parked(sampler, city, street, layout, pavement)
    return Traffic(*(torch.cat(pair, dim=1) for pair in zip(moving, parked, strict=True)))


def _sample_parked(
    sampler: BatchSampler, city: Tensor, street: Street, layout: Layout, pavement: Pavement
) -> Traffic:
    """Sample cars in parking strips or with two wheels on the kerb; half of the places on either side."""
    one_side = NUM_PARKED // 2
    side = torch.arange(NUM_PARKED, device=city.device) // one_side
    turn = torch.arange(NUM_PARKED, device=city.device) % one_side
    last = layout.last_across()
    strip_middle = torch.stack([0.5 * pavement.left, 0.5 * (last + pavement.right)], 1)
    on_kerb = torch.stack([pavement.left - 0.4, pavement.right + 0.4], 1)
    across = torch.where(street.strip == PARKING, strip_middle, on_kerb)
    there = ((street.strip == PARKING) & (street.bay > 4.0)) | (
        (street.strip == PLAIN) & (street.strips.sum(2) > 1.5) & sampler.chance(0.2, 2)
    )
    there = there & city[:, None]
    spacing = street.bay.clamp(min=5.2)[:, side]
    along = sampler.uniform(-6, 25, 2)[:, side] + spacing * turn + sampler.uniform(-0.3, 0.3, NUM_PARKED)
    truck = sampler.chance(0.06, NUM_PARKED)
    still = torch.zeros_like(along)
    return Traffic(
        along=along,
        across=across[:, side] + sampler.normal(0.12, NUM_PARKED),
        speed=still,
        shape=vehicle_shapes(sampler, NUM_PARKED, truck),
        kind=truck.long(),
        colour=sampler.pick_from(CAR_COLOURS, NUM_PARKED) * sampler.uniform(0.7, 1.2, NUM_PARKED, 1),
        braking=still.bool(),
        valid=there[:, side] & (sampler.uniform(0, 1, NUM_PARKED) < sampler.uniform(0.3, 1.0, 1)),
    )
