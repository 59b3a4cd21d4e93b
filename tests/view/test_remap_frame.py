"""Frames of bytes through cv2 against the module, with every lens."""

import numpy as np
import pytest
import torch

from lanebev import BEVGrid, BEVWarp, Camera, Extrinsics
from lanebev.view.frame import remap_frame

GRID = BEVGrid(x=(-6.0, 6.0), z=(3.0, 27.0), resolution=0.1)
POSE = Extrinsics.unstack(torch.tensor([[0.03, 0.02, -0.05, 1.4]], dtype=torch.float64))


def camera(distortion=(), model="pinhole"):
    return Camera.from_parameters(300.0, 305.0, 160.0, 90.0, 320, 180, distortion, model)


def frame():
    y, x = np.mgrid[0:180, 0:320]
    channels = [127 + 100 * np.sin(x / 30), 127 + 100 * np.cos(y / 20), (x + y) / 2]
    return np.stack(channels, -1).round().astype(np.uint8)


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((), "pinhole"),
        ((-0.2, 0.03, 0.001, -0.001), "pinhole"),
        ((-0.2, 0.03, 0.001, -0.001, 0.01), "pinhole"),
        ((-0.2, 0.03, 0.001, -0.001, 0.01, 0.1, 0.05, 0.01), "pinhole"),
        ((-0.2, 0.03, 0.001, -0.001, 0.01, 0.1, 0.05, 0.01, 1e-3, 1e-4, -1e-3, 2e-4), "pinhole"),
        ((-0.2, 0.03, 1e-3, -1e-3, 0.01, 0.1, 0.05, 0.01, 0.0, 0.0, 0.0, 0.0, 0.02, -0.01), "pinhole"),
        ((0.9, -0.2, 0.03, 0.001, -0.001), "omni"),
        ((-0.05, 0.01, -0.003, 0.001), "fisheye"),
    ],
)
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
    extrinsics = Extrinsics.unstack(torch.tensor([values], dtype=torch.float64))
    for distortion in ((), (-0.3, 0.05, 0.001, -0.001), (-0.3, 0.05, 0.001, -0.001, 0.01)):
        cam = Camera.from_parameters(150.0, 155.0, 160.0, 90.0, 320, 180, distortion)
        bev, valid = remap_frame(frame(), cam, extrinsics, grid)
        image = torch.from_numpy(frame()).permute(2, 0, 1)[None].double()
        _, expected = BEVWarp(grid)(image, cam.intrinsics[None], extrinsics, cam.distortion[None])
        assert (valid != expected[0, 0].numpy()).mean() < 1e-4  # on the edge itself
        assert (bev[~valid] == 0).all()


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
