"""Tunnels: walls on both sides, a ceiling with its lamps, no daylight."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.batch import select_rows
from lanebev.render.scene.light.weather import Light
from lanebev.render.scene.objects.surroundings import CONCRETE, NOTHING, NUM_WALLS, Surroundings
from lanebev.render.scene.objects.traffic import NUM_ONCOMING, NUM_VEHICLES, Traffic
from lanebev.render.scene.road.pavement import Pavement
from lanebev.render.scene.sampler import BatchSampler

_LAMP_COLOURS = [(1.0, 0.6, 0.2), (1.0, 0.75, 0.4), (1.0, 0.95, 0.85), (0.85, 0.95, 1.0)]


class Tunnel(NamedTuple):
    """A tunnel about the road, (B,) unless said otherwise.

    Attributes:
        on: 1 where there is one.
        ceiling: m above the road.
        exit: m along, where it ends.
        tone: (B, 3) linear reflectance of the ceiling.
        level: (B, 3) irradiance over pi on the road.
        lamp: radiance of the lamps.
        lamp_across: (B, 2) m, rows of lamps in the layout's frame.
        lamp_size: (B, 2) m along and across.
        lamp_period: m.
        lamp_colour: (B, 3).
    """

    on: Tensor
    ceiling: Tensor
    exit: Tensor
    tone: Tensor
    level: Tensor
    lamp: Tensor
    lamp_across: Tensor
    lamp_size: Tensor
    lamp_period: Tensor
    lamp_colour: Tensor


def sample_tunnel(sampler: BatchSampler, tunnel: Tensor, pavement: Pavement) -> Tunnel:
    """Sample random tunnels where tunnel (B,) holds."""
    hue = sampler.pick_from(_LAMP_COLOURS) * sampler.uniform(0.9, 1.1, 1)
    rows = torch.stack([pavement.left, pavement.right], 1)
    middle = rows.mean(1, keepdim=True)
    near_walls = sampler.chance(0.5, 1)
    share = torch.where(near_walls, sampler.uniform(0.8, 0.97, 1), sampler.uniform(0.0, 0.5, 1))
    return Tunnel(
        on=tunnel.float(),
        ceiling=sampler.uniform(4.8, 7.5),
        exit=sampler.sometimes(0.5, 60, 500, otherwise=1e5),
        tone=sampler.uniform(0.04, 0.4, 1) * (1 + sampler.normal(0.05, 3)),
        level=sampler.uniform(0.02, 0.25, 1) * hue,
        lamp=sampler.uniform(0.3, 4.0),
        lamp_across=middle + (rows - middle) * share,
        lamp_size=torch.stack([sampler.uniform(0.4, 4.0), sampler.uniform(0.1, 0.5)], 1),
        lamp_period=sampler.uniform(4.5, 16.0),
        lamp_colour=hue,
    )


def endless(tunnel: Tunnel) -> Tunnel:
    """Return a tunnel without an end, for drives."""
    return tunnel._replace(exit=torch.full_like(tunnel.exit, math.inf))


def tunnel_surroundings(
    sampler: BatchSampler, tunnel: Tensor, inside: Tunnel, pavement: Pavement, around: Surroundings
) -> Surroundings:
    """Add walls up to the ceiling, where tunnel (B,) holds."""
    edge = torch.stack([pavement.left, pavement.right], 1).repeat(1, 3)
    gap = torch.cat([sampler.uniform(30, 31, 4), sampler.uniform(0.1, 1.0, 2)], 1)
    near = torch.arange(NUM_WALLS, device=tunnel.device) >= NUM_WALLS - 2
    colour = sampler.uniform(0.05, 0.5, 1, 1) * (1 + sampler.normal(0.06, 1, 3))
    walls = around.walls._replace(
        across=edge + gap * gap.new_tensor([-1.0, 1.0] * 3),
        kind=torch.where(near, CONCRETE, NOTHING).expand_as(around.walls.kind),
        height=(inside.ceiling[:, None] + 0.15).expand_as(around.walls.height),
        colour=colour.expand_as(around.walls.colour),
        toe=torch.ones_like(around.walls.toe),
    )
    walled = around._replace(
        walls=walls,
        verge=pavement.base[:, None].expand(-1, 2, -1),
        opposite=torch.full_like(around.opposite, -math.inf),
    )
    return select_rows(tunnel, walled, around)


def tunnel_traffic(tunnel: Tensor, traffic: Traffic) -> Traffic:
    """Remove bridges, signs and lamp posts where tunnel (B,) holds; vehicles stay."""
    index = torch.arange(traffic.valid.shape[1], device=tunnel.device)
    vehicle = index < NUM_VEHICLES + NUM_ONCOMING
    return traffic._replace(valid=traffic.valid & (vehicle | ~tunnel[:, None]))


def tunnel_light(light: Light, tunnel: Tunnel) -> Light:
    """Return the illumination inside: that of the lamps alone."""
    on = (tunnel.on > 0)[:, None]
    return light._replace(
        direct=torch.where(on, 0.0, light.direct), ambient=torch.where(on, tunnel.level, light.ambient)
    )
