"""Keep geometry in single or double precision: bfloat16's 8 bits cannot represent a pixel among 1920."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import reduce, wraps
from typing import ParamSpec, TypeVar, cast

import torch
from torch import Tensor

from lanebev.tensors import all_tensors, map_tensors

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function of tensors: autocast off, and its floating arguments in one dtype.

    That is the widest of theirs, and float32 at least; tensors in NamedTuples count. Integers and booleans
    stay. Gradients flow back in the dtypes that came.
    """

    @wraps(function)
    def precise(*args: P.args, **kwargs: P.kwargs) -> R:
        values = all_tensors((*args, *kwargs.values()))
        tensors = [value for value in values if value.is_floating_point()]
        if _is_precise(tensors):
            return function(*args, **kwargs)
        dtype = common_dtype(*tensors)
        raised = [cast_floating(value, dtype) for value in args]
        named = {name: cast_floating(value, dtype) for name, value in kwargs.items()}
        with autocast_off(tensors[0].device if tensors else torch.device("cpu")):
            return cast("Callable[..., R]", function)(*raised, **named)

    return precise


def _is_precise(tensors: list[Tensor]) -> bool:
    """Return whether there is nothing to raise: one dtype of full precision, and no autocast of it.

    Autocast leaves double precision as it is. A compiled or exported program may be called under autocast
    later, so single precision in it is never sure.
    """
    dtypes = {tensor.dtype for tensor in tensors}
    if dtypes == {torch.float64}:
        return True
    if torch.compiler.is_compiling() or dtypes != {torch.float32}:
        return False
    return not autocast_is_on(tensors[0].device)


def autocast_is_on(device: torch.device) -> bool:
    """Return whether autocast is on for a device; some, such as meta, have none."""
    return torch.amp.is_autocast_available(device.type) and torch.is_autocast_enabled(device.type)


def autocast_off(device: torch.device, dtype: torch.dtype = torch.float32) -> AbstractContextManager[object]:
    """Return a context in which operations on ``device`` keep the dtype of their arguments, ``dtype``.

    Autocast leaves double precision as it is, so an exported program needs no region for it (one with a
    ``torch.cond`` inside could not be saved, torch 2.13).
    """
    if dtype == torch.float64 or not torch.amp.is_autocast_available(device.type):
        return nullcontext()
    return torch.autocast(device.type, enabled=False)


def common_dtype(*tensors: Tensor) -> torch.dtype:
    """Return the widest floating dtype among the tensors, and at least float32."""
    return reduce(torch.promote_types, (tensor.dtype for tensor in tensors), torch.float32)


def widest_dtype(device: torch.device) -> torch.dtype:
    """Return double precision, or single where a device has no double (MPS)."""
    return torch.float32 if device.type == "mps" else torch.float64


def cast_floating(value: T, dtype: torch.dtype) -> T:
    """Cast a floating tensor, or those of a NamedTuple, to a dtype; return anything else as it is."""

    def cast_part(part: Tensor) -> Tensor:
        return part.to(dtype) if part.dtype != dtype and part.is_floating_point() else part

    return map_tensors(cast_part, value)
