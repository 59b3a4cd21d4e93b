"""The camera: random lenses and poses, and every pixel's ray in the road frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lanebev.geometry.lens import (
    denormalise_points,
    distort_points,
    normalise_points,
    undistort_points,
)
from lanebev.geometry.rotation import road_from_cam
from lanebev.render.scene.sampler import Dice
from lanebev.types import Extrinsics

_COARSE = 4  # px between exactly undistorted pixels; bilinear in between errs by less than 0.005 px


class Lens(NamedTuple):
    """Cameras over a road.

    Attributes:
        intrinsics: (B, 3, 3) px.
        distortion: (B, D).
        model: "pinhole" or "fisheye".
        extrinsics: each (B,).
    """

    intrinsics: Tensor
    distortion: Tensor
    model: str
    extrinsics: Extrinsics

    def road_from_cam(self) -> Tensor:
        """(B, 3, 3)."""
        return road_from_cam(self.extrinsics.pitch, self.extrinsics.yaw, self.extrinsics.roll)

    def pixels_as_taken(self, points: Tensor, size: tuple[int, int]) -> Tensor:
        """Points (right, down, forward) from the camera, in road directions, to pixels as taken.

        Args:
            points: (B, N, 3) m.
            size: image (height, width); pixels far outside it are brought near before they are
                distorted, so that the lens polynomial cannot fold them back in.

        Returns:
            (B, N, 2) px.
        """
        camera = points @ self.road_from_cam()
        plane = camera[..., :2] / camera[..., 2:].clamp(min=0.05)
        pixels = denormalise_points(plane, self.intrinsics)
        limit = pixels.new_tensor([size[1], size[0]])
        pixels = torch.minimum(torch.maximum(pixels, -0.25 * limit), 1.25 * limit)
        return distort_points(pixels, self.intrinsics, self.distortion, self.model)


def pixel_rays(lens: Lens, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Rays of all pixels as taken.

    Args:
        lens: B cameras.
        size: image (height, width).

    Returns:
        rays: (B, 2, H, W), right and up per metre forward, in road directions.
        steps: (B, 4, H, W), their change per pixel to the right and per pixel down.
    """
    height, width = size
    batch = len(lens.intrinsics)
    if lens.distortion.shape[-1] == 0 or not bool(lens.distortion.any()):
        plane = _grid(height, width, 1, batch, lens)
        plane = normalise_points(plane, lens.intrinsics).mT.unflatten(2, (height, width))
    else:
        rows, columns = -(-(height - 1) // _COARSE) + 1, -(-(width - 1) // _COARSE) + 1
        coarse = _grid(rows, columns, _COARSE, batch, lens)
        ideal = undistort_points(coarse, lens.intrinsics, lens.distortion, lens.model)
        plane = normalise_points(ideal, lens.intrinsics).mT.unflatten(2, (rows, columns))
        full = ((rows - 1) * _COARSE + 1, (columns - 1) * _COARSE + 1)
        plane = functional.interpolate(plane, full, mode="bilinear", align_corners=True)[..., :height, :width]
    matrix = lens.road_from_cam()
    direction = torch.einsum("bij,bjhw->bihw", matrix[..., :2], plane) + matrix[..., 2, None, None]
    forward = direction[:, 2].clamp(min=1e-2)
    rays = torch.stack([direction[:, 0] / forward, -direction[:, 1] / forward], dim=1)
    by_column, by_row = _gradient(rays, 3), _gradient(rays, 2)
    return rays, torch.cat([by_column, by_row], dim=1)


def _grid(rows: int, columns: int, spacing: int, batch: int, lens: Lens) -> Tensor:
    dtype = lens.intrinsics.dtype
    y, x = torch.meshgrid(
        torch.arange(rows, dtype=dtype) * spacing, torch.arange(columns, dtype=dtype) * spacing, indexing="ij"
    )
    return torch.stack([x, y], dim=-1).reshape(1, -1, 2).expand(batch, -1, -1)


def _gradient(values: Tensor, dim: int) -> Tensor:
    """Central differences, one-sided at the border."""
    size = values.shape[dim]
    inner = (values.narrow(dim, 2, size - 2) - values.narrow(dim, 0, size - 2)) * 0.5
    first = values.narrow(dim, 1, 1) - values.narrow(dim, 0, 1)
    last = values.narrow(dim, size - 1, 1) - values.narrow(dim, size - 2, 1)
    return torch.cat([first, inner, last], dim=dim)


def sample_intrinsics(dice: Dice, size: tuple[int, int]) -> Tensor:
    """(B, 3, 3): horizontal field of view 40 to 90 degrees, principal point near the centre."""
    height, width = size
    view = torch.where(dice.chance(0.6), dice.uniform(44, 68), dice.uniform(40, 90)).deg2rad()
    focal = 0.5 * width / (0.5 * view).tan()
    matrix = torch.zeros(dice.batch_size, 3, 3)
    matrix[:, 0, 0] = focal
    matrix[:, 1, 1] = focal * (1 + dice.normal(0.003))
    matrix[:, 0, 2] = 0.5 * (width - 1) + width * dice.normal(0.012)
    matrix[:, 1, 2] = 0.5 * (height - 1) + height * torch.where(
        dice.chance(0.7), dice.normal(0.015), dice.uniform(-0.1, 0.1)
    )
    matrix[:, 2, 2] = 1
    return matrix


def sample_distortion(dice: Dice, intrinsics: Tensor, size: tuple[int, int], model: str) -> Tensor:
    """(B, 5) Brown-Conrady or (B, 4) Kannala-Brandt, mild enough to be invertible over the image."""
    corner = 0.25 * (size[0] ** 2 + size[1] ** 2) / intrinsics[:, 0, 0] ** 2  # squared radius, z = 1 plane
    if model == "fisheye":
        return torch.stack([dice.normal(0.02), dice.normal(0.005), dice.normal(0.002), 0 * corner], dim=1)
    bend = torch.where(dice.chance(0.5), 0.0, dice.uniform(-0.17, 0.04))
    zero = torch.zeros_like(bend)
    tangential = dice.normal(0.0006, 2) * (bend != 0)[:, None]
    k2 = 0.6 * bend * bend / corner**2
    return torch.stack([bend / corner, k2, tangential[:, 0], tangential[:, 1], zero], dim=1)


def sample_extrinsics(dice: Dice) -> Extrinsics:
    """Random poses: mostly near level, at times far from it."""

    def mixed(narrow: float, wide: float, rare: float, share_rare: float) -> Tensor:
        spread = torch.where(
            dice.chance(0.5), dice.normal(narrow).clamp(-wide, wide), dice.uniform(-wide, wide)
        )
        return torch.where(dice.chance(share_rare), dice.uniform(-rare, rare), spread) * (math.pi / 180)

    pitch = mixed(2.0, 6.0, 10.0, 0.08)
    yaw = mixed(1.5, 6.0, 12.0, 0.10)
    roll = mixed(1.0, 4.0, 22.0, 0.08)
    height = torch.where(dice.chance(0.65), dice.uniform(1.15, 1.75), dice.uniform(1.0, 2.3))
    return Extrinsics(pitch, yaw, roll, height)
