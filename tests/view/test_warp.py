"""The resampling against the homography, on lenses, on feature maps, and its gradients."""

import math

import pytest
import torch
from kornia.geometry.transform import warp_perspective

from lanebev import BEVGrid, BEVWarp, Camera, Extrinsics, bev_from_image
from lanebev.geometry.distortion import max_undistorted_radius
from lanebev.geometry.lens import distort_points, normalise_points
from lanebev.geometry.road import image_from_road_points
from tests.view.cameras import CAMERA, GRID, LENS, LENSES, has_gradient, pose


def smooth_image(batch=1, height=180, width=320):
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    channels = torch.stack([x / width, y / height, (x / 20).sin() * (y / 15).cos()]).double()
    return channels.expand(batch, 3, height, width).contiguous()


def interior(pixels, margin=1.0):
    """(1, 1, U, V) bool: not in the outermost pixels, where border and zero padding differ."""
    x, y = pixels.unbind(-1)
    inside = (x > margin) & (x < 319 - margin) & (y > margin) & (y < 179 - margin)
    return inside.reshape(1, 1, *GRID.shape)


def test_equals_kornia_with_the_papers_homography():
    extrinsics, intrinsics = pose([0.03, 0.02, -0.05, 1.4]), CAMERA.intrinsics[None]
    bev, valid = BEVWarp(GRID)(smooth_image(), intrinsics, extrinsics)
    homography = bev_from_image(extrinsics, intrinsics, GRID)
    expected = warp_perspective(smooth_image(), homography, GRID.shape, align_corners=True)
    inner = (valid & interior(BEVWarp(GRID).image_points(intrinsics, extrinsics)[0])).expand_as(bev)
    assert inner.double().mean() > 0.5
    torch.testing.assert_close(bev[inner], expected[inner], atol=2e-6, rtol=0)


def test_valid_is_depth_and_border():
    looking_up = pose([-0.3, 0.0, 0.0, 1.5])
    bev, valid = BEVWarp(GRID)(smooth_image() + 1, CAMERA.intrinsics[None], looking_up)
    assert not valid[0, 0, -1].any()  # below the image
    assert (bev[~valid.expand_as(bev)] == 0).all()
    behind = BEVWarp(BEVGrid(x=(-4.0, 4.0), z=(-10.0, 10.0), resolution=0.5))
    _, valid = behind(smooth_image(), CAMERA.intrinsics[None], pose([0.3, 0.0, 0.0, 1.5]))
    assert not valid[0, 0, 20:].any()
    assert valid.any()


def test_lens_is_folded_into_the_same_resampling():
    # A distorted image of a smooth function of the undistorted pixel: the BEV must not notice the lens.
    extrinsics, intrinsics = pose([0.03, 0.02, 0.05, 1.4]), LENS.intrinsics[None]
    y, x = torch.meshgrid(torch.arange(180.0), torch.arange(320.0), indexing="ij")
    taken = torch.stack([x, y], dim=-1).reshape(-1, 2).double()
    undistorted, _ = LENS.undistort_points(taken)
    image = undistorted.T.reshape(1, 2, 180, 320)  # holds undistorted coordinates
    bev, valid = BEVWarp(GRID)(image, intrinsics, extrinsics, LENS.distortion[None])
    plain, plain_valid = BEVWarp(GRID).image_points(intrinsics, extrinsics)
    plain = plain.mT.reshape(1, 2, *GRID.shape)
    seen, _ = BEVWarp(GRID).image_points(intrinsics, extrinsics, LENS.distortion[None])
    both = (valid & plain_valid.reshape(1, 1, *GRID.shape) & interior(seen)).expand_as(bev)
    assert both.double().mean() > 0.3
    assert (bev[both] - plain[both]).abs().max() < 0.02


@pytest.mark.parametrize("stride", [4, 8])
def test_feature_maps_of_any_stride_land_where_the_image_does(stride):
    extrinsics, intrinsics = pose([0.03, 0.02, -0.05, 1.4]), CAMERA.intrinsics[None]
    y, x = torch.meshgrid(torch.arange(176.0), torch.arange(320.0), indexing="ij")
    image = torch.stack([x, y])[None].double()
    features = torch.nn.functional.avg_pool2d(image, stride)
    warp = BEVWarp(GRID)
    full, valid = warp(image, intrinsics, extrinsics)
    coarse, coarse_valid = warp(features, intrinsics, extrinsics, image_size=(176, 320))
    assert torch.equal(valid, coarse_valid)
    x, y = full[:, :1], full[:, 1:]
    inner = valid & (x > stride) & (x < 320 - stride) & (y > stride) & (y < 176 - stride)
    assert (coarse - full)[inner.expand_as(full)].abs().max() < 1e-3


@pytest.mark.parametrize("stride", [2, 4, 8])
def test_maps_of_a_trunk_land_where_the_image_does_by_intrinsics_of_their_stride(stride):
    """Cell j of a trunk with symmetric padding is centred on pixel s · j, as the README says."""
    x, y = torch.meshgrid(torch.arange(320.0), torch.arange(180.0), indexing="xy")
    ramp = torch.stack([x, y])[None].double()
    extrinsics, intrinsics = pose([0.05, 0.02, 0.01, 1.5]), CAMERA.intrinsics[None]
    coarse = torch.diag(torch.tensor([1 / stride, 1 / stride, 1.0], dtype=torch.float64)) @ intrinsics
    seen, valid = BEVWarp(GRID)(ramp, intrinsics, extrinsics)
    features, there = BEVWarp(GRID)(ramp[..., ::stride, ::stride], coarse, extrinsics)
    inner = (features < ramp[..., ::stride, ::stride].amax((2, 3))[..., None, None]) & there & valid
    assert inner.double().mean() > 0.3
    torch.testing.assert_close(features[inner], seen[inner])


def test_rows_are_independent_and_cameras_per_sample():
    extrinsics = pose([0.03, 0.02, -0.05, 1.4], [-0.02, 0.0, 0.1, 2.0])
    intrinsics = torch.stack(
        [CAMERA.intrinsics, CAMERA.intrinsics * torch.tensor([1.2, 1.2, 1.0]).double()[:, None]]
    )
    image = smooth_image(2) * torch.tensor([1.0, 2.0]).double()[:, None, None, None]
    both, _ = BEVWarp(GRID)(image, intrinsics, extrinsics)
    for row in range(2):
        one = Extrinsics(*(value[row : row + 1] for value in extrinsics))
        alone, _ = BEVWarp(GRID)(image[row : row + 1], intrinsics[row : row + 1], one)
        torch.testing.assert_close(both[row : row + 1], alone)


@pytest.mark.slow
def test_gradcheck_through_pose_lens_and_image():
    grid = BEVGrid(x=(-2.0, 2.0), z=(6.0, 12.0), resolution=1.0)
    small = Camera.from_parameters(30.0, 30.0, 16.0, 9.0, 32, 18)

    def view(i, p, d):
        return BEVWarp(grid)(i, small.intrinsics[None], p, d)[0]

    assert has_gradient(view, (1, 1, 18, 32), [0.013, 0.021, -0.017, 1.43], [[-0.1, 0.01, 0.001, 0.001]])


def test_shapes_are_checked():
    with pytest.raises(ValueError, match=r"image: expected \(B, C, h, w\)"):
        BEVWarp(GRID)(torch.zeros(3, 4, 5), CAMERA.intrinsics[None], pose([0.0, 0.0, 0.0, 1.5]))
    with pytest.raises(ValueError, match=r"intrinsics: expected \(2, 3, 3\), got"):
        BEVWarp(GRID)(smooth_image(2), CAMERA.intrinsics[None], pose([0.0, 0.0, 0.0, 1.5]))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_an_image_of_half_precision_is_sampled_where_it_should_be(dtype):
    extrinsics, intrinsics = pose([0.03, 0.02, -0.05, 1.4]), CAMERA.intrinsics[None]
    image = smooth_image().to(dtype)
    half, valid = BEVWarp(GRID)(image, intrinsics, extrinsics)
    full, expected = BEVWarp(GRID)(image.float(), intrinsics, extrinsics)
    assert half.dtype == dtype
    assert torch.equal(valid, expected)
    torch.testing.assert_close(half, full.to(dtype))


def test_autocast_and_half_modules_leave_the_geometry_alone():
    extrinsics, intrinsics = pose([0.03, 0.02, -0.05, 1.4]), LENS.intrinsics[None]
    inputs = (smooth_image().float(), intrinsics.float(), Extrinsics(*(v.float() for v in extrinsics)))
    lens = LENS.distortion[None].float()
    expected, _ = BEVWarp(GRID)(*inputs, lens)
    homography = bev_from_image(inputs[2], inputs[1], GRID)
    pixels, _ = BEVWarp(GRID).image_points(*inputs[1:], lens)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(BEVWarp(GRID)(*inputs, lens)[0], expected)
        assert torch.equal(BEVWarp(GRID).image_points(*inputs[1:], lens)[0], pixels)
        assert torch.equal(bev_from_image(inputs[2], inputs[1], GRID), homography)
    assert (BEVWarp(GRID).bfloat16().image_points(*inputs[1:], lens)[0] - pixels).abs().max() < 0.01


def test_gradients_flow_under_autocast_from_a_half_precision_image():
    values = torch.tensor([[0.03, 0.02, -0.05, 1.4]], requires_grad=True)
    image = smooth_image().bfloat16().requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        bev, _ = BEVWarp(GRID)(image, CAMERA.intrinsics[None], Extrinsics.unstack(values))
        bev.float().sum().backward()
    assert image.grad.dtype == torch.bfloat16
    assert image.grad.abs().sum() > 0
    assert (values.grad != 0).all()


def test_intrinsics_pose_and_lens_may_differ_in_dtype():
    extrinsics, intrinsics = pose([0.03, 0.02, -0.05, 1.4], dtype=torch.float32), LENS.intrinsics[None]
    image = smooth_image().float()
    expected, _ = BEVWarp(GRID)(image, intrinsics.float(), extrinsics, LENS.distortion[None].float())
    bev, _ = BEVWarp(GRID)(image, intrinsics, extrinsics, LENS.distortion[None].float())
    assert bev.dtype == torch.float32
    torch.testing.assert_close(bev, expected, atol=1e-3, rtol=0)
    assert bev_from_image(extrinsics, intrinsics, GRID).dtype == torch.float64


def test_whole_numbers_and_lenses_that_do_not_fit_are_named():
    args = CAMERA.intrinsics.expand(2, 3, 3), pose([0.0, 0.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.5])
    with pytest.raises(ValueError, match=r"image: expected floating point, got torch.uint8"):
        BEVWarp(GRID)(torch.zeros(2, 3, 4, 5, dtype=torch.uint8), *args)
    for shape in ((5,), (3, 5)):
        with pytest.raises(ValueError, match=r"distortion: expected \(2, D\), got \("):
            BEVWarp(GRID)(smooth_image(2), *args, torch.zeros(shape, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"extrinsics.pitch: expected \(2,\), got \(1,\)"):
        BEVWarp(GRID)(smooth_image(2), args[0], pose([0.0, 0.0, 0.0, 1.5]))
    whole, message = args[0].long(), r"intrinsics: expected floating point, got torch.int64"
    with pytest.raises(ValueError, match=message):
        BEVWarp(GRID)(smooth_image(2), whole, args[1])
    with pytest.raises(ValueError, match=message):
        bev_from_image(args[1], whole, GRID)


def test_a_camera_that_cannot_be_used_leaves_the_other_rows_alone():
    both = torch.stack([CAMERA.intrinsics, torch.zeros(3, 3).double()])
    two = pose([0.05, 0.02, 0.01, 1.5], [0.05, 0.02, 0.01, 1.5])
    homography = bev_from_image(two, both, GRID)
    bev, _ = BEVWarp(GRID)(smooth_image(2), both, two)
    one = Extrinsics(*(part[:1] for part in two))
    torch.testing.assert_close(homography[:1], bev_from_image(one, both[:1], GRID))
    torch.testing.assert_close(bev[:1], BEVWarp(GRID)(smooth_image(), both[:1], one)[0])


def cell_by_cell(camera, extrinsics, grid):
    """Pixels as taken and validity by the functions on points, without this module's arithmetic."""
    points, front = image_from_road_points(
        grid.cells(torch.float64).reshape(1, -1, 2), camera.intrinsics[None], extrinsics
    )
    pixels = distort_points(points, camera.intrinsics[None], camera.distortion[None], camera.model)
    x, y = pixels[0].unbind(-1)
    valid = front[0] & (x >= -0.5) & (x <= 319.5) & (y >= -0.5) & (y <= 179.5)
    if len(camera.distortion):
        radius = normalise_points(points, camera.intrinsics[None])[0].norm(dim=-1)
        valid &= radius < max_undistorted_radius(camera.distortion[None], camera.model)
    return pixels[0], valid


@pytest.mark.parametrize(("distortion", "model"), LENSES)
@pytest.mark.parametrize("values", [[0.05, 0.02, -0.05, 1.4], [-0.4, 0.3, 0.2, 1.4], [0.2, -1.2, 0.1, 0.02]])
def test_every_cell_is_seen_where_its_point_projects(distortion, model, values):
    """Also behind the camera, where a lens folds over, a few cm over the road, in the outermost pixels."""
    camera = Camera.from_parameters(150.0, 155.0, 160.0, 90.0, 320, 180, distortion, model)
    grid, extrinsics = BEVGrid(x=(-6.0, 6.0), z=(-8.0, 20.0), resolution=0.1), pose(values)
    pixels, expected = cell_by_cell(camera, extrinsics, grid)
    y, x = torch.meshgrid(torch.arange(180.0), torch.arange(320.0), indexing="ij")
    ramp = torch.stack([x, y])[None].double() + 1
    lens = (camera.distortion[None], model)
    bev, valid = BEVWarp(grid)(ramp, camera.intrinsics[None], extrinsics, *lens)
    assert torch.equal(valid.flatten(), expected)
    assert 0.01 < expected.double().mean() < 0.9
    clamped = torch.stack([pixels[:, 0].clamp(0, 319), pixels[:, 1].clamp(0, 179)]) + 1
    torch.testing.assert_close(bev[0].flatten(1), torch.where(expected, clamped, 0.0), atol=1e-6, rtol=0)
    single, there = BEVWarp(grid)(ramp.float(), camera.intrinsics[None], extrinsics, *lens)
    assert (there != valid).double().mean() < 1e-4  # on the edge itself
    both = (there & valid).expand_as(bev)
    assert (single.double() - bev)[both].abs().max() < 1e-3  # px


def test_blocks_of_rows_change_nothing(monkeypatch):
    extrinsics, intrinsics = pose([0.03, 0.02, -0.05, 1.4]), LENS.intrinsics[None]
    args = (smooth_image(), intrinsics, extrinsics, LENS.distortion[None])
    whole, valid = BEVWarp(GRID)(*args)
    monkeypatch.setattr("lanebev.view.blocks.BLOCK", 7 * GRID.shape[1])
    bev, there = BEVWarp(GRID)(*args)
    assert torch.equal(bev, whole)
    assert torch.equal(there, valid)


def test_a_camera_that_is_not_above_the_road_sees_nothing():
    bev, valid = BEVWarp(GRID)(
        smooth_image(2), CAMERA.intrinsics.expand(2, 3, 3), pose([0.1, 0.0, 0.0, 0.0], [0.1, 0.0, 0.0, -1.5])
    )
    assert not valid.any()
    assert (bev == 0).all()


def test_a_cell_on_the_axis_behind_the_camera_is_not_seen():
    """Its image would be the principal point, whatever its depth."""
    grid = BEVGrid(x=(-1.0, 1.0), z=(-2.0, 2.0), resolution=0.5)
    up = pose([-math.pi / 4, 0.0, 0.0, 1.0])  # the axis meets the road at Z = -1
    for dtype in (torch.float32, torch.float64):
        _, valid = BEVWarp(grid)(smooth_image().to(dtype), CAMERA.intrinsics[None], up)
        assert not valid.any()


def test_gradients_are_zero_outside_and_finite_everywhere():
    """Also behind the camera, for every lens."""
    grid = BEVGrid(x=(-6.0, 6.0), z=(-8.0, 20.0), resolution=0.5)
    for distortion, model in LENSES:
        values = torch.tensor([[0.05, 0.02, -0.05, 1.4]], requires_grad=True)
        lens = torch.tensor([distortion], requires_grad=True)
        bev, valid = BEVWarp(grid)(
            smooth_image().float(), CAMERA.intrinsics[None].float(), Extrinsics.unstack(values), lens, model
        )
        (outside,) = torch.autograd.grad(bev[~valid.expand_as(bev)].sum(), values, retain_graph=True)
        assert (outside == 0).all()
        found = torch.autograd.grad(bev.sum(), (values, lens), allow_unused=not distortion)
        assert all(bool((part != 0).all() and part.isfinite().all()) for part in found if part is not None)
