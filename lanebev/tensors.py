"""Generic operations on tensors and NamedTuples of tensors."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from torch import Tensor

T = TypeVar("T")


def map_tensors(function: Callable[[Tensor], Tensor], value: T) -> T:
    """Apply a function to a tensor, or to every tensor of a NamedTuple; return anything else as it is."""
    if isinstance(value, Tensor):
        return cast(T, function(value))
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return cast(T, type(value)(*(map_tensors(function, part) for part in value)))
    return value
