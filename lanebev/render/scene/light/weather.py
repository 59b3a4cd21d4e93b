"""Weather, and the light that it leaves on the scene."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.kinds import Kinds
from lanebev.render.scene.sampler import BatchSampler

CLEAR, OVERCAST, DUSK, NIGHT, RAIN = range(5)


class Light(NamedTuple):
    """Illumination, linear.

    Attributes:
        sun: (B, 3) direction to the sun in the local road frame (right, up, forward).
        direct: (B, 3) irradiance over pi of the sun on a surface facing it.
        ambient: (B, 3) of the sky on a surface facing up.
        headlight: (B,) strength of the camera's own headlights.
        night: (B,) in [0, 1].
    """

    sun: Tensor
    direct: Tensor
    ambient: Tensor
    headlight: Tensor
    night: Tensor


class Weather(NamedTuple):
    """Conditions, each (B,) unless said otherwise.

    Attributes:
        kind: int64, CLEAR, OVERCAST, DUSK, NIGHT or RAIN.
        grey: [0, 1] overcast.
        wet: [0, 1].
        visibility: m.
        sun_azimuth: rad in the world, right positive.
        sun_height: rad.
    """

    kind: Tensor
    grey: Tensor
    wet: Tensor
    visibility: Tensor
    sun_azimuth: Tensor
    sun_height: Tensor


def sample_weather(sampler: BatchSampler) -> Weather:
    """Sample the weather, mostly clear days."""
    kind = sampler.pick([0.66, 0.14, 0.08, 0.06, 0.06])
    clear = sampler.uniform(0.0, 0.25)
    grey = torch.where((kind == OVERCAST) | (kind == RAIN), sampler.uniform(0.7, 1.0), clear)
    hazy = sampler.chance(0.12) | (kind == RAIN)
    dusk = kind == DUSK
    return Weather(
        kind=kind,
        grey=grey,
        wet=torch.where(kind == RAIN, sampler.uniform(0.5, 1.0), 0.0),
        visibility=torch.where(hazy, sampler.uniform(150, 600), sampler.uniform(600, 4000)),
        sun_azimuth=sampler.uniform(-3.1416, 3.1416),
        sun_height=torch.where(dusk, sampler.uniform(0.03, 0.2), sampler.uniform(0.3, 1.3)),
    )


def varied_weather(sampler: BatchSampler, kinds: Kinds, weather: Weather) -> Weather:
    """Change the weather of nights (at times a wet road), of snow (dull days) and of tunnels (clear air)."""
    wet = sampler.sometimes(0.3, 0.1, 1.0)
    night = kinds.night
    dull = kinds.snow & sampler.chance(0.7)
    visibility = torch.where(kinds.tunnel, 1e4, weather.visibility)
    return weather._replace(
        grey=torch.where(dull, sampler.uniform(0.5, 1.0), weather.grey),
        kind=torch.where(night, NIGHT, weather.kind),
        wet=torch.where(night, wet, weather.wet),
        visibility=torch.where(night, visibility.clamp(min=300.0), visibility),
    )


def light_of(weather: Weather, road_heading: Tensor) -> Light:
    """Return the illumination in the local road frame; Z points along ``road_heading`` (B,) rad."""
    azimuth, height = weather.sun_azimuth - road_heading, weather.sun_height
    sun = torch.stack([azimuth.sin() * height.cos(), height.sin(), azimuth.cos() * height.cos()], dim=1)
    night, dusk = weather.kind == NIGHT, weather.kind == DUSK
    strength = torch.where(night, 0.0, 1.0 - weather.grey)
    warm = torch.where(dusk[:, None], torch.tensor([1.0, 0.62, 0.32]), torch.tensor([1.0, 0.95, 0.86]))
    sky = torch.where(dusk[:, None], torch.tensor([0.30, 0.30, 0.38]), torch.tensor([0.27, 0.31, 0.37]))
    ambient = sky * (1 + 1.2 * weather.grey)[:, None]
    ambient = torch.where(night[:, None], torch.tensor([0.010, 0.010, 0.013]), ambient)
    return Light(
        sun=sun,
        direct=strength[:, None] * warm,
        ambient=ambient,
        headlight=torch.where(night, 1.0, torch.where(dusk, 0.1, 0.0)),
        night=night.float(),
    )
