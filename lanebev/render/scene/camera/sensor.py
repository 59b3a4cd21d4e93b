"""Properties of a camera: exposure, colours, blur, noise, compression, its own bonnet."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.kinds import Kinds
from lanebev.render.scene.light.weather import DUSK, NIGHT, Weather
from lanebev.render.scene.sampler import BatchSampler


class Sensor(NamedTuple):
    """Properties of the camera, each (B,) unless said otherwise.

    Attributes:
        exposure: linear level that the road's mean gets.
        tint: (B, 3) white balance.
        contrast: slope at middle grey.
        saturation: factor.
        black: offset.
        blur: px at 640 px width, standard deviation.
        read_noise: standard deviation, of full scale.
        shot_noise: standard deviation at full scale.
        vignette: loss in the corners.
        glare: veil over the image.
        bloom: share of saturated light that spills.
        jpeg: quality, 0 for none.
        bonnet: share of the image's height, 0 for none.
        bonnet_colour: (B, 3).
        bonnet_bow: share of the height by which its edge falls to the sides.
        bonnet_tilt: share of the height by which it falls from left to right.
        bonnet_ridge: strength of two ridges along it.
        bonnet_mirror: share of the scene's light that it mirrors.
    """

    exposure: Tensor
    tint: Tensor
    contrast: Tensor
    saturation: Tensor
    black: Tensor
    blur: Tensor
    read_noise: Tensor
    shot_noise: Tensor
    vignette: Tensor
    glare: Tensor
    bloom: Tensor
    jpeg: Tensor
    bonnet: Tensor
    bonnet_colour: Tensor
    bonnet_bow: Tensor
    bonnet_tilt: Tensor
    bonnet_ridge: Tensor
    bonnet_mirror: Tensor


def sample_sensor(sampler: BatchSampler, weather: Weather, bright: Tensor) -> Sensor:
    """Sample a random camera; ``bright`` (B,) bool overexposes."""
    others = sampler.either(0.8, (0.055, 0.22), (0.2, 0.34))
    exposure = torch.where(bright, sampler.uniform(0.3, 0.75), others)
    dark = (weather.kind == NIGHT) | (weather.kind == DUSK)
    exposure = torch.where(dark, sampler.uniform(0.03, 0.2), exposure)
    noisy = torch.where(weather.kind == NIGHT, 2.5, 1.0)
    return Sensor(
        exposure=exposure,
        tint=1 + sampler.normal(0.03, 3),
        contrast=sampler.uniform(0.9, 1.5),
        saturation=torch.where(sampler.chance(0.05), 0.0, sampler.uniform(0.6, 1.6)),
        black=sampler.uniform(-0.02, 0.04),
        blur=sampler.either(0.8, (0.2, 0.8), (0.8, 2.0)),
        read_noise=sampler.uniform(0.001, 0.012) * noisy,
        shot_noise=sampler.uniform(0.002, 0.022) * noisy,
        vignette=sampler.sometimes(0.5, 0.0, 0.4),
        glare=sampler.sometimes(0.3, 0.0, 0.2),
        bloom=sampler.sometimes(0.6, 0.0, 0.35),
        jpeg=sampler.sometimes(0.7, 35, 95),
        bonnet=sampler.sometimes(0.3, 0.02, 0.14),
        bonnet_colour=sampler.uniform(0.01, 0.25, 1) * (1 + sampler.normal(0.2, 3)).clamp(0.4, 1.6),
        bonnet_bow=sampler.uniform(0.0, 0.12),
        bonnet_tilt=torch.zeros_like(exposure),
        bonnet_ridge=torch.zeros_like(exposure),
        bonnet_mirror=torch.zeros_like(exposure),
    )


def varied_camera(sampler: BatchSampler, kinds: Kinds, sensor: Sensor) -> Sensor:
    """Change cameras: noisier and darker at night, worse where a world has a bad camera."""
    night, camera = kinds.night, kinds.camera
    exposure = torch.where(night, sampler.uniform(0.02, 0.22), sensor.exposure)
    over = torch.where(camera & sampler.chance(0.15), sampler.uniform(1.3, 3.0), 1.0)
    cast = (1 + sampler.normal(0.12, 3) * sampler.chance(0.4, 1)).clamp(0.6, 1.5)
    noisy = torch.where(night, sampler.uniform(0.5, 2.5), 1.0)
    noisy = noisy * torch.where(camera & sampler.chance(0.3), sampler.uniform(1.0, 3.0), 1.0)
    crude = camera & sampler.chance(0.35)
    bonnet = torch.where(sampler.chance(0.5), sampler.uniform(0.03, 0.28), sensor.bonnet)
    bonnet = torch.where(night & sampler.chance(0.2), sampler.uniform(0.2, 0.4), bonnet)
    soft = camera & sampler.chance(0.3)
    return sensor._replace(
        exposure=exposure * over,
        tint=torch.where((camera | night)[:, None], sensor.tint * cast, sensor.tint),
        read_noise=sensor.read_noise * noisy,
        shot_noise=sensor.shot_noise * noisy,
        blur=torch.where(soft, sampler.uniform(0.8, 2.6), sensor.blur),
        bloom=torch.where(night, sampler.uniform(0.0, 0.5), sensor.bloom),
        jpeg=torch.where(crude, sampler.uniform(6, 35), sensor.jpeg),
        bonnet=torch.where(camera | night, bonnet, sensor.bonnet),
        bonnet_tilt=torch.where(camera & sampler.chance(0.5), sampler.normal(0.04), sensor.bonnet_tilt),
        bonnet_ridge=torch.where(
            camera & sampler.chance(0.5), sampler.uniform(-0.8, 0.8), sensor.bonnet_ridge
        ),
        bonnet_mirror=torch.where(
            (camera | night) & sampler.chance(0.6), sampler.uniform(0.05, 0.6), sensor.bonnet_mirror
        ),
        bonnet_bow=torch.where(camera | night, sampler.uniform(0.0, 0.3), sensor.bonnet_bow),
        glare=torch.where(camera & sampler.chance(0.3), sampler.uniform(0.0, 0.6), sensor.glare),
    )
