"""The one resampling: from an image, or any feature map of it, to the bird's-eye grid."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from lanebev.geometry.distortion import check_lens
from lanebev.geometry.lens import check_intrinsics
from lanebev.geometry.precision import common_dtype
from lanebev.types import Extrinsics, check_extrinsics, check_tensor
from lanebev.view.grid import BEVGrid
from lanebev.view.sampling import (
    cells_and_lens,
    image_coordinates,
    normalised_intrinsics,
    resample,
    sampling_maps,
)


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
            model: "pinhole", "fisheye" or "omni", the lens of ``distortion``.
            image_size: (H, W) px of the image that the intrinsics belong to; None where that is ``image``
                itself. A feature map of stride s is (H / s, W / s) and its cells' centres are evenly spread.

        Returns:
            bev (B, C, U, V), zero where not valid, and valid (B, 1, U, V) bool: in front of the camera and
            inside the image.

        Raises:
            ValueError: shapes that don't fit, or an image or intrinsics of whole numbers.
        """
        check_image(image)
        size = image_size or (image.shape[-2], image.shape[-1])
        check_size(size)
        check_cameras(image.shape[0], intrinsics, extrinsics, distortion, model)
        image_from_cam = normalised_intrinsics(intrinsics, size)
        sums, lens = cells_and_lens(
            self.grid, image_from_cam, extrinsics, distortion, model, common_dtype(image)
        )
        (sampling_map,), valid = sampling_maps(sums, lens, [(image.shape[-2], image.shape[-1])])
        return resample(image, sampling_map), valid

    def image_points(
        self,
        intrinsics: Tensor,
        extrinsics: Extrinsics,
        distortion: Tensor | None = None,
        model: str = "pinhole",
    ) -> tuple[Tensor, Tensor]:
        """Where every cell is seen: (B, U·V, 2) px of the image as taken, and (B, U·V) bool in front."""
        sums, lens = cells_and_lens(
            self.grid, intrinsics, extrinsics, distortion, model, common_dtype(intrinsics)
        )
        points, hidden = image_coordinates(sums, lens)
        return points.flatten(2).mT, hidden.flatten(1) == 0


def check_image(image: Tensor) -> None:
    """Raise TypeError or ValueError unless this is a (B, C, h, w) map of floating point."""
    check_tensor("image", image)
    if image.ndim != 4:
        raise ValueError(f"image: expected (B, C, h, w), got {tuple(image.shape)}")
    if not image.is_floating_point():
        raise ValueError(f"image: expected floating point, got {image.dtype}")


def check_size(size: object) -> None:
    """Raise TypeError unless this is a pair, (height, width)."""
    if not (isinstance(size, Sequence) and len(size) == 2):
        raise TypeError(f"image_size: expected (height, width) in px, got {size!r}")


def check_cameras(
    batch: int, intrinsics: Tensor, extrinsics: Extrinsics, distortion: Tensor | None, model: str
) -> None:
    """Raise TypeError or ValueError unless there are ``batch`` cameras with poses, and lenses that exist."""
    check_intrinsics(intrinsics, batch)
    check_extrinsics(extrinsics, batch)
    if distortion is None:
        return
    check_tensor("distortion", distortion)
    if distortion.shape[:-1] != (batch,):
        raise ValueError(f"distortion: expected ({batch}, D) like the points, got {tuple(distortion.shape)}")
    check_lens(distortion, model)
