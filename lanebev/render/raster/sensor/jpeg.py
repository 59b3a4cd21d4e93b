"""JPEG there and back: what quantising the cosine transform of 8 x 8 blocks does to an image."""

import math
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from lanebev.tensors import constant

# Quantisation of luminance and chrominance, ITU-T T.81, tables K.1 and K.2
_LUMINANCE = (
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56,
    14, 17, 22, 29, 51, 87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92,
    49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99,
)  # fmt: skip
_CHROMINANCE = (
    17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99,
    47, 66, 99, 99, 99, 99, 99, 99, *([99] * 32),
)  # fmt: skip


@lru_cache(maxsize=8)
def _cosines(device: torch.device) -> Tensor:
    """Return the orthonormal cosine transform of a flattened 8 x 8 block, (64, 64)."""
    k, n = torch.arange(8.0)[:, None], torch.arange(8.0)
    row = torch.cos((2 * n + 1) * k * (math.pi / 16)) * 0.5
    row[0] *= 0.5**0.5
    return torch.kron(row, row).to(device)


def compress(image: Tensor, quality: Tensor) -> Tensor:
    """Quantise images as baseline JPEG does, with chrominance at half the resolution.

    Source: ITU-T T.81; tables scaled by quality as libjpeg does (jcparam.c). Deviation: what comes out is not
    rounded to 8 bits. Entropy coding loses nothing and is left out.

    Args:
        image: (B, 3, H, W) in [0, 1].
        quality: (B,) 1 to 100.

    Returns:
        (B, 3, H, W) in [0, 1].
    """
    height, width = image.shape[2:]
    red, green, blue = functional.pad(image, (0, -width % 16, 0, -height % 16), mode="replicate").unbind(1)
    luma = torch.add(0.299 * red, green, alpha=0.587).add_(blue, alpha=0.114)
    small = functional.avg_pool2d(torch.stack([blue - luma, red - luma], dim=1), 2)
    chroma = constant((0.5643, 0.7133), image)[:, None, None]

    quality = quality.clamp(1, 100).floor()
    scale = torch.where(quality < 50, 5000 / quality, 200 - 2 * quality)
    luma = _quantised(luma[:, None] - 0.5, scale, constant(_LUMINANCE, image)) + 0.5
    small = _quantised(small * chroma, scale, constant(_CHROMINANCE, image)) / chroma
    blue_part, red_part = small.unbind(1)
    green_part = (-0.299 / 0.587) * red_part - (0.114 / 0.587) * blue_part
    parts = torch.stack([red_part, green_part, blue_part], dim=1)[:, :, :, None, :, None]
    decoded = luma.unflatten(3, (-1, 2)).unflatten(2, (-1, 2)) + parts  # (B, 3, H/2, 2, W/2, 2)
    image = decoded.flatten(4, 5).flatten(2, 3)[..., :height, :width]
    return image.clamp(0, 1)


def _quantised(planes: Tensor, scale: Tensor, table: Tensor) -> Tensor:
    """Round the blocks' cosine transform of planes (B, C, h, w) to multiples of the scaled table."""
    step = ((table * scale[:, None] + 50) / 100).floor().clamp(1, 255)[:, None] / 255  # (B, 1, 64)
    batch, channels, height, width = planes.shape
    blocks = planes.unflatten(3, (-1, 8)).unflatten(2, (-1, 8)).transpose(3, 4)  # (B, C, h/8, w/8, 8, 8)
    blocks = blocks.reshape(batch, -1, 64)
    cosines = _cosines(planes.device)
    rounded = (blocks @ cosines.T).div_(step).round_().mul_(step)
    blocks = (rounded @ cosines).view(batch, channels, height // 8, width // 8, 8, 8)
    quantised: Tensor = blocks.transpose(3, 4).reshape(planes.shape)
    return quantised
