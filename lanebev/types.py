"""Named tuples of tensors that modules pass to each other, and the status."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum
from numbers import Real
from typing import NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from lanebev.geometry.rotation import camera_from_road_matrix, road_from_camera_matrix, rotation_vector
from lanebev.numbers import check_number
from lanebev.torch_internals import register_pytree

ConfigT = TypeVar("ConfigT")

NUM_BOUNDARIES = 6
"""Semantic lane boundaries by default: 0, 1, 2 left of the ego lane's middle, 3, 4, 5 right of it."""


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


def check_pixels(name: str, value: Tensor) -> None:
    """Raise ValueError unless a tensor of pixels is floating point of full precision.

    bfloat16 rounds 554 px to 556.
    """
    if not value.is_floating_point():
        raise ValueError(f"{name}: expected floating point, got {value.dtype}")
    if value.element_size() < 4:
        raise ValueError(
            f"{name}: expected float32 or float64, got {value.dtype}, which rounds them by pixels; leave "
            "them in float32"
        )


def check_number_or_tensor(name: str, value: object) -> None:
    """Raise TypeError unless this is a number, a symbolic one of ``torch.export`` too, or a tensor."""
    if not isinstance(value, (int, float, Tensor, torch.SymInt, torch.SymFloat, Real)):
        raise TypeError(f"{name}: expected a number or a torch.Tensor, got {type(value).__qualname__}")


def check_devices(tensors: Mapping[str, Tensor | None]) -> None:
    """Raise unless all tensors are on the device of the first.

    Raises:
        ValueError: naming the first that is not, and where it should be.
    """
    (first, like), *others = tensors.items()
    assert like is not None
    for name, tensor in others:
        if tensor is not None and tensor.device != like.device:
            raise ValueError(
                f"{name}: expected on {like.device} like the {first}, got on {tensor.device}; move it there"
            )


def check_numbers_known(name: str, value: Tensor) -> None:
    """Raise unless a tensor, which is read now, has memory with numbers.

    Raises:
        ValueError: it is on the device meta.
    """
    if value.is_meta:
        raise ValueError(
            f"{name}: expected numbers, got a tensor on the device meta, which has none: make it on the CPU"
        )


def check_type(name: str, value: object, expected: type) -> None:
    """Raise unless an argument is None or of a class of lanebev.

    Raises:
        TypeError: naming the argument, the class and what came.
    """
    if value is not None and not isinstance(value, expected):
        kind = f"the class {value.__qualname__}" if isinstance(value, type) else type(value).__qualname__
        raise TypeError(f"{name}: expected a lanebev.{expected.__qualname__} or None, got {kind}")


def config_of(kind: type[ConfigT], config: ConfigT | None, settings: Mapping[str, object]) -> ConfigT:
    """Return a configuration that is given as one, or by settings of it.

    Raises:
        TypeError: it is of another class.
        ValueError: both are given.
    """
    check_type("config", config, kind)
    if config is not None and settings:
        raise ValueError(f"config: expected either a {kind.__name__} or its keywords, got both")
    return config or kind(**settings)


class Status(IntEnum):
    """Status of a row of a calibration: whether lane boundaries of this frame were used.

    Later versions may add values; these keep their meaning.

    Attributes:
        UNINITIALISED: no usable frame so far; the extrinsics are the prior.
        TRACKING: lane boundaries of this frame were used.
        COASTING: this frame has no usable boundaries; the pose is predicted from earlier frames.
        LOST: no usable boundaries for too long, or frames contradict the estimate; the extrinsics are the
            last ones that could be trusted.
    """

    UNINITIALISED = 0
    TRACKING = 1
    COASTING = 2
    LOST = 3


AXES = ("pitch", "yaw", "roll", "height")
"""Names of the fields of :class:`Extrinsics`, in the order of every pose and covariance."""


@register_pytree
class Extrinsics(NamedTuple):
    """Camera pose over the road: pitch, yaw, roll (rad) and height (m), each (B,), always in this order.

    pitch > 0 is nose down, yaw > 0 points left of the lanes, roll > 0 is counter-clockwise
    seen from behind, height > 0 is above the road.
    """

    pitch: Tensor
    yaw: Tensor
    roll: Tensor
    height: Tensor

    @classmethod
    def from_values(
        cls, pitch: float, yaw: float, roll: float, height: float, dtype: torch.dtype = torch.float64
    ) -> Extrinsics:
        """Return extrinsics of batch size 1 from plain numbers in rad and m.

        Raises:
            TypeError: not numbers.
            ValueError: angles of 90 degrees or more, such as numbers in degrees, a height not above 0, or
                numbers not finite.
        """
        for name, angle in (("pitch", pitch), ("yaw", yaw), ("roll", roll)):
            check_number(name, angle)
            if not abs(angle) < math.pi / 2:
                raise ValueError(f"{name}: expected rad within ±pi/2, got {angle:g}; see math.radians")
        check_number("height", height)
        if not 0 < height < math.inf:
            raise ValueError(f"height: expected m above the road, finite and above 0, got {height:g}")
        return cls(*(torch.full((1,), value, dtype=dtype) for value in (pitch, yaw, roll, height)))

    def stack(self) -> Tensor:
        """Return the (B, 4) tensor of (pitch, yaw, roll, height)."""
        return torch.stack(tuple(self), dim=-1)

    @classmethod
    def unstack(cls, values: Tensor) -> Extrinsics:
        """Make extrinsics of a (B, 4) tensor of (pitch, yaw, roll, height)."""
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

        with the pitch θ, the yaw φ and the roll ψ, each R the right-handed rotation of a vector about a fixed
        axis. Differentiable.
        """
        return camera_from_road_matrix(*self)

    def road_from_camera(self) -> Tensor:
        """Return the camera's pose in the road's frame, (B, 4, 4), inverse of :meth:`camera_from_road`."""
        return road_from_camera_matrix(*self)

    def projection(self, intrinsics: Tensor) -> Tensor:
        """Return the projection of the road's frame to undistorted pixels, (B, 3, 4).

        It is K [R | t] of :meth:`camera_from_road`. Divide the first two entries of its product with a point
        by the third one, the depth in m.

        Args:
            intrinsics: (B, 3, 3) px.
        """
        camera_from_road = self.camera_from_road()
        return intrinsics.to(camera_from_road.dtype) @ camera_from_road[..., :3, :]

    def rvec_tvec(self) -> tuple[Tensor, Tensor]:
        """Return the pose in OpenCV's form, for points of the road's frame.

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
            joined = "; join poses of one row each by torch.cat" if part.shape == (*rows, 1) else ""
            raise ValueError(f"extrinsics.{name}: expected {rows}, got {tuple(part.shape)}{joined}")


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
        inliers: (B, N) in [0, 1], weight of each segment as an inlier.
    """

    extrinsics: Extrinsics
    covariance: Tensor
    status: Tensor
    inliers: Tensor

    def with_std_scaled(self, factor: float) -> Calibration:
        """Return the calibration with all standard deviations times ``factor``.

        A filter takes the errors of two frames as independent, but a network's errors are correlated over
        frames and do not average out. Source: covariance inflation (Anderson and Anderson 1999); Guo et al.
        2017 scale a network's probabilities in the same way.
        """
        return self._replace(covariance=factor**2 * self.covariance)
