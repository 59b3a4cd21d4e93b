"""Checks of a calibrator's input: shapes at the border, weight zero for unusable entries."""

from numbers import Integral

import torch
from torch import Tensor

from lanebev.geometry.lens import check_intrinsics, placeholder_intrinsics, usable_cameras
from lanebev.observation.segments import LaneSegments
from lanebev.tensors import constant
from lanebev.types import Calibration, Status, TensorTuple, check_number_or_tensor, check_pixels, check_tensor

FEW_SEGMENTS = 1 << 12  # of all rows, up to which one thread of the CPU computes a frame
_MIN_LENGTH = 1e-3  # px; a shorter segment has no direction
_MIN_SIGMA = 1e-3  # px; nothing is known better
LEAST_SEGMENTS = 2  # smallest N: the estimators need so many, padding included
_HARMLESS_WIDTH = 3.7  # m
LANE_WIDTHS = (1.0, 10.0)  # m, smallest and largest of a lane


def check_segments(segments: LaneSegments, intrinsics: Tensor) -> None:
    """Raise on shapes that don't fit each other, and on whole numbers."""
    if not isinstance(segments, LaneSegments):
        raise TypeError(f"segments: expected lanebev.LaneSegments(...), got {type(segments).__qualname__}")
    for name, part in segments._asdict().items():
        check_tensor(f"segments.{name}", part)
    ends = segments.endpoints
    if ends.ndim != 4 or ends.shape[2:] != (2, 2):
        raise ValueError(f"segments.endpoints: expected (B, N, 2, 2), got {tuple(ends.shape)}")
    shape = tuple(ends.shape[:2])
    for name in ("boundary", "weight", "sigma"):
        got = tuple(getattr(segments, name).shape)
        if got != shape:
            raise ValueError(f"segments.{name}: expected {shape} like the end points, got {got}")
    check_pixels("segments.endpoints", ends)
    if segments.boundary.dtype != torch.int64:
        raise ValueError(f"segments.boundary: expected int64 indices, got {segments.boundary.dtype}")
    check_intrinsics(intrinsics, ends.shape[0])


def check_state(state: TensorTuple, kind: type[TensorTuple], rows: int) -> Tensor:
    """Check that a state is a NamedTuple of the expected class with so many rows.

    Returns:
        its first tensor, (B, D), whose dtype and device are those of the calibrator.
    """
    if not isinstance(state, kind):
        raise ValueError(
            f"state: expected {kind.__name__}, begun by initial_state(batch_size), got {type(state).__name__}"
        )
    parts = state._asdict()
    for name, part in parts.items():
        if part.shape[:1] != (rows,):
            raise ValueError(f"state.{name}: expected ({rows}, ...), got {tuple(part.shape)}")
    first, like = next(iter(parts.items()))
    if like.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"state.{first}: expected float32 or float64, got {like.dtype}")
    for name in ("status", "reasons"):
        if name in parts and parts[name].dtype != torch.int64:
            got = parts[name].dtype
            raise ValueError(f"state.{name}: expected int64, got {got}; cast only floating-point tensors")
    return like


def check_new_state(batch_size: object, dtype: torch.dtype) -> None:
    """Raise unless a state can have so many rows and this dtype."""
    if torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]  # sizes are tensors
        return
    if not isinstance(batch_size, (int, torch.SymInt, Integral)) or isinstance(batch_size, bool):
        raise TypeError(f"batch_size: expected a whole number, got {batch_size!r}")
    if batch_size < 0:  # int() would fix the batch size of an exported program
        raise ValueError(f"batch_size: expected 0 or more, got {batch_size}")
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype: expected torch.float32 or torch.float64, got {dtype}")


def clean_segments(segments: LaneSegments, num_boundaries: int) -> LaneSegments:
    """Set weight zero, and valid numbers, in segments that cannot be used.

    Non-finite entries, no length, no positive sigma, or a boundary index outside 0..L-1 make a segment
    unusable. The masked entries carry no gradient.

    Returns:
        segments of the same shapes, finite throughout.
    """
    ends, boundary, weight, sigma = segments
    finite = (torch.maximum(weight, sigma) < torch.inf) & (torch.minimum(weight, sigma) > 0)  # false on NaN
    known = (boundary >= 0) & (boundary < num_boundaries)
    long = (ends[..., 1, :] - ends[..., 0, :]).abs().amax(-1) > _MIN_LENGTH
    good = finite & known & long & (ends.abs().amax((-2, -1)) < 1e6)
    placeholder = constant(((0.0, 0.0), (1.0, 1.0)), like=ends)
    return LaneSegments(
        torch.where(good[..., None, None], ends, placeholder),
        torch.where(good, boundary, 0),
        torch.where(good, weight, 0.0).clamp_max(1.0),
        torch.where(good, sigma, 1.0).clamp_min(_MIN_SIGMA),
    )


def mask_invalid_rows(
    segments: LaneSegments, intrinsics: Tensor, lane_width: Tensor, num_boundaries: int
) -> tuple[LaneSegments, Tensor, Tensor]:
    """Clean the segments, and set weight zero in rows whose intrinsics or lane widths cannot be used.

    Such rows get placeholder intrinsics and widths, so that all numbers and gradients stay finite.

    Args:
        segments: unchecked segments, see :func:`clean_segments`.
        intrinsics: (B, 3, 3), unusable where not finite, transposed or without a positive focal length.
        lane_width: (B, M) m, unusable where one is not positive, or their mean is not in LANE_WIDTHS, as in
            feet or cm.
        num_boundaries: L.
    """
    segments = clean_segments(segments, num_boundaries)
    good = usable_cameras(intrinsics) & usable_widths(lane_width)  # (B,)
    weight = torch.where(good.unsqueeze(-1), segments.weight, 0.0)
    return (
        segments._replace(weight=weight),
        torch.where(good[:, None, None], intrinsics, placeholder_intrinsics(intrinsics)),
        harmless_widths(lane_width, good),
    )


def usable_widths(lane_width: Tensor) -> Tensor:
    """Tell in which rows (B,) bool all lane widths (B, M) m are positive, and their mean is possible."""
    least, most = LANE_WIDTHS
    mean = lane_width.mean(-1)
    usable: Tensor = (lane_width > 0).all(-1) & (mean >= least) & (mean <= most)  # false on NaN
    return usable


def harmless_widths(lane_width: Tensor, good: Tensor) -> Tensor:
    """Replace the lane widths (B, M) m of rows that are not good, (B,) bool."""
    return torch.where(good.unsqueeze(-1), lane_width, _HARMLESS_WIDTH)


def padded(segments: LaneSegments, least: int = LEAST_SEGMENTS) -> LaneSegments:
    """Pad with segments of weight zero to ``least`` of them, by default the number that estimators need."""
    missing = least - segments.weight.shape[1]
    if missing <= 0:
        return segments
    return LaneSegments(
        *(torch.cat([part, part.new_zeros(part.shape[0], missing, *part.shape[2:])], 1) for part in segments)
    )


def is_running(status: Tensor) -> Tensor:
    """Return (B,) bool: the row has started and is not lost."""
    return (status == int(Status.TRACKING)) | (status == int(Status.COASTING))


def unused_frame(calibration: Calibration, skipped: Tensor) -> Calibration:
    """Set COASTING and no inliers in rows whose frame was skipped.

    Args:
        calibration: (B, ...).
        skipped: (B,) bool.
    """
    return calibration._replace(
        status=torch.where(skipped, int(Status.COASTING), calibration.status),
        inliers=torch.where(skipped.unsqueeze(-1), 0.0, calibration.inliers),
    )


def as_batch(value: float | Tensor, like: Tensor, name: str = "dt") -> Tensor:
    """Convert a number or a (B,) tensor to (B,), with the dtype and device of ``like`` (B, ...)."""
    check_number_or_tensor(name, value)
    if isinstance(value, (int, float)):  # a tensor made of a number would be a constant to torch.compile
        return torch.full(like.shape[:1], value, dtype=like.dtype, device=like.device)
    tensor = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    if tensor.ndim > 1 or (tensor.ndim == 1 and tensor.shape[0] not in (1, like.shape[0])):
        raise ValueError(f"{name}: expected a float or ({like.shape[0]},), got {tuple(tensor.shape)}")
    return tensor.expand(like.shape[0])


def as_lane_width(value: float | Tensor, like: Tensor, num_boundaries: int) -> Tensor:
    """Convert a lane width prior, float, (B,) or (B, L-1), to (B, L-1) m."""
    check_number_or_tensor("lane_width", value)
    rows, lanes = like.shape[0], num_boundaries - 1
    if isinstance(value, (int, float)):
        least, most = LANE_WIDTHS
        if not least <= value <= most:
            raise ValueError(f"lane_width: expected {least:g} to {most:g} m, got {value}")
        return as_batch(value, like).unsqueeze(-1).expand(rows, lanes)
    width = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    got = tuple(width.shape)
    if width.ndim == 1:
        width = width.unsqueeze(-1)
    fits = width.ndim == 0 or (
        width.ndim == 2 and width.shape[0] in (1, rows) and width.shape[1] in (1, lanes)
    )
    if not fits:
        raise ValueError(f"lane_width: expected a float, ({rows},) or ({rows}, {lanes}), got {got}")
    return width.expand(rows, lanes)
