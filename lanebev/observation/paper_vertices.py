"""The paper's own vertices of lane boundaries: threshold, mean of on-pixels, sampling. Not differentiable."""

import torch
from torch import Tensor

from lanebev.batch import order_true_first


def paper_vertices(probabilities: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Compute the mean position of each row's on-pixels, and sample vertices evenly from these rows.

    Source: Sec. VI-A, "for each lane boundary whose probability is larger than 0.5, we extract vertices by
    searching through the mean position of on-pixels and then sample representative vertices". The paper
    states neither rows nor even sampling. :func:`~lanebev.observation.scans.scan_vertices` is the
    differentiable rule that :class:`lanebev.LineExtractor` uses.

    Args:
        probabilities: (B, L, h, w) in [0, 1], without background.
        count: V, vertices to sample; a boundary on fewer rows gives one per row.

    Returns:
        (B, L, V, 2) px (x, y) of the map, from the top to the bottom, and (B, L, V) bool, where there is one.
    """
    on = (probabilities > 0.5).to(probabilities)
    columns = torch.arange(on.shape[-1], dtype=on.dtype, device=on.device)
    mass = on.sum(-1)  # (B, L, h)
    x = (on * columns).sum(-1) / mass.clamp(min=1)
    seen = mass > 0
    total = seen.sum(-1, keepdim=True)  # (B, L, 1) rows
    order = order_true_first(seen)  # rows with any first, from the top
    index = torch.arange(count, device=on.device)
    chosen = torch.where(total > count, index * (total - 1) // max(count - 1, 1), index)
    rows = order.gather(-1, chosen.clamp(max=on.shape[-2] - 1))  # (B, L, V)
    return torch.stack([x.gather(-1, rows), rows.to(x)], dim=-1), index < total
