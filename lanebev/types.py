"""The tuples of tensors and the status that cross module borders."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import NamedTuple, Protocol, TypeVar, cast

import torch
from torch import Tensor
from torch.utils import _pytree

T = TypeVar("T")
TupleClass = TypeVar("TupleClass", bound=type)

NUM_BOUNDARIES = 6
"""Semantic lane boundaries by default: 0, 1, 2 left of the ego lane's middle, 3, 4, 5 right of it."""


def register_pytree(cls: TupleClass) -> TupleClass:
    """Register a NamedTuple of tensors, so that ``torch.export.save`` and ``torch.load`` accept it."""
    _pytree._register_namedtuple(cls, serialized_type_name=f"lanebev.{cls.__name__}")
    torch.serialization.add_safe_globals([cls])
    return cls


class TensorTuple(Protocol):
    """Any NamedTuple of tensors."""

    def _asdict(self) -> Mapping[str, Tensor]: ...


def map_tensors(function: Callable[[Tensor], Tensor], value: T) -> T:
    """Apply a function to a tensor, or to every tensor of a NamedTuple; return anything else as it is."""
    if isinstance(value, Tensor):
        return cast(T, function(value))
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return cast(T, type(value)(*(map_tensors(function, part) for part in value)))
    return value


class Status(IntEnum):
    """What a row of a calibration is worth. A new meaning is a new value."""

    UNINITIALISED = 0  # nothing has been seen yet: the extrinsics are the initial guess
    TRACKING = 1  # this frame's observations were used
    COASTING = 2  # nothing usable in this frame: predicted from earlier ones
    LOST = 3  # too long without support: the extrinsics are the last that were believed


@register_pytree
class LaneSegments(NamedTuple):
    """Line segments on lane boundaries, padded to N per image.

    Attributes:
        endpoints: (B, N, 2, 2) px, undistorted image coordinates, ``[segment, end, (x, y)]``.
        boundary: (B, N) int64, index of the semantic lane boundary, left to right, 0..L-1.
        weight: (B, N) in [0, 1]; 0 is padding or "not seen".
        sigma: (B, N) px, standard deviation of an end point's position across the line.
    """

    endpoints: Tensor
    boundary: Tensor
    weight: Tensor
    sigma: Tensor


@register_pytree
class Extrinsics(NamedTuple):
    """Camera pose over the road, each (B,): rad, rad, rad, m; always in this order.

    pitch > 0 is nose down, yaw > 0 points left of the lanes, roll > 0 is counter-clockwise
    seen from behind, height > 0 is above the road.
    """

    pitch: Tensor
    yaw: Tensor
    roll: Tensor
    height: Tensor

    def stack(self) -> Tensor:
        """(B, 4) tensor of (pitch, yaw, roll, height)."""
        return torch.stack(tuple(self), dim=-1)

    @classmethod
    def unstack(cls, values: Tensor) -> Extrinsics:
        """From a (B, 4) tensor of (pitch, yaw, roll, height)."""
        if values.shape[-1] != 4:
            raise ValueError(f"values: expected (..., 4), got {tuple(values.shape)}")
        return cls(*values.unbind(-1))


@register_pytree
class Calibration(NamedTuple):
    """One frame's estimate.

    Attributes:
        extrinsics: pitch, yaw, roll, height, each (B,).
        covariance: (B, 4, 4) of (pitch, yaw, roll, height).
        status: (B,) int64, values of :class:`Status`.
        inliers: (B, N) in [0, 1], how far each segment was believed.
    """

    extrinsics: Extrinsics
    covariance: Tensor
    status: Tensor
    inliers: Tensor

    def with_std_scaled(self, factor: float) -> Calibration:
        """Return the calibration with all standard deviations times ``factor``.

        A filter takes the errors of two frames as independent, but a network repeats its own: its errors are
        correlated over frames and do not average out. Source: covariance inflation (Anderson and Anderson
        1999); Guo et al. 2017 scale a network's probabilities alike.
        """
        return self._replace(covariance=factor**2 * self.covariance)
