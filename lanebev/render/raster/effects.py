"""What lies between the scene and the sensor: bloom of bright light, rain in the air, drops on the glass."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

_BLOOM_SCALE = 8


def bloom(radiance: Tensor, white: float, strength: float) -> Tensor:
    """Light that spills from what is brighter than white.

    Args:
        radiance: (1, 3, H, W) linear.
        white: radiance that saturates the sensor.
        strength: share of the excess that is spread.
    """
    _, _, height, width = radiance.shape
    excess = (radiance[0] - white).clamp(0, 6 * white)
    if strength <= 0 or not bool((excess > 0).any()):
        return radiance
    pixels = excess.permute(1, 2, 0).contiguous().numpy()
    small = cv2.resize(pixels, (width // _BLOOM_SCALE, height // _BLOOM_SCALE), interpolation=cv2.INTER_AREA)
    spread = cv2.GaussianBlur(small, (0, 0), 2.0) + 0.6 * cv2.GaussianBlur(
        small, (0, 0), 0.06 * small.shape[1]
    )
    veil = torch.from_numpy(cv2.resize(spread, (width, height), interpolation=cv2.INTER_LINEAR))
    return radiance + strength * veil.permute(2, 0, 1)


def rain(image: Tensor, wet: float, generator: torch.Generator) -> Tensor:
    """Streaks of falling rain, and drops on the windscreen that show a small blurred piece of the image.

    Args:
        image: (1, 3, H, W) display values.
        wet: in (0, 1].
        generator: the randomness.
    """
    _, _, height, width = image.shape
    pixels = image[0].permute(1, 2, 0).contiguous().numpy()
    grain = (torch.rand(height, width, generator=generator) > 0.997).float().numpy()
    length = max(3, height // 18)
    kernel = np.zeros((length, length), np.float32)
    lean = int(torch.randint(-length // 5, length // 5 + 1, (1,), generator=generator))
    cv2.line(kernel, (length // 2 - lean, 0), (length // 2 + lean, length - 1), 1.0)
    streaks = cv2.filter2D(grain, -1, kernel / kernel.sum()) * 0.9 * wet
    pixels = pixels + streaks[..., None] * (0.9 - pixels)

    blurred = cv2.GaussianBlur(pixels, (0, 0), 0.012 * width)
    mask = np.zeros((height, width), np.float32)
    for x, y, size in torch.rand(int(4 + 14 * wet), 3, generator=generator).tolist():
        radius = (0.004 + 0.014 * size * size) * width
        axes = (max(1, int(radius)), max(1, int(radius * (0.9 + 0.5 * size))))
        cv2.ellipse(mask, (int(x * width), int(y * height)), axes, 0, 0, 360, 1.0, -1)
    mask = cv2.GaussianBlur(mask, (0, 0), 0.0025 * width)[..., None]
    shifted = np.roll(blurred, -height // 12, axis=0) * 1.05
    pixels = pixels + mask * (shifted - pixels) * 0.8
    return torch.from_numpy(pixels.clip(0, 1)).permute(2, 0, 1)[None]
