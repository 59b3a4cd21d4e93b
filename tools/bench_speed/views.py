"""Views of images and feature maps, and of frames of bytes."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from kornia.geometry.transform import warp_perspective
from torch import Tensor

from lanebev import BEVGrid, BEVWarp, Extrinsics, bev_from_image
from lanebev.view.cells import cells_and_lens
from lanebev.view.frame import remap_frame
from lanebev.view.lens import Lens
from lanebev.view.projection import CellSums, normalised_intrinsics
from lanebev.view.sampling import MapSize, sampling_maps
from tools.bench_speed import scene
from tools.bench_speed.measuring import Calls


def warps(batch: int, channels: int, stride: int) -> Calls:
    """Make calls of the warp and its peers on one image or feature map."""
    image = torch.rand(batch, channels, scene.SIZE[0] // stride, scene.SIZE[1] // stride)
    grid, warp, extrinsics = scene.sampling_grid(batch), BEVWarp(scene.GRID), scene.poses(batch)
    ideal = scene.camera().intrinsics.float().expand(batch, 3, 3)
    coarse = torch.diag(torch.tensor([1 / stride, 1 / stride, 1.0]))
    homography = bev_from_image(extrinsics, coarse @ ideal, scene.GRID)

    def with_lens(distortion: list[float], model: str = "pinhole") -> Callable[[], object]:
        lens = torch.tensor([distortion]).expand(batch, -1)
        return lambda: warp(image, ideal, extrinsics, lens, model, scene.SIZE)

    return {
        "grid_sample": lambda: F.grid_sample(image, grid, align_corners=False),
        "kornia warp_perspective": lambda: warp_perspective(image, homography, scene.GRID.shape),
        "BEVWarp": lambda: warp(image, ideal, extrinsics, image_size=scene.SIZE),
        "BEVWarp, 5 coefficients": with_lens(scene.BROWN),
        "BEVWarp, 8 coefficients": with_lens(scene.RATIONAL),
        "BEVWarp, fisheye": with_lens(scene.FISHEYE, "fisheye"),
    }


def stages(distortion: list[float] | None) -> Calls:
    """Make calls of the stages of a view of one image: alone, in a warm cache, and before the resampling."""
    image, grid = torch.rand(1, 3, *scene.SIZE), scene.sampling_grid(1)
    warp, extrinsics = BEVWarp(scene.GRID), scene.poses(1)
    ideal = scene.camera().intrinsics.float()[None]
    lens = None if distortion is None else torch.tensor([distortion])

    def matrices() -> tuple[CellSums, Lens | None]:
        scaled = normalised_intrinsics(ideal, scene.SIZE)
        return cells_and_lens(scene.GRID, scaled, extrinsics, lens, "pinhole", torch.float32)

    def maps() -> object:
        return sampling_maps(*matrices(), [MapSize(*scene.SIZE)], scene.SIZE)

    def sample() -> Tensor:
        return F.grid_sample(image, grid, align_corners=False)

    return {
        "grid_sample": sample,
        "matrices alone": matrices,
        "matrices and map alone": maps,
        "matrices, grid_sample": lambda: (matrices(), sample()),
        "matrices, map, grid_sample": lambda: (maps(), sample()),
        "all of BEVWarp": lambda: warp(image, ideal, extrinsics, lens, image_size=scene.SIZE),
    }


def compiled(distortion: list[float] | None) -> Calls:
    """Make calls of the warp of one image, and the same compiled by inductor, which needs a C++ compiler."""
    image, grid = torch.rand(1, 3, *scene.SIZE), scene.sampling_grid(1)
    ideal, extrinsics, warp = scene.camera().intrinsics.float()[None], scene.poses(1), BEVWarp(scene.GRID)
    lens = None if distortion is None else torch.tensor([distortion])
    compiled_warp = torch.compile(warp, fullgraph=True)
    compiled_warp(image, ideal, extrinsics, lens, image_size=scene.SIZE)  # a minute, which is not measured
    return {
        "grid_sample": lambda: F.grid_sample(image, grid, align_corners=False),
        "BEVWarp": lambda: warp(image, ideal, extrinsics, lens, image_size=scene.SIZE),
        "torch.compile": lambda: compiled_warp(image, ideal, extrinsics, lens, image_size=scene.SIZE),
    }


def backwards(batch: int, channels: int, stride: int) -> Calls:
    """Make calls of the warp and its peers, and the gradients of the image and of what it is sampled at."""
    image = torch.rand(batch, channels, scene.SIZE[0] // stride, scene.SIZE[1] // stride, requires_grad=True)
    grid = scene.sampling_grid(batch).requires_grad_()
    values = torch.tensor([scene.POSE]).repeat(batch, 1).requires_grad_()
    ideal, warp = scene.camera().intrinsics.float().expand(batch, 3, 3), BEVWarp(scene.GRID)
    coarse = torch.diag(torch.tensor([1 / stride, 1 / stride, 1.0]))
    weight = torch.rand(batch, channels, *scene.GRID.shape)

    def both(forward: Callable[[], Tensor]) -> Callable[[], object]:
        def run() -> None:
            image.grad = grid.grad = values.grad = None
            forward().backward(weight)

        return run

    def warped(distortion: list[float] | None = None, model: str = "pinhole") -> Callable[[], object]:
        lens = None if distortion is None else torch.tensor([distortion]).expand(batch, -1)
        return both(lambda: warp(image, ideal, Extrinsics.unstack(values), lens, model, scene.SIZE)[0])

    def by_kornia() -> Tensor:
        homography = bev_from_image(Extrinsics.unstack(values), coarse @ ideal, scene.GRID)
        bev: Tensor = warp_perspective(image, homography, scene.GRID.shape)
        return bev

    return {
        "grid_sample": both(lambda: F.grid_sample(image, grid, align_corners=False)),
        "kornia warp_perspective": both(by_kornia),
        "BEVWarp": warped(),
        "BEVWarp, 5 coefficients": warped(scene.BROWN),
        "BEVWarp, 8 coefficients": warped(scene.RATIONAL),
        "BEVWarp, fisheye": warped(scene.FISHEYE, "fisheye"),
    }


def frames(distortion: list[float], model: str = "pinhole") -> Calls:
    """Make calls on one frame of bytes through a lens, or without one."""
    taken = scene.camera(distortion, model)
    frame = np.random.default_rng(0).integers(0, 255, (*scene.SIZE, 3), np.uint8)
    extrinsics = Extrinsics(*(value.double() for value in scene.poses(1)))
    matrix, coefficients = taken.intrinsics.numpy(), taken.distortion.numpy()
    turn = (bev_from_image(extrinsics, taken.intrinsics[None], scene.GRID)[0] @ taken.intrinsics).numpy()
    rectify: Any = cv2.fisheye.initUndistortRectifyMap if model == "fisheye" else cv2.initUndistortRectifyMap
    shape = (scene.GRID.shape[1], scene.GRID.shape[0])

    def maps(kind: int = cv2.CV_16SC2) -> tuple[Any, Any]:
        first, second = rectify(matrix, coefficients, turn, np.eye(3), shape, kind)
        return first, second

    ready, exact = maps(), maps(cv2.CV_32FC1)
    wide, sampled = (np.empty((*size, 4), np.uint8) for size in (scene.SIZE, scene.GRID.shape))
    first = int(np.clip(exact[1].min(), 0, scene.SIZE[0] - 1))
    rows, bev = slice(first, None), np.empty((*scene.GRID.shape, 3), np.uint8)

    def four_channels() -> None:
        cv2.cvtColor(frame[rows], cv2.COLOR_RGB2RGBA, wide[rows])
        cv2.remap(wide, *exact, cv2.INTER_LINEAR, sampled)
        cv2.cvtColor(sampled, cv2.COLOR_RGBA2RGB, bev)

    return {
        "cv2.remap": lambda: cv2.remap(frame, *ready, cv2.INTER_LINEAR),
        "cv2.remap, float32": lambda: cv2.remap(frame, *exact, cv2.INTER_LINEAR),
        "cv2.remap, four channels": four_channels,
        "cv2 maps and remap": lambda: cv2.remap(frame, *maps(), cv2.INTER_LINEAR),
        "remap_frame": lambda: remap_frame(frame, taken, extrinsics, scene.GRID),
    }


def cells(resolution: float) -> Calls:
    """Make calls of the warp on grids of one rectangle."""
    grid = BEVGrid(scene.GRID.x, scene.GRID.z, resolution)
    image, ideal, warp = torch.rand(1, 3, *scene.SIZE), scene.camera().intrinsics[None].float(), BEVWarp(grid)
    lens = torch.tensor([scene.BROWN])
    return {
        "BEVWarp": lambda: warp(image, ideal, scene.poses(1)),
        "BEVWarp, 5 coefficients": lambda: warp(image, ideal, scene.poses(1), lens),
    }
