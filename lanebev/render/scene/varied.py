"""What weather, camera and mount are where a world is more than the plain highway."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.render.scene.kinds import Kinds
from lanebev.render.scene.sampler import Dice
from lanebev.render.scene.sensor import Sensor
from lanebev.render.scene.weather import NIGHT, Weather
from lanebev.types import Extrinsics


def varied_weather(dice: Dice, kinds: Kinds, weather: Weather) -> Weather:
    """Night where it is night, at times with a wet road; dull days of snow; clear air in tunnels."""
    wet = torch.where(dice.chance(0.3), dice.uniform(0.1, 1.0), 0.0)
    night = kinds.night
    dull = kinds.snow & dice.chance(0.7)
    visibility = torch.where(kinds.tunnel, 1e4, weather.visibility)
    return weather._replace(
        grey=torch.where(dull, dice.uniform(0.5, 1.0), weather.grey),
        kind=torch.where(night, NIGHT, weather.kind),
        wet=torch.where(night, wet, weather.wet),
        visibility=torch.where(night, visibility.clamp(min=300.0), visibility),
    )


def varied_camera(dice: Dice, kinds: Kinds, sensor: Sensor) -> Sensor:
    """Noisier and darker cameras at night, worse ones where a world has a bad camera."""
    night, camera = kinds.night, kinds.camera
    exposure = torch.where(night, dice.uniform(0.02, 0.22), sensor.exposure)
    over = torch.where(camera & dice.chance(0.15), dice.uniform(1.3, 3.0), 1.0)
    cast = (1 + dice.normal(0.12, 3) * dice.chance(0.4, 1)).clamp(0.6, 1.5)
    noisy = torch.where(night, dice.uniform(0.5, 2.5), 1.0)
    noisy = noisy * torch.where(camera & dice.chance(0.3), dice.uniform(1.0, 3.0), 1.0)
    crude = camera & dice.chance(0.35)
    bonnet = torch.where(dice.chance(0.5), dice.uniform(0.03, 0.3), sensor.bonnet)
    soft = camera & dice.chance(0.3)
    return sensor._replace(
        exposure=exposure * over,
        tint=torch.where((camera | night)[:, None], sensor.tint * cast, sensor.tint),
        read_noise=sensor.read_noise * noisy,
        shot_noise=sensor.shot_noise * noisy,
        blur=torch.where(soft, dice.uniform(0.8, 2.6), sensor.blur),
        bloom=torch.where(night, dice.uniform(0.0, 0.5), sensor.bloom),
        jpeg=torch.where(crude, dice.uniform(6, 35), sensor.jpeg),
        bonnet=torch.where(camera | night, bonnet, sensor.bonnet),
        bonnet_bow=torch.where(camera | night, dice.uniform(0.0, 0.3), sensor.bonnet_bow),
        glare=torch.where(camera & dice.chance(0.3), dice.uniform(0.0, 0.6), sensor.glare),
    )


def varied_extrinsics(dice: Dice, camera: Tensor, pose: Extrinsics) -> Extrinsics:
    """Heights of lorries and of low cars where a world has an unusual camera, (B,) bool."""
    height = torch.where(dice.chance(0.5), dice.uniform(1.7, 3.0), pose.height)
    return pose._replace(height=torch.where(camera, height, pose.height))


def varied_intrinsics(dice: Dice, camera: Tensor, intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Wide lenses where a world has an unusual camera, (B,) bool; (B, 3, 3)."""
    view = dice.uniform(70, 110).deg2rad()
    wide = camera & dice.chance(0.4)
    factor = torch.where(wide, 0.5 * size[1] / (0.5 * view).tan() / intrinsics[:, 0, 0], 1.0)
    scale = torch.stack([factor, factor, torch.ones_like(factor)], dim=1)
    focal = torch.diag_embed(intrinsics.diagonal(dim1=1, dim2=2) * (scale - 1))
    return intrinsics + focal
