"""Objects between the scene and the sensor: the own bonnet, rain in the air, drops on the glass."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from lanebev.render.raster.base.noise import CLOUD, sample_noise
from lanebev.render.raster.base.select import as_float
from lanebev.render.raster.sensor.filters import blur_reach, gaussian_blur
from lanebev.render.scene.camera.sensor import Sensor
from lanebev.render.scene.light.weather import Light

_MOST_DROPS = 18


def add_bonnet(
    radiance: Tensor, blocked: Tensor, rows: Tensor, tallest: float, sensor: Sensor, light: Light, sky: Tensor
) -> None:
    """Paint own vehicles' bonnets at the bottom of images; changes radiance and blocked.

    Args:
        radiance: (B, 3, H, W).
        blocked: (B, H, W) m.
        rows: (R,) int64, which have a bonnet.
        tallest: the largest share of the image's height of any of them.
        sensor: R of them.
        light: R rows, falls on the bonnets.
        sky: (R, 3) radiance that they reflect.
    """
    height, width = radiance.shape[2:]
    top = int(height * (1 - tallest)) - 1
    y = torch.arange(top, height, device=radiance.device)[:, None] / height
    x = (torch.arange(width, device=radiance.device) + 0.5) / width - 0.5
    share = sensor.bonnet[:, None, None]
    edge = 1 - share + 4 * sensor.bonnet_bow[:, None, None] * x * x  # (R, 1, W)
    edge = edge + sensor.bonnet_tilt[:, None, None] * x
    alpha = ((y - edge) * height + 0.5).clamp(0, 1)
    below = ((y - edge) / share.clamp(min=0.02)).clamp(0, 1)
    gloss = (0.30 - 0.22 * below + 0.05 * sample_noise(CLOUD, x * 0.5, 0.2 * y)).clamp(0.02)
    colour = (sensor.bonnet_colour * (light.ambient + 0.6 * light.direct + 0.02))[..., None, None]
    aside = (x.abs() - 0.22 - 0.1 * below) / (0.006 + 0.012 * below)
    ridges = 1 + sensor.bonnet_ridge[:, None, None] * (aside * torch.exp(-aside * aside))
    mirror = sensor.bonnet_mirror[:, None, None] * (1 - 0.75 * below)
    paint = colour * ((1.1 - 0.3 * below) * ridges)[:, None]
    paint = paint + (gloss * (1 - mirror).clamp(min=0))[:, None] * sky[..., None, None]
    upwards = torch.arange(height - top - 1, -1, -1, device=radiance.device)
    mirrored = (upwards * 3 // 2).clamp(max=height // 2)  # rows of the image
    above = radiance.index_select(0, rows).index_select(2, mirrored)  # it faces the sky
    paint = paint + (mirror * ridges)[:, None] * above.clamp(max=4.0)
    under = radiance[:, :, top:].index_select(0, rows)
    radiance[:, :, top:].index_copy_(0, rows, under + (paint - under) * alpha[:, None])
    hidden = blocked[:, top:].index_select(0, rows).masked_fill(alpha > 0.5, 0.0)
    blocked[:, top:].index_copy_(0, rows, hidden)


def rain(image: Tensor, wet: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
    """Draw streaks of falling rain, and drops on the windscreen that show a small blurred piece of the image.

    Args:
        image: (R, 3, H, W) display values.
        wet: (R,) in (0, 1].
        generators: R of them, on the images' device.
    """
    batch, _, height, width = image.shape
    grain = random_rows((1, height, width), generators, image.device) > 0.997
    lean = random_rows((), generators, image.device) * 0.4 - 0.2
    falling = _streaks(grain.float(), lean) * (0.9 * wet)[:, None, None, None]
    image = image + falling * (0.9 - image)

    wide = 0.012 * width
    blurred = gaussian_blur(image, image.new_full((batch,), wide), [blur_reach(wide)] * batch)
    mask = _drops(wet, random_rows((_MOST_DROPS, 3), generators, image.device), (height, width))
    narrow = 0.0025 * width
    mask = gaussian_blur(mask[:, None], image.new_full((batch,), narrow), [blur_reach(narrow)] * batch)
    shifted = blurred.roll(-(height // 12), dims=2) * 1.05
    return (image + mask * (shifted - image) * 0.8).clamp(0, 1)


def _streaks(grain: Tensor, lean: Tensor) -> Tensor:
    """Blur noise along lines that lean by (R,) px to the right per px down, (R, 1, H, W)."""
    height, width = grain.shape[2:]
    length = max(3, height // 18)
    total = torch.zeros_like(grain)
    column = torch.arange(width, device=grain.device)
    for k in range(length):
        down = k - length // 2
        source = (column - (lean * down).round()[:, None].long()).clamp(0, width - 1)
        total += grain.roll(down, dims=2).gather(3, source[:, None, None].expand_as(grain))
    return total / length


def _drops(wet: Tensor, draw: Tensor, size: tuple[int, int]) -> Tensor:
    """Draw 4 to 18 drops of random places and sizes (R, 18, 3): 1 on drops, (R, H, W)."""
    height, width = size
    place_x, place_y, large = draw.unbind(2)
    radius = (0.004 + 0.014 * large * large) * width
    down_radius = (radius * (0.9 + 0.5 * large)).clamp(min=1.0)
    reach = int(0.018 * 1.4 * width) + 2
    span = torch.arange(-reach, reach + 1, device=wet.device)
    centre_x, centre_y = place_x * width, place_y * height  # (R, 18)
    x, y = centre_x.round()[..., None] + span, centre_y.round()[..., None] + span  # (R, 18, K)
    across = (x - centre_x[..., None]) / radius.clamp(min=1.0)[..., None]
    down = (y - centre_y[..., None]) / down_radius[..., None]
    on = across.square()[..., None, :] + down.square()[..., None] < 1  # (R, 18, K, K)
    on &= ((x >= 0) & (x < width))[..., None, :] & ((y >= 0) & (y < height))[..., None]
    on &= (torch.arange(_MOST_DROPS, device=wet.device) < 4 + 14 * wet[:, None])[..., None, None]
    place = y.clamp(0, height - 1)[..., None] * width + x.clamp(0, width - 1)[..., None, :]
    mask = torch.zeros(len(wet), height * width, device=wet.device)
    mask.scatter_reduce_(1, place.long().flatten(1), as_float(on).flatten(1), "amax")
    drops: Tensor = mask.unflatten(1, size)
    return drops


def random_rows(
    shape: tuple[int, ...],
    generators: Sequence[torch.Generator],
    device: torch.device,
    draw: Callable[..., Tensor] = Tensor.uniform_,
) -> Tensor:
    """Draw (R, *shape) values on the device, which is the generators': uniform in [0, 1) by default."""
    values = torch.empty(len(generators), *shape, device=device)
    for row, generator in zip(values, generators, strict=True):
        draw(row, generator=generator)
    return values
