"""Generic operations on tensors and NamedTuples of tensors."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import lru_cache, wraps
from threading import Lock, local
from typing import Any, ParamSpec, TypeVar, cast

import torch
from torch import Tensor

from lanebev.torch_internals import handled_by_mode

P = ParamSpec("P")
T = TypeVar("T")

_INLINED = 8  # numbers of a constant, at most, that inductor writes into its code

_lock = Lock()
_before: list[int] = []  # numbers of threads before the blocks of one_thread under way; the first one counts
_block = local()  # attribute `active` in a Python thread that is in such a block


def map_tensors(function: Callable[[Tensor], Tensor], value: T) -> T:
    """Apply a function to a tensor, or to every tensor of a NamedTuple; return anything else as it is."""
    if isinstance(value, Tensor):
        return cast(T, function(value))
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return cast(T, type(value)(*(map_tensors(function, part) for part in value)))
    return value


def join_tensors(function: Callable[[list[Tensor]], Tensor], values: Sequence[T]) -> T:
    """Apply a function, such as ``torch.cat``, to corresponding tensors of NamedTuples.

    What is no tensor is that of the first one.
    """
    first: Any = values[0]
    if isinstance(first, Tensor):
        return cast(T, function(cast("list[Tensor]", list(values))))
    if isinstance(first, tuple) and hasattr(first, "_fields"):
        parts = zip(*cast("Sequence[tuple[Any, ...]]", values), strict=True)
        return cast(T, type(first)(*(join_tensors(function, part) for part in parts)))
    return values[0]


def all_tensors(values: Iterable[object]) -> Iterator[Tensor]:
    """Yield the tensors among values, those of NamedTuples too, in order."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, tuple) and hasattr(value, "_fields"):
            yield from all_tensors(value)


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread of the CPU in a block or a decorated function.

    For many operations on small tensors: several threads save little, and where other processes compute as
    well, each operation waits for the thread that comes last (``python -m tools.render_cost --threads 2``).

    PyTorch's number of threads is each Python thread's own, and also the one with which later Python threads
    begin. So where blocks of several overlap, all leave with the number that was there before the first. A
    Python thread that first computes during another one's block, outside a block of its own, keeps 1. A block
    inside another one of the same Python thread changes nothing.
    """
    if getattr(_block, "active", False):
        yield
        return
    with _lock:
        _before.append(torch.get_num_threads())
        torch.set_num_threads(1)
    _block.active = True
    try:
        yield
    finally:
        _block.active = False
        with _lock:
            torch.set_num_threads(_before[0])
            _before.pop()


def one_thread_if_small(batch: Tensor, most: int) -> AbstractContextManager[None]:
    """Return :func:`one_thread` for a batch of at most ``most`` numbers on the CPU.

    Otherwise, and where operations are only recorded, return a context without effect.
    """
    small = not recorded() and batch.device.type == "cpu" and batch.numel() <= most
    return one_thread() if small else nullcontext()


def recorded() -> bool:
    """Return whether operations are recorded for other numbers, by a compiler, an exporter or a mode."""
    if torch.compiler.is_compiling() or handled_by_mode():
        return True
    return bool(torch.jit.is_tracing())  # type: ignore[attr-defined, no-untyped-call]


def usable_device(device: torch.device | str | int) -> torch.device:
    """Return a device by its name."""
    try:
        found = torch.device(device)
        torch.empty(0, device=found)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device: expected one that torch can use here, got {device}: {reason}") from error
    return found


def device_of_numbers() -> torch.device:
    """Return the default device, or the CPU where that is meta, whose tensors have no numbers."""
    device = torch.get_default_device()
    return torch.device("cpu") if device.type == "meta" else device


def made_once(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function of hashable arguments that makes tensors, to be called once for each of them.

    A compiled, exported or traced program makes its own, and so does each call inside a context in which
    tensors are of another kind, such as ``FakeTensorMode``. The tensors must not be changed in place.
    """

    @lru_cache(maxsize=256)
    def kept(*args: Any, **kwargs: Any) -> T:
        with torch.inference_mode(mode=False):  # tensors that are made in it could not be used for gradients
            return cast("Callable[..., T]", function)(*args, **kwargs)

    @wraps(function)
    def once(*args: P.args, **kwargs: P.kwargs) -> T:
        if recorded():
            return function(*args, **kwargs)
        return cast("Callable[..., T]", kept)(*args, **kwargs)

    return once


def constant(numbers: tuple[Any, ...], like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Return a tensor of given numbers, made once per dtype and device; not to be changed in place.

    A compiled or exported program has it as a constant of its own.

    Args:
        numbers: tuple of numbers, or of such tuples.
        like: whose device, and dtype unless it is given, it has.
        dtype: of the result.
    """
    kind = dtype or like.dtype
    if torch.compiler.is_exporting():
        return _computed_constant(numbers, kind, like.device)
    if torch.compiler.is_compiling():
        return _constant_of_pieces(numbers, kind, like.device)
    return _constant(numbers, kind, like.device)


def _computed_constant(numbers: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Compute a constant: literals in a branch of ``torch.cond`` cannot be exported to ONNX (torch 2.13)."""
    shape, flat = _flat(numbers)
    each = {number: torch.full((1,), number, dtype=dtype, device=device) for number in set(flat)}
    return torch.cat([each[number] for number in flat]).view(shape)


def _constant_of_pieces(numbers: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Join a constant of pieces so short that inductor writes them into its code.

    It does not find longer ones in a branch of ``torch.cond`` (torch 2.13).
    """
    shape, flat = _flat(numbers)
    starts = range(0, len(flat), _INLINED)
    pieces = [torch.tensor(flat[at : at + _INLINED], dtype=dtype, device=device) for at in starts]
    return torch.cat(pieces).view(shape)


def _flat(numbers: tuple[Any, ...]) -> tuple[list[int], list[Any]]:
    """Return the shape of nested tuples, and their numbers in order."""
    shape: list[int] = []
    first: Any = numbers
    while isinstance(first, tuple):
        shape.append(len(first))
        first = first[0]
    flat = list(numbers)
    for _ in shape[1:]:
        flat = [number for row in flat for number in row]
    return shape, flat


@made_once
def identity(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the identity matrix, made once per size, dtype and device; not to be changed in place."""
    return torch.eye(size, dtype=dtype, device=device)


@made_once
def _constant(numbers: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(numbers, dtype=dtype, device="cpu").to(device)
