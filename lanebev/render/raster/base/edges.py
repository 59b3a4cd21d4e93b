"""Shares of pixels within and beyond edges, by a box of the pixel's size."""

import torch
from torch import Tensor


def band(position: Tensor, low: Tensor, high: Tensor, reach: Tensor) -> Tensor:
    """Compute the share of a pixel between ``low`` and ``high``, all m, over a box of ``reach`` m."""
    top, bottom = torch.minimum(position + 0.5 * reach, high), torch.maximum(position - 0.5 * reach, low)
    return ((top - bottom) / reach).clamp(0, 1)


def beyond(position: Tensor, edge: Tensor, reach: Tensor) -> Tensor:
    """Compute the share of a pixel that lies beyond an edge."""
    return ((position - edge) / reach + 0.5).clamp(0, 1)
