"""Operations on the rows of a batch that all packages share."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntFlag
from typing import TypeVar, cast

import torch
from torch import Tensor

T = TypeVar("T")
FlagT = TypeVar("FlagT", bound=IntFlag)


def select_rows(rows: Tensor, yes: T, no: T) -> T:
    """Take whole rows of ``yes`` where ``rows`` holds and of ``no`` elsewhere.

    Args:
        rows: (B,) bool.
        yes: (B, ...) tensor, or a NamedTuple of such.
        no: values elsewhere, of the same shapes.
    """
    if isinstance(yes, Tensor):
        mask = rows.view(-1, *[1] * (yes.ndim - 1)) if yes.ndim > 1 else rows
        return cast(T, torch.where(mask, yes, cast(Tensor, no)))
    pairs = zip(cast("tuple[Tensor, ...]", yes), cast("tuple[Tensor, ...]", no), strict=True)
    return type(yes)(*(select_rows(rows, *pair) for pair in pairs))


def may_skip(wanted: Tensor) -> bool:
    """Tell whether a costly step, such as a search, can be left out because no row wants its result.

    The one place where the maths asks the device. A compiled or exported program cannot, and always searches.
    """
    return not torch.compiler.is_compiling() and not bool(wanted.any())


def flags(conditions: Mapping[FlagT, Tensor]) -> Tensor:
    """Return the bits of the reasons whose conditions (B,) hold, (B,) int64; no two share a bit."""
    holds = torch.stack(list(conditions.values()), dim=-1)
    bits = torch.tensor([int(reason) for reason in conditions], device=holds.device)
    total: Tensor = (holds * bits).sum(-1)
    return total


def flag(condition: Tensor, reason: IntFlag) -> Tensor:
    """Return the reason's bit as int64 where the condition holds, else 0."""
    return condition.to(torch.int64) * int(reason)


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """Compute the lower median over the last dimension of the finite entries in the mask, or 0."""
    mask = mask & values.isfinite()
    ordered = values.masked_fill(~mask, torch.inf).sort(dim=-1).values
    middle = ((mask.sum(-1, keepdim=True) - 1) // 2).clamp(min=0)
    median = ordered.gather(-1, middle).squeeze(-1)
    return torch.where(median.isfinite(), median, 0.0)


def order_true_first(mask: Tensor) -> Tensor:
    """Return indices (..., N) that sort the true entries of a mask first, in their order.

    By keys that all differ, since ONNX has no stable sort.
    """
    count = mask.shape[-1]
    place = torch.arange(count, device=mask.device)
    return torch.where(mask, place, place + count).argsort(dim=-1)
