"""The tuples of tensors and the status that cross module borders."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree

from lanebev.geometry.rotation import (
    camera_from_road_matrix,
    road_from_camera_matrix,
    rotation_vector,
)
from lanebev.tensors import map_tensors as map_tensors  # noqa: PLC0414 - part of this module too

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


def check_tensor(name: str, value: object) -> None:
    """Raise unless an argument is a tensor.

    Raises:
        TypeError: naming the argument, what came and what to do.
    """
    if not isinstance(value, Tensor):
        kind = f"{type(value).__module__}.{type(value).__qualname__}".removeprefix("builtins.")
        remedy = "torch.from_numpy(...)" if kind == "numpy.ndarray" else "torch.as_tensor(...)"
        raise TypeError(f"{name}: expected a torch.Tensor, got {kind}; convert numbers with {remedy}")


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

    def check(self, num_boundaries: int = NUM_BOUNDARIES) -> LaneSegments:
        """Check what calibrators leave unchecked, since it would wait for the device: the numbers.

        To a calibrator a segment that cannot be used is one that is not there. That is right for a detector's
        bad frame and hides a mistake of the code that makes segments: check its first ones.

        Args:
            num_boundaries: L.

        Returns:
            the segments themselves.

        Raises:
            TypeError: a part is no tensor.
            ValueError: a part has another shape or dtype, or a segment that is there has a boundary index
                outside 0..L-1, a weight outside 0..1, an end point that is not finite or a sigma that is
                not positive.
        """
        for name, part in self._asdict().items():
            check_tensor(f"segments.{name}", part)
        rows = self.weight.shape
        shapes = {"endpoints": (*rows, 2, 2), "boundary": rows, "sigma": rows}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                got = tuple(getattr(self, name).shape)
                raise ValueError(f"segments.{name}: expected {tuple(shape)}, got {got}")
        if self.boundary.dtype != torch.int64:
            raise ValueError(f"segments.boundary: expected int64 indices, got {self.boundary.dtype}")
        seen, last = self.weight != 0, num_boundaries - 1
        for name, expected, good in (
            ("weight", "0 to 1", (self.weight >= 0) & (self.weight <= 1)),
            ("boundary", f"0 to {last}", (self.boundary >= 0) & (self.boundary <= last)),
            ("endpoints", "finite px", self.endpoints.isfinite().flatten(2).all(-1)),
            ("sigma", "positive finite px", (self.sigma > 0) & self.sigma.isfinite()),
        ):
            if bool((seen & ~good).any()):
                got = getattr(self, name)[seen & ~good][0].tolist()
                raise ValueError(f"segments.{name}: expected {expected}, got {got}")
        return self


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
        check_tensor("values", values)
        if values.shape[-1] != 4:
            raise ValueError(f"values: expected (..., 4), got {tuple(values.shape)}")
        return cls(*values.unbind(-1))

    def camera_from_road(self) -> Tensor:
        """Return the rigid transform from the road's frame to the camera's, (B, 4, 4).

        For column vectors (X, Y, Z, 1) in m. The road's frame (X right, Y down, Z along the lanes) has its
        origin on the road below the camera. The rotation is R(θ, φ, ψ)ᵀ of Eq. (24): a road vector is turned
        first by roll about Z, then by yaw about Y, then by pitch about X,

            camera_from_road[:3, :3] = R_x(θ) R_y(φ) R_z(ψ),

        with the pitch θ, the yaw φ and the roll ψ, each R the right-handed rotation of a vector about an axis
        that stays. Differentiable.
        """
        return camera_from_road_matrix(*self)

    def road_from_camera(self) -> Tensor:
        """Return the camera's pose in the road's frame, (B, 4, 4), inverse of :meth:`camera_from_road`."""
        return road_from_camera_matrix(*self)

    def projection(self, intrinsics: Tensor) -> Tensor:
        """Return the projection of the road's frame to undistorted pixels, (B, 3, 4).

        It is K [R | t] of :meth:`camera_from_road`: the third entry of its product is the depth in m, by
        which the first two are divided.

        Args:
            intrinsics: (B, 3, 3) px.
        """
        camera_from_road = self.camera_from_road()
        return intrinsics.to(camera_from_road.dtype) @ camera_from_road[..., :3, :]

    def rvec_tvec(self) -> tuple[Tensor, Tensor]:
        """Return the pose as OpenCV wants it, for points of the road's frame.

        Returns:
            rotation vector (B, 3) rad and translation (B, 3) m of :meth:`camera_from_road`, as
            ``cv2.projectPoints``, ``cv2.solvePnP`` and ``cv2.drawFrameAxes`` take them.
        """
        camera_from_road = self.camera_from_road()
        return rotation_vector(camera_from_road[..., :3, :3]), camera_from_road[..., :3, 3]


def check_extrinsics(extrinsics: object, *rows: int) -> None:
    """Raise unless these are extrinsics of tensors, each of the shape ``rows`` if that is given.

    Raises:
        TypeError: not :class:`Extrinsics`, or not of tensors.
        ValueError: another shape.
    """
    if not isinstance(extrinsics, Extrinsics):
        raise TypeError(
            "extrinsics: expected lanebev.Extrinsics(pitch, yaw, roll, height), each a tensor (B,), got "
            f"{type(extrinsics).__qualname__}; Extrinsics.unstack makes it of a tensor (B, 4)"
        )
    for name, part in extrinsics._asdict().items():
        check_tensor(f"extrinsics.{name}", part)
        if rows and part.shape != rows:
            raise ValueError(f"extrinsics.{name}: expected {rows}, got {tuple(part.shape)}")


def check_calibration(calibration: object) -> None:
    """Raise TypeError unless this is what a calibrator returns."""
    if not isinstance(calibration, Calibration):
        got = type(calibration).__qualname__
        raise TypeError(f"calibration: expected a calibrator's lanebev.Calibration, got {got}")


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
