"""Cameras over the road: random lenses and poses."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.geometry.lens import denormalise_points, distort_points
from lanebev.geometry.precision import widest_dtype
from lanebev.geometry.rotation import road_from_cam
from lanebev.render.scene.sampler import BatchSampler
from lanebev.types import Extrinsics


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
        """Compute the rotation (B, 3, 3) in double precision: single may round products to 10 bits."""
        pitch, yaw, roll, _ = self.extrinsics
        wide = widest_dtype(pitch.device)
        return road_from_cam(pitch.to(wide), yaw.to(wide), roll.to(wide)).to(pitch.dtype)

    def in_camera(self, points: Tensor) -> Tensor:
        """Turn points (B, N, 3) right, down, forward from the camera in road directions to its own."""
        matrix = self.road_from_cam()[:, None]  # rows are the road's axes
        turned = [points[..., i, None] * matrix[..., i, :] for i in range(3)]
        return turned[0] + turned[1] + turned[2]

    def pixels_as_taken(self, points: Tensor, size: tuple[int, int]) -> Tensor:
        """Project points (right, down, forward) from the camera, in road directions, to pixels as taken.

        Args:
            points: (B, N, 3) m.
            size: image (height, width); pixels far outside it are brought near before they are
                distorted, so that the lens polynomial cannot fold them back in.

        Returns:
            (B, N, 2) px.
        """
        camera = self.in_camera(points)
        plane = camera[..., :2] / camera[..., 2:].clamp(min=0.05)
        pixels = denormalise_points(plane, self.intrinsics)
        limits = (size[1], size[0])
        near = [v.clamp(-0.25 * n, 1.25 * n) for v, n in zip(pixels.unbind(-1), limits, strict=True)]
        pixels = torch.stack(near, dim=-1)
        return distort_points(pixels, self.intrinsics, self.distortion, self.model)


def sample_intrinsics(sampler: BatchSampler, size: tuple[int, int]) -> Tensor:
    """Sample intrinsics (B, 3, 3): field of view 40 to 90 degrees, principal point near the centre."""
    height, width = size
    view = sampler.either(0.6, (44, 68), (40, 90)).deg2rad()
    focal = 0.5 * width / (0.5 * view).tan()
    matrix = torch.zeros(sampler.batch_size, 3, 3)
    matrix[:, 0, 0] = focal
    matrix[:, 1, 1] = focal * (1 + sampler.normal(0.003))
    matrix[:, 0, 2] = 0.5 * (width - 1) + width * sampler.normal(0.012)
    matrix[:, 1, 2] = 0.5 * (height - 1) + height * torch.where(
        sampler.chance(0.7), sampler.normal(0.015), sampler.uniform(-0.1, 0.1)
    )
    matrix[:, 2, 2] = 1
    return matrix


def sample_distortion(sampler: BatchSampler, intrinsics: Tensor, size: tuple[int, int], model: str) -> Tensor:
    """Sample (B, 5) Brown-Conrady or (B, 4) Kannala-Brandt coefficients that can be inverted in the image."""
    corner = 0.25 * (size[0] ** 2 + size[1] ** 2) / intrinsics[:, 0, 0] ** 2  # squared radius, z = 1 plane
    if model == "fisheye":
        return torch.stack(
            [sampler.normal(0.02), sampler.normal(0.005), sampler.normal(0.002), 0 * corner], dim=1
        )
    bend = torch.where(sampler.chance(0.5), 0.0, sampler.uniform(-0.17, 0.04))
    zero = torch.zeros_like(bend)
    tangential = sampler.normal(0.0006, 2) * (bend != 0)[:, None]
    k2 = 0.6 * bend * bend / corner**2
    return torch.stack([bend / corner, k2, tangential[:, 0], tangential[:, 1], zero], dim=1)


def sample_extrinsics(sampler: BatchSampler) -> Extrinsics:
    """Sample random poses: mostly near level, at times far from it."""

    def mixed(narrow: float, wide: float, rare: float, share_rare: float) -> Tensor:
        spread = torch.where(
            sampler.chance(0.5), sampler.normal(narrow).clamp(-wide, wide), sampler.uniform(-wide, wide)
        )
        return torch.where(sampler.chance(share_rare), sampler.uniform(-rare, rare), spread) * (math.pi / 180)

    pitch = mixed(2.0, 6.0, 10.0, 0.08)
    yaw = mixed(1.5, 6.0, 12.0, 0.10)
    roll = mixed(1.0, 4.0, 22.0, 0.08)
    height = sampler.either(0.65, (1.15, 1.75), (1.0, 2.3))
    return Extrinsics(pitch, yaw, roll, height)


def varied_extrinsics(sampler: BatchSampler, camera: Tensor, pose: Extrinsics) -> Extrinsics:
    """Sample heights of lorries and of low cars where a world has an unusual camera, (B,) bool."""
    height = torch.where(sampler.chance(0.5), sampler.uniform(1.7, 3.0), pose.height)
    return pose._replace(height=torch.where(camera, height, pose.height))


def varied_intrinsics(
    sampler: BatchSampler, camera: Tensor, intrinsics: Tensor, size: tuple[int, int]
) -> Tensor:
    """Sample wide lenses (B, 3, 3) where a world has an unusual camera, (B,) bool."""
    view = sampler.uniform(70, 110).deg2rad()
    wide = camera & sampler.chance(0.4)
    factor = torch.where(wide, 0.5 * size[1] / (0.5 * view).tan() / intrinsics[:, 0, 0], 1.0)
    scale = torch.stack([factor, factor, torch.ones_like(factor)], dim=1)
    focal = torch.diag_embed(intrinsics.diagonal(dim1=1, dim2=2) * (scale - 1))
    return intrinsics + focal
