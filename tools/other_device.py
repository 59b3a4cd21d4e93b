"""A simulated device: tensors that claim to be elsewhere, on a machine that has only a CPU.

Every operation is carried out on the CPU, but tensors of "elsewhere" and those of the CPU must not meet, as
on a real accelerator; what waits for the device, and what is launched on it, is counted.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any
from unittest import mock

import torch
import torch._dynamo  # a dispatch mode imports it, and its annotations need torch.Generator as it is
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

ELSEWHERE = torch.device("meta")
_COPIES = ("aten::_to_copy", "aten::copy_")
_INTO_TABLES = ("aten::scatter_", "aten::index_copy_", "aten::index_put_", "aten::index_add_")
_FROM_TABLES = ("aten::index_select", "aten::gather", "aten::index", "aten::take")
_WAITS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::equal")


class Elsewhere(torch.Tensor):
    """A tensor that says it is on :data:`ELSEWHERE`; its values are in ``here``."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> Elsewhere:
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            here.size(),
            strides=here.stride(),
            storage_offset=here.storage_offset(),
            dtype=here.dtype,
            device=ELSEWHERE,
        )
        made.here = here
        return made

    def tolist(self) -> Any:
        """Return the values, after waiting for the device."""
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        raise AssertionError(f"{func}: used outside of OtherDevice")


class OtherDevice(TorchDispatchMode):
    """Context in which ``device=ELSEWHERE`` works.

    Attributes:
        launches: operations carried out elsewhere that compute, by name; views do not.
        waits: those of them that wait for the device.
        read_and_written: bytes of the elements that they read and write, about.
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.launches: Counter[str] = Counter()
        self.waits: Counter[str] = Counter()
        self.read_and_written = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = func._schema.name
        values, _ = tree_flatten((args, kwargs))
        tensors = [v for v in values if isinstance(v, Tensor)]
        away = any(isinstance(t, Elsewhere) for t in tensors)
        _check_one_device(name, tensors)
        to_elsewhere = _is_for_elsewhere(name, args, kwargs.get("device"), away)
        if kwargs.get("device") is not None:
            kwargs["device"] = torch.device("cpu")
        views = any(r.alias_info is not None and not r.alias_info.is_write for r in func._schema.returns)
        is_launch = (away or to_elsewhere) and not views
        self.launches.update([name] if is_launch else [])
        if away and (name in _WAITS or (name == "aten::_to_copy" and not to_elsewhere)):
            self.waits[name] += 1
        plain_args, plain = tree_map(lambda v: v.here if isinstance(v, Elsewhere) else v, (args, kwargs))
        result = func(*plain_args, **plain)
        if is_launch:
            self.read_and_written += _bytes(name, plain_args, result)
        if not to_elsewhere or name == "aten::_local_scalar_dense":
            return result
        first = args[0] if args and func._schema.is_mutable else None
        if isinstance(first, Elsewhere) and any(v is first.here for v in tree_flatten(result)[0][:1]):
            return first
        return tree_map(lambda v: Elsewhere(v) if isinstance(v, Tensor) else v, result)


def _is_for_elsewhere(name: str, args: Any, target: Any, away: bool) -> bool:
    """Return whether the result of an operation is elsewhere: by its target, else by its tensors."""
    if name == "aten::copy_":
        return isinstance(args[0], Elsewhere)
    return away if target is None else ELSEWHERE in (target, str(target))


def _check_one_device(name: str, tensors: list[Tensor]) -> None:
    """Refuse operations, other than copies, on tensors of both devices; numbers may come from the host."""
    strangers = [t for t in tensors if not isinstance(t, Elsewhere) and t.ndim > 0]
    if strangers and any(isinstance(t, Elsewhere) for t in tensors) and name not in _COPIES:
        shapes = [(tuple(t.shape), t.device.type) for t in tensors]
        raise AssertionError(f"{name}: tensors of two devices meet: {shapes}")


def _bytes(name: str, args: tuple[Any, ...], result: Any) -> int:
    """Return the bytes that an operation reads and writes; of a table, those of the elements it looks up."""
    tensors = [value for value in tree_flatten((args, result))[0] if isinstance(value, Tensor)]
    if name in _INTO_TABLES:
        return 3 * _own_bytes(tensors[-2])  # the new values, read and written, and their places
    if name in _FROM_TABLES:
        return 3 * _own_bytes(tensors[-1])
    return sum(map(_own_bytes, tensors))


def _own_bytes(tensor: Tensor) -> int:
    """Return the bytes of a tensor's elements; those that it repeats count once."""
    strides = zip(tensor.shape, tensor.stride(), strict=True)
    return tensor.element_size() * math.prod(size for size, stride in strides if stride)


@contextmanager
def other_device() -> Iterator[OtherDevice]:
    """Enter a context in which generators and autocast do not know the simulated device."""

    def of_cpu(device: Any = None) -> torch.Generator:
        return torch._C.Generator()

    with (
        OtherDevice() as device,
        mock.patch.object(torch, "Generator", of_cpu),
        mock.patch.object(torch, "autocast", return_value=nullcontext()),
    ):
        yield device
