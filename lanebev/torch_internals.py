"""The private names of torch that the package uses, since there are no public ones (torch 2.13)."""

from typing import TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils import _pytree

TupleClass = TypeVar("TupleClass", bound=type)


def handled_by_mode() -> bool:
    """Return whether a context handles every operation itself, as ``FakeTensorMode`` and ``make_fx`` do.

    Tensors may then have no numbers of their own, or numbers that stand for all others.
    """
    return bool(torch._C._len_torch_dispatch_stack())


def is_batched_by_vmap(value: Tensor) -> bool:
    """Return whether ``torch.vmap`` wraps this tensor, which then has no numbers of its own."""
    functorch = torch._C._functorch
    while functorch.is_functorch_wrapped_tensor(value):
        if functorch.is_batchedtensor(value):
            return True
        value = functorch.get_unwrapped(value)
    return False


def is_in_transform() -> bool:
    """Return whether a transform of ``torch.func`` is active, such as ``vmap``, ``grad`` or ``jvp``."""
    return torch._C._are_functorch_transforms_active()


def is_in_forward_mode() -> bool:
    """Return whether derivatives are computed forwards, as by ``torch.func.jvp``."""
    return forward_ad._current_level >= 0


def register_pytree(cls: TupleClass) -> TupleClass:
    """Register a NamedTuple of tensors, so that ``torch.export.save`` and ``torch.load`` accept it."""
    _pytree._register_namedtuple(cls, serialized_type_name=f"lanebev.{cls.__name__}")
    torch.serialization.add_safe_globals([cls])
    return cls
