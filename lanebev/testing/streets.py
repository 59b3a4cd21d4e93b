"""Streets whose boundaries are not parallel: each wanders from side to side along the road."""

import math
from collections.abc import Callable
from random import Random

import torch
from torch import Tensor

_LENGTHS = (60.0, 200.0)  # m, shortest and longest wavelength
_TERMS = 3  # sinusoids of each boundary


def wandering(seed: int, std: float) -> Callable[[Tensor], Tensor]:
    """Draw how far each boundary is beside its place along a street: a sum of three sinusoids.

    Wavelengths are uniform between 60 and 200 m, phases uniform. With 10 cm, headings have a standard
    deviation of 6 mrad.

    Args:
        seed: seed of the draw.
        std: standard deviation, m.

    Returns:
        a function of the way along the street (G,) m to the lateral displacements (6, G) m.
    """
    random = Random(seed)
    waves = [[(random.uniform(*_LENGTHS), random.random()) for _ in range(_TERMS)] for _ in range(6)]
    length, phase = torch.tensor(waves, dtype=torch.float64).unsqueeze(-1).unbind(2)  # (6, 3, 1) each
    size = std * math.sqrt(2 / _TERMS)
    return lambda way: size * (2 * math.pi * (way / length + phase)).sin().sum(1)
