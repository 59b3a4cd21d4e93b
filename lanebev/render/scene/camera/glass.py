"""Faults between the road and the file: windscreen, dirt, shake, time stamps, old codecs."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.render.scene.sampler import BatchSampler

STAMP_LENGTH = 24  # letters
LETTERS = "0123456789:/-. KMHNEAP"
_PATTERNS = (  # 0 stands for any digit, * for any letter
    "0000-00-00 00:00:00     ",
    "00/00/0000 00:00:00 000 ",
    "000 KM/H  00:00:00      ",
    "00:00:00                ",
    "N00.00000 E000.00000 000",
    "*********  0000-00-00   ",
)


def sample_text(sampler: BatchSampler, length: int) -> Tensor:
    """Sample indices of letters, (B, length) int64."""
    blank, first = LETTERS.index(" "), LETTERS.index("K")
    codes = [[{"0": -1.0, "*": -2.0}.get(c, float(LETTERS.find(c))) for c in p] for p in _PATTERNS]
    pattern = sampler.pick_from([tuple(c) for c in codes]).long()[:, :length]
    digit = sampler.pick([1.0] * 10, length)
    letter = first + sampler.pick([1.0] * (len(LETTERS) - first), length)
    text = torch.where(pattern == -1, digit, torch.where(pattern == -2, letter, pattern))
    return text.where(text >= 0, blank)


class Glass(NamedTuple):
    """Faults of windscreen, lens and recorder, (B,) unless said otherwise; 0 is none.

    Attributes:
        side: m, how far the camera sits right of the vehicle's middle.
        veil: strength of the dashboard's reflection in the windscreen.
        veil_colour: (B, 3).
        veil_seed: shifts its pattern.
        dirt: strength of dirt on the glass.
        dirt_cover: share of the glass that is dirty.
        drops: strength of drops on it.
        shake: (B, 3) blur by motion: px right and px down at 640 px width, and rad about the middle.
        frame: share of the image's width that black rounded corners take.
        sticker: (B, 3) radius, and place along the upper edge and below it, in widths of the image.
        sticker_colour: (B, 3).
        stamp: strength of a burnt-in text.
        text: (B, T) int64, its letters.
        stamp_place: (B, 2) share of the width and of the height where it begins.
        stamp_height: height of a letter, share of the image's height.
        stamp_colour: (B, 3).
        stamp_outline: strength of a dark rim of the letters.
        chroma: share of the colour's detail that is lost.
        chroma_block: px at 640 px width over which it is averaged.
        block: strength of 16 px blocks of one brightness.
    """

    side: Tensor
    veil: Tensor
    veil_colour: Tensor
    veil_seed: Tensor
    dirt: Tensor
    dirt_cover: Tensor
    drops: Tensor
    shake: Tensor
    frame: Tensor
    sticker: Tensor
    sticker_colour: Tensor
    stamp: Tensor
    text: Tensor
    stamp_place: Tensor
    stamp_height: Tensor
    stamp_colour: Tensor
    stamp_outline: Tensor
    chroma: Tensor
    chroma_block: Tensor
    block: Tensor


def sample_glass(sampler: BatchSampler, camera: Tensor, night: Tensor) -> Glass:
    """Sample random faults of the windscreen and the recorder.

    Args:
        sampler: the randomness.
        camera: (B,) bool; elsewhere there are none but a shaken image.
        night: (B,) bool; a long exposure shakes more.
    """
    here = camera.float()

    def some(probability: float, low: float, high: float) -> Tensor:
        return here * sampler.sometimes(probability, low, high)

    amount = torch.where(night, sampler.uniform(0.0, 1.0) ** 2, 0.35 * sampler.uniform(0.0, 1.0) ** 3)
    amount = amount * torch.maximum(here, night.float()) * sampler.chance(0.6)
    shake = torch.stack([sampler.normal(std) for std in (4.0, 3.0, 0.012)], dim=1) * amount[:, None]
    below = sampler.chance(0.6)
    high = sampler.uniform(0.03, 0.075)
    top = torch.where(below, 1.0 - high * sampler.uniform(0.8, 1.6), sampler.uniform(-0.01, 0.03))
    warm = sampler.pick_from(
        [(1.0, 1.0, 1.0), (1.0, 1.0, 1.0), (1.0, 0.9, 0.1), (0.9, 0.1, 0.1), (0.1, 1.0, 0.2)]
    )
    return Glass(
        side=some(0.3, -0.7, 0.7),
        veil=some(0.35, 0.05, 0.45),
        veil_colour=sampler.uniform(0.6, 1.0, 1) * (1 + sampler.normal(0.12, 3)).clamp(0.6, 1.4),
        veil_seed=sampler.uniform(0, 1),
        dirt=some(0.25, 0.15, 0.7),
        dirt_cover=sampler.uniform(0.02, 0.2),
        drops=some(0.2, 0.3, 1.0),
        shake=shake,
        frame=some(0.12, 0.005, 0.03),
        sticker=torch.stack(
            [some(0.15, 0.02, 0.07), sampler.uniform(0.0, 1.0), sampler.uniform(-0.02, 0.02)], dim=1
        ),
        sticker_colour=sampler.uniform(0.0, 1.0, 3) ** 2,
        stamp=some(0.4, 0.6, 1.0),
        text=sample_text(sampler, STAMP_LENGTH),
        stamp_place=torch.stack([sampler.either(0.5, (0.0, 0.06), (0.1, 0.7)), top], 1),
        stamp_height=high,
        stamp_colour=warm,
        stamp_outline=sampler.sometimes(0.5, 0.4, 1.0),
        chroma=some(0.4, 0.4, 1.0),
        chroma_block=sampler.uniform(4.0, 24.0),
        block=some(0.2, 0.1, 0.45),
    )
