"""Losses on per-boundary logits."""

import torch
from torch import Tensor

_LEAST_MASS = 0.5  # of labels, below which a row does not count


def boundary_cross_entropy(
    logits: Tensor, target: Tensor, weight: Tensor, class_weight: Tensor | None = None
) -> Tensor:
    """Compute the cross-entropy with soft labels, mean over the pixels that count.

    Source: Sect. "Experiments", "a cross entropy loss". Weighting classes moves the probabilities away from
    frequencies; :func:`unweighted_bias` undoes it.

    Args:
        logits: (B, 1+L, h, w).
        target: (B, 1+L, h, w), sums to one over channels.
        weight: (B, h, w).
        class_weight: (1+L,), or None for ones.
    """
    log_p = logits.log_softmax(1)
    scaled = target if class_weight is None else target * class_weight.view(1, -1, 1, 1)
    return -((scaled * log_p).sum(1) * weight).sum() / weight.sum().clamp(min=1)


def row_cross_entropy(logits: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Compute how far each boundary's share of a row's probability is from its crossing of the row.

    Each row of each boundary that is there counts the same, however thin its stripe: this says where, the
    pixels' cross-entropy says whether.

    Args:
        logits: (B, 1+L, h, w).
        target: (B, 1+L, h, w).
        weight: (B, h, w).

    Returns:
        Mean Kullback-Leibler divergence over counting rows.
    """
    log_p = (logits.log_softmax(1)[:, 1:] + (weight.unsqueeze(1) - 1) * 30).log_softmax(-1)  # over columns
    share = target[:, 1:] * weight.unsqueeze(1)
    mass = share.sum(-1, keepdim=True)
    counts = (mass > _LEAST_MASS).squeeze(-1)
    share = share / mass.clamp(min=_LEAST_MASS)
    divergence = (torch.special.xlogy(share, share) - share * log_p).sum(-1)
    mean: Tensor = (divergence * counts).sum() / counts.sum().clamp(min=1)
    return mean


def unweighted_bias(class_weight: Tensor) -> Tensor:
    """Return the bias that makes logits trained with class weights a frequency by softmax (paper.md T4).

    With weights w the loss is least at p ∝ w q; adding -log w makes it p = q.
    """
    return -class_weight.log()
