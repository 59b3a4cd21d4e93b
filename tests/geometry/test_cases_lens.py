"""Lenses that real cameras have and a plain iteration loses: pincushions, tilted sensors, mirrors, folds."""

import re

import cv2
import numpy as np
import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lanebev import BEVGrid, BEVWarp, Camera, Extrinsics
from lanebev.camera.plausibility import lens_remark
from lanebev.geometry import undistortion
from lanebev.geometry.distortion import (
    brown_conrady,
    distort_plane,
    lift_unified_plane,
    max_undistorted_radius,
    tilt_homography,
    unified_plane,
    upright_homography,
)
from lanebev.geometry.lens import invert_distortion, undistort_points
from lanebev.geometry.undistortion import bracket_increasing, undistort_plane
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.segments import segments_from_vertices

WIDTH, HEIGHT = 1024, 768
PINCUSHION = [0.35, 0.3, 0, 0, 0.0]
RATIONAL = [0.2, -0.1, 0, 0, 0, -0.45, -0.15, 0.0]
TILTED = [0.1, -0.05, 0.001, -0.0005, 0.01, 0.15, -0.02, 0.005, 1e-3, -2e-3, 3e-3, 1e-3, 0.04, -0.03]
FISHEYE = [-0.02, 0.003, -0.001, 0.0002]
OMNI = [1.7, -0.15, 0.6, 0.001, -0.0005]
LENSES = [
    (PINCUSHION, "pinhole", 530.0),
    (RATIONAL, "pinhole", 530.0),
    (TILTED, "pinhole", 530.0),
    ([-0.28, 0.07, 0.03, -0.02, 0.0], "pinhole", 700.0),  # decentred by far more than real lenses
    (FISHEYE, "fisheye", 470.0),
    (OMNI, "omni", 1200.0),
]
IDS = ["pincushion", "rational", "tilted", "decentred", "fisheye", "omni"]


def _camera(distortion, model="pinhole", focal=530.0):
    return Camera.from_parameters(focal, focal + 3, 511.5, 383.5, WIDTH, HEIGHT, distortion, model)


def _grid(columns=33, rows=25):
    x, y = np.meshgrid(np.linspace(0, WIDTH - 1, columns), np.linspace(0, HEIGHT - 1, rows))
    return torch.tensor(np.stack([x.ravel(), y.ravel()], 1))


def _lens(camera):
    return camera.intrinsics[None], camera.distortion[None], camera.model


@pytest.mark.parametrize(("distortion", "model", "focal"), LENSES, ids=IDS)
def test_every_pixel_is_inverted(distortion, model, focal):
    cam, pixels = _camera(distortion, model, focal), _grid()
    undistorted, valid = cam.undistort_points(pixels)
    assert valid.all()
    torch.testing.assert_close(cam.distort_points(undistorted), pixels, atol=1e-6, rtol=0)
    assert cam.share_without_rays() == 0
    single = cam.to(dtype=torch.float32)
    undistorted, valid = single.undistort_points(pixels.float())
    assert valid.all()
    torch.testing.assert_close(single.distort_points(undistorted), pixels.float(), atol=5e-3, rtol=0)


@pytest.mark.parametrize("distortion", [PINCUSHION, RATIONAL, TILTED])
def test_undistortion_equals_opencvs(distortion):
    cam, pixels = _camera(distortion), _grid()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    plane = cv2.undistortPoints(
        pixels.numpy()[:, None], cam.intrinsics.numpy(), np.array(distortion), criteria=criteria
    )
    np.testing.assert_allclose(cam.rays(pixels)[:, :2].numpy(), plane[:, 0], atol=1e-6)


def test_14_coefficients_with_a_tilted_sensor_equal_opencv():
    cam, pixels = _camera(TILTED), _grid()
    rays = torch.cat([(pixels - cam.intrinsics[:2, 2]) / 530, torch.ones(len(pixels), 1)], -1)
    expected, _ = cv2.projectPoints(
        rays.numpy(), np.zeros(3), np.zeros(3), cam.intrinsics.numpy(), np.array(TILTED)
    )
    got, _ = cam.project(rays)
    np.testing.assert_allclose(got.numpy(), expected[:, 0], atol=1e-8)
    tau = torch.tensor([[0.04, -0.03], [0.0, 0.0]], dtype=torch.float64)
    both = upright_homography(tau) @ tilt_homography(tau)
    torch.testing.assert_close(both, torch.eye(3, dtype=torch.float64).expand(2, 3, 3))


def test_convention_omni_is_mei_and_rives():
    """The paper's projection of one point, step by step; "mei" is another name of it."""
    xi, k1, k2, p1, p2 = OMNI
    x, y, z = np.array([0.4, -0.2, 0.7])
    length = np.sqrt(x * x + y * y + z * z)
    x, y = x / (z + xi * length), y / (z + xi * length)
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    for name in ("omni", "mei"):
        cam = _camera(OMNI, name, 1000.0)
        got, seen = cam.project(torch.tensor([[0.4, -0.2, 0.7]], dtype=torch.float64))
        np.testing.assert_allclose(got[0], [1000 * u + 511.5, 1003 * v + 383.5], atol=1e-9)
        assert seen.all()
        assert cam.model == "omni"


@given(
    st.sampled_from([0.0, 0.3, 0.9, 1.0, 1.4, 2.3]),
    st.floats(0.0, 20.0),
    st.floats(-3.14, 3.14),
)
def test_the_unified_model_is_lifted_back(xi, radius, angle):
    point = torch.tensor([[[radius * np.cos(angle), radius * np.sin(angle)]]])
    single = torch.tensor([[xi]], dtype=torch.float64)
    back, front = lift_unified_plane(unified_plane(point.double(), single), single)
    assert front.all()
    torch.testing.assert_close(back, point.double(), rtol=1e-6, atol=1e-9)


coefficient = st.floats(-1.0, 1.0)


@st.composite
def lenses(draw):
    """Lenses of every model, mild to wild; where their radial part folds over is known."""
    kinds = [*(("pinhole", n) for n in (4, 5, 8, 12, 14)), ("fisheye", 4), ("omni", 5)]
    model, count = draw(st.sampled_from(kinds))
    k = [draw(coefficient) for _ in range(count)]
    if model == "fisheye":
        return model, [0.1 * k[0], 0.03 * k[1], 0.01 * k[2], 0.003 * k[3]]
    if model == "omni":
        return model, [1.2 + k[0], 0.3 * k[1], 0.3 * k[2], 0.01 * k[3], 0.01 * k[4]]
    scale = [0.4, 0.3, 0.01, 0.01, 0.2, 0.4, 0.3, 0.1, 0.01, 0.01, 0.01, 0.01, 0.1, 0.1]
    return model, [a * b for a, b in zip(k, scale, strict=False)]


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(lenses(), st.floats(0.02, 0.9), st.integers(0, 11))
def test_distorted_points_come_back(lens, share, turn):
    model, distortion = lens
    k = torch.tensor([distortion], dtype=torch.float64)
    reach = max_undistorted_radius(k, model)
    angle = turn * np.pi / 6
    radius = share * float(reach.clamp(max=2.0)[0])
    point = torch.tensor([[[radius * np.cos(angle), radius * np.sin(angle)]]], dtype=torch.float64)
    path = point * torch.linspace(0, 1, 200, dtype=torch.float64)[None, :, None]  # from the centre outwards
    if model == "pinhole":
        plain = brown_conrady(path.movedim(-1, 0), k)
        if (plain.determinant() < 0.02).any():
            return  # decentred so that it folds over earlier
    image = distort_plane(point, k, model)
    back, valid = undistort_plane(image, k, model, reach)
    assert valid.all()
    torch.testing.assert_close(distort_plane(back, k, model), image, atol=1e-9, rtol=0)
    torch.testing.assert_close(back, point, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("count", [4, 5, 8, 12])
def test_the_jacobian_is_the_derivative(count):
    generator = torch.Generator().manual_seed(0)
    plane = torch.randn(2, 3, 4, generator=generator, dtype=torch.float64)
    k = 0.1 * torch.randn(3, count, generator=generator, dtype=torch.float64)
    got = brown_conrady(plane, k)
    full = torch.func.jacfwd(lambda p: brown_conrady(p, k).value)(plane)  # (2, 3, 4, 2, 3, 4)
    expected = torch.einsum("ibnjbn->ijbn", full)
    torch.testing.assert_close(got.diagonal, torch.stack([expected[0, 0], expected[1, 1]]))
    torch.testing.assert_close(got.cross, torch.stack([expected[0, 1], expected[1, 0]]))


@pytest.mark.parametrize(("distortion", "model", "focal"), LENSES, ids=IDS)
def test_undistortion_has_the_solutions_gradient(distortion, model, focal):
    cam = _camera(distortion, model, focal)
    points = torch.tensor([[[511.5, 383.5], [900.0, 700.0], [30.0, 400.0]]], dtype=torch.float64)
    inputs = [points[:, 1:], cam.intrinsics[None], cam.distortion[None]]
    inputs = [each.clone().requires_grad_() for each in inputs]
    focal_only = torch.zeros(3, 3, dtype=torch.float64)
    focal_only[0, 0] = focal_only[1, 1] = 1.0
    assert torch.autograd.gradcheck(
        lambda p, a, k: undistort_points(p, cam.intrinsics + focal_only * a[:, :1, :1], k, model),
        (inputs[0], torch.zeros(1, 1, 1, dtype=torch.float64, requires_grad=True), inputs[2]),
        eps=1e-5,
        atol=1e-4,
    )
    centre = points.clone().requires_grad_()
    undistort_points(centre, *_lens(cam)).sum().backward()
    assert centre.grad.isfinite().all()


def test_what_cannot_be_inverted_is_said_and_has_no_gradient():
    cam = _camera([-0.3, 0.0, 0.0, 0.0], focal=600.0)  # folds over at 1/sqrt(0.9) = 1.054, imaged at 0.703
    circle = 600 * (1.0541 * (1 - 0.3 * 1.0541**2))
    points = torch.tensor(
        [[[511.5 + circle - 2, 383.5], [511.5 + circle + 2, 383.5], [0.0, 0.0], [torch.nan, 5.0]]]
    ).double()
    intrinsics, distortion = cam.intrinsics[None], cam.distortion[None].requires_grad_()
    points.requires_grad_()
    undistorted, valid = invert_distortion(points, intrinsics, distortion)
    assert valid.tolist() == [[True, False, False, False]]
    assert undistorted[0, :3].isfinite().all()
    undistorted[0, :3].sum().backward()
    assert points.grad[0, 0].abs().sum() > 0
    assert (points.grad[0, 1:] == 0).all()
    assert distortion.grad.isfinite().all()
    share = cam.share_without_rays()
    outside = (_grid(256, 192) - torch.tensor([511.5, 383.5])).norm(dim=-1) > circle
    assert share == pytest.approx(float(outside.double().mean()), abs=0.01)


def test_a_run_says_what_its_lens_cannot_have_imaged():
    assert lens_remark(_camera(PINCUSHION)) == ""
    remark = lens_remark(_camera([-0.3, 0.0, 0.0, 0.0], focal=600.0))
    assert re.match(r"\d+\.\d\d% of the pixels cannot be undistorted by the lens", remark)


def test_segments_that_the_lens_cannot_have_imaged_weigh_nothing():
    cam = _camera([-0.3, 0.0, 0.0, 0.0], focal=600.0)
    ends = torch.tensor([[[[500.0, 600], [520, 500]], [[0, 0], [300, 300]], [[400, 600], [1023, 767]]]])
    ends.requires_grad_()
    ones = torch.ones(1, 3, 2)
    vertices = BoundaryVertices(ends, ones, ones, torch.tensor([[2, 1, 3]]))
    got = segments_from_vertices(vertices, cam.intrinsics[None].float(), cam.distortion[None].float())
    assert got.weight.tolist() == [[1, 0, 0]]
    assert got.endpoints.isfinite().all()
    assert got.sigma.isfinite().all()
    (got.endpoints * got.weight[..., None, None]).sum().backward()
    assert ends.grad.isfinite().all()


def test_a_row_of_a_batch_is_the_row_alone():
    lenses = torch.tensor([PINCUSHION, [-0.3, 0.05, 0, 0, 0], [torch.nan] * 5, [0.0] * 5]).double()
    intrinsics = _camera([]).intrinsics.expand(4, 3, 3)
    points = _grid(9, 7).expand(4, -1, -1)
    together = invert_distortion(points, intrinsics, lenses)
    for row in (0, 1, 3):
        alone = invert_distortion(points[:1], intrinsics[:1], lenses[row : row + 1])
        for a, b in zip(alone, together, strict=True):
            assert torch.equal(a[0], b[row])
    assert not together[1][2].any()


@pytest.mark.parametrize(
    ("distortion", "model", "expected"),
    [
        ([-0.3, 0.0, 0.0, 0.0], "pinhole", 1 / 0.9**0.5),
        ([0.0] * 4, "pinhole", 10.0),
        ([0.0, 0, 0, 0, 0, -0.25, 0, 0], "pinhole", 2.0),  # a pole
        ([-0.2, 0.0, 0.0, 0.0], "fisheye", np.tan(1 / 0.6**0.5)),
        ([1.0, -0.9, 0.0, 0.0, 0.0], "omni", None),
    ],
)
def test_where_lenses_fold_over(distortion, model, expected):
    k = torch.tensor([distortion], dtype=torch.float64)
    reach = float(max_undistorted_radius(k, model)[0])
    if expected is None:  # at a radius of 1/sqrt(2.7) on the projection plane
        at = 1 / 2.7**0.5
        expected = 2 * at / (1 - at * at)  # of ξ = 1: stereographic
    assert reach == pytest.approx(expected, rel=0.01)
    assert float(max_undistorted_radius(torch.full_like(k, torch.nan), model)[0]) == 0


def test_a_table_brackets_what_it_tabulates():
    nodes = torch.linspace(0, 2, 9, dtype=torch.float64)[None]
    target = torch.tensor([[0.0, 0.3, 0.25**2, 3.99, 4.0, 7.0]], dtype=torch.float64)
    low, high, linear = bracket_increasing(nodes, nodes.square(), target)
    assert low.tolist() == [[0, 0.5, 0.25, 1.75, 1.75, 1.75]]
    torch.testing.assert_close(high - low, torch.full_like(low, 0.25))
    assert linear[0, 0] == 0
    assert linear[0, -1] == 2


BARREL = [-0.28, 0.09, 0.001, -0.0007, -0.012]


class _Warps(torch.nn.Module):
    """Image and pose to the view, behind a lens of each model."""

    def __init__(self):
        super().__init__()
        self.warp = BEVWarp(BEVGrid(x=(-4, 4), z=(4, 20), resolution=0.5))

    def forward(self, image, intrinsics, pose, barrel, fisheye, omni):
        lenses = ((barrel, "pinhole"), (fisheye, "fisheye"), (omni, "omni"))
        views = [self.warp(image, intrinsics, Extrinsics.unstack(pose), *lens) for lens in lenses]
        return tuple(part for view in views for part in view)


class _Inverse(torch.nn.Module):
    """Points to undistorted ones."""

    def forward(self, points, intrinsics, distortion):
        return invert_distortion(points, intrinsics, distortion)


def _onnx_equals_eager(net, args, path):
    net = net.eval()
    with torch.no_grad():
        expected = tuple(net(*args))
        torch.onnx.export(net, args, path, dynamo=True, verbose=False)
    session = onnxruntime.InferenceSession(path)
    feeds = {each.name: arg.numpy() for each, arg in zip(session.get_inputs(), args, strict=True)}
    for got, value in zip(map(torch.from_numpy, session.run(None, feeds)), expected, strict=True):
        torch.testing.assert_close(got, value, atol=2e-3, rtol=1e-4)
    return expected


INTRINSICS = torch.tensor([[[130.0, 0, 79.5], [0, 130.0, 44.5], [0, 0, 1]]])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_the_warp_with_a_lens_goes_to_onnx(tmp_path):
    lenses = (torch.tensor([each]) for each in (BARREL, FISHEYE, [0.8, *OMNI[1:]]))
    args = (torch.rand(1, 3, 90, 160), INTRINSICS, torch.tensor([[0.05, 0.0, 0.0, 1.4]]), *lenses)
    expected = _onnx_equals_eager(_Warps(), args, tmp_path / "net.onnx")
    assert all(valid.float().mean() > 0.3 for valid in expected[1::2])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_the_inverse_of_a_lens_goes_to_onnx(tmp_path, monkeypatch):
    monkeypatch.setattr(undistortion, "_PLANE_STEPS", 3)  # of 10 alike: export takes a second per step
    points = torch.rand(1, 40, 2) * torch.tensor([159.0, 89.0])
    args = (points, INTRINSICS, torch.tensor([TILTED]))
    assert _onnx_equals_eager(_Inverse(), args, tmp_path / "net.onnx")[1].all()
