"""Small operations on the rows of a batch that all rooms share."""

from __future__ import annotations

from enum import IntFlag

import torch
from torch import Tensor


def where(row: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """(B, ...) whole rows of ``yes`` where ``row`` (B,) holds, else of ``no``."""
    return torch.where(row.view(-1, *[1] * (yes.ndim - 1)), yes, no)


def may_skip(wanted: Tensor) -> bool:
    """Whether no row wants what is costly, such as a search: every row would discard its result.

    The one place where the maths asks the device. A compiled or exported program cannot, and always searches.
    """
    return not torch.compiler.is_compiling() and not bool(wanted.any())


def flag(condition: Tensor, reason: IntFlag) -> Tensor:
    """The reason's bit as int64 where the condition holds, else 0."""
    return condition.to(torch.int64) * int(reason)


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """Lower median over the last dimension of the finite entries in the mask; 0 where there are none."""
    mask = mask & values.isfinite()
    ordered = values.masked_fill(~mask, torch.inf).sort(dim=-1).values
    middle = ((mask.sum(-1, keepdim=True) - 1) // 2).clamp(min=0)
    median = ordered.gather(-1, middle).squeeze(-1)
    return torch.where(median.isfinite(), median, 0.0)
