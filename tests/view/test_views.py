"""Several maps, several planes, the way back, and a camera that stays."""

import pytest
import torch
from kornia.geometry.transform import warp_perspective

from lanebev import BEVGrid, BEVWarp, Camera
from lanebev.geometry.rotation import road_from_cam
from lanebev.view.canonical import CanonicalView
from lanebev.view.matrices import ego_from_camera, ego_from_road, image_from_ego, lift_splat_inputs
from lanebev.view.paint import ImageFromBEV
from tests.view.cameras import CAMERA, GRID, LENS, has_gradient, pose

FISHEYE = Camera.from_parameters(
    200.0, 200.0, 160.0, 90.0, 320, 180, [-0.02, 0.01, 0.0, 0.0], model="fisheye"
)
K = CAMERA.intrinsics[None]


def ramp(height=180, width=320, batch=1):
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y]).double().expand(batch, 2, height, width).contiguous()


def off_the_edge(pixels):
    """Which (B, 2, ...) pixels lie among centres: beyond the outermost the ramp stays."""
    x, y = pixels.unbind(1)
    return ((x > 1) & (x < 318) & (y > 1) & (y < 178)).unsqueeze(1)


def inner_cells(seen):
    """(B, 1, U, V) without the outermost: beyond their centres a resampling stays, too."""
    inner = torch.zeros_like(seen, dtype=torch.float64)
    inner[..., 1:-1, 1:-1] = seen[..., 1:-1, 1:-1].double()
    return inner


def test_maps_of_several_scales_are_each_as_alone():
    extrinsics = pose([0.05, 0.02, 0.01, 1.5], [0.0, -0.02, 0.1, 1.2])
    maps = [torch.rand(2, 3 + level, 180 // 2**level, 320 // 2**level).double() for level in range(3)]
    args = (K.expand(2, 3, 3), extrinsics, LENS.distortion.expand(2, 5), "pinhole", (180, 320))
    for strides in (None, (1, 2, 4)):
        bevs, valid = BEVWarp(GRID)(maps, *args, strides)
        assert [bev.shape[1] for bev in bevs] == [3, 4, 5]
        for index, bev in enumerate(bevs):
            stride = None if strides is None else strides[index]
            alone, there = BEVWarp(GRID)(maps[index], *args, stride)
            assert torch.equal(bev, alone)
            assert torch.equal(valid, there)


@pytest.mark.parametrize("stride", [2, 4, 8])
def test_cells_of_a_strided_trunk_are_centred_on_multiples_of_the_stride(stride):
    """By ``strides`` as by intrinsics of the map, which only an ideal lens allows."""
    extrinsics, image = pose([0.05, 0.02, 0.01, 1.5]), ramp()
    features = image[..., ::stride, ::stride].contiguous()
    found, valid = BEVWarp(GRID)(features, K, extrinsics, image_size=(180, 320), strides=stride)
    seen, there = BEVWarp(GRID)(image, K, extrinsics)
    assert torch.equal(valid, there)
    last = features.amax((2, 3))[..., None, None]
    inner = (found < last) & valid  # what lies beyond the last centre has its value
    assert inner.double().mean() > 0.3
    torch.testing.assert_close(found[inner], seen[inner], atol=1e-9, rtol=0)


def test_planes_above_the_road_are_those_of_a_lower_camera():
    extrinsics, heights = pose([0.1, 0.02, -0.05, 1.6], [0.0, 0.0, 0.0, 0.9]), (0.0, 0.5, 1.0, -0.3)
    args = (K.expand(2, 3, 3), LENS.distortion.expand(2, 5))
    bev, valid = BEVWarp(GRID, heights)(ramp(batch=2), args[0], extrinsics, args[1])
    assert bev.shape == (2, 2, 4, *GRID.shape)
    assert valid.shape == (2, 1, 4, *GRID.shape)
    for plane, height in enumerate(heights):
        lower = extrinsics._replace(height=extrinsics.height - height)
        expected, there = BEVWarp(GRID)(ramp(batch=2), args[0], lower, args[1])
        torch.testing.assert_close(bev[:, :, plane], expected)
        assert torch.equal(valid[:, :, plane], there)
    assert not valid[1, :, 2].any()  # 1.0 m is above that camera
    points, front = BEVWarp(GRID, heights).image_points(args[0], extrinsics)
    assert points.shape == (2, 4 * GRID.shape[0] * GRID.shape[1], 2)
    assert front.shape == points.shape[:2]


def test_arguments_of_several_maps_are_checked():
    warp, extrinsics = BEVWarp(GRID), pose([0.05, 0.02, 0.01, 1.5])
    with pytest.raises(ValueError, match=r"image_size: expected \(H, W\) px .* got None"):
        warp([ramp(), ramp()], K, extrinsics)
    with pytest.raises(ValueError, match=r"image_size: expected \(H, W\) px .* got None"):
        warp(ramp(), K, extrinsics, strides=4)
    with pytest.raises(ValueError, match="strides: expected 2, one for each map, got 3"):
        warp([ramp(), ramp()], K, extrinsics, image_size=(180, 320), strides=[1, 2, 4])
    for views in (warp, CanonicalView(K[0], (180, 320), extrinsics)):
        with pytest.raises(ValueError, match=r"\(height, width\), got \(320, 180\) with a map .* swapped"):
            views(torch.rand(1, 2, 23, 40), K, extrinsics, image_size=(320, 180))
        with pytest.raises(ValueError, match=r"image_size: expected .* of 1 px or more, got \(0, 320\)"):
            views(torch.rand(1, 2, 23, 40), K, extrinsics, image_size=(0, 320))
        with pytest.raises(ValueError, match=r"image: .* with h and w of 1 or more, got \(1, 2, 0, 40\)"):
            views(torch.rand(1, 2, 0, 40), K, extrinsics)
    with pytest.raises(ValueError, match="image: expected maps of 1 images, got 2"):
        warp([ramp(), ramp(batch=2)], K, extrinsics, image_size=(180, 320))
    with pytest.raises(ValueError, match="image: expected one map at least, got none"):
        warp([], K, extrinsics)
    with pytest.raises(ValueError, match="plane_heights: expected one plane at least"):
        BEVWarp(GRID, ())


@pytest.mark.parametrize("camera", [CAMERA, LENS, FISHEYE], ids=["ideal", "lens", "fisheye"])
def test_what_is_painted_is_seen_where_it_was(camera):
    """Image to view to image, of a function that a bilinear resampling keeps nearly."""
    extrinsics = pose([0.06, 0.03, -0.02, 1.5])
    intrinsics, lens = camera.intrinsics[None], (camera.distortion[None], camera.model)
    bev, seen = BEVWarp(GRID)(ramp(), intrinsics, extrinsics, *lens)
    painted, valid = ImageFromBEV(GRID)(
        torch.cat([bev, inner_cells(seen)], 1), intrinsics, extrinsics, (180, 320), *lens
    )
    inner = valid & (painted[:, 2:] > 0.999) & off_the_edge(ramp())  # of neighbours that were all seen
    assert inner.double().mean() > 0.08
    assert (painted[:, :2] - ramp())[inner.expand(1, 2, 180, 320)].abs().max() < 0.5
    assert not valid[:, :, :60].any()  # above the horizon


def test_painting_keeps_to_the_rectangle_and_to_the_road():
    extrinsics = pose([0.06, 0.03, -0.02, 1.5], [0.06, 0.0, 0.0, 0.0], [0.06, 0.0, 0.0, 1.8])
    bev = torch.ones(3, 1, *GRID.shape, dtype=torch.float64)
    painted, valid = ImageFromBEV(GRID)(bev, K.expand(3, 3, 3), extrinsics, (180, 320))
    assert torch.equal(painted > 0, valid)
    assert not valid[1].any()
    raised, above = ImageFromBEV(GRID, plane_height=0.3)(bev[:1], K, extrinsics._replace(
        **{name: value[:1] for name, value in extrinsics._asdict().items()}), (180, 320))  # fmt: skip
    lower, _ = ImageFromBEV(GRID)(bev[:1], K, pose([0.06, 0.03, -0.02, 1.2]), (180, 320))
    assert torch.equal(raised, lower)
    assert above.any()


@pytest.mark.parametrize("camera", [CAMERA, LENS, FISHEYE], ids=["ideal", "lens", "fisheye"])
def test_a_camera_below_the_plane_sees_nothing_of_it(camera):
    extrinsics, bev = pose([0.06, 0.0, 0.0, -1.0]), torch.ones(1, 1, *GRID.shape, dtype=torch.float64)
    lens = (camera.distortion[None], camera.model)
    painted, valid = ImageFromBEV(GRID)(bev, camera.intrinsics[None], extrinsics, (180, 320), *lens)
    assert not valid.any()
    assert not painted.any()


def test_painting_has_the_gradient_of_finite_differences():
    grid, size = BEVGrid(x=(-2.0, 2.0), z=(6.0, 12.0), resolution=1.0), (6, 8)
    small = torch.tensor([[[20.0, 0.0, 4.0], [0.0, 20.0, 1.0], [0.0, 0.0, 1.0]]], dtype=torch.float64)

    def view(b, p):
        return ImageFromBEV(grid)(b, small, p, size)[0]

    values = [0.113, 0.021, -0.017, 1.43]
    assert view(torch.ones(1, 1, 6, 4, dtype=torch.float64), pose(values)).count_nonzero() > 5
    assert has_gradient(view, (1, 1, 6, 4), values)


VIRTUAL = torch.tensor([[250.0, 0.0, 150.0], [0.0, 250.0, 60.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def test_a_turned_camera_is_turned_back_by_a_homography():
    extrinsics, fixed = pose([0.05, -0.03, 0.04, 1.7]), pose([0.02, 0.0, 0.0, 1.5])
    view = CanonicalView(VIRTUAL, (120, 300), fixed, keep_height=True)
    image = (ramp() / 30).sin()
    found, valid = view(image, K, extrinsics)
    turn = road_from_cam(*fixed[:3]).mT @ road_from_cam(*extrinsics[:3])  # virtual from real camera
    homography = VIRTUAL @ turn @ K.inverse()
    expected = warp_perspective(image, homography, (120, 300), align_corners=True)
    inner = valid[..., 2:-2, 2:-2].expand(1, 2, 116, 296)
    assert inner.double().mean() > 0.6
    off = (found - expected)[..., 2:-2, 2:-2][inner].abs()
    assert off.quantile(0.99) < 1e-9  # the rest is the outermost pixel's edge


@pytest.mark.parametrize("camera", [CAMERA, LENS, FISHEYE], ids=["ideal", "lens", "fisheye"])
def test_the_canonical_view_shows_the_road_as_its_camera_would(camera):
    """Its bird's-eye view is that of the image: cells hold the pixel that they came from."""
    extrinsics, fixed = pose([0.05, -0.03, 0.04, 1.7]), pose([0.02, 0.01, -0.02, 1.5])
    lens = (camera.distortion[None], camera.model)
    view, valid = CanonicalView(VIRTUAL, (120, 300), fixed)(
        ramp(), camera.intrinsics[None], extrinsics, *lens
    )
    both = torch.cat([view, inner_cells(valid)], 1)
    twice, seen = BEVWarp(GRID)(both, VIRTUAL[None], fixed)
    once, there = BEVWarp(GRID)(ramp(), camera.intrinsics[None], extrinsics, *lens)
    inner = seen & there & (twice[:, 2:] > 0.999) & off_the_edge(once)
    assert inner.double().mean() > 0.3
    assert (twice[:, :2] - once)[inner.expand_as(once)].abs().max() < 0.02  # px: two resamplings


def test_the_horizon_stays_and_what_is_above_it_is_turned_only():
    higher, fixed = pose([0.0, 0.0, 0.0, 3.0]), pose([0.0, 0.0, 0.0, 1.5])
    view, _ = CanonicalView(CAMERA.intrinsics, (180, 320), fixed)(ramp(), K, higher)
    torch.testing.assert_close(view[..., :91, :], ramp()[..., :91, :])  # the horizon is row 90
    torch.testing.assert_close(view[0, 1, 91:135, 0], 90 + 2 * torch.arange(1.0, 45.0).double())
    nothing, valid = CanonicalView(CAMERA.intrinsics, (180, 320), fixed)(
        ramp(), K, pose([0.0, 0.0, 0.0, -1.0])
    )
    assert valid.any()
    assert nothing.isfinite().all()


def test_gradients_of_the_canonical_view_are_those_of_finite_differences():
    small = torch.tensor([[[8.0, 0.0, 4.0], [0.0, 8.0, 2.0], [0.0, 0.0, 1.0]]], dtype=torch.float64)
    view = CanonicalView(small[0], (5, 8), pose([0.02, 0.01, -0.02, 1.5]))
    values, lens = [0.113, 0.021, -0.017, 1.43], [-0.1, 0.01, 0.001, 0.001]
    assert has_gradient(lambda i, p, d: view(i, small, p, d)[0], (1, 1, 6, 9), values, [lens])


def test_canonical_views_are_checked():
    with pytest.raises(ValueError, match="extrinsics: expected those of one virtual camera, got 2"):
        CanonicalView(VIRTUAL, (120, 300), pose([0.0] * 4, [0.0] * 4))
    with pytest.raises(ValueError, match=r"extrinsics\.height: expected more than 0 m, got 0"):
        CanonicalView(VIRTUAL, (120, 300), pose([0.0] * 4))
    with pytest.raises(ValueError, match=r"intrinsics: expected \(3, 3\), got"):
        CanonicalView(VIRTUAL[None], (120, 300), pose([0.0, 0.0, 0.0, 1.5]))


POSES = pose([0.05, -0.03, 0.04, 1.7], [0.0, 0.2, 0.0, 1.4])


def seen_by(points, intrinsics):
    """Ego points (N, 3) to pixels by the axes' meaning: forward, left, up become Z, -X, -Y."""
    forward, left, up = points.T
    road = torch.stack([-left, -up, forward, torch.ones(len(points)).double()], -1)
    return road @ POSES.projection(intrinsics.expand(2, 3, 3)).mT  # (2, N, 3)


def test_ego_points_project_as_heads_do_it():
    points = torch.tensor([[10.0, 2.0, 0.0], [20.0, -3.0, 1.2], [7.0, 0.5, 0.3]]).double()
    homogeneous = torch.cat([points, torch.ones(3, 1)], -1)
    found = (
        homogeneous @ image_from_ego(POSES, K.expand(2, 3, 3)).mT
    )  # as BEVFormer: lidar2img @ (x, y, z, 1)
    torch.testing.assert_close(found[..., :3], seen_by(points, K))
    shifted = ego_from_road(torch.float64)
    shifted[:3, 3] = torch.tensor([1.5, 0.0, 0.1])  # the camera's foot is 1.5 m ahead of that origin
    moved = homogeneous + torch.tensor([1.5, 0.0, 0.1, 0.0]).double()
    torch.testing.assert_close(moved @ image_from_ego(POSES, K.expand(2, 3, 3), shifted).mT, found)
    half = torch.diag(torch.tensor([0.5, 0.5, 1.0])).double()
    resized = homogeneous @ image_from_ego(POSES, K.expand(2, 3, 3), image_transform=half).mT
    torch.testing.assert_close(resized[..., :2], found[..., :2] / 2)


@pytest.mark.parametrize("scale", [(1.05, 1.05, 1.05), (1.0, -1.0, 1.0), (-1.1, 1.1, 1.1)])
def test_an_augmented_ego_frame_projects_to_the_same_pixels(scale):
    """As BEVDet augments it: turned, scaled and mirrored, points and matrix alike."""
    turn = torch.eye(4).double()
    turn[:2, :2] = torch.tensor([[0.8, -0.6], [0.6, 0.8]])
    augmentation = torch.diag(torch.tensor([*scale, 1.0])).double() @ turn
    points = torch.tensor([[10.0, 2.0, 0.0, 1.0], [20.0, -3.0, 1.2, 1.0]]).double()
    cameras = K.expand(2, 3, 3)
    found = (
        points
        @ augmentation.mT
        @ image_from_ego(POSES, cameras, augmentation @ ego_from_road(torch.float64)).mT
    )
    torch.testing.assert_close(found, points @ image_from_ego(POSES, cameras).mT)


def test_lifted_pixels_are_the_ego_points_that_they_show():
    """get_geometry of Lift-Splat-Shoot, written out."""
    points = torch.tensor([[10.0, 2.0, 0.0], [20.0, -3.0, 1.2], [7.0, 0.5, 0.3]]).double()
    seen = seen_by(points, K)
    depth, pixels = seen[..., 2:], seen[..., :2] / seen[..., 2:]
    crop = torch.tensor([[0.5, 0.0, -7.0], [0.0, 0.5, -11.0], [0.0, 0.0, 1.0]]).double()
    given = lift_splat_inputs(POSES, K.expand(2, 3, 3), image_transform=crop)
    network = 0.5 * pixels + crop[:2, 2]
    frustum = torch.cat([network, depth], -1) - given.post_trans.unsqueeze(1)
    frustum = torch.linalg.solve(given.post_rots, frustum.mT).mT
    lifted = torch.cat([frustum[..., :2] * frustum[..., 2:], frustum[..., 2:]], -1)
    combined = given.rots @ torch.linalg.inv(given.intrins)
    torch.testing.assert_close(lifted @ combined.mT + given.trans.unsqueeze(1), points.expand(2, 3, 3))
    single = lift_splat_inputs(POSES, K.expand(2, 3, 3).float(), image_transform=crop.float())
    assert {part.dtype for part in single} == {torch.float64}
    sensor = ego_from_camera(POSES)
    torch.testing.assert_close(sensor[:, :3, :3], given.rots)
    torch.testing.assert_close(sensor[:, :3, 3], torch.tensor([[0, 0, 1.7], [0, 0, 1.4]]).double())
