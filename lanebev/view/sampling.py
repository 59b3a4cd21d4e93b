"""Resample maps at the cells that an image shows.

Coordinates are computed in blocks of rows that stay in the cache; without gradients, in memory that is kept.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import torch
import torch.nn.functional as F
from torch import Tensor

from lanebev.tensors import one_thread
from lanebev.view.blocks import Block, blocks, traced
from lanebev.view.lens import Lens
from lanebev.view.projection import Cells
from lanebev.view.reused_memory import ReusedArrays

_kept = ReusedArrays()

_PUSH = 4.0  # half widths of a map by which what lies outside is moved away from it
_MOST_SIDE = (1 << 15) - 1  # of images that OpenCV samples, px, is less
_OPENCV_IS_EXACT = int(cv2.__version__.split(".")[0]) >= 5  # before, it rounds coordinates to 1/32 px


class MapSize(NamedTuple):
    """Shape of a map to be sampled and the position of its cells in the image.

    Attributes:
        height, width: cells.
        stride: px; cell j is centred on pixel stride · j. None where cells are evenly spread over the image.
    """

    height: int
    width: int
    stride: float | None = None


def resampled(
    maps: Sequence[Tensor],
    cells: Cells,
    lens: Lens | None,
    sizes: Sequence[MapSize],
    image_size: tuple[int, int],
) -> tuple[list[Tensor], Tensor]:
    """Sample maps of one image where it shows cells, bilinearly, zero where it does not.

    Args:
        maps: (B, C, h, w) each.
        cells: homogeneous coordinates, ``normalised_intrinsics`` applied; with a lens in the camera.
        lens: into normalised coordinates, or None.
        sizes: sizes of every map.
        image_size: (H, W) px of the image that the coordinates belong to.

    Returns:
        (B, C, R, V) of each map in its dtype, and (B, 1, R, V) bool: valid.
    """
    at = sampling_maps(cells, lens, sizes, image_size)
    valid = _at_most_one(at[0][:, :1])
    if all(map(_is_for_opencv, maps, at)):
        sampled = [_remapped(each, where) for each, where in zip(maps, at, strict=True)]
        if all(map(_is_finite, sampled)):
            return sampled, valid
        at = sampling_maps(cells, lens, sizes, image_size)  # they were overwritten
    return [_grid_sample(each, where) for each, where in zip(maps, at, strict=True)], valid


def _at_most_one(values: Tensor) -> Tensor:
    """Return where values are at most 1, bool."""
    if values.device.type == "cpu" and not traced():
        return torch.from_numpy(values.detach().numpy() <= 1)  # in a quarter of torch's time
    return values <= 1


def sampling_maps(
    cells: Cells, lens: Lens | None, sizes: Sequence[MapSize], image_size: tuple[int, int]
) -> list[Tensor]:
    """Compute where to sample maps of one image.

    Args:
        cells: as of :func:`resampled`.
        lens: as of :func:`resampled`.
        sizes: of every map.
        image_size: (H, W) px.

    Returns:
        (B, 2, R, V) of each map, coordinates for ``grid_sample``, x above 1 where not seen, in memory that is
        kept where there is no graph.
    """
    limit = min(1 - 1 / side for size in sizes for side in (size.width, size.height))
    if _may_overwrite():
        return _maps_written(cells, lens, sizes, image_size, limit)
    parts: list[list[Tensor]] = [[] for _ in sizes]
    for block in blocks(cells, lens, limit):
        for part, size in zip(parts, sizes, strict=True):
            part.append(block_map(block, size, image_size))
    return [torch.cat(part, dim=2) for part in parts]


def _maps_written(
    cells: Cells, lens: Lens | None, sizes: Sequence[MapSize], image_size: tuple[int, int], limit: float
) -> list[Tensor]:
    """Compute :func:`sampling_maps` without a graph, in memory that is kept."""
    maps = _kept_maps(len(sizes), cells)
    for block in blocks(cells, lens, limit, lambda first, last: maps[0][:, :, first:last]):
        rows = slice(block.first, block.last)
        for number in reversed(range(len(sizes))):  # the first map takes the place of the points
            block_map(block, sizes[number], image_size, maps[number][:, :, rows])
    return maps


def _may_overwrite() -> bool:
    """Return whether results need no graph, be it of gradients or of operations."""
    return not (torch.is_grad_enabled() or traced())


def _kept_maps(count: int, cells: Cells) -> list[Tensor]:
    """Return memory for maps; elsewhere than on a CPU the device's own store of memory."""
    like = cells.rows(0, 0)
    shape = (cells.shape[0], 2, *cells.shape[1:])
    if like.device.type != "cpu":
        return [like.new_empty(shape) for _ in range(count)]
    return [torch.from_numpy(_kept(f"map {number}", shape, like.numpy().dtype)) for number in range(count)]


def block_map(block: Block, size: MapSize, image_size: tuple[int, int], out: Tensor | None = None) -> Tensor:
    """Compute the coordinates of a map for ``grid_sample``; x is above 1 where not seen.

    Args:
        block: block of the image.
        size: size of the map.
        image_size: (H, W) px.
        out: (B, 2, rows, V) to write to, which may be the block's points.

    Returns:
        (B, 2, rows, V).
    """
    if block.outside is None and size.stride is None:
        if out is None or out.data_ptr() == block.points.data_ptr():
            return block.points
        return out.copy_(block.points)
    x, y = block.points.unbind(1)
    to_x, to_y = (None, None) if out is None else out.unbind(1)
    x = map_coordinate(x, size.width, size.stride, image_size[1], to_x)
    y = map_coordinate(y, size.height, size.stride, image_size[0], to_y)
    if block.outside is not None:
        x = torch.add(x, block.outside, alpha=_PUSH, out=to_x)
    return torch.stack([x, y], dim=1) if out is None else out


def map_coordinate(
    coordinate: Tensor, cells: int, stride: float | None, pixels: int, out: Tensor | None
) -> Tensor:
    """Transform a normalised coordinate of the image to that of a map, clamped to its outermost centres.

    Args:
        coordinate: (B, R, V), x or y.
        cells: cells of the map along it.
        stride: px, or None, see :class:`MapSize`.
        pixels: pixels of the image along it.
        out: (B, R, V) to write to, or None.
    """
    if stride is not None:  # x of the image to x / stride of the map
        scale = pixels / (stride * cells)
        coordinate = coordinate * scale + ((pixels - 1) / (stride * cells) + 1 / cells - 1)
    centre = 1 - 1 / cells
    if (
        out is not None or torch.compiler.is_exporting()
    ):  # ONNX's hardtanh takes no limits that depend on sizes
        return torch.clamp(coordinate, -centre, centre, out=out)
    return F.hardtanh(coordinate, -centre, centre)  # whose gradient takes a sixth of the time


def _is_for_opencv(features: Tensor, at: Tensor) -> bool:
    """Return whether OpenCV samples as :func:`_grid_sample` does: without gradients, on the CPU."""
    return (
        _may_overwrite()
        and (at.device.type, at.dtype) == ("cpu", torch.float32)
        and _OPENCV_IS_EXACT
        and max(*features.shape[2:], *at.shape[2:]) < _MOST_SIDE
    )


@one_thread()  # of PyTorch; OpenCV uses its own
def _remapped(features: Tensor, at: Tensor) -> Tensor:
    """Sample as :func:`_grid_sample`, one image divided among threads; none waits for one that is late.

    The coordinates are overwritten. Between infinite values the result is NaN.
    """
    for plane, side in zip(at.unbind(1), reversed(features.shape[2:]), strict=True):
        # to pixels, rounded as by grid_sample
        torch.add(plane.new_tensor(-0.5), plane.add_(1), alpha=side / 2, out=plane)
    sampled = at.new_empty(*features.shape[:2], *at.shape[2:])
    images = features.to(at.dtype).contiguous().numpy(force=True)
    for image, (x, y), bev in zip(images, at.numpy(), sampled.numpy(), strict=True):
        for channel, out in zip(image, bev, strict=True):
            cv2.remap(channel, x, y, cv2.INTER_LINEAR, out)
    return sampled.to(features.dtype)


@one_thread()
def _is_finite(values: Tensor) -> bool:
    return bool(values.sum(dtype=torch.float32).isfinite())  # half precision would overflow


def _grid_sample(features: Tensor, at: Tensor) -> Tensor:
    """Sample (B, C, h, w) bilinearly at (B, 2, R, V), zero where that lies outside, in its dtype."""
    at = at.movedim(1, -1)
    return F.grid_sample(features.to(at.dtype), at, "bilinear", "zeros", align_corners=False).to(
        features.dtype
    )
