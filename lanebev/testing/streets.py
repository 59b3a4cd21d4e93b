"""Streets whose boundaries are not parallel: each wanders from side to side along the road."""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random

import torch
from torch import Tensor

_LENGTHS = (60.0, 200.0)  # m, shortest and longest wavelength


def wandering(seed: int, std: float, num: int = 6, terms: int = 3) -> Callable[[Tensor], Tensor]:
    """Draw how far each boundary is beside its place along a street: a sum of sinusoids.

    Wavelengths are uniform between 60 and 200 m, phases uniform. With 10 cm, headings have a standard
    deviation of 6 mrad.

    Args:
        seed: seed of the draw.
        std: standard deviation, m.
        num: boundaries.
        terms: sinusoids of each.

    Returns:
        a function of the way along the street (G,) m to the lateral displacements (num, G) m.
    """
    random = Random(seed)
    waves = [[(random.uniform(*_LENGTHS), random.random()) for _ in range(terms)] for _ in range(num)]
    length, phase = torch.tensor(waves, dtype=torch.float64).unsqueeze(-1).unbind(2)  # (num, terms, 1) each
    size = std * math.sqrt(2 / terms)
    return lambda way: size * (2 * math.pi * (way / length + phase)).sin().sum(1)
