"""How well lanes are found."""

from __future__ import annotations

import torch
from torch import Tensor


def point_recall(
    probabilities: Tensor, target: Tensor, tolerance: float = 2.5, least: float = 0.5
) -> tuple[Tensor, Tensor]:
    """Rows of each boundary that are found.

    A row where a boundary's stripe has its mass is found if at least half of that mass of probability lies
    within the tolerance of the stripe's centre.

    Args:
        probabilities: (B, L, h, w).
        target: (B, L, h, w) in [0, 1].
        tolerance: label px.
        least: mass, in label px, below which a row has no boundary.

    Returns:
        found, there: (B, L) counts of rows.
    """
    columns = torch.arange(target.shape[-1], dtype=target.dtype, device=target.device)
    mass = target.sum(-1)
    centre = (target * columns).sum(-1) / mass.clamp(min=1e-6)
    near = (columns - centre.unsqueeze(-1)).abs() <= tolerance
    there = mass > least
    found = there & ((probabilities * near).sum(-1) >= 0.5 * (target * near).sum(-1))
    return found.sum(-1).to(target.dtype), there.sum(-1).to(target.dtype)
