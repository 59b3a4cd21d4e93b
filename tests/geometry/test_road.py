"""Points between image, road and BEV, and their covariance."""

import itertools
import math

import pytest
import torch

from lanebev import (
    BEVGrid,
    Extrinsics,
    bev_from_image,
    image_covariance,
    image_from_road_points,
    road_covariance,
)
from lanebev.geometry.road import great_circle_normals, road_from_image_points, segment_rays
from lanebev.geometry.rotation import vanishing_dir_from_pitch_yaw

K = torch.tensor([[[1000.0, 0.0, 640.0], [0.0, 980.0, 360.0], [0.0, 0.0, 1.0]]], dtype=torch.float64)
ROAD = torch.tensor([[[-4.0, 8.0], [0.0, 20.0], [3.0, 45.0]]], dtype=torch.float64)


def pose(pitch=0.0, yaw=0.0, roll=0.0, height=1.5):
    return Extrinsics(*(torch.tensor([v], dtype=torch.float64) for v in (pitch, yaw, roll, height)))


def test_a_point_straight_ahead_by_hand():
    pixel, valid = image_from_road_points(
        torch.tensor([[[2.0, 10.0]]], dtype=torch.float64), K, pose(height=1.5)
    )
    assert valid.all()
    torch.testing.assert_close(pixel, torch.tensor([[[640 + 200.0, 360 + 98.0 * 1.5]]], dtype=torch.float64))


@pytest.mark.parametrize(
    ("pitch", "yaw", "roll", "height"),
    list(itertools.product((-0.05, 0.0, 0.1), (-0.17, 0.0, 0.1), (-0.35, 0.0, 0.2), (1.0, 2.3))),
)
def test_road_image_bev_round_trip(pitch, yaw, roll, height):
    e, grid = pose(pitch, yaw, roll, height), BEVGrid()
    pixels, front = image_from_road_points(ROAD, K, e)
    assert front.all()
    back, valid = road_from_image_points(pixels, K, e)
    assert valid.all()
    torch.testing.assert_close(back, ROAD)
    homography = bev_from_image(e, K, grid)
    bev = torch.cat([pixels, torch.ones(1, 3, 1)], -1) @ homography.mT
    torch.testing.assert_close(bev[..., :2] / bev[..., 2:], grid.bev_from_road_points(ROAD))
    torch.testing.assert_close(grid.road_from_bev_points(grid.bev_from_road_points(ROAD)), ROAD)


def test_homography_is_the_papers_for_its_grid():
    # Eq. (23) with a_X = a_Z = 20 px/m, b_X = 16 m, b_Z = 50 m.
    a, b_x, b_z = 20.0, 16.0, 50.0
    e = pose(0.03, -0.02, 0.01, 1.4)
    from lanebev.geometry.rotation import road_from_cam

    rows = road_from_cam(e.pitch, e.yaw, e.roll)[0]
    scale = torch.tensor([[a, 0, b_x * a / 2], [0, -a, b_z * a], [0, 0, 1]], dtype=torch.float64)
    paper = scale @ torch.stack([rows[0], rows[2], rows[1] / 1.4]) @ torch.linalg.inv(K[0])
    grid = BEVGrid(x=(-b_x / 2, b_x / 2), z=(0.0, b_z), resolution=1 / a)
    torch.testing.assert_close(bev_from_image(e, K, grid)[0], paper)


def test_above_the_horizon_is_not_road():
    _, valid = road_from_image_points(torch.tensor([[[640.0, 300.0]]], dtype=torch.float64), K, pose())
    assert not valid.any()
    _, front = image_from_road_points(torch.tensor([[[0.0, -5.0]]], dtype=torch.float64), K, pose())
    assert not front.any()


def test_great_circles_of_parallel_lines_meet_in_the_vanishing_direction():
    e = pose(0.05, -0.1, 0.2, 1.3)
    near = torch.tensor([[[-5.0, 8.0], [-1.0, 8.0], [4.0, 9.0]]], dtype=torch.float64)
    far = near + torch.tensor([0.0, 25.0], dtype=torch.float64)
    ends = torch.stack([image_from_road_points(p, K, e)[0] for p in (near, far)], dim=2)
    normals = great_circle_normals(segment_rays(ends, K))
    v = vanishing_dir_from_pitch_yaw(e.pitch, e.yaw)
    torch.testing.assert_close((normals @ v[..., None]).abs().max(), torch.zeros((), dtype=torch.float64))


def test_road_covariance_equals_monte_carlo():
    e = pose(0.02, 0.01, -0.01, 1.5)
    pixels, _ = image_from_road_points(ROAD, K, e)
    pixel_std, pose_std = 0.3, torch.tensor([5e-4, 1e-3, 1e-3, 0.01], dtype=torch.float64)
    cov = road_covariance(
        pixels,
        K,
        e,
        (torch.eye(2, dtype=torch.float64) * pixel_std**2).expand(1, 3, 2, 2),
        torch.diag(pose_std**2)[None],
    )
    generator = torch.Generator().manual_seed(0)
    n = 20000
    noise = torch.randn(n, 3, 2, generator=generator, dtype=torch.float64) * pixel_std
    poses = e.stack() + torch.randn(n, 4, generator=generator, dtype=torch.float64) * pose_std
    road, _ = road_from_image_points(pixels + noise, K.expand(n, 3, 3), Extrinsics.unstack(poses))
    for k in range(3):
        torch.testing.assert_close(torch.cov(road[:, k].T), cov[0, k], rtol=0.1, atol=2e-4)
    grid = BEVGrid(resolution=0.1)
    bev = grid.bev_from_road_covariance(cov)
    torch.testing.assert_close(bev[0, :, 0, 1], -100 * cov[0, :, 0, 1])
    torch.testing.assert_close(grid.road_from_bev_covariance(bev), cov)


def test_image_covariance_equals_monte_carlo_and_leads_back():
    e = pose(0.02, 0.01, -0.01, 1.5)
    pixels, _ = image_from_road_points(ROAD, K, e)
    road_cov = torch.tensor([[0.01, 0.002], [0.002, 0.02]], dtype=torch.float64).expand(1, 3, 2, 2)
    pose_std = torch.tensor([5e-4, 1e-3, 1e-3, 0.01], dtype=torch.float64)
    cov = image_covariance(ROAD, K, e, road_cov, torch.diag(pose_std**2)[None])
    generator = torch.Generator().manual_seed(0)
    n = 20000
    noise = (
        torch.randn(n, 3, 2, generator=generator, dtype=torch.float64)
        @ torch.linalg.cholesky(road_cov[0, 0]).T
    )
    poses = e.stack() + torch.randn(n, 4, generator=generator, dtype=torch.float64) * pose_std
    found, _ = image_from_road_points(ROAD + noise, K.expand(n, 3, 3), Extrinsics.unstack(poses))
    for k in range(3):
        torch.testing.assert_close(torch.cov(found[:, k].T), cov[0, k], rtol=0.1, atol=0.02)
    exact = image_covariance(ROAD, K, e, road_cov)
    torch.testing.assert_close(road_covariance(pixels, K, e, exact), road_cov)
    behind = image_covariance(torch.tensor([[[0.0, -5.0]]], dtype=torch.float64), K, e, road_cov[:, :1])
    assert behind[0, 0].tolist() == [[math.inf, 0.0], [0.0, math.inf]]


def test_a_camera_below_the_road_sees_none_of_it():
    assert not image_from_road_points(ROAD, K, pose(0.02, 0.01, -0.01, -1.5))[1].any()


def test_the_homography_asks_for_a_camera_to_every_pose():
    with pytest.raises(ValueError, match=r"intrinsics: expected \(1, 3, 3\), got \(2, 3, 3\)"):
        bev_from_image(pose(), K.expand(2, 3, 3), BEVGrid())


def test_grid_shape_and_cells():
    grid = BEVGrid(x=(-10.0, 10.0), z=(3.0, 60.0), resolution=0.05)
    assert grid.shape == (1140, 400)
    cells = grid.cells(torch.float64)
    assert cells.shape == (1140, 400, 2)
    assert cells[0, 0].tolist() == [-10.0, 60.0]
    assert cells[-1, -1].tolist() == pytest.approx([9.95, 3.05])
    with pytest.raises(ValueError, match="resolution: expected > 0"):
        BEVGrid(resolution=0.0)
    for x in ((5.0, -5.0), (5.0, math.inf)):
        with pytest.raises(ValueError, match="x: expected"):
            BEVGrid(x=x)
    assert math.isclose(float(grid.bev_from_road_points(torch.tensor([0.0, 60.0]))[1]), 0.0)


def test_covariance_is_infinite_where_there_is_no_road():
    pixels = torch.tensor([[[640.0, 300.0], [640.0, 500.0]]], dtype=torch.float64)
    pixel_cov = torch.eye(2, dtype=torch.float64).expand(1, 2, 2, 2)
    cov = road_covariance(pixels, K, pose(), pixel_cov)
    assert cov[0, 0].tolist() == [[math.inf, 0.0], [0.0, math.inf]]
    assert cov[0, 1].isfinite().all()
    assert road_covariance(pixels, K, pose())[0, :, 0, 0].tolist() == [math.inf, 0.0]
    assert BEVGrid().bev_from_road_covariance(cov)[0, 0].diagonal().tolist() == [math.inf, math.inf]


def test_autocast_leaves_double_precision_as_it_is():
    """So ``full_precision`` and ``autocast_off`` do nothing for it."""
    numbers = torch.linspace(0.1, 2.0, 12, dtype=torch.float64).view(3, 4)
    with torch.autocast("cpu", torch.bfloat16):
        found = numbers @ numbers.mT, torch.baddbmm(numbers[None], numbers[None, :, :3], numbers[None, :3])
    expected = numbers @ numbers.mT, torch.baddbmm(numbers[None], numbers[None, :, :3], numbers[None, :3])
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))


def test_points_keep_their_digits_under_autocast_and_in_mixed_dtypes():
    e = Extrinsics(*(v.float() for v in pose(0.02, 0.01, -0.01, 1.5)))
    single = K.float()
    pixels, _ = image_from_road_points(ROAD.float(), single, e)
    cov = road_covariance(pixels, single, e, extrinsics_cov=torch.eye(4)[None])
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(image_from_road_points(ROAD.float(), single, e)[0], pixels)
        assert torch.equal(road_covariance(pixels, single, e, extrinsics_cov=torch.eye(4)[None]), cov)
    mixed, _ = image_from_road_points(ROAD.float(), K, e)
    assert mixed.dtype == torch.float64
    torch.testing.assert_close(mixed.float(), pixels)
