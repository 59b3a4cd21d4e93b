"""A camera's image of painted views."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from lanebev.render.raster.base.features import Features
from lanebev.render.raster.paint import Painted
from lanebev.render.raster.sensor.effects import add_bonnet, rain, random_rows
from lanebev.render.raster.sensor.exposure import expose
from lanebev.render.raster.sensor.filters import blur_reach, gaussian_blur
from lanebev.render.raster.sensor.glass import behind_glass, frame_cover, recorded, shaken
from lanebev.render.raster.sensor.jpeg import compress
from lanebev.render.rows import take_rows
from lanebev.render.scene.camera.sensor import Sensor
from lanebev.render.scene.world import Scene

_REFERENCE_WIDTH = 640  # px, at which the blur is stated
_SHARP = 0.2  # px of blur that is not visible


def take_image(
    painted: Painted,
    scene: Scene,
    host: Scene,
    features: Features,
    generators: Sequence[torch.Generator],
    ideal: bool,
) -> Tensor:
    """Make images of painted views; changes ``painted`` where bonnets and black frames hide the road.

    Args:
        painted: B views.
        scene: scene of the views.
        host: the same on the host, where it is read which rows have what.
        features: what the scenes have.
        generators: B of them, of rain and noise, on the views' device.
        ideal: leave out rain, blur, noise and compression.

    Returns:
        (B, 3, H, W) in [0, 1].
    """
    sensor, device, faulty = scene.world.sensor, painted.radiance.device, features.rows.glass
    _hide_by_bonnets(painted, scene, host)
    image = expose(painted.radiance, sensor, painted.road_level, features.bloom)
    if ideal:
        return image

    def change(mask: Tensor, effect: Callable[[Tensor, Tensor], Tensor]) -> None:
        """Change the images of the rows in which a mask holds, by an effect of these images and rows."""
        if bool(mask.any()):
            rows = _rows_with(mask, device)
            image.index_copy_(0, rows, effect(image.index_select(0, rows), rows))

    raining = host.world.weather.wet > 0
    drawn = [g for g, wet_row in zip(generators, raining.tolist(), strict=True) if wet_row]
    change(raining, lambda part, rows: rain(part, scene.world.weather.wet.index_select(0, rows), drawn))
    windscreens = torch.tensor(faulty, dtype=torch.long).to(device, non_blocking=True)
    glass = take_rows(scene.world.glass, windscreens)
    moved, shake = host.world.glass.shake.any(1), scene.world.glass.shake
    change(moved, lambda part, rows: shaken(part, shake.index_select(0, rows)))
    if faulty:
        image.index_copy_(0, windscreens, behind_glass(image.index_select(0, windscreens), glass))
    _blur(image, host.world.sensor.blur * (image.shape[3] / _REFERENCE_WIDTH))
    image = add_noise(image, sensor, generators)
    if faulty:
        image.index_copy_(0, windscreens, recorded(image.index_select(0, windscreens), glass))
        shut = frame_cover(glass, (image.shape[2], image.shape[3])) > 0.5
        seen = painted.blocked.index_select(0, windscreens).masked_fill(shut, 0.0)
        painted.blocked.index_copy_(0, windscreens, seen)
    change(host.world.sensor.jpeg > 0, lambda part, rows: compress(part, sensor.jpeg.index_select(0, rows)))
    return image


def _rows_with(mask: Tensor, device: torch.device) -> Tensor:
    """Return the rows in which a mask (B,) on the host holds, on the device."""
    return mask.nonzero()[:, 0].to(device, non_blocking=True)


def _hide_by_bonnets(painted: Painted, scene: Scene, host: Scene) -> None:
    """Paint the bonnets of own vehicles; changes ``painted``."""
    bonnet = host.world.sensor.bonnet
    if not bool((bonnet > 0).any()):
        return
    rows = _rows_with(bonnet > 0, painted.radiance.device)
    own, light = take_rows(scene.world.sensor, rows), take_rows(scene.light, rows)
    open_air = (1 - 0.95 * scene.world.tunnel.on)[:, None]
    sky = (scene.world.surroundings.skyline * open_air).index_select(0, rows)
    tallest = float((bonnet + 0.5 * host.world.sensor.bonnet_tilt.abs()).amax())
    add_bonnet(painted.radiance, painted.blocked, rows, tallest, own, light, sky)


def _blur(image: Tensor, std: Tensor) -> None:
    """Blur images (B, C, H, W) by Gaussians of (B,) px, on the host, if that shows; changes the images."""
    most, order = std.sort(descending=True, stable=True)
    most = most[most >= _SHARP]
    if len(most):
        rows = order[: len(most)].to(image.device, non_blocking=True)
        reach = [blur_reach(each) for each in most.tolist()]
        own = most.to(image.device, non_blocking=True)
        image.index_copy_(0, rows, gaussian_blur(image.index_select(0, rows), own, reach))


def add_noise(image: Tensor, sensor: Sensor, generators: Sequence[torch.Generator]) -> Tensor:
    """Add shot and read noise to display values, (B, 3, H, W)."""
    noise = random_rows(tuple(image.shape[1:]), generators, image.device, Tensor.normal_)
    read, shot = (v.square()[:, None, None, None] for v in (sensor.read_noise, sensor.shot_noise))
    level = torch.addcmul(read, image, shot).sqrt_()
    return torch.addcmul(image, noise, level).clamp_(0, 1)
