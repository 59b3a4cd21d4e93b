"""Weather, camera and mount of worlds that are more varied than the plain highway."""

import torch
from torch import Tensor

from lanebev.render.scene.camera.sensor import Sensor
from lanebev.render.scene.kinds import Kinds
from lanebev.render.scene.light.weather import NIGHT, Weather
from lanebev.render.scene.sampler import BatchSampler
from lanebev.types import Extrinsics


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


def varied_extrinsics(sampler: BatchSampler, camera: Tensor, pose: Extrinsics) -> Extrinsics:
    """Sample heights of lorries and of low cars where a world has an unusual camera, (B,) bool."""
    height = torch.where(sampler.chance(0.5), sampler.uniform(1.7, 3.0), pose.height)
    return pose._replace(height=torch.where(camera, height, pose.height))


def varied_intrinsics(
    sampler: BatchSampler, camera: Tensor, intrinsics: Tensor, size: tuple[int, int]
) -> Tensor:
    """Sample wide lenses (B, 3, 3) where a world has an unusual camera, (B,) bool."""
    view = sampler.uniform(70, 110).deg2rad()
    wide = camera & sampler.chance(0.4)
    factor = torch.where(wide, 0.5 * size[1] / (0.5 * view).tan() / intrinsics[:, 0, 0], 1.0)
    scale = torch.stack([factor, factor, torch.ones_like(factor)], dim=1)
    focal = torch.diag_embed(intrinsics.diagonal(dim1=1, dim2=2) * (scale - 1))
    return intrinsics + focal
