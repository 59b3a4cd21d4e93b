"""Every pixel's ray in the road frame."""

from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.geometry.lens import normalise_points, undistort_points
from lanebev.render.scene.camera.lens import Lens

_COARSE = 8  # px between exactly undistorted pixels; cubic in between errs by less than 0.002 px


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


def coarse_plane(lens: Lens, size: tuple[int, int]) -> Tensor:
    """Compute x and y on the z = 1 plane of every eighth pixel as taken, (B, 2, rows, columns).

    The first lies eight pixels before the image's first, the last beyond its last.

    Args:
        lens: B cameras.
        size: image (height, width).
    """
    rows, columns = (-(-(side - 1) // _COARSE) + 3 for side in size)
    k = lens.intrinsics
    y = (torch.arange(rows, dtype=k.dtype, device=k.device) - 1) * _COARSE
    x = (torch.arange(columns, dtype=k.dtype, device=k.device) - 1) * _COARSE
    grid = torch.stack(torch.broadcast_tensors(x, y[:, None]), dim=-1).reshape(1, -1, 2)
    ideal = undistort_points(grid.expand(len(k), -1, -1).contiguous(), k, lens.distortion, lens.model)
    plane: Tensor = normalise_points(ideal, k).mT.unflatten(2, (rows, columns))
    return plane


def pixel_rays(lens: Lens, plane: Tensor, size: tuple[int, int]) -> View:
    """Compute the rays of all pixels as taken.

    Args:
        lens: B cameras.
        plane: see :func:`coarse_plane`; cubic in between.
        size: image (height, width).
    """
    x, y = _upsampled(_upsampled(plane, 3), 2)[:, :, : size[0], : size[1]].unbind(1)
    m = lens.road_from_cam()[..., None, None]
    right, down, ahead = (m[:, i, 0] * x + (m[:, i, 1] * y + m[:, i, 2]) for i in range(3))
    ahead = ahead.clamp(min=1e-2)
    ray_x, ray_y = right / ahead, down / ahead
    steps = torch.cat(torch.gradient(torch.stack([ray_x, ray_y]), dim=(3, 2)))
    return View(size, ray_x.flatten(1), ray_y.flatten(1), steps.flatten(2))


def _upsampled(values: Tensor, dim: int) -> Tensor:
    """Interpolate (B, 2, n, m) to 8 (n - 3) + 1 values along one of the last two dimensions.

    Source: cubic Lagrange interpolation through the four nearest; linear values stay as they are.
    """
    t = torch.arange(_COARSE, dtype=values.dtype, device=values.device) / _COARSE
    weights = (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )
    count = values.shape[dim] - 3
    shape = (-1, 1) if dim == 2 else (-1,)
    between = values.new_zeros(())
    for k, weight in enumerate(weights):
        between = between + values.narrow(dim, k, count).unsqueeze(dim + 1) * weight.view(shape)
    return torch.cat([between.flatten(dim, dim + 1), values.narrow(dim, count + 1, 1)], dim=dim)
