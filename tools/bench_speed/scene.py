"""The image, camera, pose and grid that views are timed with."""

import torch
from torch import Tensor

from lanebev import BEVGrid, BEVWarp, Camera, Extrinsics

SIZE = (1020, 1920)  # px, (H, W)
GRID = BEVGrid(x=(-10.24, 10.24), z=(3.0, 43.96), resolution=0.04)  # 1024 × 512
BROWN = [-0.2, 0.03, 0.001, -0.001, 0.005]
RATIONAL = [-0.2, 0.03, 0.001, -0.001, 0.005, 0.1, 0.05, 0.01]
FISHEYE = [-0.05, 0.01, -0.003, 0.001]
POSE = [0.03, 0.02, 0.01, 1.5]


def camera(distortion: list[float] | None = None, model: str = "pinhole") -> Camera:
    return Camera.from_parameters(1050, 1050, 959.5, 509.5, SIZE[1], SIZE[0], distortion or [], model)


def poses(batch: int) -> Extrinsics:
    return Extrinsics.unstack(torch.tensor([POSE]).repeat(batch, 1))


def sampling_grid(batch: int) -> Tensor:
    """Return where the warp samples, as ``grid_sample`` takes it."""
    intrinsics = camera().intrinsics.float().expand(batch, 3, 3)
    points, _ = BEVWarp(GRID).image_points(intrinsics, poses(batch))
    size = torch.tensor([SIZE[1], SIZE[0]])
    grid: Tensor = ((2 * points + 1) / size - 1).unflatten(1, GRID.shape)
    return grid
