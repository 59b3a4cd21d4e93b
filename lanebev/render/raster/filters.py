"""Blurring images, each row of a batch by its own width."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

_REACH = 2.6  # standard deviations at which a Gaussian is cut off


def gaussian_blur(image: Tensor, std: Tensor, largest: float) -> Tensor:
    """Blur images by Gaussians; the border is repeated.

    A sum of shifted images, since depthwise convolutions are slow on processors.

    Args:
        image: (B, C, H, W).
        std: (B,) px; 0 leaves a row as it is.
        largest: largest value of ``std``, px, on the host.
    """
    reach = max(1, round(_REACH * largest))
    place = torch.arange(reach + 1, device=image.device, dtype=image.dtype)
    weight = torch.exp(-0.5 * (place / std.clamp(min=1e-3)[:, None]).square())
    weight = weight * (place <= (_REACH * std).round().clamp(min=1)[:, None])  # a row's own, whatever others'
    weight = weight / (2 * weight.sum(1, keepdim=True) - weight[:, :1])
    weight = weight.T[..., None, None, None]  # (reach + 1, B, 1, 1, 1)
    return _weighted(_weighted(image, weight, 3), weight, 2)


def _weighted(image: Tensor, weight: Tensor, dim: int) -> Tensor:
    """Sum an image shifted both ways by k along a dimension, times the k-th weight."""
    reach, size = len(weight) - 1, image.shape[dim]
    padding = (reach, reach, 0, 0) if dim == 3 else (0, 0, reach, reach)
    padded = functional.pad(image, padding, mode="replicate")
    total = padded.narrow(dim, reach, size) * weight[0]
    for k in range(1, reach + 1):
        pair = padded.narrow(dim, reach - k, size) + padded.narrow(dim, reach + k, size)
        total.addcmul_(pair, weight[k])
    return total
