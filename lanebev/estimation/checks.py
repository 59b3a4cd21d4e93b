"""What every calibrator asks of its input: shapes at the border, and unusable entries to weight zero."""

from __future__ import annotations

import torch
from torch import Tensor

from lanebev.types import LaneSegments

_MIN_LENGTH = 1e-3  # px; a shorter segment has no direction
_MIN_SIGMA = 1e-3  # px; nothing is known better


def check_segments(segments: LaneSegments, intrinsics: Tensor) -> None:
    """Raise on shapes that don't fit each other.

    Raises:
        ValueError: naming the tensor, what was expected and what came.
    """
    ends = segments.endpoints
    if ends.ndim != 4 or ends.shape[2:] != (2, 2):
        raise ValueError(f"segments.endpoints: expected (B, N, 2, 2), got {tuple(ends.shape)}")
    shape = tuple(ends.shape[:2])
    for name in ("boundary", "weight", "sigma"):
        got = tuple(getattr(segments, name).shape)
        if got != shape:
            raise ValueError(f"segments.{name}: expected {shape} like the end points, got {got}")
    if segments.boundary.is_floating_point():
        raise ValueError(f"segments.boundary: expected int64 indices, got {segments.boundary.dtype}")
    if intrinsics.shape != (ends.shape[0], 3, 3):
        raise ValueError(f"intrinsics: expected ({ends.shape[0]}, 3, 3), got {tuple(intrinsics.shape)}")


def clean_segments(segments: LaneSegments, num_boundaries: int) -> LaneSegments:
    """Weight zero, and harmless numbers, wherever a segment can't be used.

    Non-finite entries, no length, no positive sigma, or a boundary index outside 0..L-1 make a segment
    unusable. The masked entries carry no gradient.

    Args:
        segments: as they came.
        num_boundaries: L.

    Returns:
        segments of the same shapes, finite throughout.
    """
    ends, boundary, weight, sigma = segments
    finite = ends.isfinite().all(-1).all(-1) & weight.isfinite() & sigma.isfinite()
    known = (boundary >= 0) & (boundary < num_boundaries)
    long = (ends[..., 1, :] - ends[..., 0, :]).abs().amax(-1) > _MIN_LENGTH  # false on NaN
    good = finite & known & long & (weight > 0) & (sigma > 0) & (ends.abs().amax(-1).amax(-1) < 1e6)
    harmless = ends.new_tensor([[0.0, 0.0], [1.0, 1.0]])
    return LaneSegments(
        torch.where(good[..., None, None], ends, harmless),
        torch.where(good, boundary, 0),
        torch.where(good, weight, 0.0).clamp_max(1.0),
        torch.where(good, sigma, 1.0).clamp_min(_MIN_SIGMA),
    )


def as_batch(value: float | Tensor, like: Tensor) -> Tensor:
    """A number or a (B,) tensor to (B,), with the dtype and device of ``like`` (B, ...).

    Raises:
        ValueError: another shape.
    """
    tensor = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    if tensor.ndim > 1 or (tensor.ndim == 1 and tensor.shape[0] not in (1, like.shape[0])):
        raise ValueError(f"dt: expected a float or ({like.shape[0]},), got {tuple(tensor.shape)}")
    return tensor.expand(like.shape[0])


def as_lane_width(value: float | Tensor, like: Tensor, num_boundaries: int) -> Tensor:
    """Lane width prior to (B, L-1) m: from a float, (B,) or (B, L-1).

    Raises:
        ValueError: another shape, or a float that is not positive.
    """
    if isinstance(value, (int, float)) and not value > 0:
        raise ValueError(f"lane_width: expected a positive width in m, got {value}")
    width = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    rows, lanes, got = like.shape[0], num_boundaries - 1, tuple(width.shape)
    if width.ndim == 1:
        width = width.unsqueeze(-1)
    fits = width.ndim == 0 or (
        width.ndim == 2 and width.shape[0] in (1, rows) and width.shape[1] in (1, lanes)
    )
    if not fits:
        raise ValueError(f"lane_width: expected a float, ({rows},) or ({rows}, {lanes}), got {got}")
    return width.expand(rows, lanes)
