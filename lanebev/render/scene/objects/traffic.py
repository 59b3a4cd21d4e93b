"""Vehicles, signs, poles and bridges along the road, and their places."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.objects.objects import BRIDGE, CAR, POLE, SIGN, TRUCK, SceneObjects
from lanebev.render.scene.road.alignment import (
    Alignment,
    elevation_at,
    local_from_road,
    road_from_local,
    z_from_arc,
)
from lanebev.render.scene.road.layout import Layout
from lanebev.render.scene.road.pavement import Pavement
from lanebev.render.scene.sampler import BatchSampler

NUM_VEHICLES, NUM_ONCOMING = 14, 5
CAR_COLOURS = [
    (0.75, 0.75, 0.75), (0.75, 0.75, 0.75), (0.02, 0.02, 0.022), (0.02, 0.02, 0.022), (0.35, 0.36, 0.38),
    (0.12, 0.125, 0.13), (0.10, 0.015, 0.015), (0.03, 0.06, 0.16), (0.25, 0.22, 0.17), (0.05, 0.09, 0.06),
]  # fmt: skip
SIGN_COLOURS = [
    (0.01, 0.16, 0.07), (0.01, 0.16, 0.07), (0.02, 0.10, 0.35), (0.6, 0.42, 0.02), (0.5, 0.5, 0.5),
]  # fmt: skip


class Traffic(NamedTuple):
    """Things along the road, (B, M) each unless said otherwise; vehicles first.

    Attributes:
        along: m in the world at time zero.
        across: m in the layout's frame.
        speed: m/s along the road; oncoming ones are negative, what stands has none.
        shape: (B, M, 2, 8), see :class:`SceneObjects`.
        kind: int64.
        colour: (B, M, 3).
        braking: bool.
        valid: bool.
    """

    along: Tensor
    across: Tensor
    speed: Tensor
    shape: Tensor
    kind: Tensor
    colour: Tensor
    braking: Tensor
    valid: Tensor


def vehicle_shapes(sampler: BatchSampler, count: int, truck: Tensor) -> Tensor:
    """Sample a body and what is above it, (B, count, 2, 8)."""
    length = sampler.uniform(3.9, 5.1, count)
    half = sampler.uniform(0.86, 0.98, count)
    tall = sampler.chance(0.35, count)  # SUVs and vans
    waist = torch.where(tall, sampler.uniform(1.05, 1.2, count), sampler.uniform(0.88, 1.0, count))
    roof = torch.where(tall, sampler.uniform(1.65, 1.95, count), sampler.uniform(1.38, 1.5, count))
    one = torch.ones_like(half)
    rear, front = -0.5 * length, 0.5 * length
    body = [half, half * 0.97, rear, front, rear + 0.05, front - 0.15, 0.10 * one, waist]
    back = torch.where(tall, 0.08, 0.75) * one
    glass_low = [half * 0.95, half * 0.76, rear + 0.3 * back, front - 0.9 * one]
    cabin = [*glass_low, rear + back + 0.2, front - 1.9 * one, waist, roof]
    car = torch.stack([torch.stack(body, -1), torch.stack(cabin, -1)], dim=2)
    long = sampler.uniform(5.0, 13.0, count)
    box = [1.25 * one, 1.25 * one, -0.5 * long, 0.5 * long - 1.8, -0.5 * long, 0.5 * long - 1.8, 0.3 * one]
    box = [*box, sampler.uniform(2.6, 4.0, count)]
    cab = [
        1.2 * one,
        1.1 * one,
        0.5 * long - 1.7,
        0.5 * long,
        0.5 * long - 1.7,
        0.5 * long - 0.3,
        0.5 * one,
        2.7 * one,
    ]
    lorry = torch.stack([torch.stack(box, -1), torch.stack(cab, -1)], dim=2)
    return torch.where(truck[..., None, None], lorry, car)


def _box(half: Tensor, rear: Tensor, front: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.stack(torch.broadcast_tensors(half, half, rear, front, rear, front, low, high), dim=-1)


def sample_traffic(
    sampler: BatchSampler,
    layout: Layout,
    ego_lane: Tensor,
    opposite: Tensor,
    pavement: Pavement,
    bridge_at: Tensor,
    bridge_long: Tensor,
) -> Traffic:
    """Sample random objects along the road.

    Args:
        sampler: the randomness.
        layout: the boundaries.
        ego_lane: (B,) int64.
        opposite: (B,) m, the opposite carriageway's right edge; -infinite: none.
        pavement: its edges.
        bridge_at: (B,) m along, where a bridge begins; infinite: none.
        bridge_long: (B,) m, its extent along the road.
    """
    vehicles = _sample_vehicles(sampler, layout, ego_lane, opposite)
    props = _sample_props(sampler, pavement.left, pavement.right, bridge_at, bridge_long)
    return Traffic(*(torch.cat(pair, dim=1) for pair in zip(vehicles, props, strict=True)))


def _sample_vehicles(sampler: BatchSampler, layout: Layout, ego_lane: Tensor, opposite: Tensor) -> Traffic:
    ahead, count = NUM_VEHICLES, NUM_VEHICLES + NUM_ONCOMING
    lanes = (layout.exists.sum(1) - 1).clamp(min=1)[:, None]
    start = sampler.uniform(0, 8, 1).long()
    hop = 1 + (sampler.uniform(0, 1, ahead) * (lanes - 1).clamp(min=1)).long()
    lane = (start + hop.cumsum(1)) % lanes
    near = torch.where(sampler.chance(0.3, 1), -2.0, 3.0)
    along = near + 6.5 * torch.exp(0.27 * torch.arange(ahead) + 0.12 * sampler.uniform(0, 1, ahead))
    truck = sampler.chance(0.16, count)
    shape = vehicle_shapes(sampler, count, truck)
    half_length = 0.5 * (shape[..., 0, 3] - shape[..., 0, 2])
    middle = 0.5 * (layout.across.gather(1, lane) + layout.across.gather(1, lane + 1))
    across = middle + sampler.normal(0.2, ahead)
    wanted = sampler.chance(0.75, 1) & (sampler.uniform(0, 1, ahead) < sampler.uniform(0.1, 1.0, 1))
    ahead_of_ego = lane == ego_lane[:, None]
    tail = along - half_length[:, :ahead]
    clear = ~ahead_of_ego | (tail > 22.0) | ((tail > 6.0) & sampler.chance(0.3, ahead))
    overlap = (lane[:, :, None] == lane[:, None, :]) & (
        (along[:, :, None] - along[:, None, :]).abs()
        < half_length[:, :ahead, None] + half_length[:, None, :ahead] + 1.5
    )
    first = torch.tril(overlap, diagonal=-1).any(2)
    oncoming_along = sampler.uniform(10, 200, NUM_ONCOMING)
    oncoming_across = opposite[:, None].clamp(min=-500) - 2.85 - 3.7 * sampler.pick([1, 1, 1], NUM_ONCOMING)
    return Traffic(
        along=torch.cat([along, oncoming_along], 1),
        across=torch.cat([across, oncoming_across], 1),
        speed=torch.cat([sampler.uniform(-3, 3, ahead), -sampler.uniform(48, 60, NUM_ONCOMING)], 1),
        shape=shape,
        kind=torch.where(truck, TRUCK, CAR),
        colour=torch.where(
            truck[..., None],
            sampler.uniform(0.15, 0.75, count, 1) * torch.tensor([1.0, 0.98, 0.95]),
            sampler.pick_from(CAR_COLOURS, count) * sampler.uniform(0.7, 1.2, count, 1),
        ),
        braking=sampler.chance(0.2, count),
        valid=torch.cat(
            [wanted & clear & ~first, opposite.isfinite()[:, None] & sampler.chance(0.6, NUM_ONCOMING)], 1
        ),
    )


class _Props(NamedTuple):
    """Shapes (B, M, 2, 8) of what stands along the road, and their places across and along it, (B, M) m."""

    shape: Tensor
    across: Tensor
    along: Tensor


def _sample_props(
    sampler: BatchSampler, left: Tensor, right: Tensor, bridge_at: Tensor, bridge_long: Tensor
) -> Traffic:
    """Sample a bridge with its piers, a gantry with its legs, three signs and four lamp posts."""
    edges = (left[:, None], right[:, None])
    bridge = bridge_at.isfinite()[:, None]
    over = _sample_bridge(sampler, *edges, torch.where(bridge, bridge_at[:, None], 0.0), bridge_long[:, None])
    gantry = sampler.chance(0.25, 1)
    above = _sample_gantry(sampler, *edges)
    panels = _sample_signs(sampler)
    lamps = _sample_lamps(sampler, *edges)
    sign_across = torch.where(sampler.chance(0.75, 3), right[:, None] + 1.8, left[:, None] - 1.2)
    signs = _Props(panels, sign_across, sampler.uniform(12, 160, 3))
    shape, across, along = (torch.cat(part, 1) for part in zip(over, above, signs, lamps, strict=True))

    kind = torch.tensor([BRIDGE, POLE, POLE, SIGN, POLE, POLE, SIGN, SIGN, SIGN, POLE, POLE, POLE, POLE])
    concrete = sampler.uniform(0.15, 0.4, 1, 1) * torch.tensor([1.0, 0.97, 0.93])
    steel = sampler.uniform(0.1, 0.4, 1, 1) * torch.ones(3)
    board, *boards = sampler.pick_from(SIGN_COLOURS, 4).split(1, dim=1)
    colour = torch.cat(
        [concrete.expand(-1, 3, -1), board, steel.expand(-1, 2, -1), *boards, steel.expand(-1, 4, -1)], 1
    )
    lit = sampler.chance(0.3, 1).expand(-1, 4)
    valid = torch.cat([bridge.expand(-1, 3), gantry.expand(-1, 3), sampler.chance(0.35, 3), lit], dim=1)
    off = torch.zeros_like(valid)
    return Traffic(along, across, 0.0 * along, shape, kind.expand_as(along), colour, off, valid)


def _sample_bridge(sampler: BatchSampler, left: Tensor, right: Tensor, at: Tensor, long: Tensor) -> _Props:
    """Sample a deck and two piers; (B, 1) each: the pavement's edges, where it begins and its length."""
    reach = 0.5 * long
    low = sampler.uniform(4.9, 6.5, 1)
    deck = _box(0.5 * (right - left) + 25, -reach, reach, low, low + sampler.uniform(1.0, 2.4, 1))
    pier = _box(sampler.uniform(0.4, 0.9, 1), -0.7 * reach, 0.7 * reach, 0 * low, low).expand(-1, 2, -1)
    across = torch.cat([0.5 * (left + right), left - 1.5, right + sampler.uniform(1.5, 6, 1)], dim=1)
    boxes = torch.cat([deck, pier], 1)
    return _Props(torch.stack([boxes, torch.zeros_like(boxes)], 2), across, (at + reach).expand(-1, 3))


def _sample_gantry(sampler: BatchSampler, left: Tensor, right: Tensor) -> _Props:
    """Sample a beam with its board, and two legs; (B, 1) each: the pavement's edges."""
    one = torch.ones_like(left)
    along, clearance = sampler.uniform(25, 180, 1), sampler.uniform(5.6, 6.5, 1)
    beam = _box(0.5 * (right - left) + 1.5, -0.15 * one, 0.15 * one, clearance + 0.8, clearance + 1.1)
    half, tall = sampler.uniform(1.5, 4.0, 1), sampler.uniform(1.5, 3.2, 1)
    board = _box(half, -0.3 * one, -0.16 * one, clearance, clearance + tall)
    leg = _box(0.18 * one, -0.18 * one, 0.18 * one, 0 * one, clearance + 1.1)
    legs = torch.stack([leg, torch.zeros_like(leg)], 2).expand(-1, 2, -1, -1)
    across = torch.cat([0.5 * (left + right), left - 1.5, right + 1.5], dim=1)
    return _Props(torch.cat([torch.stack([beam, board], 2), legs], 1), across, along.expand(-1, 3))


def _sample_signs(sampler: BatchSampler) -> Tensor:
    """Sample the shapes of three signs on their posts."""
    bottom, half = sampler.uniform(1.2, 2.2, 3), sampler.uniform(0.3, 1.3, 3)
    zero = torch.zeros_like(half)
    post = _box(zero + 0.05, zero - 0.05, zero + 0.05, zero, zero + 3)
    panel = _box(half, zero - 0.09, zero - 0.05, bottom, bottom + 2 * half.clamp(max=0.8))
    return torch.stack([post, panel], 2)


def _sample_lamps(sampler: BatchSampler, left: Tensor, right: Tensor) -> _Props:
    """Sample four equal lamp posts in a row; (B, 1) each: the pavement's edges."""
    one, high = torch.ones_like(left), sampler.uniform(8.0, 12.0, 1)
    pole = _box(0.09 * one, -0.09 * one, 0.09 * one, 0 * one, high)
    arm = _box(1.7 * one, -0.1 * one, 0.1 * one, high, high + 0.14)
    across = torch.where(sampler.chance(0.5, 1), left - 0.8, right + 1.5)
    gap = sampler.uniform(28, 55, 1)
    along = sampler.uniform(5, 30, 1) + gap * torch.arange(4)
    return _Props(torch.stack([pole, arm], 2).expand(-1, 4, -1, -1), across.expand(-1, 4), along)


def place_objects(traffic: Traffic, alignment: Alignment, start: Tensor, side: Tensor) -> SceneObjects:
    """Return the traffic in the local road frame.

    Args:
        traffic: in the world.
        alignment: seen from the camera's foot.
        start: (B,) m, the camera's arc length in the world.
        side: (B,) m, the camera's place across.
    """
    arc = traffic.along - start[:, None]
    across = traffic.across - side[:, None]
    x, z, _ = local_from_road(alignment, z_from_arc(alignment, arc), across)
    point = road_from_local(alignment, x, z)
    heading = torch.atan2(point.sin, point.cos) + math.pi * (traffic.speed < -20)
    return SceneObjects(
        x=x,
        z=z,
        ground=elevation_at(alignment, z),
        heading=heading,
        shape=traffic.shape,
        kind=traffic.kind,
        colour=traffic.colour,
        braking=traffic.braking,
        valid=traffic.valid & (arc > -20) & (arc < 450),
    )
