"""Frames of bytes through cv2 against the module, with every lens."""

import math

import numpy as np
import pytest
import torch

from lanebev import BEVGrid, BEVWarp, Camera, Extrinsics
from lanebev.view.frame import remap_frame
from tests.view.cameras import LENSES, pose

GRID = BEVGrid(x=(-6.0, 6.0), z=(3.0, 27.0), resolution=0.1)
POSE = pose([0.03, 0.02, -0.05, 1.4])


def camera(distortion=(), model="pinhole"):
    return Camera.from_parameters(300.0, 305.0, 160.0, 90.0, 320, 180, distortion, model)


def frame():
    y, x = np.mgrid[0:180, 0:320]
    channels = [127 + 100 * np.sin(x / 30), 127 + 100 * np.cos(y / 20), (x + y) / 2]
    return np.stack(channels, -1).round().astype(np.uint8)


@pytest.mark.parametrize(("distortion", "model"), LENSES)
def test_equals_the_module(distortion, model):
    cam, image = camera(distortion, model), frame()
    bev, valid = remap_frame(image, cam, POSE, GRID)
    expected, there = BEVWarp(GRID)(
        torch.from_numpy(image).permute(2, 0, 1)[None].float(),
        cam.intrinsics[None], POSE, cam.distortion[None], model,
    )  # fmt: skip
    assert bev.shape == (*GRID.shape, 3)
    assert bev.dtype == np.uint8
    assert 0.2 < valid.mean() < 1
    assert np.array_equal(valid, there[0, 0].numpy())
    assert (bev[~valid] == 0).all()
    off = np.abs(bev - expected[0].permute(1, 2, 0).numpy())
    assert off.max() < 1.0  # of 255: half a step of rounding, and 1/64 px on slopes of 10 a pixel


@pytest.mark.parametrize("values", [(-0.4, 0.3, 0.2, 1.4), (0.2, -1.2, 0.1, 0.02), (0.1, 0.0, 0.0, 0.0)])
def test_what_is_behind_or_beyond_a_fold_is_not_seen(values):
    """Nor anything by a camera that is not above the road."""
    grid = BEVGrid(x=(-6.0, 6.0), z=(-8.0, 20.0), resolution=0.1)
    extrinsics = pose(values)
    for distortion in ((), (-0.3, 0.05, 0.001, -0.001), (-0.3, 0.05, 0.001, -0.001, 0.01)):
        cam = Camera.from_parameters(150.0, 155.0, 160.0, 90.0, 320, 180, distortion)
        bev, valid = remap_frame(frame(), cam, extrinsics, grid)
        image = torch.from_numpy(frame()).permute(2, 0, 1)[None].double()
        _, expected = BEVWarp(grid)(image, cam.intrinsics[None], extrinsics, cam.distortion[None])
        assert (valid != expected[0, 0].numpy()).mean() < 1e-4  # on the edge itself
        assert (bev[~valid] == 0).all()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((), "pinhole"),
        ((-0.35, 0.12, 0.001, -0.001, -0.02), "pinhole"),  # folds over
        ((-0.2, 0.03, 0.001, -0.001, 0.01, 0.1, 0.05, 0.01), "pinhole"),
        ((-0.2, 0.03, 1e-3, -1e-3, 0.01, 0.1, 0.05, 0.01, 0.0, 0.0, 0.0, 0.0, 0.02, -0.01), "pinhole"),
        ((1.6, -0.1, 0.03, 0.001, -0.001), "omni"),
        ((0.0, 0.0, 0.0, 0.0), "fisheye"),
    ],
)
def test_any_view_equals_the_exact_one_cell_by_cell(distortion, model, seed):
    """Of any lens, pose, curvature and grid: the horizon, cells behind the camera, cells below the image.

    The exact view is in double precision. The frame before was white: no pixel of it is left.
    """
    rng = np.random.default_rng(seed)
    wide = seed % 2  # from 60 px on, more than 100 degrees to each side of a fisheye
    focal, steep = rng.uniform(60, 120) if wide else rng.uniform(200, 500), 1 if seed % 3 else 0.1
    cam = Camera.from_parameters(
        focal,
        focal * rng.uniform(0.9, 1.1),
        rng.uniform(140, 180),
        rng.uniform(70, 110),
        320,
        180,
        distortion,
        model,
    )
    values = [*(steep * rng.uniform((-0.5, -0.6, -0.4), (1.2, 0.6, 0.4))), rng.uniform(0.5, 2.5)]
    pose = Extrinsics.unstack(torch.tensor([values], dtype=torch.float64))
    near, resolution = rng.uniform(-5.0, 6.0), (0.05, 0.1, 0.2)[seed % 3]
    left = rng.uniform(-8.0, -2.0)
    grid = BEVGrid(
        (left, left + rng.uniform(6, 14)), (near, near + resolution * rng.integers(30, 400)), resolution
    )
    curvature = None if seed < 2 else torch.tensor([rng.uniform(-2e-3, 2e-3)], dtype=torch.float64)
    remap_frame(np.full_like(frame(), 255), cam, pose, BEVGrid((-20.0, 20.0), (-9.0, 40.0), 0.1))
    image = torch.from_numpy(frame()).permute(2, 0, 1)[None].double()
    exact, there = BEVWarp(grid)(
        image, cam.intrinsics[None], pose, cam.distortion[None], model, vertical_curvature=curvature
    )
    exact, there = exact[0].permute(1, 2, 0).numpy(), there[0, 0].numpy()
    for taken, expected in ((frame(), exact), (frame()[..., 1], exact[..., 1])):
        bev, valid = remap_frame(taken, cam, pose, grid, curvature)
        assert (valid != there).mean() < 1e-3  # on the edge itself
        assert (bev[~valid] == 0).all()
        assert np.abs(bev - expected)[valid & there].max(initial=0) < 1.0


def test_a_frame_with_many_pixels_for_each_cell_is_sampled_as_it_is():
    """Not with a fourth channel: its copy would take longer."""
    coarse = BEVGrid(x=(-6.0, 6.0), z=(3.0, 27.0), resolution=0.4)
    bev, valid = remap_frame(frame(), camera(), POSE, coarse)
    image = torch.from_numpy(frame()).permute(2, 0, 1)[None].double()
    expected, there = BEVWarp(coarse)(image, camera().intrinsics[None], POSE)
    assert np.array_equal(valid, there[0, 0].numpy())
    assert np.abs(bev - expected[0].permute(1, 2, 0).numpy()).max() < 1.0


def test_a_pose_that_is_not_a_number_is_seen_nowhere():
    values = torch.tensor([[math.nan, 0.0, 0.0, 1.4]], dtype=torch.float64)
    bev, valid = remap_frame(frame(), camera((-0.2, 0.03, 0.001, -0.001)), Extrinsics.unstack(values), GRID)
    assert not valid.any()
    assert (bev == 0).all()


def test_a_skewed_camera_is_seen_as_by_the_module():
    """OpenCV's own maps know no skew."""
    cam = camera()
    skewed = torch.tensor([[0.0, 20.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) + cam.intrinsics
    cam = Camera(skewed, cam.distortion, "pinhole", cam.image_size)
    bev, _ = remap_frame(frame(), cam, POSE, GRID)
    image = torch.from_numpy(frame()).permute(2, 0, 1)[None].double()
    expected, _ = BEVWarp(GRID)(image, skewed[None], POSE)
    assert np.abs(bev - expected[0].permute(1, 2, 0).numpy()).max() < 1.0


def test_the_order_of_a_frame_in_memory_changes_nothing():
    """As of channels that were turned round, which cv2 would copy for every block of rows."""
    image = frame()
    expected, there = remap_frame(image, camera(), POSE, GRID)
    bev, valid = remap_frame(np.ascontiguousarray(image[..., ::-1])[..., ::-1], camera(), POSE, GRID)
    assert np.array_equal(bev, expected)
    assert np.array_equal(valid, there)


def test_frames_of_another_kind_are_refused():
    with pytest.raises(ValueError, match=r"frame: expected \(H, W, 3\) of uint8, got .* of float64"):
        remap_frame(frame().astype(float), camera(), POSE, GRID)
    with pytest.raises(ValueError, match="frame: expected the camera's 180 x 320, got 90 x 320; see Camera"):
        remap_frame(frame()[:90], camera(), POSE, GRID)
