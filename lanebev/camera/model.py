"""One camera's lens, image size and file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from lanebev.camera.files import camera_from_fields, read_camera, write_camera
from lanebev.camera.parameters import CameraParameters, are_swapped
from lanebev.geometry.distortion import check_lens, lens_model, max_undistorted_radius
from lanebev.geometry.lens import (
    check_intrinsics,
    check_points,
    denormalise_points,
    distort_points,
    invert_distortion,
)
from lanebev.geometry.road import rays_from_pixels
from lanebev.numbers import check_number, shown
from lanebev.tensors import device_of_numbers
from lanebev.types import check_numbers_known, check_tensor

_ROUNDED = 1e-6  # error of a number that was computed


def check_camera(value: object) -> None:
    """Raise unless an argument is a camera."""
    if not isinstance(value, Camera):
        got = type(value).__qualname__
        raise TypeError(f"camera: expected a lanebev.Camera, got {got}; see Camera.from_file and from_fov")


def _check_rows(points: Tensor) -> None:
    """Raise unless these are the (N, 2) points of one camera."""
    check_points(points)
    if points.ndim != 2:
        raise ValueError(f"points: expected (N, 2), got {tuple(points.shape)}; see Tensor.flatten(0, -2)")


def _coefficients(given: Any, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return coefficients as (D,), where they are (D,), (1, D) or (D, 1)."""
    try:
        if isinstance(given, Tensor):
            numbers = given.detach().to(device, dtype, copy=True)
        else:
            values = given.tolist() if isinstance(given, np.ndarray) else list(given)
            numbers = torch.tensor(values, dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"distortion: expected (D,) numbers, got {shown(given)}") from error
    return numbers.flatten() if numbers.ndim == 2 and 1 in numbers.shape else numbers


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera: its intrinsics, lens distortion and image size.

    Attributes:
        intrinsics: (3, 3) px.
        distortion: (D,), OpenCV's order, see :mod:`lanebev.geometry.distortion`; empty for an ideal lens.
        model: "pinhole" (Brown-Conrady, D = 0, 4, 5, 8, 12, or 14 with a tilted sensor), "fisheye"
            (Kannala and Brandt 2006, D = 4) or "omni" (Mei and Rives 2007, D = 5: ξ k1 k2 p1 p2), which may
            be given as "mei".
        image_size: (height, width) px.
        remark: note on the file that the camera was read from, such as which of its cameras it is; else
            empty.
    """

    intrinsics: Tensor
    distortion: Tensor
    model: str
    image_size: tuple[int, int]
    remark: str = ""

    def __post_init__(self) -> None:
        check_intrinsics(self.intrinsics)
        check_tensor("distortion", self.distortion)
        check_numbers_known("intrinsics", self.intrinsics)
        check_numbers_known("distortion", self.distortion)
        if self.distortion.ndim != 1:
            raise ValueError(f"distortion: expected (D,), got {tuple(self.distortion.shape)}")
        check_lens(self.distortion, self.model)
        object.__setattr__(self, "model", lens_model(self.model))
        sides: tuple[Any, ...] = tuple(self.image_size)
        if len(sides) != 2 or not all(isinstance(side, Integral) and int(side) > 0 for side in sides):
            raise ValueError(f"image_size: expected whole positive (height, width), got {self.image_size}")
        object.__setattr__(self, "image_size", (int(sides[0]), int(sides[1])))
        for name in ("intrinsics", "distortion"):
            value = getattr(self, name)
            if not bool(value.isfinite().all()):
                raise ValueError(f"{name}: expected finite numbers, got {value.flatten().tolist()}")
        x, y, one = self.intrinsics[2].tolist()
        if max(abs(x), abs(y), abs(one - 1.0)) > _ROUNDED:
            raise ValueError(f"intrinsics: expected the last row 0 0 1, got {x:g} {y:g} {one:g}")
        fx, fy = float(self.intrinsics[0, 0]), float(self.intrinsics[1, 1])
        if not (fx > 0 and fy > 0):
            raise ValueError(f"intrinsics: expected positive focal lengths, got fx {fx:g}, fy {fy:g}")

    @classmethod
    def from_parameters(
        cls,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        width: int,
        height: int,
        distortion: ArrayLike | Tensor | Iterable[float] | None = None,
        model: str = "pinhole",
        dtype: torch.dtype = torch.float64,
    ) -> Camera:
        """Make a camera from plain numbers.

        Args:
            fx: focal length along x, px.
            fy: focal length along y, px.
            cx: x of the principal point, px; the centre of the first pixel is 0.
            cy: y of the principal point, px.
            width: of the images, px.
            height: of the images, px.
            distortion: coefficients in OpenCV's order, also (1, D) or (D, 1) as OpenCV returns them; None or
                empty for none.
            model: "pinhole", "fisheye" or "omni".
            dtype: dtype of the tensors.

        Raises:
            TypeError: a focal length or a coordinate that is no number.
            ValueError: focal lengths that are not positive, an impossible image size, a number of
                coefficients that the model does not have, or numbers that are not finite.
        """
        numbers: dict[str, object] = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
        for name, value in numbers.items():
            if not isinstance(value, Tensor):
                check_number(name, value, "px as a number")
        rows, device = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], device_of_numbers()
        intrinsics = torch.tensor(rows, dtype=dtype, device=device)
        coefficients = _coefficients(() if distortion is None else distortion, device, dtype)
        return cls(intrinsics, coefficients, model, (height, width))

    @classmethod
    def from_fov(cls, degrees: float, width: int, height: int, dtype: torch.dtype = torch.float64) -> Camera:
        """Make an ideal camera of a horizontal field of view, for use without a calibration.

        Pixels are square and the principal point is the image's centre. Hardly any real camera is exactly
        so, and poses have the errors that follow from the difference.

        Args:
            degrees: angle between the outer edges of the leftmost and the rightmost column.
            width: px.
            height: px.
            dtype: dtype of the tensors.

        Raises:
            TypeError: an angle that is no number.
            ValueError: an angle that is not between 10 and 179 degrees, or an impossible image size.
        """
        check_number("fov", degrees, "degrees as a number")
        if not 10.0 <= degrees <= 179.0:  # NaN is not
            raise ValueError(
                f"fov: expected a horizontal field of view of 10 to 179 degrees, got {degrees!r}"
            )
        focal = 0.5 * width / math.tan(math.radians(0.5 * degrees))
        return cls.from_parameters(
            focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), width, height, dtype=dtype
        )

    @classmethod
    def from_file(
        cls, path: str | Path, image_size: tuple[int, int] | None = None, rectified: bool = False
    ) -> Camera:
        """Read a camera file: OpenCV, ROS, Kalibr, EuRoC, CamOdoCal, KITTI, nuScenes, OpenLane, short YAML.

        :func:`lanebev.camera.files.read_camera` describes each of these formats.

        Args:
            path: the file; ``camchain.yaml#cam1`` chooses the camera cam1 of several.
            image_size: (height, width) px of the images, for a file without a size. Not used otherwise.
            rectified: whether the images were rectified: then P is the camera matrix, without distortion.

        Raises:
            ValueError: the file is missing, cut, or holds an absurd value; one line says which.
        """
        return cls._of(read_camera(path, image_size, rectified))

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any], rectified: bool = False) -> Camera:
        """Make a camera of a ROS ``camera_info``: width, height, distortion_model, D, K, R, P, roi.

        Args:
            fields: by name.
            rectified: whether the images were rectified: then P is the camera matrix, without distortion.

        Raises:
            TypeError: the fields are no mapping from names to values.
            ValueError: an unknown field, or a missing or absurd value.
        """
        given: object = fields
        if not isinstance(given, Mapping):
            got = type(given).__qualname__
            raise TypeError(f"fields: expected a mapping from names to values, got {got}; see from_file")
        return cls._of(camera_from_fields(fields, rectified))

    @classmethod
    def _of(cls, read: CameraParameters) -> Camera:
        return cls(
            torch.tensor(read.matrix, dtype=torch.float64, device=device_of_numbers()).reshape(3, 3),
            torch.tensor(read.distortion, dtype=torch.float64, device=device_of_numbers()),
            read.model,
            read.image_size,
            read.remark,
        )

    def parameters(self) -> CameraParameters:
        """Return the camera as plain numbers."""
        matrix, distortion = self.intrinsics.flatten().tolist(), self.distortion.tolist()
        return CameraParameters(matrix, distortion, self.model, self.image_size)

    def fingerprint(self) -> str:
        """Return a text that is different for every camera: model, image size, intrinsics, distortion.

        It is the same on any device and in any floating dtype, and does not depend on how many zeros follow
        the distortion's last coefficient. State files keep it.
        """
        height, width = self.image_size
        matrix, distortion = (
            [f"{value + 0.0:.9g}" for value in part.flatten().to(torch.float32).tolist()]
            for part in (self.intrinsics, self.distortion)
        )
        while distortion and distortion[-1] == "0":
            distortion.pop()
        return f"{self.model} {width}x{height} K {' '.join(matrix)} D {' '.join(distortion)}".rstrip()

    def to_file(self, path: str | Path, name: str = "camera") -> None:
        """Write the camera as a ROS ``camera_info`` YAML, which :meth:`from_file` reads as well."""
        write_camera(path, self.parameters(), name)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Camera:
        """Return the same camera on another device or in another precision."""
        return replace(
            self,
            intrinsics=self.intrinsics.to(device=device, dtype=dtype),
            distortion=self.distortion.to(device=device, dtype=dtype),
        )

    def scaled(self, image_size: tuple[int, int]) -> Camera:
        """Return the camera of the image resized to (height, width), with pixel centres at integers."""
        if not (isinstance(image_size, Sequence) and len(image_size) == 2):
            raise TypeError(f"image_size: expected (height, width) in px, got {image_size!r}")
        if are_swapped((image_size[0], image_size[1]), self.image_size):
            raise ValueError(
                f"image_size: expected (height, width), got {tuple(image_size)} for a camera of "
                f"{self.image_size}: are they swapped?"
            )
        sy, sx = image_size[0] / self.image_size[0], image_size[1] / self.image_size[1]
        resize = self.intrinsics.new_tensor(
            [[sx, 0.0, 0.5 * (sx - 1)], [0.0, sy, 0.5 * (sy - 1)], [0.0, 0.0, 1.0]]
        )
        return replace(self, intrinsics=resize @ self.intrinsics, image_size=(image_size[0], image_size[1]))

    def cropped(self, top: int, left: int, height: int, width: int) -> Camera:
        """Return the camera of ``image[top:top+height, left:left+width]``, which may exceed the image.

        Args:
            top: first row, px; negative above the image.
            left: first column, px; negative left of the image.
            height: rows, px.
            width: columns, px.

        Raises:
            ValueError: sides that are not whole and positive.
        """
        shift = self.intrinsics.new_tensor([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
        return replace(self, intrinsics=self.intrinsics - shift, image_size=(height, width))

    def distort_points(self, points: Tensor) -> Tensor:
        """Convert undistorted pixels (N, 2) to pixels as taken (N, 2)."""
        _check_rows(points)
        return distort_points(points[None], self.intrinsics[None], self.distortion[None], self.model)[0]

    @cached_property
    def max_radius(self) -> Tensor:
        """() radius on the undistorted z = 1 plane up to which the lens images anything."""
        return max_undistorted_radius(self.distortion[None], self.model)[0]

    def undistort_points(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Convert pixels as taken (N, 2) to undistorted ones (N, 2), and tell where there is one, (N,)."""
        _check_rows(points)
        lens = (self.intrinsics[None], self.distortion[None], self.model)
        undistorted, valid = invert_distortion(points[None], *lens, reach=self.max_radius[None])
        return undistorted[0], valid[0]

    def share_without_rays(self) -> float:
        """Return the fraction of the image's pixels without a ray, where the lens images nothing.

        It is computed on a grid of 64 x 64 pixels. Points of lanes in such pixels are left out.
        """
        height, width = self.image_size
        rows, columns = (
            torch.linspace(0, side - 1, 64, dtype=self.intrinsics.dtype, device=self.intrinsics.device)
            for side in (height, width)
        )
        points = torch.cartesian_prod(columns, rows)
        return 1.0 - float(self.undistort_points(points)[1].double().mean())

    def rays(self, points: Tensor) -> Tensor:
        """Convert pixels as taken (N, 2) to camera rays (N, 3) with z = 1."""
        return rays_from_pixels(self.undistort_points(points)[0], self.intrinsics)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points of the camera frame to pixels as taken.

        Args:
            points: (N, 3) m.

        Returns:
            (N, 2) px, and (N,) bool: in front of the camera, inside the image, and where the lens does not
            fold over.
        """
        check_points(points, 3)
        front = points[..., 2] > 1e-6
        depth = torch.where(front, points[..., 2], 1.0)
        plane = points[..., :2] / depth.unsqueeze(-1)
        pixels = self.distort_points(denormalise_points(plane, self.intrinsics))
        height, width = self.image_size
        x, y = pixels.unbind(-1)
        inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
        if not self.distortion.shape[-1]:
            return pixels, front & inside
        return pixels, front & inside & (plane.norm(dim=-1) < self.max_radius)
