"""Resample a map of the road to the image, the inverse of the bird's-eye view."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lanebev.geometry.lens import invert_distortion
from lanebev.geometry.precision import cast_floating, common_dtype, full_precision
from lanebev.geometry.road import road_from_image_points
from lanebev.types import Extrinsics, check_type
from lanebev.view.checks import blind_unless_usable, check_cameras, check_image, check_size, doubt_intrinsics
from lanebev.view.grid import BEVGrid, bev_from_image
from lanebev.view.projection import CellSums, normalised_intrinsics, pixel_sums
from lanebev.view.sampling import MapSize, resampled

_ABOVE = -1e6  # depth of what is not on the road


class PixelCells(NamedTuple):
    """Homogeneous coordinates in the bird's-eye view of every pixel.

    Attributes:
        points: (B, 3, H, W).
    """

    points: Tensor

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, H, W)."""
        return self.points.shape[0], self.points.shape[2], self.points.shape[3]

    def rows(self, first: int, last: int) -> Tensor:
        """Return those of rows first to last - 1, (B, 3, last - first, W)."""
        return self.points[:, :, first:last].clone()


class ImageFromBEV(nn.Module):
    """Resamples a bird's-eye map to the image that would show it on the road; differentiable.

    It moves labels, masks or heat maps of the road into the image as the camera takes it.

    Args:
        grid: grid of the map; default :class:`BEVGrid`.
        plane_height: height above the road, m, of the plane that contains the map.
    """

    def __init__(self, grid: BEVGrid | None = None, plane_height: float = 0.0) -> None:
        super().__init__()
        check_type("grid", grid, BEVGrid)
        self.grid = grid or BEVGrid()
        self.plane_height = plane_height

    def forward(
        self,
        bev: Tensor,
        intrinsics: Tensor,
        extrinsics: Extrinsics,
        image_size: tuple[int, int],
        distortion: Tensor | None = None,
        model: str = "pinhole",
        vertical_curvature: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Resample a map of the road as the camera would see it.

        Args:
            bev: (B, C, u, v), of the grid's shape, or of another resolution of the same rectangle.
            intrinsics: (B, 3, 3) px.
            extrinsics: each (B,).
            image_size: (H, W) px of the image.
            distortion: (B, D) of the lens, or None for an undistorted image.
            model: "pinhole", "fisheye" or "omni", the lens of ``distortion``.
            vertical_curvature: (B,) 1/m of the road, positive over a crest, or None for a plane.

        Returns:
            (B, C, H, W), zero where not valid, and valid (B, 1, H, W) bool: pixels that show the rectangle.

        Raises:
            TypeError: an argument of another kind.
            ValueError: shapes that don't fit, or a map or intrinsics of whole numbers.
        """
        check_image(bev, "bev")
        check_size(image_size)
        check_cameras(bev, intrinsics, extrinsics, distortion, model, "bev")
        doubt_intrinsics(intrinsics, image_size)
        intrinsics, extrinsics, distortion = blind_unless_usable(intrinsics, extrinsics, distortion)
        size, dtype = self.grid.shape, common_dtype(bev)
        cells: CellSums | PixelCells
        if vertical_curvature is None and (distortion is None or distortion.shape[-1] == 0):
            cells = self._sums(intrinsics, extrinsics, image_size)
        else:
            cells = self._points(intrinsics, extrinsics, image_size, distortion, model, vertical_curvature)
        cells = cast_floating(cells, dtype)
        (image,), valid = resampled([bev], cells, None, [MapSize(bev.shape[-2], bev.shape[-1])], size)
        return image, valid

    @full_precision
    def _sums(self, intrinsics: Tensor, extrinsics: Extrinsics, image_size: tuple[int, int]) -> CellSums:
        """Compute where every undistorted pixel meets a plane road, homogeneous in [-1, 1]."""
        below = extrinsics.height - self.plane_height
        height = torch.where(below > 0, below, 1.0)
        matrix = bev_from_image(extrinsics._replace(height=height), intrinsics, self.grid)
        slope = normalised_intrinsics(matrix, self.grid.shape) * height[:, None, None]  # last row: of a ray
        return pixel_sums(torch.where((below > 0)[:, None, None], slope, _ABOVE), image_size)

    @full_precision
    def _points(
        self,
        intrinsics: Tensor,
        extrinsics: Extrinsics,
        image_size: tuple[int, int],
        distortion: Tensor | None,
        model: str,
        vertical_curvature: Tensor | None,
    ) -> PixelCells:
        """Compute where every pixel as taken meets the road, homogeneous in [-1, 1]."""
        pixels, valid = _all_pixels(image_size, intrinsics), None
        if distortion is not None:
            pixels, valid = invert_distortion(pixels, intrinsics, distortion, model)
        below = extrinsics._replace(height=extrinsics.height - self.plane_height)
        road, on_road = road_from_image_points(pixels, intrinsics, below, vertical_curvature)
        bev = self.grid.bev_from_road_points(road).mT  # (B, 2, H·W)
        to_unit = normalised_intrinsics(torch.eye(3).to(bev), self.grid.shape)
        points = to_unit[:, :2] @ bev + to_unit[:, 2:]
        seen = on_road if valid is None else on_road & valid
        return PixelCells(torch.where(seen.unsqueeze(1), points, _ABOVE).unflatten(-1, image_size))


def _all_pixels(image_size: tuple[int, int], like: Tensor) -> Tensor:
    """Return the pixels of an image, (B, H·W, 2), for every (3, 3) of ``like``."""
    y, x = (torch.arange(side, dtype=like.dtype, device=like.device) for side in image_size)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(1, -1, 2)
    return pixels.expand(len(like), -1, 2)
