"""Resample camera frames as files hold them: one image of bytes."""

import itertools
import math
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lanebev.camera.model import Camera
from lanebev.geometry.precision import cast_floating
from lanebev.geometry.road_profile import check_vertical_curvature
from lanebev.types import Extrinsics
from lanebev.view.blocks import BLOCK, image_coordinates_by_one_thread
from lanebev.view.cells import cell_sums, rows_in_sight
from lanebev.view.grid import BEVGrid
from lanebev.view.lens import Lens, make_lens
from lanebev.view.projection import CellSums, normalised_intrinsics
from lanebev.view.reused_memory import ReusedArrays
from lanebev.view.thread_limits import ONE_THREAD
from lanebev.view.tiles import LARGEST_WEIGHTS, interpolant

_kept = ReusedArrays()

_MOST_PIXELS = 8  # pixels per cell; with more, adding a fourth channel takes longer than it saves


@torch.inference_mode()
def remap_frame(
    frame: NDArray[np.uint8],
    camera: Camera,
    extrinsics: Extrinsics,
    grid: BEVGrid,
    vertical_curvature: Tensor | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Resample one frame to the bird's-eye view, as :class:`~lanebev.BEVWarp` does, by OpenCV.

    Args:
        frame: (H, W, 3) or (H, W) of bytes, as taken.
        camera: its lens, of the frame's size.
        extrinsics: extrinsics of batch size 1.
        grid: the road's rectangle.
        vertical_curvature: (1,) 1/m of the road, or None for a plane.

    Returns:
        (U, V, 3) or (U, V) bytes, zero where not valid, and (U, V) bool. OpenCV before 5 rounds coordinates
        to 1/32 px.

    Raises:
        ValueError: a frame of another type or size than the camera's, or a curvature of another shape.
    """
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3):
        raise ValueError(f"frame: expected (H, W, 3) of uint8, got {frame.shape} of {frame.dtype}")
    height, width = camera.image_size
    if frame.shape[:2] != (height, width):
        raise ValueError(
            f"frame: expected the camera's {height} x {width}, got {frame.shape[0]} x {frame.shape[1]}; "
            "see Camera.scaled"
        )
    image_from_cam, lens = _projection(camera)
    extrinsics = Extrinsics(*(part.cpu() for part in extrinsics))
    curvature = None
    if vertical_curvature is not None:
        check_vertical_curvature(vertical_curvature, 1)
        curvature = vertical_curvature.cpu()
    cells = cast_floating(cell_sums(grid, (0.0,), image_from_cam, extrinsics, curvature), torch.float32)
    source = _Source(frame, grid.shape)
    bev = np.empty((*grid.shape, *frame.shape[2:]), np.uint8)
    valid = np.ones(grid.shape, np.bool_)
    for strip in _strips(cells, lens, camera.image_size):
        source.prepare(*strip.image_rows)
        source.sample(strip.points, strip.seen, bev[strip.rows])
        if strip.seen is not None:
            valid[strip.rows] = strip.seen
    if curvature is not None:
        hidden = ~rows_in_sight(grid, (0.0,), extrinsics, curvature)[0].numpy()
        bev[hidden], valid[hidden] = 0, False
    return bev, valid


class _Strip(NamedTuple):
    """The coordinates at which an image shows some rows of cells.

    Attributes:
        rows: of the view.
        points: (2, R, V) px, in the image; in memory that is kept.
        seen: (R, V) bool, or None where all are.
        image_rows: from which row of the image to below which those that are seen are sampled.
    """

    rows: slice
    points: NDArray[np.float32]
    seen: NDArray[np.bool_] | None
    image_rows: tuple[int, int]


def _strips(cells: CellSums, lens: Lens | None, size: tuple[int, int]) -> Iterator[_Strip]:
    """Compute where an image shows cells, in strips of rows that stay in the cache.

    Args:
        cells: float32, of a batch of one.
        lens: into normalised coordinates, or None.
        size: (H, W) px of the image.
    """
    _, count, columns = cells.shape
    curves = interpolant(cells, lens, 1 - 1 / min(size))
    edges: tuple[int, ...] = (0, count)
    memory = torch.from_numpy(_kept("points", (1, 2, max(1, BLOCK // columns), columns), np.float32))
    if curves is not None:
        curves, edges = curves._replace(values=_pixels(curves.values, size)), curves.rows.edges
    for tile, span in enumerate(itertools.pairwise(edges)):
        smooth = curves is not None and bool(curves.smooth[0, tile])
        step = max(1, (BLOCK if smooth else ONE_THREAD // 3) // columns)
        for rows in (slice(first, min(first + step, span[1])) for first in range(*span, step)):
            if curves is not None and smooth:
                inner = slice(rows.start - span[0], rows.stop - span[0])
                points = curves.points(tile, inner, memory[:, :, : rows.stop - rows.start])
                if curves.inside[tile]:
                    y = curves.values[0, 1, tile].numpy()
                    yield _Strip(rows, points[0].numpy(), None, _image_rows(*_bounds(y), size[0]))
                    continue
                hidden = curves.hidden(tile, inner)
            else:
                points, hidden = image_coordinates_by_one_thread(cells.rows(rows.start, rows.stop), lens)
                points = _pixels(points, size)
            at = points[0].numpy()
            seen = _clamp(at, size)
            if hidden is not None:
                seen &= hidden[0].numpy() == 0
            yield _Strip(rows, at, seen, _image_rows(at[1].min(), at[1].max(), size[0]))


def _image_rows(low: float, high: float, height: int) -> tuple[int, int]:
    """Return from which row of an image to below which points between two y, px, are interpolated.

    All rows, if the y are not numbers: no comparison with these is true.
    """
    return int(max(0.0, low)), int(min(height - 2.0, high)) + 2


def _bounds(values: NDArray[np.float32]) -> tuple[float, float]:
    """Bound polynomials by their values at the nodes of a tile.

    They depart from the middle by no more than these, times the sum of the magnitudes of the weights.
    """
    low, high = float(values.min()), float(values.max())
    reach = LARGEST_WEIGHTS * (high - low) / 2
    return (low + high) / 2 - reach, (low + high) / 2 + reach


def _clamp(points: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Clamp points to an image, in place.

    Args:
        points: (2, R, V) px, clamped to the centres of the outermost pixels.
        size: (H, W) px.

    Returns:
        (R, V), which were in the image, with the edges of its outermost pixels.
    """
    x, y = points
    inside: NDArray[np.bool_] = x >= -0.5
    inside &= x <= size[1] - 0.5
    inside &= y >= -0.5
    inside &= y <= size[0] - 0.5
    np.clip(x, 0, size[1] - 1, out=x)
    np.clip(y, 0, size[0] - 1, out=y)
    return inside


def _pixels(points: Tensor, size: tuple[int, int]) -> Tensor:
    """Convert normalised coordinates (1, 2, ...) to pixels of an image of size (H, W)."""
    sides = np.array([size[1], size[0]], np.float32).reshape(2, *[1] * (points.ndim - 2))
    return torch.from_numpy(points.numpy() * (sides / 2) + (sides - 1) / 2)


class _Source:
    """A frame to be sampled.

    OpenCV samples four channels in half the time of three, so it gets a fourth if that takes less.

    Args:
        frame: (H, W, 3) or (H, W).
        shape: (U, V) of its view.
    """

    def __init__(self, frame: NDArray[np.uint8], shape: tuple[int, int]) -> None:
        self._frame = frame
        self._wide = frame.shape[2:] == (3,) and frame.size < 3 * _MOST_PIXELS * math.prod(shape)
        self._pixels = _kept("wide", (*frame.shape[:2], 4), np.uint8) if self._wide else frame
        self._memory = _kept("sampled", (max(BLOCK, shape[1]), *self._pixels.shape[2:]), np.uint8)
        self._ready = range(0)  # rows that have a fourth channel

    def prepare(self, first: int, last: int) -> None:
        """Prepare rows from the first to below the last to be sampled."""
        ready = self._ready or range(first, first)
        for start, stop in ((first, ready.start), (ready.stop, last)):
            if self._wide and start < stop:
                cv2.cvtColor(self._frame[start:stop], cv2.COLOR_RGB2RGBA, self._pixels[start:stop])
        self._ready = range(min(first, ready.start), max(last, ready.stop))

    def sample(
        self, points: NDArray[np.float32], seen: NDArray[np.bool_] | None, out: NDArray[np.uint8]
    ) -> None:
        """Sample at points (2, R, V) px, to (R, V, 3) or (R, V); zero where not seen, None where all are."""
        x, y = points
        sampled = self._memory[: x.size].reshape(*x.shape, *self._pixels.shape[2:])
        cv2.remap(self._pixels, x, y, cv2.INTER_LINEAR, sampled)
        if seen is not None:
            sampled = cv2.copyTo(sampled, seen.view(np.uint8))
        if self._wide:
            cv2.cvtColor(sampled, cv2.COLOR_RGBA2RGB, out)
        else:
            out[:] = sampled.reshape(out.shape)


@lru_cache(maxsize=8)
def _projection(camera: Camera) -> tuple[Tensor | None, Lens | None]:
    """Return the matrix, (1, 3, 3), or the lens that leads from camera to normalised coordinates."""
    image_from_cam = normalised_intrinsics(camera.intrinsics[None].cpu(), camera.image_size)
    lens = make_lens(image_from_cam, camera.distortion[None].cpu(), camera.model, torch.float32)
    return image_from_cam if lens is None else None, lens
