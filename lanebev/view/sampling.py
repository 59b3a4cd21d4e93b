"""The maps of a resampling: where an image is sampled for each cell, and which cells it does not show.

Coordinates are planes (B, 2, R, V), never pairs, and rows of cells are processed in blocks that stay in the
cache. Sums that are zero inside the image tell what lies outside: comparisons and ``where`` take several
times as long as arithmetic on a CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from lanebev.view.kept import KeptArrays
from lanebev.view.lens import Lens, image_planes

_kept = KeptArrays()

LEAST_DEPTH = 1e-3  # in front of the camera; m for cells of the road
_PUSH = 1e4  # factor that moves what lies outside away from the map, even a millimetre above the road
BLOCK = 1 << 17  # cells: a dozen float32 planes of so many fit a cache of a few MB


class Cells(Protocol):
    """Homogeneous coordinates of R × V cells."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, R, V)."""
        ...

    def rows(self, first: int, last: int) -> Tensor:
        """Return those of rows first to last - 1, (B, 3, last - first, V), a tensor of its own."""
        ...


class CellSums(NamedTuple):
    """Homogeneous coordinates of cells, as sums of a row's and a column's part.

    Attributes:
        by_row: (B, 3, R).
        by_column: (B, 3, V).
    """

    by_row: Tensor
    by_column: Tensor

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, R, V)."""
        return self.by_row.shape[0], self.by_row.shape[2], self.by_column.shape[2]

    def rows(self, first: int, last: int) -> Tensor:
        """Return those of rows first to last - 1, (B, 3, last - first, V)."""
        return self.by_row[..., first:last].unsqueeze(-1) + self.by_column.unsqueeze(-2)


class MapSize(NamedTuple):
    """Shape of a map to be sampled and how its cells lie in the image.

    Attributes:
        height, width: cells.
        stride: px; cell j is centred on pixel stride · j. None where cells are evenly spread over the image.
    """

    height: int
    width: int
    stride: float | None = None


def normalised_intrinsics(intrinsics: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Intrinsics to coordinates in which the image, its outer pixels' edges included, is [-1, 1].

    This is the convention of ``grid_sample(align_corners=False)``: the same for maps of every size.

    Args:
        intrinsics: (B, 3, 3) px.
        image_size: (H, W) px.
    """
    height, width = image_size
    scale = intrinsics.new_tensor([2 / width, 2 / height, 1.0]).unsqueeze(-1)
    shift = intrinsics.new_tensor([1 / width - 1, 1 / height - 1, 0.0]).unsqueeze(-1)
    return intrinsics * scale + intrinsics[..., 2:, :] * shift


def image_coordinates(cells: Tensor, lens: Lens | None) -> tuple[Tensor, Tensor]:
    """Project cells.

    Args:
        cells: (B, 3, R, V) homogeneous coordinates in the image, or with a lens in the camera.
        lens: None for an undistorted image.

    Returns:
        (B, 2, R, V) coordinates, finite everywhere, and (B, R, V): zero in front of the camera and where the
        lens does not fold over, else positive.
    """
    depth = cells[:, 2]
    ahead = depth.clamp(min=LEAST_DEPTH)
    points = cells[:, :2] / ahead.unsqueeze(1)
    hidden = (ahead - depth).detach()
    if lens is None:
        return points, hidden
    points, beyond = image_planes(points, lens)
    return points, hidden + beyond


def outside_image(points: Tensor, hidden: Tensor) -> Tensor:
    """Mark what an image does not show.

    Args:
        points: (B, 2, R, V) normalised coordinates.
        hidden: (B, R, V), zero where seen.

    Returns:
        (B, R, V), zero where seen and inside the image, else positive; without gradient.
    """
    beyond = F.hardshrink(points.detach(), 1.0)  # zero in [-1, 1]
    x, y = beyond.unbind(1)
    return torch.addcmul(torch.addcmul(hidden, x, x), y, y)


def sampling_maps(
    cells: Cells, lens: Lens | None, sizes: Sequence[MapSize], image_size: tuple[int, int]
) -> tuple[list[Tensor], Tensor]:
    """Compute the maps for :func:`resample`.

    Where nothing asks for a gradient, they are written to memory that the next call in this thread writes to
    again: they are to be used up before.

    Args:
        cells: homogeneous coordinates, :func:`normalised_intrinsics` applied; with a lens in the camera.
        lens: into normalised coordinates, or None.
        sizes: of every map to be sampled.
        image_size: (H, W) px of the image that the coordinates belong to.

    Returns:
        (B, 2, R, V) for each size, and (B, 1, R, V) bool: valid.
    """
    if _may_overwrite():
        return _filled_maps(cells, lens, sizes, image_size)
    batch, rows, columns = cells.shape
    block = max(1, BLOCK // max(1, batch * columns))
    if torch.compiler.is_compiling():  # compiled code has no planes in between
        block = rows
    maps: list[tuple[list[Tensor], list[Tensor]]] = [([], []) for _ in sizes]
    invalid = []
    for first in range(0, rows, block):
        points, hidden = image_coordinates(cells.rows(first, min(first + block, rows)), lens)
        outside = outside_image(points, hidden)
        for size, (xs, ys) in zip(sizes, maps, strict=True):
            x = map_coordinate(points[:, 0], size.width, size.stride, image_size[1])
            xs.append(torch.add(x, outside, alpha=_PUSH))
            ys.append(map_coordinate(points[:, 1], size.height, size.stride, image_size[0]))
        invalid.append(outside.bool())
    stacked = [torch.cat([*xs, *ys], dim=1).unflatten(1, (2, rows)) for xs, ys in maps]
    return stacked, torch.cat(invalid, dim=1).logical_not().unsqueeze(1)


def _may_overwrite() -> bool:
    """Whether results need no graph, be it of gradients or of operations."""
    traced = torch.compiler.is_compiling() or torch.jit.is_tracing()  # type: ignore[attr-defined, no-untyped-call]
    return not (torch.is_grad_enabled() or traced or torch._C._are_functorch_transforms_active())


def _filled_maps(
    cells: Cells, lens: Lens | None, sizes: Sequence[MapSize], image_size: tuple[int, int]
) -> tuple[list[Tensor], Tensor]:
    """Compute what :func:`sampling_maps` does, by the same arithmetic in place, in memory that is kept."""
    batch, rows, columns = cells.shape
    like = cells.rows(0, 0)
    maps = [_kept_map(number, (batch, 2, rows, columns), like) for number in range(len(sizes))]
    valid = torch.empty((batch, 1, rows, columns), dtype=torch.bool, device=like.device)
    block = max(1, BLOCK // max(1, batch * columns))
    for first in range(0, rows, block):
        last = min(first + block, rows)
        homogeneous = cells.rows(first, last)
        depth = homogeneous[:, 2]
        ahead = depth.clamp(min=LEAST_DEPTH)
        points = homogeneous[:, :2].div_(ahead.unsqueeze(1))
        outside = ahead.sub_(depth)
        if lens is not None:
            points, beyond = image_planes(points, lens)
            outside += beyond
        for beyond in F.hardshrink(points, 1.0).unbind(1):
            outside.addcmul_(beyond, beyond)
        for size, whole in zip(sizes, maps, strict=True):
            x, y = whole[:, :, first:last].unbind(1)
            map_coordinate(points[:, 0], size.width, size.stride, image_size[1], out=x)
            map_coordinate(points[:, 1], size.height, size.stride, image_size[0], out=y)
            x.add_(outside, alpha=_PUSH)
        torch.logical_not(outside.bool(), out=valid[:, 0, first:last])
    return maps, valid


def _kept_map(number: int, shape: tuple[int, int, int, int], like: Tensor) -> Tensor:
    """Memory for the map of this number; the device's own store of memory elsewhere than on a CPU."""
    if like.device.type != "cpu":
        return like.new_empty(shape)
    return torch.from_numpy(_kept(f"map {number}", shape, like.numpy().dtype))


def map_coordinate(
    coordinate: Tensor, cells: int, stride: float | None, pixels: int, out: Tensor | None = None
) -> Tensor:
    """Transform a normalised coordinate of the image to that of a map, clamped to its outermost centres.

    Args:
        coordinate: (B, R, V), x or y.
        cells: of the map along it.
        stride: px, or None, see :class:`MapSize`.
        pixels: of the image along it.
        out: (B, R, V) to write to.
    """
    if stride is not None:  # x of the image to x / stride of the map
        scale = pixels / (stride * cells)
        coordinate = coordinate * scale + ((pixels - 1) / (stride * cells) + 1 / cells - 1)
    centre = 1 - 1 / cells
    if out is not None:
        return torch.clamp(coordinate, -centre, centre, out=out)
    return F.hardtanh(coordinate, -centre, centre)


def resample(features: Tensor, sampling_map: Tensor) -> Tensor:
    """Sample (B, C, h, w) bilinearly, zero where the map lies outside, in the features' dtype."""
    sampled = F.grid_sample(
        features.to(sampling_map.dtype), sampling_map.movedim(1, -1), "bilinear", "zeros", align_corners=False
    )
    return sampled.to(features.dtype)
