"""The effects of windscreen, lens and recorder on an image, in batches."""

from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lanebev.render.raster.base.noise import CLOUD, sample_noise, smoothstep
from lanebev.render.scene.camera.glass import LETTERS, Glass

_HIGH, _WIDE = 24, 16  # px of a letter
_SHAKES = 9  # images that a shaken one is the mean of


@lru_cache(maxsize=8)
def _letters(device: torch.device) -> Tensor:
    """Return the letters, and the letters with their rims, (2, G · HIGH · WIDE)."""
    cells, thick = [], []
    for letter in LETTERS:
        canvas = np.zeros((4 * _HIGH, 4 * _WIDE), np.uint8)
        cv2.putText(canvas, letter, (6, 4 * _HIGH - 18), cv2.FONT_HERSHEY_SIMPLEX, 2.3, 255, 9, cv2.LINE_AA)
        cells.append(cv2.resize(canvas, (_WIDE, _HIGH), interpolation=cv2.INTER_AREA))
        rim = cv2.dilate(canvas, np.ones((15, 15), np.uint8))
        thick.append(cv2.resize(rim, (_WIDE, _HIGH), interpolation=cv2.INTER_AREA))
    table = np.stack([np.stack(cells), np.stack(thick)]).astype(np.float32) / 255
    return torch.from_numpy(table).flatten(1).to(device)


def _stamped(image: Tensor, glass: Glass) -> Tensor:
    """Write the recorder's line of text, with a dark rim, over an image (B, 3, H, W) of display values."""
    height, width = image.shape[2:]
    y = torch.arange(height, device=image.device)[None, :, None]
    x = torch.arange(width, device=image.device)[None, None, :]
    tall = (glass.stamp_height * height)[:, None, None].clamp(min=4.0)
    wide = tall * _WIDE / _HIGH
    v = (y - glass.stamp_place[:, 1, None, None] * height) / tall
    u = (x - glass.stamp_place[:, 0, None, None] * width) / wide
    text, slot = glass.text, u.floor()
    inside = (v >= 0) & (v < 1) & (slot >= 0) & (slot < text.shape[1])
    letter = text.gather(1, slot.long().clamp(0, text.shape[1] - 1).expand(-1, height, -1).flatten(1))
    letter = letter.unflatten(1, (height, width))
    row = (v * _HIGH).long().clamp(0, _HIGH - 1)
    column = ((u - slot) * _WIDE).long().clamp(0, _WIDE - 1)
    at = (letter * _HIGH + row) * _WIDE + column
    table = _letters(image.device)
    on, rim = ((table[i].take(at) * inside * glass.stamp[:, None, None])[:, None] for i in (0, 1))
    image = image * (1 - rim * glass.stamp_outline[:, None, None, None])
    return image + (glass.stamp_colour[..., None, None] - image) * on


def behind_glass(image: Tensor, glass: Glass) -> Tensor:
    """Put a dirty windscreen that mirrors the dashboard before an image (B, 3, H, W)."""
    height, width = image.shape[2:]
    y = ((torch.arange(height, device=image.device) + 0.5) / height)[None, :, None]
    x = ((torch.arange(width, device=image.device) + 0.5) / width)[None, None, :]
    seed = glass.veil_seed[:, None, None]
    image = _dirty(image, glass, x, y, seed)
    cloth = 0.6 + 0.25 * sample_noise(CLOUD, 0.22 * x + seed, 0.2 * y + seed)
    vents = smoothstep(0.1, 0.25, (x * 5.0 + seed * 9.0 + 0.4 * y) % 1.0 - 0.5)
    edge = smoothstep(0.0, 0.08, y - 0.55 * seed - 0.25 * (x - 0.5) ** 2)
    pattern = (cloth * (0.75 + 0.25 * vents) * (0.3 + 0.7 * edge)).clamp(0, 1.2) * glass.veil[:, None, None]
    return image + glass.veil_colour[..., None, None] * pattern[:, None] * (1 - 0.7 * image)


def _dirty(image: Tensor, glass: Glass, x: Tensor, y: Tensor, seed: Tensor) -> Tensor:
    """Add spots that block and scatter light, and drops that show the image upside down."""
    wide = image.shape[3]
    level = image.mean((2, 3), keepdim=True)
    spots = sample_noise(CLOUD, x * 0.9 + 3 * seed, y * 0.5 + 5 * seed)
    spots = spots + 0.7 * sample_noise(CLOUD, x * 3.1 + seed, y * 1.8 + 7 * seed)
    edge = 2.6 - 5.0 * glass.dirt_cover[:, None, None]
    dirt = smoothstep(edge, edge + 1.2, spots) * glass.dirt[:, None, None]
    image = image + (0.5 * level + 0.05 - 0.6 * image) * dirt[:, None]
    cells = 18.0
    u, v = x * cells, y * cells * image.shape[2] / wide
    shift = [
        sample_noise(CLOUD, (u.floor() + k * seed) * 0.137, v.floor() * 0.173 + k * seed)
        for k in (1.0, 2.0, 3.0)
    ]
    du, dv = (u % 1.0) - 0.5 - 0.15 * shift[0].clamp(-1, 1), (v % 1.0) - 0.5 - 0.15 * shift[1].clamp(-1, 1)
    radius = 0.22 * (shift[2] - 0.7).clamp(0, 1.2)
    drop = smoothstep(1.0, 0.75, (du * du + dv * dv).sqrt() / radius.clamp(min=1e-3)) * (radius > 0.02)
    small = functional.interpolate(image, scale_factor=0.125, mode="area", recompute_scale_factor=True)
    mirrored = functional.interpolate(small.flip(2), image.shape[2:], mode="bilinear", align_corners=False)
    return image + (mirrored - image) * (0.75 * drop * glass.drops[:, None, None])[:, None]


def shaken(image: Tensor, shake: Tensor) -> Tensor:
    """Average an image over a small motion.

    Args:
        image: (B, 3, H, W).
        shake: (B, 3) px right and px down at 640 px width, and rad about the middle, from end to end.
    """
    height, width = image.shape[2:]
    right, down = shake[:, 0] * 2 / 640, shake[:, 1] * 2 / 640 * width / height
    total = torch.zeros_like(image)
    for step in torch.linspace(-0.5, 0.5, _SHAKES).tolist():
        turn, zero = shake[:, 2] * step, torch.zeros_like(right)
        matrix = torch.stack(
            [
                torch.stack([zero + 1, -turn * height / width, right * step], 1),
                torch.stack([turn * width / height, zero + 1, down * step], 1),
            ],
            1,
        )
        grid = functional.affine_grid(matrix, list(image.shape), align_corners=False)
        total = total + functional.grid_sample(image, grid, padding_mode="border", align_corners=False)
    return total / _SHAKES


def frame_cover(glass: Glass, size: tuple[int, int]) -> Tensor:
    """Compute the share of each pixel under black rounded corners at the image's sides, (B, H, W)."""
    height, width = size
    y = ((torch.arange(height, device=glass.frame.device) + 0.5) / height * 2 - 1)[None, :, None]
    x = ((torch.arange(width, device=glass.frame.device) + 0.5) / width * 2 - 1)[None, None, :]
    bow = 1 - glass.frame[:, None, None] * (0.4 + 1.6 * y * y)
    return smoothstep(0.995, 1.0, x.abs() / bow.clamp(min=0.5)) * (glass.frame > 0)[:, None, None]


def recorded(image: Tensor, glass: Glass) -> Tensor:
    """Add what the recorder draws over an image, and the losses of its codec."""
    height, width = image.shape[2:]
    y = torch.arange(height, device=image.device)[None, :, None]
    x = torch.arange(width, device=image.device)[None, None, :]
    radius = glass.sticker[:, 0, None, None] * width
    distance = torch.hypot(
        x - glass.sticker[:, 1, None, None] * width, 1.6 * (y - glass.sticker[:, 2, None, None] * width)
    )
    on = ((radius - distance).clamp(0, 1) * (radius > 0))[:, None]
    on_rim = (distance > 0.8 * radius)[:, None]
    colour = torch.where(on_rim, 0.85, glass.sticker_colour[..., None, None])
    image = image + (colour - image) * on
    image = image * (1 - frame_cover(glass, (height, width)))[:, None]
    return _coded(_stamped(image, glass), glass)


def _coded(image: Tensor, glass: Glass) -> Tensor:
    """Reduce the detail of colours, and make blocks of one brightness."""
    grey = image.mean(1, keepdim=True)
    size = list(image.shape[2:])
    fine, coarse = (_blocks(image - grey, cell, size) for cell in (4, 16))
    part = ((glass.chroma_block - 4) / 12).clamp(0, 1)[:, None, None, None]
    chroma = glass.chroma[:, None, None, None]
    colour = (image - grey) * (1 - chroma) + (fine + (coarse - fine) * part) * chroma
    flat = _blocks(grey, 8, size)
    weak = torch.exp(-(((grey - flat) / 0.06) ** 2)) * glass.block[:, None, None, None]
    return (grey + (flat - grey) * weak + colour).clamp(0, 1)


def _blocks(image: Tensor, cell: int, size: list[int]) -> Tensor:
    """Average over squares of ``cell`` px, at the image's own size."""
    means = functional.avg_pool2d(image, cell, ceil_mode=True, count_include_pad=False)
    return means.repeat_interleave(cell, 2).repeat_interleave(cell, 3)[..., : size[0], : size[1]]
