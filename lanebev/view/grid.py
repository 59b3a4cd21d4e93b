"""The bird's-eye grid and the homography from the image to it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lanebev.geometry.lens import cam_from_image, check_intrinsics
from lanebev.geometry.precision import full_precision
from lanebev.geometry.rotation import road_from_cam
from lanebev.numbers import check_number
from lanebev.types import Extrinsics, check_extrinsics


@dataclass(frozen=True)
class BEVGrid:
    """A rectangle of the road and its resolution.

    Pixel (column, row) with centres at integers lies at X = x[0] + column · resolution,
    Z = z[1] - row · resolution: rows run far to near, columns left to right (Eq. (23)'s convention).

    Attributes:
        x: (left, right) m.
        z: (near, far) m.
        resolution: m per pixel.
    """

    x: tuple[float, float] = (-10.0, 10.0)
    z: tuple[float, float] = (3.0, 60.0)
    resolution: float = 0.05

    def __post_init__(self) -> None:
        check_number("resolution", self.resolution, "m as a number")
        if not (self.resolution > 0 and math.isfinite(self.resolution)):
            raise ValueError(f"resolution: expected > 0 m and finite, got {self.resolution}")
        for name, interval in (("x", self.x), ("z", self.z)):
            if not (isinstance(interval, Sequence) and len(interval) == 2):
                raise TypeError(f"{name}: expected (low, high) in m, got {interval!r}")
            low, high = interval
            check_number(f"{name}[0]", low, "m as a number")
            check_number(f"{name}[1]", high, "m as a number")
            if not (high - low >= self.resolution and math.isfinite(high - low)):
                raise ValueError(
                    f"{name}: expected finite (low, high), high above low by {self.resolution} m, a cell, at "
                    f"least, got {(low, high)}"
                )

    @property
    def shape(self) -> tuple[int, int]:
        """(U, V): rows far to near, columns left to right."""
        return (
            round((self.z[1] - self.z[0]) / self.resolution),
            round((self.x[1] - self.x[0]) / self.resolution),
        )

    def road_from_bev_points(self, points: Tensor) -> Tensor:
        """Convert BEV pixels (column, row), (..., 2), to road points (X, Z), m."""
        column, row = points.unbind(-1)
        return torch.stack([self.x[0] + column * self.resolution, self.z[1] - row * self.resolution], dim=-1)

    def bev_from_road_points(self, points: Tensor) -> Tensor:
        """Convert road points (X, Z), (..., 2) m, to BEV pixels (column, row)."""
        x, z = points.unbind(-1)
        return torch.stack([(x - self.x[0]) / self.resolution, (self.z[1] - z) / self.resolution], dim=-1)

    def bev_from_road_covariance(self, cov: Tensor) -> Tensor:
        """Convert covariances of (X, Z), (..., 2, 2) m², to those of (column, row), px²."""
        sign = cov.new_tensor([1.0, -1.0]) / self.resolution
        return cov * sign[:, None] * sign

    def road_from_bev_covariance(self, cov: Tensor) -> Tensor:
        """Convert covariances of (column, row), (..., 2, 2) px², to those of (X, Z), m²."""
        sign = cov.new_tensor([1.0, -1.0]) * self.resolution
        return cov * sign[:, None] * sign

    def axes(
        self, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return X of the columns' centres (V,) and Z of the rows' centres (U,), m."""
        row, column = (torch.arange(size, dtype=dtype, device=device) for size in self.shape)
        return self.x[0] + column * self.resolution, self.z[1] - row * self.resolution

    def cells(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Tensor:
        """Return road coordinates (X, Z) of every pixel centre, (U, V, 2) m."""
        x, z = self.axes(dtype, device)
        z, x = torch.meshgrid(z, x, indexing="ij")
        return torch.stack([x, z], dim=-1)


@full_precision
def bev_from_image(extrinsics: Extrinsics, intrinsics: Tensor, grid: BEVGrid) -> Tensor:
    """Compute the homography from undistorted image pixels to BEV pixels.

    Source: Eq. (23), H_WC = S [r₁; r₃; r₂/h] K⁻¹ with r_i the rows of R(θ, φ, ψ). S is the paper's for a
    grid x = (-b_X/2, b_X/2), z = (0, b_Z); other rectangles shift it.

    Args:
        extrinsics: each (B,).
        intrinsics: (B, 3, 3).
        grid: the BEV rectangle.

    Returns:
        (B, 3, 3), pixels to pixels. Not normalised: its last row is the depth below the horizon. Not finite
        in rows whose focal lengths are zero.

    Raises:
        ValueError: intrinsics of another batch, or of whole numbers.
    """
    check_extrinsics(extrinsics)
    check_intrinsics(intrinsics, *extrinsics.pitch.shape)
    if not isinstance(grid, BEVGrid):
        raise TypeError(f"grid: expected lanebev.BEVGrid(...), got {type(grid).__qualname__}")
    rows = road_from_cam(extrinsics.pitch, extrinsics.yaw, extrinsics.roll)
    right, down, forward = rows.unbind(-2)
    plane_from_cam = torch.stack([right, forward, down / extrinsics.height.unsqueeze(-1)], dim=-2)
    scale = 1.0 / grid.resolution
    bev_from_plane = intrinsics.new_tensor(
        [[scale, 0.0, -grid.x[0] * scale], [0.0, -scale, grid.z[1] * scale], [0.0, 0.0, 1.0]]
    )
    return bev_from_plane @ plane_from_cam @ cam_from_image(intrinsics)
