"""Robust weights of segments: a mixture of Gaussian inliers and uniformly distributed outliers.

Iterated reweighting maximises the mixture's likelihood. A segment within three standard deviations keeps a
weight near one, so clean data loses almost nothing; the weight of a gross outlier goes to zero.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

OUTLIER_RANGE = 0.2  # of the focal length: gross outliers spread over some 200 px at f = 1000 px
OUTLIER_ODDS = 0.3  # prior odds of a gross outlier
SCALE_PRIOR = 20.0  # segments' worth of belief in the sigmas as they were given


def inlier_log_odds(distance: Tensor, sigma: Tensor, scale: Tensor, focal: Tensor) -> Tensor:
    """Compute the log odds that a segment is an inlier.

    Source: (J6).

    Args:
        distance: (B, N, 2) px, of both end points.
        sigma: (B, N) px.
        scale: (B,) factor on sigma.
        focal: (B,) px.

    Returns:
        (B, N): log of inlier over outlier density.
    """
    variance = (sigma * scale.unsqueeze(-1)).square()
    spread = (OUTLIER_RANGE * focal).square() / (2.0 * math.pi * OUTLIER_ODDS)
    chi2 = distance.square().sum(-1) / variance
    return torch.sub((spread.unsqueeze(-1) / variance).log(), chi2, alpha=0.5)


def inlier_weights(distance: Tensor, valid: Tensor, sigma: Tensor, scale: Tensor, focal: Tensor) -> Tensor:
    """Compute the probability (B, N) that a segment is an inlier, 0 where not valid."""
    return torch.where(valid, inlier_log_odds(distance, sigma, scale, focal).sigmoid(), 0.0)


def log_likelihood(
    distance: Tensor, valid: Tensor, weight: Tensor, sigma: Tensor, scale: Tensor, focal: Tensor
) -> Tensor:
    """Compute the log likelihood ratio (B,) of a frame: the mixture against outliers alone."""
    log_odds = inlier_log_odds(distance, sigma, scale, focal)
    return (weight * torch.where(valid, torch.nn.functional.softplus(log_odds), 0.0)).sum(-1)


def noise_scale(distance: Tensor, sigma: Tensor, weight: Tensor) -> Tensor:
    """Compute the factor by which the residuals of inliers exceed their sigmas, at least 1.

    Source: (J7).

    Args:
        distance: (B, N, 2) px.
        sigma: (B, N) px.
        weight: (B, N) in [0, 1].

    Returns:
        (B,) root of the mean squared normalised distance, drawn to 1 by ``SCALE_PRIOR`` segments.
    """
    chi2 = distance.square().sum(-1) / sigma.square()
    total = SCALE_PRIOR + 0.5 * (weight * chi2).sum(-1)
    return (total / (SCALE_PRIOR + weight.sum(-1))).sqrt().clamp(min=1.0)


def anneal_scale(scale: Tensor, fitted: Tensor) -> Tensor:
    """Lower the noise scale (B,) to the fitted one, by a factor of 2 at most; never raise it."""
    return torch.minimum(torch.maximum(fitted, 0.5 * scale), scale)


def start_scale(distance: Tensor, sigma: Tensor, weight: Tensor) -> Tensor:
    """Compute the noise scale to begin reweighting with, from the 30 % quantile of the residuals.

    It is right with up to two outliers in three.

    Args:
        distance: (..., B, N, 2) px, at the predicted parameters.
        sigma: (B, N) px.
        weight: (B, N), 0 where there is nothing.

    Returns:
        (..., B) at least 1.
    """
    there = weight > 0
    worst = (distance.abs().amax(-1) / sigma).masked_fill(~there, torch.inf)  # (B, N)
    count = there.sum(-1, keepdim=True)
    rank = (0.3 * count.to(distance.dtype)).long().clamp(max=worst.shape[-1] - 1).expand(*worst.shape[:-1], 1)
    value = worst.sort(dim=-1).values.gather(-1, rank).squeeze(-1)
    # 30 % of max(|a|, |b|) lies at the root-30 % quantile of |N|, 0.75
    return torch.where(value.isfinite(), value / 0.75, 1.0).clamp(min=1.0)
