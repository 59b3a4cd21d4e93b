"""The one resampling: from an image, or any feature map of it, to the bird's-eye grid."""

from __future__ import annotations

import torch
from kornia.geometry.transform import remap
from torch import Tensor, nn

from lanebev.geometry.lens import (
    check_intrinsics,
    check_rows,
    distort_points,
    max_undistorted_radius,
    normalise_points,
)
from lanebev.geometry.precision import common_dtype, full_precision
from lanebev.geometry.road import image_from_road_points
from lanebev.types import Extrinsics
from lanebev.view.grid import BEVGrid


class BEVWarp(nn.Module):
    """Inverse perspective mapping of images or feature maps, differentiable in everything but the grid.

    Source: Sec. V; the homography of Eq. (23) applied cell by cell, with the lens distortion folded into the
    same single bilinear resampling. Geometry is float32 at least, also under autocast and for images of half
    precision; so is the resampling, and its result has the image's dtype.

    Args:
        grid: the road's rectangle; default :class:`BEVGrid`.
    """

    def __init__(self, grid: BEVGrid | None = None) -> None:
        super().__init__()
        self.grid = grid or BEVGrid()

    def forward(
        self,
        image: Tensor,
        intrinsics: Tensor,
        extrinsics: Extrinsics,
        distortion: Tensor | None = None,
        model: str = "pinhole",
        image_size: tuple[int, int] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Resample.

        Args:
            image: (B, C, h, w), an image as it was taken or a feature map that covers it.
            intrinsics: (B, 3, 3) px of the image.
            extrinsics: each (B,).
            distortion: (B, D) of the lens, or None for an undistorted image.
            model: "pinhole" or "fisheye", the lens of ``distortion``.
            image_size: (H, W) px of the image that the intrinsics belong to; None where that is ``image``
                itself. A feature map of stride s is (H / s, W / s) and its cells' centres are evenly spread.

        Returns:
            bev (B, C, U, V), zero where not valid, and valid (B, 1, U, V) bool: in front of the camera and
            inside the image.

        Raises:
            ValueError: shapes that don't fit, or an image or intrinsics of whole numbers.
        """
        if image.ndim != 4:
            raise ValueError(f"image: expected (B, C, h, w), got {tuple(image.shape)}")
        if not image.is_floating_point():
            raise ValueError(f"image: expected floating point, got {image.dtype}")
        batch = image.shape[0]
        check_intrinsics(intrinsics, batch)
        if extrinsics.pitch.shape != (batch,):
            raise ValueError(f"extrinsics: expected ({batch},) each, got {tuple(extrinsics.pitch.shape)}")
        height, width = image_size or (image.shape[-2], image.shape[-1])
        pixels, valid = self.image_points(intrinsics, extrinsics, distortion, model)
        x, y = pixels.unbind(-1)
        inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
        valid = valid & inside
        scale_y, scale_x = image.shape[-2] / height, image.shape[-1] / width
        map_x = torch.where(valid, (x + 0.5) * scale_x - 0.5, -2.0).reshape(batch, *self.grid.shape)
        map_y = torch.where(valid, (y + 0.5) * scale_y - 0.5, -2.0).reshape(batch, *self.grid.shape)
        valid = valid.reshape(batch, 1, *self.grid.shape)
        dtype = common_dtype(image)
        bev = remap(
            image.to(dtype), map_x.to(dtype), map_y.to(dtype), mode="bilinear", padding_mode="border",
            align_corners=True, normalized_coordinates=False,
        )  # fmt: skip
        return torch.where(valid, bev, 0.0).to(image.dtype), valid

    @full_precision
    def image_points(
        self,
        intrinsics: Tensor,
        extrinsics: Extrinsics,
        distortion: Tensor | None = None,
        model: str = "pinhole",
    ) -> tuple[Tensor, Tensor]:
        """Where every cell is seen: (B, U·V, 2) px of the image as taken, and (B, U·V) bool in front."""
        cells = self.grid.cells(intrinsics.dtype, intrinsics.device).reshape(1, -1, 2)
        cells = cells.expand(intrinsics.shape[0], -1, -1)
        pixels, valid = image_from_road_points(cells, intrinsics, extrinsics)
        if distortion is None or distortion.shape[-1] == 0:
            return pixels, valid
        check_rows(distortion, pixels)
        radius = normalise_points(pixels, intrinsics).norm(dim=-1)
        seen = valid & (radius < max_undistorted_radius(distortion, model).unsqueeze(-1))
        centre = intrinsics[:, None, :2, 2]
        pixels = torch.where(seen.unsqueeze(-1), pixels, centre)  # no gradient through the folded part
        return distort_points(pixels, intrinsics, distortion, model), seen
