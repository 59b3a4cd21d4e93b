"""From linear radiance to display values: metering, veils of light, and the tone curve."""

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from lanebev.render.raster.base.select import indices_where, take
from lanebev.render.scene.camera.sensor import Sensor

_BLOOM_SCALE = 8
_SHOULDER = 0.6  # display-linear level above which highlights are compressed
_PER_ROOT, _LEVELS = 4096, 8192  # entries of the table of tones: up to a linear value of 4
_MIDDLE = 0.45  # display level that the contrast leaves as it is


def expose(radiance: Tensor, sensor: Sensor, road_level: Tensor, bloom: bool) -> Tensor:
    """Convert radiance to display values, without noise.

    Args:
        radiance: (B, 3, H, W) linear.
        sensor: the cameras.
        road_level: (B,) radiance of the road; the exposure is set for it, and less for all the rest.
        bloom: whether any camera has some.

    Returns:
        (B, 3, H, W) display values in [0, 1].
    """
    height, width = radiance.shape[2:]
    mean = radiance.mean((1, 2, 3))
    metered = road_level.clamp(min=1e-4) ** 0.7 * mean.clamp(min=1e-4) ** 0.3
    gain = (sensor.exposure / metered)[:, None] * sensor.tint
    value = radiance * gain[..., None, None]
    if bloom:
        _add_bloom(value, gain, sensor.bloom)
    y = torch.arange(height, device=value.device)[:, None] / height - 0.5
    x = torch.arange(width, device=value.device) / width - 0.5
    value *= 1 - (2 * sensor.vignette)[:, None, None, None] * (x * x + y * y)
    value += (sensor.glare * value.mean((1, 2, 3)))[:, None, None, None]
    value = _toned(value, sensor.contrast, sensor.black)
    grey = value.mean(1, keepdim=True)
    return torch.lerp(grey, value, sensor.saturation[:, None, None, None]).clamp_(0, 1)


def tone_curve(value: Tensor, contrast: Tensor) -> Tensor:
    """Map linear values, 1 is the middle of the highlights, to display values.

    A soft shoulder above 0.6, a power of 1 / 2.2, and an S-shaped curve through 0, 0.45 and 1 whose slope in
    the middle is the contrast.
    """
    over = (value - _SHOULDER).clamp(min=0)
    value = value.clamp(1e-4, _SHOULDER) + 0.4 * (1 - torch.exp(-over / 0.4))
    value = value ** (1 / 2.2)
    low = (value.clamp(max=_MIDDLE) / _MIDDLE) ** contrast
    high = ((1 - value).clamp(0, 1 - _MIDDLE) / (1 - _MIDDLE)) ** contrast
    return _MIDDLE * low + (1 - _MIDDLE) * (1 - high)


def _toned(value: Tensor, contrast: Tensor, black: Tensor) -> Tensor:
    """Apply the tone curve by a table over square roots, to 2e-4: a tenth of the time of powers."""
    level = torch.arange(_LEVELS, device=value.device) / _PER_ROOT
    table = tone_curve(level.square(), contrast[:, None]) + black[:, None]  # (B, LEVELS)
    index = value.sqrt().mul_(_PER_ROOT).add_(0.5).clamp_(max=_LEVELS - 1).int()
    first = torch.arange(len(value), device=value.device, dtype=torch.int32) * _LEVELS
    return take(table, index.add_(first[:, None, None, None]))


def _add_bloom(value: Tensor, gain: Tensor, strength: Tensor) -> None:
    """Spread light from what is brighter than white over its neighbourhood; changes ``value``."""
    height, width = value.shape[2:]
    white = gain / gain.amax(1, keepdim=True)  # value of each channel at which the first one saturates
    rows = indices_where((strength > 0) & (value.amax((2, 3)) > white).any(1))
    if not len(rows):
        return
    white, strength = (
        t.index_select(0, rows) for t in (white[..., None, None], strength[:, None, None, None])
    )
    bright = torch.minimum((value.index_select(0, rows) - white).clamp_(min=0), 6 * white)
    excess = functional.avg_pool2d(bright, _BLOOM_SCALE, ceil_mode=True, count_include_pad=False) * strength
    veil = torch.zeros_like(value[:1])
    for std, share in ((2.0, 1.0), (0.06 * excess.shape[3], 0.6)):
        down, across = (_spread(n, std, value.device) for n in (height, width))
        veil = veil + share * (down @ (excess @ across.T))
    value.index_add_(0, rows, veil)


@lru_cache(maxsize=64)
def _spread(length: int, std: float, device: torch.device) -> Tensor:
    """Return the matrix (length, cells) of a Gaussian blur of cells and linear interpolation."""
    cells = -(-length // _BLOOM_SCALE)
    reach = int(4 * std + 0.5)
    shifts = torch.arange(-reach, reach + 1, dtype=torch.float64)
    weight = torch.exp(-0.5 * (shifts / std) ** 2)
    source = (torch.arange(cells)[:, None] + shifts).clamp(0, cells - 1).long()
    blur = torch.zeros(cells, cells, dtype=torch.float64)
    blur.scatter_add_(1, source, (weight / weight.sum()).expand_as(source))
    place = ((torch.arange(length, dtype=torch.float64) + 0.5) / _BLOOM_SCALE - 0.5).clamp(0, cells - 1)
    low = place.long().clamp(max=max(cells - 2, 0))
    share = (place - low)[:, None]
    return (blur[low] * (1 - share) + blur[(low + 1).clamp(max=cells - 1)] * share).float().to(device)
