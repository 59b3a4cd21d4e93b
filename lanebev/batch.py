"""Operations on the rows of a batch that all packages share."""

from collections.abc import Callable, Mapping, Sequence
from enum import IntFlag
from typing import Any, TypeVar, cast

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_unflatten

from lanebev.tensors import constant, map_tensors, recorded
from lanebev.torch_internals import is_batched_by_vmap

T = TypeVar("T")
FlagT = TypeVar("FlagT", bound=IntFlag)

_BLOCK = 1_000_000  # numbers of a block of rows


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
    """Return whether a costly step, such as a search, can be left out because no row wants its result.

    Beside :func:`replace_rows` the one place where the maths asks the device. A compiled, exported or traced
    program, ``torch.vmap``, ``FakeTensorMode`` and the device meta cannot, and always search.
    """
    return not _is_without_numbers(wanted) and not bool(wanted.any())


def readable(value: Tensor) -> bool:
    """Return whether a check may read a tensor's numbers: now, and without waiting for a device."""
    return value.device.type == "cpu" and not _is_without_numbers(value)


def _is_without_numbers(value: Tensor) -> bool:
    return recorded() or value.is_meta or is_batched_by_vmap(value)


def replace_rows(rows: Tensor, values: T, function: Callable[..., T], *operands: Any) -> T:
    """Replace some rows of ``values`` by a costly function's result, which is computed for these rows only.

    The device is asked how many rows there are. A compiled or exported program has both ways
    (``torch.cond``): it computes the function for all rows where there is any, else not at all. Under
    ``torch.vmap``, ``torch.jit.trace`` and ``FakeTensorMode`` it is computed for all rows.

    Args:
        rows: (B,) bool.
        values: (B, ...) tensor, or a NamedTuple of such.
        function: of the operands, to what ``values`` is; each row's result depends on that row alone.
        operands: (B, ...) tensors, or NamedTuples of such.
    """
    if torch.compiler.is_compiling():
        return _replace_rows_in_program(rows, values, function, operands)
    if _is_without_numbers(rows):
        return select_rows(rows, function(*operands), values)
    index = rows.nonzero().squeeze(-1)
    if index.shape[0] == 0:
        return values
    if index.shape[0] == rows.shape[0]:
        return function(*operands)
    chosen = (map_tensors(lambda part: part.index_select(0, index), operand) for operand in operands)
    return _put_rows(index, function(*chosen), values)


def _replace_rows_in_program(
    rows: Tensor, values: T, function: Callable[..., T], operands: tuple[Any, ...]
) -> T:
    """Replace rows as :func:`replace_rows` does, by ``torch.cond``, of tensors none of which is a view."""
    parts, structure = tree_flatten((rows, values, operands))
    parts = [part.clone() for part in parts]
    leaves, results = tree_flatten(values)
    kinds = [leaf.dtype for leaf in leaves]

    def anew(*parts: Tensor) -> tuple[Tensor, ...]:
        rows, values, operands = tree_unflatten(parts, structure)
        return _differentiable(tree_flatten(select_rows(rows, function(*operands), values))[0])

    def kept(*parts: Tensor) -> tuple[Tensor, ...]:
        return _differentiable([part.clone() for part in parts[1 : 1 + results.num_leaves]])

    chosen = torch.cond(rows.any(), anew, kept, tuple(parts))
    found: T = tree_unflatten([part.to(kind) for part, kind in zip(chosen, kinds, strict=True)], results)
    return found


def _differentiable(parts: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return numbers of floating point: ``torch.cond`` has no gradient beside whole ones (torch 2.13).

    Those of a state are far below 2²⁴, up to which single precision holds them all.
    """
    if not torch.is_grad_enabled():
        return tuple(parts)
    return tuple(part if part.is_floating_point() else part.float() for part in parts)


def _put_rows(index: Tensor, rows: T, values: T) -> T:
    """Return ``values`` with ``rows`` at the places (K,) of the index."""
    if isinstance(values, Tensor):
        return cast(T, values.index_copy(0, index, cast(Tensor, rows)))
    pairs = zip(cast("tuple[Tensor, ...]", rows), cast("tuple[Tensor, ...]", values), strict=True)
    return type(values)(*(_put_rows(index, *pair) for pair in pairs))


def in_blocks(numbers: int, function: Callable[..., T], *operands: Any) -> T:
    """Apply a function to a large batch in blocks of rows, one after the other, and join the results.

    On a CPU the intermediate values of a large batch leave its caches, and the memory allocator returns them
    to the operating system and asks for them again. GPUs, and programs that are compiled or exported, compute
    all rows at once.

    Args:
        numbers: that the function holds at once for each row, about; a block has a million of them, 8 MB.
        function: of the operands, to tensors or tuples of tensors (B, ...); each row's result depends on that
            row alone.
        operands: (B, ...) tensors, or NamedTuples of such.
    """
    first = operands[0]
    while isinstance(first, tuple):
        first = first[0]
    if recorded() or first.device.type != "cpu":
        return function(*operands)
    count = round(numbers * first.shape[0] / _BLOCK)
    if count < 2:
        return function(*operands)
    parts, structure = tree_flatten(operands)
    blocks = zip(*(part.chunk(count) for part in parts), strict=True)
    results = [tree_flatten(function(*tree_unflatten(list(block), structure))) for block in blocks]
    joined = [torch.cat(same) for same in zip(*(leaves for leaves, _ in results), strict=True)]
    return cast(T, tree_unflatten(joined, results[0][1]))


def flags(conditions: Mapping[FlagT, Tensor]) -> Tensor:
    """Return the bits of the reasons whose conditions (B,) hold, (B,) int64; no two share a bit."""
    holds = torch.stack(list(conditions.values()), dim=-1)
    bits = constant(tuple(map(int, conditions)), like=holds, dtype=torch.int64)
    return (holds * bits).sum(-1)


def flag(condition: Tensor, reason: IntFlag) -> Tensor:
    """Return the reason's bit as int64 where the condition holds, else 0."""
    return condition.to(torch.int64) * int(reason)


def has_flag(bits: Tensor, reason: IntFlag) -> Tensor:
    """Return where a reason's bit is set, bool."""
    return (bits & int(reason)) != 0


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
