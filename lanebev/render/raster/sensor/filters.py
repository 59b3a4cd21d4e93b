"""Blurring images, each row of a batch by its own width."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

_REACH = 2.6  # standard deviations at which a Gaussian is cut off


def gaussian_blur(image: Tensor, std: Tensor, reach: Sequence[int]) -> Tensor:
    """Blur images by Gaussians; the border is repeated.

    A sum of shifted images, since depthwise convolutions are slow on processors.

    Args:
        image: (B, C, H, W), those with the largest reach first.
        std: (B,) px.
        reach: B of :func:`blur_reach`, on the host.
    """
    place = torch.arange(reach[0] + 1, device=image.device, dtype=image.dtype)
    weight = torch.exp(-0.5 * (place / std.clamp(min=1e-3)[:, None]).square())
    weight = weight * (place <= (_REACH * std).round().clamp(min=1)[:, None])  # a row's own, whatever others'
    weight = weight / (2 * weight.sum(1, keepdim=True) - weight[:, :1])
    weight = weight.T[..., None, None, None]  # (reach + 1, B, 1, 1, 1)
    rows = [sum(each >= k for each in reach) for k in range(reach[0] + 1)]
    return _weighted(_weighted(image, weight, rows, 3), weight, rows, 2)


def blur_reach(std: float) -> int:
    """Return how far a Gaussian of a standard deviation reaches, px."""
    return max(1, round(_REACH * std))


def _weighted(image: Tensor, weight: Tensor, rows: list[int], dim: int) -> Tensor:
    """Sum images shifted both ways by k px, the first rows[k] of them, times the k-th weight."""
    reach, size = len(weight) - 1, image.shape[dim]
    padding = (reach, reach, 0, 0) if dim == 3 else (0, 0, reach, reach)
    padded = functional.pad(image, padding, mode="replicate")
    total = padded.narrow(dim, reach, size) * weight[0]
    for k in range(1, reach + 1):
        part = padded[: rows[k]]
        pair = part.narrow(dim, reach - k, size) + part.narrow(dim, reach + k, size)
        total[: rows[k]].addcmul_(pair, weight[k, : rows[k]])
    return total
