"""Clips of T frames: their intrinsics, numbers such as time steps, and the frames that begin a drive."""

import warnings

import torch
from torch import Tensor, nn

from lanebev.batch import readable
from lanebev.geometry.lens import check_intrinsics
from lanebev.geometry.precision import common_dtype
from lanebev.types import check_number_or_tensor, check_tensor

_LONG_DT = 5.0  # s


def frame_cameras(intrinsics: Tensor, image: Tensor) -> Tensor:
    """Return the intrinsics of every frame, (B, T, 3, 3) px.

    Args:
        intrinsics: (B, 3, 3), those of all frames, or (B, T, 3, 3).
        image: (B, 3, H, W), which is one frame, or (B, T, 3, H, W).

    Raises:
        TypeError: not a tensor.
        ValueError: another shape, or see :func:`~lanebev.geometry.lens.check_intrinsics`.
    """
    check_tensor("intrinsics", intrinsics)
    each = image.ndim == 5 and intrinsics.ndim == 4
    check_intrinsics(intrinsics, *image.shape[: 2 if each else 1])
    steps = image.shape[1] if image.ndim == 5 else 1
    return intrinsics if each else intrinsics.unsqueeze(1).expand(-1, steps, -1, -1)


def per_frame(name: str, value: float | Tensor, batch: int, steps: int, like: Tensor) -> Tensor:
    """Convert a number of each frame to (B, T), at least float32, on the device of ``like``.

    Args:
        name: what it is, for errors.
        value: a float, (B,) or (B, T).
        batch: B.
        steps: T.
        like: tensor whose device and dtype are taken.
    """
    check_number_or_tensor(name, value)
    if isinstance(value, (int, float)):  # a tensor made of a number would be a constant to torch.compile
        return torch.full((batch, steps), value, dtype=common_dtype(like), device=like.device)
    numbers = torch.as_tensor(value, dtype=common_dtype(like), device=like.device)
    got = tuple(numbers.shape)
    if numbers.ndim < 2:
        numbers = numbers.reshape(-1, 1)
    if numbers.ndim > 2 or numbers.shape[0] not in (1, batch) or numbers.shape[1] not in (1, steps):
        raise ValueError(f"{name}: expected a float, ({batch},) or ({batch}, {steps}), got {got}")
    return numbers.expand(batch, steps)


def doubt_intervals(intervals: Tensor, begins: Tensor | None) -> None:
    """Warn if all time steps (B, T) s after frames of a drive are longer than those of a camera.

    Where reading numbers would wait for a device, there is no warning. Its text is always the same: Python
    then shows it once.

    Args:
        intervals: (B, T) s.
        begins: (B, T) bool, the frames that begin a drive, whose time steps do not count; None for none.
    """
    if not (readable(intervals) and (begins is None or readable(begins))):
        return
    counted = intervals[intervals.isfinite() if begins is None else intervals.isfinite() & ~begins]
    if counted.numel() and bool((counted > _LONG_DT).all()):
        warnings.warn(
            f"dt: expected seconds since the frame before, got more than {_LONG_DT:g} in all frames; of "
            "milliseconds give dt / 1000",
            stacklevel=3,
        )


def drive_starts(reset: Tensor, batch: int, steps: int) -> Tensor:
    """Return which frames begin a drive, (B, T) bool.

    Args:
        reset: (B, T) bool, or (B,), which applies to the first frame.
        batch: B.
        steps: T.
    """
    check_tensor("reset", reset)
    if reset.dtype != torch.bool or reset.shape not in ((batch,), (batch, steps)):
        raise ValueError(
            f"reset: expected bool ({batch},) or ({batch}, {steps}), got {reset.dtype} {tuple(reset.shape)}"
        )
    return reset if reset.ndim == 2 else nn.functional.pad(reset.unsqueeze(-1), (0, steps - 1))
