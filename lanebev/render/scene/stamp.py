"""Texts that recorders burn into the image: date, time, speed."""

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
    digit, letter = (
        sampler.pick([1.0] * 10, length),
        first + sampler.pick([1.0] * (len(LETTERS) - first), length),
    )
    text = torch.where(pattern == -1, digit, torch.where(pattern == -2, letter, pattern))
    return text.where(text >= 0, blank)
