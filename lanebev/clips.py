"""Clips of T frames: their time steps, the frames that begin a drive, and their outputs."""

from typing import Any

import torch
from torch import Tensor, nn

from lanebev.geometry.precision import common_dtype
from lanebev.types import check_number_or_tensor, check_tensor


def frame_intervals(dt: float | Tensor, batch: int, steps: int, like: Tensor) -> Tensor:
    """Convert time steps to (B, T) s, at least float32, on the device of ``like``.

    Args:
        dt: s: a float, (B,) or (B, T).
        batch: B.
        steps: T.
        like: tensor whose device and dtype are taken.

    Raises:
        TypeError: neither number nor tensor.
        ValueError: another shape.
    """
    check_number_or_tensor("dt", dt)
    if isinstance(dt, (int, float)):  # a tensor made of a number would be a constant to torch.compile
        return torch.full((batch, steps), dt, dtype=common_dtype(like), device=like.device)
    intervals = torch.as_tensor(dt, dtype=common_dtype(like), device=like.device)
    got = tuple(intervals.shape)
    if intervals.ndim < 2:
        intervals = intervals.reshape(-1, 1)
    if intervals.ndim > 2 or intervals.shape[0] not in (1, batch) or intervals.shape[1] not in (1, steps):
        raise ValueError(f"dt: expected a float, ({batch},) or ({batch}, {steps}), got {got}")
    return intervals.expand(batch, steps)


def drive_starts(reset: Tensor, batch: int, steps: int) -> Tensor:
    """Return which frames begin a drive, (B, T) bool.

    Args:
        reset: (B, T) bool, or (B,), which applies to the first frame.
        batch: B.
        steps: T.

    Raises:
        TypeError: not a tensor.
        ValueError: another shape or type of number.
    """
    check_tensor("reset", reset)
    if reset.dtype != torch.bool or reset.shape not in ((batch,), (batch, steps)):
        raise ValueError(
            f"reset: expected bool ({batch},) or ({batch}, {steps}), got {reset.dtype} {tuple(reset.shape)}"
        )
    return reset if reset.ndim == 2 else nn.functional.pad(reset.unsqueeze(-1), (0, steps - 1))


def stack_frames(outputs: list[Any]) -> Any:
    """Stack per-frame (nested) tuples of tensors to one of (B, T, ...) tensors; None stays."""
    if outputs[0] is None:
        return None
    if isinstance(outputs[0], Tensor):
        return torch.stack(outputs, dim=1)
    return type(outputs[0])(*(stack_frames(list(parts)) for parts in zip(*outputs, strict=True)))
