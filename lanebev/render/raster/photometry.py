"""Light on the scene, and what a camera makes of it."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from lanebev.render.raster.effects import bloom
from lanebev.render.raster.noise import CLOUD, sample_noise
from lanebev.render.raster.solids import Light
from lanebev.render.scene.sampler import Dice

CLEAR, OVERCAST, DUSK, NIGHT, RAIN = range(5)


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


def sample_weather(dice: Dice) -> Weather:
    """Mostly clear days."""
    kind = dice.pick([0.66, 0.14, 0.08, 0.06, 0.06])
    clear = dice.uniform(0.0, 0.25)
    grey = torch.where((kind == OVERCAST) | (kind == RAIN), dice.uniform(0.7, 1.0), clear)
    hazy = dice.chance(0.12) | (kind == RAIN)
    dusk = kind == DUSK
    return Weather(
        kind=kind,
        grey=grey,
        wet=torch.where(kind == RAIN, dice.uniform(0.5, 1.0), 0.0),
        visibility=torch.where(hazy, dice.uniform(150, 600), dice.uniform(600, 4000)),
        sun_azimuth=dice.uniform(-3.1416, 3.1416),
        sun_height=torch.where(dusk, dice.uniform(0.03, 0.2), dice.uniform(0.3, 1.3)),
    )


def light_of(weather: Weather, road_heading: Tensor) -> Light:
    """Illumination in the local road frame, whose Z axis points along ``road_heading`` (B,) rad."""
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


def headlight_irradiance(x: Tensor, z: Tensor) -> Tensor:
    """(B, N) relative irradiance of dipped headlights on the road at (x, z) m."""
    distance = z.clamp(min=0.5)
    spread = torch.exp(-(((x - 0.02 * distance) / (1.8 + 0.22 * distance)) ** 2))
    pools = 1 + 0.5 * torch.exp(-(((x.abs() - 0.9 - 0.05 * distance) / (0.7 + 0.05 * distance)) ** 2))
    reach = (1 - torch.exp(-((distance / 5.0) ** 2))) / (1 + (distance / 14.0) ** 2)
    return 1.2 * spread * pools * reach


class Sensor(NamedTuple):
    """What the camera does to the light, each (B,) unless said otherwise.

    Attributes:
        exposure: linear level that the road's mean is brought to.
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


def sample_sensor(dice: Dice, weather: Weather, bright: Tensor) -> Sensor:
    """A random camera; ``bright`` (B,) bool overexposes."""
    usual = torch.where(dice.chance(0.8), dice.uniform(0.055, 0.22), dice.uniform(0.2, 0.34))
    exposure = torch.where(bright, dice.uniform(0.3, 0.75), usual)
    dark = (weather.kind == NIGHT) | (weather.kind == DUSK)
    exposure = torch.where(dark, dice.uniform(0.03, 0.2), exposure)
    noisy = torch.where(weather.kind == NIGHT, 2.5, 1.0)
    return Sensor(
        exposure=exposure,
        tint=1 + dice.normal(0.03, 3),
        contrast=dice.uniform(0.9, 1.5),
        saturation=torch.where(dice.chance(0.05), 0.0, dice.uniform(0.6, 1.6)),
        black=dice.uniform(-0.02, 0.04),
        blur=torch.where(dice.chance(0.8), dice.uniform(0.2, 0.8), dice.uniform(0.8, 2.0)),
        read_noise=dice.uniform(0.001, 0.012) * noisy,
        shot_noise=dice.uniform(0.002, 0.022) * noisy,
        vignette=torch.where(dice.chance(0.5), dice.uniform(0.0, 0.4), 0.0),
        glare=torch.where(dice.chance(0.3), dice.uniform(0.0, 0.2), 0.0),
        bloom=torch.where(dice.chance(0.6), dice.uniform(0.0, 0.35), 0.0),
        jpeg=torch.where(dice.chance(0.7), dice.uniform(35, 95), 0.0),
        bonnet=torch.where(dice.chance(0.3), dice.uniform(0.02, 0.14), 0.0),
        bonnet_colour=dice.uniform(0.01, 0.25, 1) * (1 + dice.normal(0.2, 3)).clamp(0.4, 1.6),
        bonnet_bow=dice.uniform(0.0, 0.12),
    )


def add_bonnet(radiance: Tensor, blocked: Tensor, sensor: Sensor, light: Light, sky: Tensor) -> None:
    """Paint the own vehicle's bonnet at the bottom; changes radiance and blocked.

    Args:
        radiance: (1, 3, H, W).
        blocked: (1, H, W) m.
        sensor: has the bonnet.
        light: falls on it.
        sky: (1, 3) radiance that it reflects.
    """
    _, _, height, width = radiance.shape
    top = int(height * (1 - float(sensor.bonnet))) - 1
    y = torch.arange(top, height)[:, None] / height
    x = (torch.arange(width)[None] + 0.5) / width - 0.5
    edge = 1 - sensor.bonnet + 4 * sensor.bonnet_bow * x * x
    alpha = ((y - edge) * height + 0.5).clamp(0, 1)
    below = ((y - edge) / sensor.bonnet.clamp(min=0.02)).clamp(0, 1)
    gloss = (0.30 - 0.22 * below + 0.05 * sample_noise(CLOUD, x * 0.5 + 0 * y, 0.2 * y + 0 * x)).clamp(0.02)
    colour = sensor.bonnet_colour * (light.ambient + 0.6 * light.direct + 0.02)
    paint = colour[..., None, None] * (1.1 - 0.3 * below) + gloss * sky[..., None, None]
    part = radiance[:, :, top:]
    part += (paint - part) * alpha
    blocked[:, top:].masked_fill_(alpha > 0.5, 0.0)


def expose(radiance: Tensor, sensor: Sensor, road_level: Tensor) -> Tensor:
    """Linear radiance to display values before noise.

    Args:
        radiance: (1, 3, H, W).
        sensor: the camera.
        road_level: (1,) radiance of the road; the exposure is set for it, and less for all the rest.

    Returns:
        (1, 3, H, W) in [0, 1].
    """
    _, _, height, width = radiance.shape
    mean = radiance.mean((1, 2, 3))
    metered = road_level.clamp(min=1e-4) ** 0.7 * mean.clamp(min=1e-4) ** 0.3
    gain = (sensor.exposure / metered)[:, None] * sensor.tint
    white = 1.0 / float(gain.amax())
    value = bloom(radiance, white, float(sensor.bloom)) * gain[..., None, None]
    if bool(sensor.vignette > 0):
        y = torch.arange(height)[:, None] / height - 0.5
        x = torch.arange(width)[None] / width - 0.5
        value *= 1 - sensor.vignette * 2 * (x * x + y * y)
    value += sensor.glare * value.mean()
    over = (value - 0.6).clamp(min=0)
    value = value.clamp(1e-4, 0.6) + 0.4 * (1 - torch.exp(-over / 0.4))  # soft shoulder
    value = _contrast(value ** (1 / 2.2), float(sensor.contrast))
    grey = value.mean(1, keepdim=True)
    value = grey + (value - grey) * sensor.saturation
    return (value + sensor.black).clamp(0, 1)


def _contrast(value: Tensor, power: float, middle: float = 0.45) -> Tensor:
    """An S-shaped curve through 0, the middle and 1, with slope ``power`` at the middle."""
    low = middle * (value.clamp(max=middle) / middle) ** power
    high = (1 - middle) * ((1 - value).clamp(0, 1 - middle) / (1 - middle)) ** power
    return low + (1 - middle) - high


def blur(image: Tensor, std: float) -> Tensor:
    """Gaussian blur of one image, (1, 3, H, W), standard deviation in px; none below 0.2 px."""
    if std < 0.2:
        return image
    pixels = image[0].permute(1, 2, 0).contiguous().numpy()
    blurred = cv2.GaussianBlur(pixels, (0, 0), std, borderType=cv2.BORDER_REPLICATE)
    return torch.from_numpy(blurred).permute(2, 0, 1)[None]


def add_noise(image: Tensor, sensor: Sensor, generator: torch.Generator) -> Tensor:
    """Shot and read noise on display values, (B, 3, H, W)."""
    noise = torch.randn(image.shape, generator=generator)
    level = (
        sensor.read_noise[:, None, None, None] ** 2 + image * sensor.shot_noise[:, None, None, None] ** 2
    ).sqrt()
    return (image + noise * level).clamp(0, 1)


def compress(image: Tensor, quality: Tensor) -> Tensor:
    """JPEG there and back; (B, 3, H, W) in [0, 1], quality (B,), 0 leaves the row as it is."""
    rows = []
    for row, level in zip(image, quality.tolist(), strict=True):
        if level <= 0:
            rows.append(row)
            continue
        pixels = (row.flip(0).permute(1, 2, 0) * 255).round().byte().numpy()
        _, data = cv2.imencode(".jpg", np.ascontiguousarray(pixels), [cv2.IMWRITE_JPEG_QUALITY, int(level)])
        decoded = torch.from_numpy(cv2.imdecode(data, cv2.IMREAD_COLOR))
        rows.append(decoded.permute(2, 0, 1).flip(0).to(image.dtype) / 255)
    return torch.stack(rows)
