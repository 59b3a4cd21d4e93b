"""Robust weights of segments: a mixture of Gaussian inliers and uniformly distributed outliers.

Iterated reweighting maximises the mixture's likelihood. A segment within three standard deviations keeps a
weight near one, so clean data loses almost nothing; the weight of a gross outlier goes to zero.
"""

import math

import torch
from torch import Tensor

from lanebev.estimation.joint.measurement.observations import Observations

OUTLIER_RANGE = 0.2  # focal lengths: gross outliers spread over some 200 px at f = 1000 px
OUTLIER_ODDS = 0.3  # prior odds of a gross outlier
SCALE_PRIOR = 20.0  # number of segments as which the prior for the given sigmas counts


def squared_distance(distance: Tensor) -> Tensor:
    """Compute a segment's squared distance (…, N), the sum of those (…, 2, N) of its end points."""
    first, second = distance.unbind(-2)
    return torch.addcmul(first * first, second, second)


def scaled_variance(sigma: Tensor, scale: Tensor) -> Tensor:
    """Compute the variance s² σ² (B, N) px² for sigmas (B, N) px and noise scales (B,)."""
    return (sigma * scale.unsqueeze(-1)).square()


def inlier_log_odds(squared: Tensor, variance: Tensor, focal: Tensor) -> Tensor:
    """Compute the log odds that a segment is an inlier.

    Source: (J6).

    Args:
        squared: (..., B, N) px², sum of the squared distances of both end points.
        variance: (B, N) px², of an end point.
        focal: (B,) px.

    Returns:
        (B, N): log of inlier over outlier density.
    """
    spread = focal.square() * (OUTLIER_RANGE**2 / (2.0 * math.pi * OUTLIER_ODDS))  # px²
    return torch.sub((spread.unsqueeze(-1) / variance).log(), squared / variance, alpha=0.5)


def inlier_weights(squared: Tensor, valid: Tensor, variance: Tensor, focal: Tensor) -> Tensor:
    """Compute the probability (B, N) that a segment is an inlier, 0 where not valid."""
    return torch.where(valid, inlier_log_odds(squared, variance, focal).sigmoid(), 0.0)


def log_likelihood(squared: Tensor, valid: Tensor, weight: Tensor, variance: Tensor, focal: Tensor) -> Tensor:
    """Compute the log likelihood ratio (B,) of a frame: the mixture against outliers alone."""
    log_odds = inlier_log_odds(squared, variance, focal)
    return (weight * torch.where(valid, torch.nn.functional.softplus(log_odds), 0.0)).sum(-1)


def noise_scale(squared: Tensor, sigma: Tensor, weight: Tensor) -> Tensor:
    """Compute the factor by which the residuals of inliers exceed their sigmas, at least 1.

    Source: (J7).

    Args:
        squared: (B, N) px², see :func:`inlier_log_odds`.
        sigma: (B, N) px.
        weight: (B, N) in [0, 1].

    Returns:
        (B,) root of the mean squared normalised distance, drawn to 1 by ``SCALE_PRIOR`` segments.
    """
    chi2 = squared / sigma.square()
    total = SCALE_PRIOR + 0.5 * (weight * chi2).sum(-1)
    return (total / (SCALE_PRIOR + weight.sum(-1))).sqrt().clamp(min=1.0)


def anneal_scale(scale: Tensor, fitted: Tensor) -> Tensor:
    """Lower the noise scale (B,) to the fitted one, by a factor of 2 at most; never raise it."""
    return torch.minimum(torch.maximum(fitted, 0.5 * scale), scale)


def reweigh(
    squared: Tensor, valid: Tensor, seen: Observations, scale: Tensor, blur: float | Tensor = 0.0
) -> tuple[Tensor, Tensor]:
    """Weigh the segments of a frame, and lower the noise scale to that of its inliers.

    Source: (J6) and (J7).

    Args:
        squared: (B, N) px², see :func:`inlier_log_odds`.
        valid: (B, N) bool.
        seen: what was observed.
        scale: (B,), noise scale so far.
        blur: (B, N) px² or a number, variance that no end point owes to its noise.

    Returns:
        (B, N) probability of an inlier, and (B,) noise scale.
    """
    trust = inlier_weights(squared, valid, scaled_variance(seen.sigma, scale) + blur, seen.focal)
    return trust, anneal_scale(scale, noise_scale(squared, seen.sigma, trust * seen.weight))


def start_scale(distance: Tensor, sigma: Tensor, weight: Tensor) -> Tensor:
    """Compute the noise scale to begin reweighting with, from the 30 % quantile of the residuals.

    It is right with up to two outliers in three.

    Args:
        distance: (..., B, 2, N) px, at the predicted parameters.
        sigma: (B, N) px.
        weight: (B, N), 0 where there is nothing.

    Returns:
        (..., B) at least 1.
    """
    there = weight > 0
    worst = torch.where(there, distance.abs().amax(-2) / sigma, torch.inf)  # (B, N)
    count = there.sum(-1, keepdim=True)
    rank = (0.3 * count.to(distance.dtype)).long().clamp(max=worst.shape[-1] - 1).expand(*worst.shape[:-1], 1)
    value = worst.sort(dim=-1).values.gather(-1, rank).squeeze(-1)
    # 30 % of max(|a|, |b|) lies at the root-30 % quantile of |N|, 0.75
    return torch.where(value.isfinite(), value / 0.75, 1.0).clamp(min=1.0)
