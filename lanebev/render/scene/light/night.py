"""Lights of the night: the own low beam, street lamps, other vehicles, the town."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.light.weather import Light
from lanebev.render.scene.sampler import BatchSampler

NUM_LAMPS = 10  # street lamps ahead on each side
NUM_SPOTS = 28  # distant lights of the town
LAMP_COLOURS = [(1.0, 0.55, 0.14), (1.0, 0.62, 0.2), (1.0, 0.8, 0.5), (0.9, 0.95, 1.0), (0.95, 0.9, 0.25)]
SPOT_COLOURS = [
    (1.0, 0.6, 0.2), (1.0, 0.6, 0.2), (1.0, 0.9, 0.7), (0.9, 0.95, 1.0), (1.0, 0.05, 0.03), (0.1, 0.25, 1.0),
    (0.05, 1.0, 0.5),
]  # fmt: skip


class Lights(NamedTuple):
    """Lights of a night without daylight, (B,) unless said otherwise.

    Attributes:
        on: 1 on such a night; 0: nothing of this is there.
        dark: factor of the sky's own light.
        spill: (B, 3) irradiance over pi by signs and windows of the town.
        beam: strength of the own low beam.
        beam_colour: (B, 3).
        beam_reach: m at which it has fallen to a half.
        beam_fall: power with which it falls.
        beam_end: m, where the cut-off meets the road.
        beam_width: m of its half width at the lamps, and per metre ahead, (B, 2).
        beam_rays: strength of its streaks.
        lamp: (B, 2) power of the street lamps left and right; 0: none.
        lamp_period: m.
        lamp_phase: m.
        lamp_across: (B, 2) m in the layout's frame.
        lamp_height: m.
        lamp_colour: (B, 3).
        spot: (B, S) strength of distant lights.
        spot_place: (B, S, 2) rad, azimuth from the road's direction and elevation.
        spot_size: (B, S) rad.
        spot_colour: (B, S, 3).
        halo: strength of the glare about lights.
        halo_size: fraction of the image's width.
        streak: strength of a line of glare through each light, and its direction, rad, (B, 2).
        mirror: strength of lights mirrored in a wet road.
        smear: m that the road moves while the shutter is open.
    """

    on: Tensor
    dark: Tensor
    spill: Tensor
    beam: Tensor
    beam_colour: Tensor
    beam_reach: Tensor
    beam_fall: Tensor
    beam_end: Tensor
    beam_width: Tensor
    beam_rays: Tensor
    lamp: Tensor
    lamp_period: Tensor
    lamp_phase: Tensor
    lamp_across: Tensor
    lamp_height: Tensor
    lamp_colour: Tensor
    spot: Tensor
    spot_place: Tensor
    spot_size: Tensor
    spot_colour: Tensor
    halo: Tensor
    halo_size: Tensor
    streak: Tensor
    mirror: Tensor
    smear: Tensor


def sample_lights(sampler: BatchSampler, night: Tensor, left: Tensor, right: Tensor) -> Lights:
    """Sample random lights of the night.

    Args:
        sampler: the randomness.
        night: (B,) bool; elsewhere nothing is on.
        left: (B,) m, the pavement's left edge.
        right: (B,) m, its right edge.
    """
    on = night.float()
    lit = sampler.chance(0.65)
    one = sampler.chance(0.5)
    sides = torch.stack([one | (sampler.chance(0.35)), ~one | sampler.chance(0.1)], dim=1)
    power = sampler.either(0.5, (0.03, 0.3), (0.2, 1.4))
    hue = sampler.pick_from(LAMP_COLOURS)
    white = sampler.uniform(0, 1, 1)
    beam_colour = torch.cat([1.0 + 0 * white, 0.78 + 0.2 * white, 0.5 + 0.5 * white], dim=1)
    town = sampler.sometimes(0.75, 0.1, 1.0)[:, None]
    wet = sampler.sometimes(0.3, 0.2, 1.0)
    rare = sampler.uniform(0, 1, NUM_SPOTS) < 0.6 * town
    neon = sampler.chance(0.12, NUM_SPOTS)
    across = torch.stack([left, right], 1) + sampler.uniform(0.3, 3.0, 2) * left.new_tensor([-1.0, 1.0])
    across = across + sampler.sometimes(0.4, 0.5, 2.5, 1) * left.new_tensor([1.0, -1.0])
    return Lights(
        on=on,
        dark=on * sampler.either(0.75, (0.01, 0.35), (0.2, 1.5)),
        spill=(on * sampler.sometimes(0.2, 0.0, 0.05))[:, None] * sampler.pick_from(SPOT_COLOURS),
        beam=on * sampler.sometimes(0.9, 0.5, 1.6, otherwise=0.05),
        beam_colour=beam_colour,
        beam_reach=sampler.uniform(8, 24),
        beam_fall=sampler.uniform(1.8, 3.5),
        beam_end=sampler.uniform(35, 110),
        beam_width=torch.stack([sampler.uniform(0.7, 2.4), sampler.uniform(0.05, 0.3)], dim=1),
        beam_rays=sampler.uniform(0.0, 0.35),
        lamp=(on * lit * power)[:, None] * sides,
        lamp_period=sampler.uniform(22, 55),
        lamp_phase=sampler.uniform(0, 55),
        lamp_across=across,
        lamp_height=sampler.uniform(6.0, 12.0),
        lamp_colour=hue * sampler.uniform(0.85, 1.15, 1),
        spot=on[:, None] * rare * sampler.uniform(0.1, 1.0, NUM_SPOTS),
        spot_place=torch.stack(
            [sampler.uniform(-0.8, 0.8, NUM_SPOTS), sampler.uniform(0, 1, NUM_SPOTS) ** 3 * 0.14 + 0.002],
            dim=2,
        ),
        spot_size=torch.where(
            neon, sampler.uniform(0.004, 0.012, NUM_SPOTS), sampler.uniform(0.0008, 0.0035, NUM_SPOTS)
        ),
        spot_colour=sampler.pick_from(SPOT_COLOURS, NUM_SPOTS),
        halo=on * sampler.either(0.75, (0.0, 0.12), (0.05, 0.6)),
        halo_size=sampler.uniform(0.008, 0.04),
        streak=torch.stack([sampler.sometimes(0.35, 0.1, 0.8), sampler.uniform(0.6, 2.5)], dim=1),
        mirror=on * wet,
        smear=on * sampler.either(0.7, (0.0, 0.8), (0.5, 2.0)),
    )


def night_light(light: Light, lights: Lights) -> Light:
    """Return the illumination on a night with these lights."""
    lamps = 0.25 * lights.lamp.sum(1, keepdim=True) * lights.lamp_colour + lights.spill
    on = (lights.on > 0)[:, None]
    return light._replace(
        ambient=torch.where(on, light.ambient * lights.dark[:, None] + lamps, light.ambient),
        headlight=torch.where(on[:, 0], 0.7 * lights.beam, light.headlight),
    )
