"""Every pixel's ray in the road frame."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.geometry.lens import normalise_points, undistort_points
from lanebev.render.scene.camera import Lens

_COARSE = 4  # px between exactly undistorted pixels; bilinear in between errs by less than 0.005 px


class View(NamedTuple):
    """Rays of the pixels of B cameras, (B, H·W) each unless said otherwise.

    Attributes:
        size: image (height, width).
        ray_x: right per metre forward, in road directions.
        ray_y: down per metre forward.
        steps: (4, B, H·W), change of ray_x and of ray_y per pixel to the right, and of both per pixel down.
    """

    size: tuple[int, int]
    ray_x: Tensor
    ray_y: Tensor
    steps: Tensor


def pixel_rays(lens: Lens, size: tuple[int, int], distorted: bool = True) -> View:
    """Compute the rays of all pixels as taken.

    Args:
        lens: B cameras.
        size: image (height, width).
        distorted: False if no lens has any distortion.
    """
    if distorted and lens.distortion.shape[-1]:
        x, y = _undistorted_plane(lens, size)
    else:
        x, y = _plane(lens, *size, 1)
    m = lens.road_from_cam()[..., None, None]
    right, down, ahead = (m[:, i, 0] * x + (m[:, i, 1] * y + m[:, i, 2]) for i in range(3))
    ahead = ahead.clamp(min=1e-2)
    ray_x, ray_y = right / ahead, down / ahead
    steps = torch.stack([_gradient(ray, dim) for dim in (2, 1) for ray in (ray_x, ray_y)])
    return View(size, ray_x.flatten(1), ray_y.flatten(1), steps.flatten(2))


def _plane(lens: Lens, rows: int, columns: int, spacing: int) -> tuple[Tensor, Tensor]:
    """(B, rows, columns) x and y on the z = 1 plane, of pixels as if they were undistorted."""
    k = lens.intrinsics
    y = torch.arange(rows, dtype=k.dtype, device=k.device) * spacing
    x = torch.arange(columns, dtype=k.dtype, device=k.device) * spacing
    grid = torch.stack(torch.broadcast_tensors(x, y[:, None]), dim=-1).reshape(1, -1, 2)
    plane = normalise_points(grid.expand(len(k), -1, -1), k).unflatten(1, (rows, columns))
    return plane[..., 0], plane[..., 1]


def _undistorted_plane(lens: Lens, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """(B, H, W) x and y on the z = 1 plane, exact at every fourth pixel, bilinear in between."""
    height, width = size
    rows, columns = -(-(height - 1) // _COARSE) + 1, -(-(width - 1) // _COARSE) + 1
    k = lens.intrinsics
    y = torch.arange(rows, dtype=k.dtype, device=k.device) * _COARSE
    x = torch.arange(columns, dtype=k.dtype, device=k.device) * _COARSE
    grid = torch.stack(torch.broadcast_tensors(x, y[:, None]), dim=-1).reshape(1, -1, 2)
    ideal = undistort_points(grid.expand(len(k), -1, -1).contiguous(), k, lens.distortion, lens.model)
    plane = normalise_points(ideal, k).unflatten(1, (rows, columns))
    x, y = (_upsampled(_upsampled(plane[..., i], 2), 1)[:, :height, :width] for i in (0, 1))
    return x, y


def _upsampled(values: Tensor, dim: int) -> Tensor:
    """(B, n, m) to (4 (n - 1) + 1) values along a dimension, linear in between."""
    share = torch.arange(_COARSE, dtype=values.dtype, device=values.device) / _COARSE
    count = values.shape[dim] - 1
    first, last = values.narrow(dim, 0, count), values.narrow(dim, count, 1)
    share = share if dim == 2 else share[:, None]
    between = first.unsqueeze(dim + 1) + values.diff(dim=dim).unsqueeze(dim + 1) * share
    return torch.cat([between.flatten(dim, dim + 1), last], dim=dim)


def _gradient(values: Tensor, dim: int) -> Tensor:
    """Central differences, one-sided at the border."""
    size = values.shape[dim]
    inner = (values.narrow(dim, 2, size - 2) - values.narrow(dim, 0, size - 2)) * 0.5
    first = values.narrow(dim, 1, 1) - values.narrow(dim, 0, 1)
    last = values.narrow(dim, size - 1, 1) - values.narrow(dim, size - 2, 1)
    return torch.cat([first, inner, last], dim=dim)
