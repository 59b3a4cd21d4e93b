"""What is painted: one radiance and one depth for every pixel of a batch."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Canvas(NamedTuple):
    """The pixels of B images of H x W, P = B·H·W of them, row-major; painted into in place.

    Attributes:
        radiance: (3, P) linear.
        distance: (2, P) m, Z of what is there, infinite in the sky; and Z of the nearest thing that is not
            the road, infinite where there is none.
    """

    radiance: Tensor
    distance: Tensor

    @property
    def depth(self) -> Tensor:
        """(P,) m, Z of what is there."""
        return self.distance[0]

    @property
    def blocked(self) -> Tensor:
        """(P,) m, Z of the nearest thing that is not the road."""
        return self.distance[1]


def empty_canvas(pixels: int, device: torch.device) -> Canvas:
    """Make a canvas of nothing."""
    distance = torch.full((2, pixels), torch.inf, device=device)
    return Canvas(torch.zeros(3, pixels, device=device), distance)
