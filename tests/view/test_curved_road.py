"""Views of a road with a vertical curvature: over a crest, through a dip."""

import math

import numpy as np
import pytest
import torch

from lanebev import BEVGrid, BEVWarp, Camera, Extrinsics, ImageFromBEV
from lanebev.geometry.road import image_from_road_points, road_from_image_points
from lanebev.view.frame import remap_frame

DOUBLE = torch.float64
GRID = BEVGrid(x=(-6.0, 6.0), z=(4.0, 44.0), resolution=0.2)
POSE = Extrinsics.unstack(torch.tensor([[0.03, 0.02, -0.05, 1.4]], dtype=DOUBLE))
LEVEL = Extrinsics.from_values(0.0, 0.0, 0.0, 1.5)
K = torch.tensor([[[600.0, 0.0, 320.0], [0.0, 590.0, 180.0], [0.0, 0.0, 1.0]]], dtype=DOUBLE)
CREST, DIP = (torch.tensor([value], dtype=DOUBLE) for value in (4e-4, -4e-4))


def camera(distortion=(), model="pinhole"):
    return Camera.from_parameters(600.0, 590.0, 320.0, 180.0, 640, 360, distortion, model)


def image():
    """A smooth picture (1, 2, 360, 640)."""
    y, x = torch.meshgrid(torch.arange(360.0), torch.arange(640.0), indexing="ij")
    return torch.stack([torch.sin(x / 60), torch.cos(y / 40)])[None].double()


def test_a_point_over_a_crest_by_hand():
    """At 20 m the road of R = 2500 m is 8 cm below the plane at the camera."""
    point = torch.tensor([[[2.0, 20.0]]], dtype=DOUBLE)
    pixel, valid = image_from_road_points(point, K, LEVEL, CREST)
    assert valid.all()
    expected = torch.tensor([[[320 + 600 * 2 / 20, 180 + 590 * (1.5 + 0.08) / 20]]], dtype=DOUBLE)
    torch.testing.assert_close(pixel, expected)


@pytest.mark.parametrize("curvature", [CREST, DIP, torch.zeros(1, dtype=DOUBLE)])
def test_road_and_image_round_trip(curvature):
    road = torch.tensor([[[-4.0, 8.0], [0.0, 20.0], [3.0, 60.0]]], dtype=DOUBLE)
    pixels, ahead = image_from_road_points(road, K, POSE, curvature)
    back, valid = road_from_image_points(pixels, K, POSE, curvature)
    assert ahead.all()
    assert valid.all()
    torch.testing.assert_close(back, road)


def test_without_curvature_it_is_the_plane():
    road = torch.tensor([[[-4.0, 8.0], [0.0, 20.0], [3.0, 60.0]]], dtype=DOUBLE)
    none = torch.zeros(1, dtype=DOUBLE)
    plane, curved = (image_from_road_points(road, K, POSE, each) for each in (None, none))
    torch.testing.assert_close(curved, plane)
    warps = [BEVWarp(GRID)(image(), K, POSE, vertical_curvature=each) for each in (None, none)]
    torch.testing.assert_close(*warps)


def test_a_crest_hides_the_road_behind_it():
    """A sight line from 1.5 m touches R = 2500 m at √(2 · 1.5 · 2500) = 86.6 m; 0.8 of it is shown."""
    road = torch.tensor([[[0.0, 69.0], [0.0, 69.5]]], dtype=DOUBLE)
    _, seen = image_from_road_points(road, K, LEVEL, CREST)
    assert seen.tolist() == [[True, False]]
    grid = BEVGrid(x=(-2.0, 2.0), z=(20.0, 120.0), resolution=0.5)
    bev, valid = BEVWarp(grid)(image(), K, LEVEL, vertical_curvature=CREST)
    _, z = grid.axes(DOUBLE)
    assert torch.equal(valid[0, 0, :, 4], z < 0.8 * math.sqrt(2 * 1.5 * 2500))
    assert (bev[:, :, ~valid[0, 0, :, 4]] == 0).all()
    _, ahead = BEVWarp(grid).image_points(K, LEVEL, vertical_curvature=CREST)
    assert torch.equal(ahead, valid.flatten(1))


def test_points_just_before_the_limit_are_seen_both_ways():
    road = torch.tensor([[[1.0, 0.79 * math.sqrt(2 * 1.5 * 2500)]]], dtype=DOUBLE)
    pixels, ahead = image_from_road_points(road, K, LEVEL, CREST)
    back, valid = road_from_image_points(pixels, K, LEVEL, CREST)
    assert ahead.all()
    assert valid.all()
    torch.testing.assert_close(back, road)


@pytest.mark.parametrize("height", [-2.0, 0.0])
def test_a_camera_that_is_not_above_the_road_spoils_no_other_row(height):
    """Nor its gradients: in a dip, the square root of what such a camera sees is not real."""
    heights = torch.tensor([height, 1.4], dtype=DOUBLE, requires_grad=True)
    pose = Extrinsics(*(part.expand(2) for part in POSE))._replace(height=heights)
    pixels = torch.tensor([[[320.0, 160.0], [320.0, 300.0]]], dtype=DOUBLE).expand(2, 2, 2)
    road, valid = road_from_image_points(pixels, K.expand(2, 3, 3), pose, DIP.expand(2))
    assert not valid[0].any()
    road[1].sum().backward()
    assert road.isfinite().all()
    assert heights.grad.isfinite().all()


def test_directions_over_the_crest_are_not_on_the_road():
    pixels = torch.tensor([[[320.0, 180.0], [320.0, 150.0], [320.0, 300.0]]], dtype=DOUBLE)
    _, valid = road_from_image_points(pixels, K, LEVEL, CREST)
    assert valid.tolist() == [[False, False, True]]


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((), "pinhole"),
        ((-0.2, 0.03, 0.001, -0.001, 0.01), "pinhole"),
        ((-0.05, 0.01, -0.003, 0.001), "fisheye"),
    ],
)
@pytest.mark.parametrize("curvature", [CREST, DIP])
def test_a_cell_shows_the_point_of_the_road(distortion, model, curvature):
    """The view of a smooth image is its value where the cell's point is projected."""
    cam = camera(distortion, model)
    bev, valid = BEVWarp(GRID)(
        image(), cam.intrinsics[None], POSE, cam.distortion[None], model, vertical_curvature=curvature
    )
    cells = GRID.cells(DOUBLE).reshape(1, -1, 2)
    pixels = cam.distort_points(image_from_road_points(cells, K, POSE, curvature)[0][0])
    x, y = pixels.T.reshape(2, *GRID.shape)
    expected = torch.stack([torch.sin(x / 60), torch.cos(y / 40)])
    there = valid[0, 0] & (x > 1) & (x < 638) & (y > 1) & (y < 358)  # half a pixel at the edge is clamped
    assert 0.5 < there.double().mean() <= 1
    torch.testing.assert_close(bev[0][:, there], expected[:, there], atol=1e-3, rtol=0)
    plane, _ = BEVWarp(GRID)(image(), cam.intrinsics[None], POSE, cam.distortion[None], model)
    assert (plane[0][:, there] - expected[:, there]).abs().max() > 0.05


def test_rows_of_a_batch_have_their_own_curvature():
    both = Extrinsics(*(part.expand(2) for part in POSE))
    curvature = torch.cat([CREST, DIP])
    bev, valid = BEVWarp(GRID)(
        image().expand(2, -1, -1, -1), K.expand(2, 3, 3), both, vertical_curvature=curvature
    )
    for row, own in enumerate((CREST, DIP)):
        alone = BEVWarp(GRID)(image(), K, POSE, vertical_curvature=own)
        torch.testing.assert_close((bev[row : row + 1], valid[row : row + 1]), alone)


def test_planes_above_a_curved_road_follow_it():
    """A plane 0.5 m above the road is the road of a camera 0.5 m lower."""
    planes, _ = BEVWarp(GRID, plane_heights=(0.0, 0.5))(image(), K, POSE, vertical_curvature=CREST)
    lower = POSE._replace(height=POSE.height - 0.5)
    alone, _ = BEVWarp(GRID)(image(), K, lower, vertical_curvature=CREST)
    torch.testing.assert_close(planes[:, :, 1], alone)


def test_gradients_by_the_curvature_are_finite_differences():
    grid = BEVGrid(x=(-2.0, 2.0), z=(8.0, 24.0), resolution=1.0)
    curvature = CREST.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda each: BEVWarp(grid)(image(), K, POSE, vertical_curvature=100 * each)[0].sum((2, 3)),
        (curvature / 100).detach().requires_grad_(),
        eps=1e-8, atol=1e-2, rtol=1e-3,
    )  # fmt: skip


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.03, 0.001, -0.001, 0.01)])
@pytest.mark.parametrize("curvature", [CREST, DIP])
def test_a_frame_of_bytes_equals_the_module(distortion, curvature):
    cam, frame = camera(distortion), (127 + 100 * image()[0]).round().byte()
    grid = BEVGrid(x=(-6.0, 6.0), z=(4.0, 120.0), resolution=0.2)
    bev, valid = remap_frame(frame[[0, 1, 0]].permute(1, 2, 0).numpy(), cam, POSE, grid, curvature)
    expected, there = BEVWarp(grid)(
        frame[None].float(), cam.intrinsics[None], POSE, cam.distortion[None], vertical_curvature=curvature
    )
    assert np.array_equal(valid, there[0, 0].numpy())
    assert 0.2 < valid.mean() < 1
    assert np.abs(bev[..., :2] - expected[0].permute(1, 2, 0).numpy()).max() < 1.0


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.03, 0.001, -0.001, 0.01)])
@pytest.mark.parametrize("curvature", [CREST, DIP])
def test_a_map_is_painted_where_the_road_is(distortion, curvature):
    """A map of X and Z, painted to the image, gives every pixel its point of the road."""
    cam = camera(distortion)
    cells = GRID.cells(DOUBLE).permute(2, 0, 1)[None]
    painted, valid = ImageFromBEV(GRID)(
        cells, cam.intrinsics[None], POSE, (360, 640), cam.distortion[None], vertical_curvature=curvature
    )
    y, x = torch.meshgrid(torch.arange(360.0), torch.arange(640.0), indexing="ij")
    pixels, _ = cam.undistort_points(torch.stack([x, y], dim=-1).reshape(-1, 2).double())
    road, there = road_from_image_points(pixels[None], K, POSE, curvature)
    shown = valid[0, 0].flatten()
    assert 0.1 < shown.double().mean() < 1
    assert there[0, shown].all()
    inner = (
        shown & (road[0] > torch.tensor([-5.8, 4.3])).all(1) & (road[0] < torch.tensor([5.7, 43.9])).all(1)
    )
    torch.testing.assert_close(painted[0].flatten(1).mT[inner], road[0, inner], atol=1e-6, rtol=0)


def test_a_curvature_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"vertical_curvature: expected \(1,\) 1/m, .*, got \(2,\)"):
        BEVWarp(GRID)(image(), K, POSE, vertical_curvature=torch.zeros(2))
    with pytest.raises(TypeError, match="vertical_curvature"):
        BEVWarp(GRID)(image(), K, POSE, vertical_curvature=1e-4)
    with pytest.raises(ValueError, match=r"vertical_curvature: expected \(1,\)"):
        road_from_image_points(torch.zeros(1, 3, 2), K, POSE, torch.zeros(1, 1))
    with pytest.raises(ValueError, match=r"vertical_curvature: expected \(1,\)"):
        BEVWarp(GRID).image_points(K, POSE, vertical_curvature=torch.zeros(2))
    frame = np.zeros((360, 640, 3), np.uint8)
    with pytest.raises(TypeError, match="vertical_curvature"):
        remap_frame(frame, camera(), POSE, GRID, 1e-4)
    with pytest.raises(ValueError, match=r"vertical_curvature: expected \(1,\)"):
        remap_frame(frame, camera(), POSE, GRID, torch.zeros(2))
