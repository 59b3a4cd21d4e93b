"""Shares of pixels that stripes, dashes and what is beyond edges cover, over the pixel's footprint."""

import torch
from torch import Tensor

PSF = 0.5  # px, standard deviation of the pixel's Gaussian: keeps thin stripes' centroids unbiased


def stripe_coverage(distance: Tensor, width: Tensor | float, footprint: Tensor) -> Tensor:
    """Compute the share of a Gaussian pixel that a stripe covers.

    Args:
        distance: m from the stripe's centre line.
        width: m.
        footprint: m per pixel, across the stripe.
    """
    scale = (PSF * 2**0.5 * footprint).reciprocal()
    half = 0.5 * width
    return 0.5 * (torch.erf((distance + half) * scale) - torch.erf((distance - half) * scale))


def dash_coverage(along: Tensor, length: Tensor | float, period: Tensor, footprint: Tensor) -> Tensor:
    """Compute the share of a pixel that a periodic dash covers, integrated exactly along the road."""
    reach = 0.5 * footprint.clamp(min=1e-3)

    def painted_up_to(s: Tensor) -> Tensor:
        whole = (s / period).floor()
        return whole * length + (s - whole * period).clamp(max=length)

    return (painted_up_to(along + reach) - painted_up_to(along - reach)) / (2 * reach)


def band(position: Tensor, low: Tensor, high: Tensor, reach: Tensor) -> Tensor:
    """Compute the share of a pixel between ``low`` and ``high``, all m, over a box of ``reach`` m."""
    top, bottom = torch.minimum(position + 0.5 * reach, high), torch.maximum(position - 0.5 * reach, low)
    return ((top - bottom) / reach).clamp(0, 1)


def beyond(position: Tensor, edge: Tensor | float, reach: Tensor) -> Tensor:
    """Compute the share of a pixel that lies beyond an edge."""
    return ((position - edge) / reach + 0.5).clamp(0, 1)
