"""Resample an image, or its feature maps, to the bird's-eye grid."""

import math
from collections.abc import Sequence
from numbers import Real

import torch
from torch import Tensor, nn

from lanebev.geometry.precision import common_dtype
from lanebev.geometry.road_profile import check_vertical_curvature
from lanebev.numbers import check_number
from lanebev.types import Extrinsics, check_type
from lanebev.view.cells import cells_and_lens, rows_in_sight
from lanebev.view.checks import (
    blind_unless_usable,
    check_cameras,
    check_covers,
    check_image,
    check_size,
    check_stride,
    doubt_intrinsics,
)
from lanebev.view.grid import BEVGrid
from lanebev.view.projection import image_coordinates, normalised_intrinsics
from lanebev.view.sampling import MapSize, resampled


class BEVWarp(nn.Module):
    """Inverse perspective mapping of images or feature maps, differentiable in everything but the grid.

    Source: Sec. V; the homography of Eq. (23) applied cell by cell, with the lens distortion folded into the
    same single bilinear resampling. Geometry is float32 at least, also under autocast and for images of half
    precision; so is the resampling, and its result has the image's dtype.

    Args:
        grid: the road's rectangle; default :class:`BEVGrid`.
        plane_heights: heights above the road, m, of P planes parallel to it that are sampled instead of the
            road, for detection heads that sample volumes.
    """

    def __init__(self, grid: BEVGrid | None = None, plane_heights: Sequence[float] | None = None) -> None:
        super().__init__()
        check_type("grid", grid, BEVGrid)
        if isinstance(plane_heights, (str, Real)):
            raise TypeError(f"plane_heights: expected a list of heights in m, got {plane_heights!r}")
        self.grid = grid or BEVGrid()
        self.plane_heights = None if plane_heights is None else tuple(map(float, plane_heights))
        if self.plane_heights == ():
            raise ValueError("plane_heights: expected one plane at least, or None for the road, got none")

    def forward(
        self,
        image: Tensor | Sequence[Tensor],
        intrinsics: Tensor,
        extrinsics: Extrinsics,
        distortion: Tensor | None = None,
        model: str = "pinhole",
        image_size: tuple[int, int] | None = None,
        strides: float | Sequence[float] | None = None,
        vertical_curvature: Tensor | None = None,
    ) -> tuple[Tensor | list[Tensor], Tensor]:
        """Resample images or feature maps to the bird's-eye view.

        Args:
            image: (B, C, h, w), an image as it was taken or a feature map that covers it, or a sequence of
                maps of any sizes and channels.
            intrinsics: (B, 3, 3) px of the image.
            extrinsics: each (B,).
            distortion: (B, D) of the lens, or None for an undistorted image.
            model: "pinhole", "fisheye" or "omni", the lens of ``distortion``.
            image_size: (H, W) px of the image that the intrinsics belong to; None where that is ``image``
                itself.
            strides: stride of the map, or of each map, px: cell j is centred on pixel stride · j, as in a
                convolutional trunk with symmetric padding. None: cells are evenly spread over the image, as
                after pooling or with patches.
            vertical_curvature: (B,) 1/m of the road, positive over a crest, such as a calibrator's
                ``vertical_curvature(state)``; None for a plane.

        Returns:
            bev (B, C, U, V), zero where not valid, or a list of one for each map; and valid (B, 1, U, V)
            bool: in front of the camera, inside the image, and not hidden by a crest. With P plane heights,
            bev (B, C, P, U, V) and valid (B, 1, P, U, V).

        Raises:
            TypeError: an argument of another kind.
            ValueError: shapes that don't fit, or an image or intrinsics of whole numbers.
        """
        maps = [image] if isinstance(image, Tensor) or not isinstance(image, Sequence) else list(image)
        sizes, size = _map_sizes(maps, strides, image_size)
        check_cameras(maps[0], intrinsics, extrinsics, distortion, model)
        doubt_intrinsics(intrinsics, size)
        intrinsics, extrinsics, distortion = blind_unless_usable(intrinsics, extrinsics, distortion)
        if vertical_curvature is not None:
            check_vertical_curvature(vertical_curvature, maps[0].shape[0])
        heights = self.plane_heights or (0.0,)
        cells, lens = cells_and_lens(
            self.grid, normalised_intrinsics(intrinsics, size), extrinsics, distortion, model,
            common_dtype(*maps), heights, vertical_curvature,
        )  # fmt: skip
        sampled, valid = resampled(maps, cells, lens, sizes, size)
        if vertical_curvature is not None:
            shown = rows_in_sight(self.grid, heights, extrinsics, vertical_curvature)[:, None, :, None]
            sampled, valid = [torch.where(shown, each, 0.0) for each in sampled], valid & shown
        bevs = [self._planes(each) for each in sampled]
        return bevs[0] if maps[0] is image else bevs, self._planes(valid)

    def image_points(
        self,
        intrinsics: Tensor,
        extrinsics: Extrinsics,
        distortion: Tensor | None = None,
        model: str = "pinhole",
        vertical_curvature: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Compute where every cell is seen.

        Args:
            intrinsics: (B, 3, 3) px.
            extrinsics: extrinsics, each (B,).
            distortion: (B, D) of the lens, or None for an undistorted image.
            model: "pinhole", "fisheye" or "omni", the lens of ``distortion``.
            vertical_curvature: (B,) 1/m of the road, positive over a crest; None for a plane.

        Returns:
            (B, U·V, 2) px of the image as taken, and (B, U·V) bool, in front and not hidden by a crest; with
            P plane heights P·U·V.
        """
        if vertical_curvature is not None:
            check_vertical_curvature(vertical_curvature, intrinsics.shape[0])
        heights = self.plane_heights or (0.0,)
        cells, lens = cells_and_lens(
            self.grid, intrinsics, extrinsics, distortion, model, common_dtype(intrinsics),
            heights, vertical_curvature,
        )  # fmt: skip
        points, hidden = image_coordinates(cells.rows(0, cells.shape[1]), lens)
        ahead = hidden == 0
        if vertical_curvature is not None:
            ahead = ahead & rows_in_sight(self.grid, heights, extrinsics, vertical_curvature).unsqueeze(-1)
        return points.flatten(2).mT, ahead.flatten(1)

    def _planes(self, sampled: Tensor) -> Tensor:
        """Reshape (B, C, P·U, V) to (B, C, P, U, V) if there are several planes."""
        if self.plane_heights is None:
            return sampled
        planes: Tensor = sampled.unflatten(2, (len(self.plane_heights), -1))
        return planes


def _map_sizes(
    maps: Sequence[Tensor], strides: float | Sequence[float] | None, image_size: tuple[int, int] | None
) -> tuple[list[MapSize], tuple[int, int]]:
    """Check maps, and return how each lies in the image, and the image's size."""
    if not maps:
        raise ValueError("image: expected one map at least, got none")
    for each in maps:
        check_image(each)
        if each.shape[0] != maps[0].shape[0]:
            raise ValueError(f"image: expected maps of {maps[0].shape[0]} images, got {each.shape[0]}")
    steps = _checked_strides(strides, len(maps))
    if image_size is None:
        if len(maps) > 1 or steps[0] is not None:
            raise ValueError("image_size: expected (H, W) px of the image that maps belong to, got None")
        image_size = (maps[0].shape[-2], maps[0].shape[-1])
    check_size(image_size)
    for each, step in zip(maps, steps, strict=True):
        check_covers(each, image_size)
        check_stride(each, step, image_size)
    sizes = [MapSize(each.shape[-2], each.shape[-1], step) for each, step in zip(maps, steps, strict=True)]
    return sizes, image_size


def _checked_strides(strides: float | Sequence[float] | None, count: int) -> list[float | None]:
    """Return the stride of each of ``count`` maps, px, or None."""
    steps: list[float | None] = list(strides) if isinstance(strides, Sequence) else [strides] * count
    if len(steps) != count:
        raise ValueError(f"strides: expected {count}, one for each map, got {len(steps)}")
    for step in steps:
        if step is not None:
            check_number("strides", step, "px as numbers, or None")
            if not 0 < step < math.inf:
                raise ValueError(f"strides: expected more than 0 px, got {step}")
    return steps
