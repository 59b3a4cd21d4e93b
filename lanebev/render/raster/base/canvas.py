"""The painted image: one radiance and one depth for every pixel of a batch."""

from typing import NamedTuple

import torch
from torch import Tensor


class Canvas(NamedTuple):
    """The pixels of B images of H x W, P = B·H·W of them, row-major; painted into in place.

    Attributes:
        planes: (5, P) the linear radiance; Z of what is there, m, infinite in the sky; and Z of the nearest
            thing that is not the road, infinite where there is none.
    """

    planes: Tensor

    @property
    def radiance(self) -> Tensor:
        """(3, P) linear."""
        return self.planes[:3]

    @property
    def depth(self) -> Tensor:
        """(P,) m, Z of what is there."""
        return self.planes[3]

    @property
    def blocked(self) -> Tensor:
        """(P,) m, Z of the nearest thing that is not the road."""
        return self.planes[4]


def empty_canvas(pixels: int, device: torch.device) -> Canvas:
    """Make a black canvas on which everything is infinitely far away."""
    planes = torch.full((5, pixels), torch.inf, device=device)
    planes[:3] = 0
    return Canvas(planes)
