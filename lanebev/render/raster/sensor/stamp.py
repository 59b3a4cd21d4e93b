"""Text burnt into the image, as recorders do: date, time, speed."""

from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from lanebev.render.scene.stamp import LETTERS

_HIGH, _WIDE, _FONTS = 24, 16, (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX)


@lru_cache(maxsize=8)
def _letters(device: torch.device) -> Tensor:
    """Return the letters, and the letters with their rims, (2, G · HIGH · WIDE)."""
    cells, thick = [], []
    for letter in LETTERS:
        canvas = np.zeros((4 * _HIGH, 4 * _WIDE), np.uint8)
        cv2.putText(canvas, letter, (6, 4 * _HIGH - 18), _FONTS[0], 2.3, 255, 9, cv2.LINE_AA)
        cells.append(cv2.resize(canvas, (_WIDE, _HIGH), interpolation=cv2.INTER_AREA))
        rim = cv2.dilate(canvas, np.ones((15, 15), np.uint8))
        thick.append(cv2.resize(rim, (_WIDE, _HIGH), interpolation=cv2.INTER_AREA))
    table = np.stack([np.stack(cells), np.stack(thick)]).astype(np.float32) / 255
    return torch.from_numpy(table).flatten(1).to(device)


def stamp(
    image: Tensor,
    text: Tensor,
    place: Tensor,
    high: Tensor,
    colour: Tensor,
    strength: Tensor,
    outline: Tensor,
) -> Tensor:
    """Write a line of text over an image.

    Args:
        image: (B, 3, H, W) display values.
        text: (B, T) int64, see :func:`~lanebev.render.scene.stamp.sample_text`.
        place: (B, 2) of its upper left corner, shares of width and height.
        high: (B,) of a letter, share of the height.
        colour: (B, 3).
        strength: (B,) in [0, 1].
        outline: (B,) in [0, 1], of a dark rim.
    """
    height, width = image.shape[2:]
    y = torch.arange(height, device=image.device)[None, :, None]
    x = torch.arange(width, device=image.device)[None, None, :]
    tall = (high * height)[:, None, None].clamp(min=4.0)
    wide = tall * _WIDE / _HIGH
    v = (y - place[:, 1, None, None] * height) / tall
    u = (x - place[:, 0, None, None] * width) / wide
    slot = u.floor()
    inside = (v >= 0) & (v < 1) & (slot >= 0) & (slot < text.shape[1])
    letter = text.gather(1, slot.long().clamp(0, text.shape[1] - 1).expand(-1, height, -1).flatten(1))
    letter = letter.unflatten(1, (height, width))
    row = (v * _HIGH).long().clamp(0, _HIGH - 1)
    column = ((u - slot) * _WIDE).long().clamp(0, _WIDE - 1)
    at = (letter * _HIGH + row) * _WIDE + column
    table = _letters(image.device)
    on, rim = ((table[i].take(at) * inside * strength[:, None, None])[:, None] for i in (0, 1))
    image = image * (1 - rim * outline[:, None, None, None])
    return image + (colour[..., None, None] - image) * on
