"""Lenses against OpenCV, and their round trips."""

import json

import cv2
import numpy as np
import pytest
import torch

from lanebev import Camera
from lanebev.geometry.distortion import max_undistorted_radius
from lanebev.geometry.lens import (
    cam_from_image,
    distort_points,
    normalise_points,
    undistort_points,
    undistorted_sigma,
)
from lanebev.geometry.road import rays_from_pixels

BROWN = {
    4: [-0.25, 0.05, -0.0007, 0.0001],
    5: [-0.2567775, 0.0433809, -0.0006875, 0.0001257, -0.1150202],
    8: [0.1, -0.05, 0.001, -0.0005, 0.01, 0.15, -0.02, 0.005],
    12: [0.1, -0.05, 0.001, -0.0005, 0.01, 0.15, -0.02, 0.005, 1e-4, -2e-4, 3e-4, 1e-4],
}
FISHEYE = [-0.02, 0.003, -0.001, 0.0002]


def camera(distortion, model="pinhole", focal=1100.0):
    return Camera.from_parameters(focal, focal + 5, 650.0, 370.0, 1280, 720, distortion, model)


def pixels(n=400, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(n, 2, generator=generator, dtype=torch.float64) * torch.tensor([1279.0, 719.0])


@pytest.mark.parametrize("count", sorted(BROWN))
def test_brown_conrady_equals_opencv(count):
    cam = camera(BROWN[count])
    undistorted = pixels()
    rays = torch.linalg.solve(cam.intrinsics, torch.cat([undistorted, torch.ones(400, 1)], -1).double().T).T
    expected, _ = cv2.projectPoints(
        rays.numpy(), np.zeros(3), np.zeros(3), cam.intrinsics.numpy(), np.array(BROWN[count])
    )
    np.testing.assert_allclose(cam.distort_points(undistorted).numpy(), expected[:, 0], atol=1e-8)


def test_fisheye_equals_opencv():
    cam = camera(FISHEYE, "fisheye", 500.0)
    plane = normalise_points(pixels(), cam.intrinsics)
    expected = cv2.fisheye.distortPoints(plane.numpy()[None], cam.intrinsics.numpy(), np.array(FISHEYE))
    np.testing.assert_allclose(cam.distort_points(pixels()).numpy(), expected[0], atol=1e-8)


@pytest.mark.parametrize(
    ("distortion", "model", "focal"),
    [([], "pinhole", 1100.0), (FISHEYE, "fisheye", 500.0), *((BROWN[n], "pinhole", 1100.0) for n in BROWN)],
)
def test_undistortion_inverts_distortion(distortion, model, focal):
    cam = camera(distortion, model, focal)
    undistorted, valid = cam.undistort_points(pixels())
    assert valid.all()
    torch.testing.assert_close(cam.distort_points(undistorted), pixels(), atol=1e-4, rtol=0)


def test_fisheye_undistortion_has_a_gradient_at_the_centre():
    cam = camera(FISHEYE, "fisheye", 500.0)
    points = torch.tensor([[[650.0, 370.0], [100.0, 600.0]]], dtype=torch.float64, requires_grad=True)
    args = (cam.intrinsics[None], cam.distortion[None], "fisheye")
    undistort_points(points, *args).sum().backward()
    assert points.grad.isfinite().all()
    away = torch.tensor([[[700.0, 400.0], [100.0, 600.0]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: undistort_points(p, *args), (away,))


def test_rays_project_back():
    cam = camera(BROWN[5])
    points = pixels()
    back, inside = cam.project(cam.rays(points) * 7.0)
    torch.testing.assert_close(back, points, atol=1e-4, rtol=0)
    assert inside.all()
    _, behind = cam.project(-cam.rays(points))
    assert not behind.any()


def test_the_matrix_of_the_inverse_camera_has_skew():
    intrinsics = torch.tensor(
        [[[900.0, 3.0, 640.0], [0.0, 800.0, 360.0], [0.0, 0.0, 1.0]]], dtype=torch.float64
    )
    torch.testing.assert_close(cam_from_image(intrinsics), torch.linalg.inv(intrinsics))
    rays = rays_from_pixels(torch.tensor([[[10.0, 20.0]]], dtype=torch.float64), intrinsics)
    pixel = torch.tensor([10.0, 20.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close((cam_from_image(intrinsics) @ pixel)[0], rays[0, 0])


def test_points_beyond_the_fold_of_the_lens_are_not_seen():
    cam = camera(BROWN[5])
    radius = float(max_undistorted_radius(cam.distortion[None])[0])
    assert 0.8 < radius < 1.5
    folded = torch.tensor([[radius * 1.2, 0.0, 1.0]], dtype=torch.float64)
    _, inside = cam.project(folded)
    assert not inside.any()
    none = torch.zeros(1, 0, dtype=torch.float64)
    assert float(max_undistorted_radius(none)[0]) == pytest.approx(10.0)


def test_a_fisheye_sees_to_the_side():
    wide = Camera.from_parameters(300, 300, 640, 360, 1280, 720, [0.0] * 4, "fisheye")
    angle = torch.tensor([85.0, 88.0], dtype=torch.float64).deg2rad()
    pixels, seen = wide.project(torch.stack([angle.sin(), torch.zeros(2).double(), angle.cos()], -1))
    torch.testing.assert_close(pixels[:, 0], 640 + 300 * angle)
    assert seen.all()


def test_image_size_is_two_whole_numbers_of_any_kind():
    made = Camera.from_parameters(500, 500, 320, 240, np.int64(640), np.int64(480))
    assert json.dumps(made.image_size) == "[480, 640]"
    for size in ((480, 640, 3), (480,), ()):
        with pytest.raises(ValueError, match="image_size: expected whole positive"):
            Camera(made.intrinsics, made.distortion, "pinhole", size)


def test_points_that_the_lens_folds_back_into_the_image_are_not_seen():
    wide = Camera.from_parameters(560, 560, 640, 400, 1280, 800, [-0.28, 0.07, 0.0, 0.0, -0.008])
    points = torch.tensor([[2.4, 0.0, 1.0], [2.6, 0.3, 1.0], [1.0, 0.2, 1.0]], dtype=torch.float64)
    assert wide.project(points)[1].tolist() == [False, False, True]


@pytest.mark.parametrize("size", [(360, 640), (500, 1280)])
def test_scaled_camera_sees_the_resized_image(size):
    cam = camera([])
    point = torch.tensor([[0.3, 0.2, 2.0]], dtype=torch.float64)
    x, y = cam.project(point)[0][0]
    sx, sy = size[1] / 1280, size[0] / 720
    expected = torch.stack([(x + 0.5) * sx - 0.5, (y + 0.5) * sy - 0.5])
    torch.testing.assert_close(cam.scaled(size).project(point)[0][0], expected)


def test_arguments_of_a_cameras_functions_are_checked():
    cam = camera([])
    with pytest.raises(
        ValueError, match=r"image_size: .* got \(640, 360\) for a camera of \(720, 1280\): are"
    ):
        cam.scaled((640, 360))
    assert cam.scaled((512, 512)).image_size == (512, 512)
    for size in ((0, 0), (0, 640), (640, 0), (-1, -1)):
        with pytest.raises(ValueError, match=r"image_size: expected whole positive \(height, width\)"):
            cam.scaled(size)
    for function in (cam.rays, cam.distort_points, cam.undistort_points):
        for shape in ((2,), (3, 4, 2)):
            with pytest.raises(ValueError, match=r"points: expected \(.*N, 2\), got"):
                function(torch.zeros(shape))
    with pytest.raises(TypeError, match="fields: expected a mapping from names to values, got list"):
        Camera.from_fields([1.0])


@pytest.mark.parametrize(
    ("size", "to", "are_swapped"),
    [
        ((1024, 1280), (640, 608), False),  # nearly square
        ((1000, 1100), (1100, 1000), False),
        ((1024, 1280), (640, 512), True),
        ((1280, 720), (360, 640), True),
        ((1280, 720), (640, 360), False),
    ],
)
def test_swapped_sides_of_a_resized_image(size, to, are_swapped):
    cam = Camera.from_fov(60.0, size[1], size[0])
    if not are_swapped:
        assert cam.scaled(to).image_size == to
        return
    with pytest.raises(ValueError, match="are they swapped"):
        cam.scaled(to)


@pytest.mark.parametrize(
    "make",
    [
        lambda values: torch.tensor(values, requires_grad=True),
        lambda values: [torch.tensor(value, requires_grad=True) for value in values],
        lambda values: torch.tensor(values, dtype=torch.bfloat16),
        lambda values: torch.tensor([values], dtype=torch.float16),
        lambda values: (value for value in values),
        lambda values: np.array(values, dtype=">f8"),
        lambda values: np.array(values, dtype=object),
        lambda values: [[value] for value in values],
    ],
)
def test_coefficients_of_any_kind(make):
    parameters = (650.0, 655.0, 650.0, 370.0, 1280, 720)
    values = [-0.25, 0.0625, 0.0, 0.0, 0.0]
    found = Camera.from_parameters(*parameters, make(values)).distortion
    assert found.tolist() == values
    assert not found.requires_grad
    given = torch.tensor(values, dtype=torch.float64)
    taken = Camera.from_parameters(*parameters, given).distortion
    given[0] = 5.0
    assert taken.tolist() == values


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        (np.full((2, 4), 0.01), ValueError, r"expected \(D,\), got \(2, 4\)$"),
        (torch.full((1, 1, 4), 0.01), ValueError, r"expected \(D,\), got \(1, 1, 4\)$"),
        (0.1, TypeError, r"expected \(D,\) numbers, got 0.1$"),
        ("0.1 0 0 0", TypeError, r"expected \(D,\) numbers, got '0.1 0 0 0'$"),
        ([[0.1], [0.1, 0.2]], TypeError, r"expected \(D,\) numbers, got \[\[0.1\], \[0.1, 0.2\]\]$"),
        ([0.1, None, 0, 0], TypeError, r"expected \(D,\) numbers, got \[0.1, None, 0, 0\]$"),
        (torch.zeros(4, device="meta"), TypeError, r"expected \(D,\) numbers"),
    ],
)
def test_what_are_no_coefficients(given, error, words):
    with pytest.raises(error, match=f"^distortion: {words}"):
        Camera.from_parameters(650.0, 655.0, 650.0, 370.0, 1280, 720, given)


@pytest.mark.parametrize("shape", [(5,), (1, 5), (5, 1)])
def test_coefficients_as_opencv_returns_them(shape):
    parameters = (650.0, 655.0, 650.0, 370.0, 1280, 720)
    lens = np.array(BROWN[5]).reshape(shape)
    for distortion in (lens, lens.tolist(), torch.from_numpy(lens)):
        assert torch.equal(
            Camera.from_parameters(*parameters, distortion).distortion, camera(BROWN[5]).distortion
        )
    assert Camera.from_parameters(*parameters, None).distortion.shape == (0,)


def test_cropped_camera_shifts():
    cam, point = camera(BROWN[5]), torch.tensor([[0.1, 0.2, 2.0]], dtype=torch.float64)
    shift = cam.project(point)[0] - cam.cropped(100, 40, 300, 500).project(point)[0]
    torch.testing.assert_close(shift, torch.tensor([[40.0, 100.0]], dtype=torch.float64))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"distortion": [0.1, 0.2, 0.3]},
            "expected 0, 4, 5, 8, 12, 14 coefficients for a pinhole lens",
        ),
        ({"model": "ball"}, "model: expected one of pinhole, fisheye, omni, got 'ball'"),
        ({"fx": -1.0}, "expected positive focal lengths, got fx -1"),
        ({"width": 0}, "image_size: expected whole positive"),
        ({"width": 1280.5}, "image_size: expected whole positive"),
        ({"cx": float("nan")}, "intrinsics: expected finite numbers"),
        ({"distortion": [0.1, float("inf"), 0.0, 0.0]}, "distortion: expected finite numbers"),
    ],
)
def test_impossible_cameras_are_refused(arguments, message):
    values = {"fx": 1000.0, "fy": 1000.0, "cx": 640.0, "cy": 360.0, "width": 1280, "height": 720} | arguments
    with pytest.raises(ValueError, match=message):
        Camera.from_parameters(**values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda matrix: 2 * matrix, "intrinsics: expected the last row 0 0 1, got 0 0 2"),
        (lambda matrix: matrix.T, r"intrinsics: expected \[fx s cx; 0 fy cy; 0 0 1\], got its transpose"),
        (lambda matrix: matrix.half(), "intrinsics: expected float32 or float64, got torch.float16"),
        (lambda matrix: matrix.long(), "intrinsics: expected floating point, got torch.int64"),
        (lambda matrix: matrix[None], r"intrinsics: expected \(3, 3\), got \(1, 3, 3\)"),
    ],
)
def test_a_matrix_of_another_form_is_refused(change, message):
    matrix = Camera.from_parameters(1000, 1000, 640, 360, 1280, 720).intrinsics
    with pytest.raises(ValueError, match=message):
        Camera(change(matrix), torch.zeros(0), "pinhole", (720, 1280))


@pytest.mark.parametrize(
    ("distortion", "model", "focal"),
    [((-0.28, 0.07, 0.001, -0.001, -0.008), "pinhole", 560.0), ((0.02, -0.01, 0.0, 0.0), "fisheye", 420.0)],
)
def test_sigma_across_a_line_goes_through_the_lens(distortion, model, focal):
    """As noise across the line as taken, undistorted, spreads across the line undistorted."""
    wide = Camera.from_parameters(focal, focal, 640, 400, 1280, 800, list(distortion), model)
    lens = (wide.intrinsics[None], wide.distortion[None], model)
    t = torch.linspace(0, 1, 9, dtype=torch.float64)
    line = torch.stack([200 + 300 * t, 760 - 250 * t], dim=-1)[None]  # undistorted
    along = torch.tensor([300.0, -250.0], dtype=torch.float64).expand_as(line)
    seen = [distort_points(line + sign * 1e-3 * along, *lens) for sign in (-1, 1)]
    across = (seen[1] - seen[0]).flip(-1) * torch.tensor([1.0, -1.0])
    across = across / across.norm(dim=-1, keepdim=True)
    noise = torch.randn(4000, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noisy = distort_points(line, *lens)[0, :, None] + 0.2 * noise * across[0, :, None]  # (9, 4000, 2)
    back = undistort_points(noisy.flatten(0, 1)[None], *lens)[0].unflatten(0, (9, -1))
    normal = torch.tensor([250.0, 300.0], dtype=torch.float64) / (250**2 + 300**2) ** 0.5
    spread = ((back - line[0, :, None]) @ normal).square().mean(1).sqrt()
    said = undistorted_sigma(torch.full((1, 9), 0.2, dtype=torch.float64), line, along, *lens)[0]
    assert (said / 0.2 - 1).abs().max() > 0.2  # not nothing
    torch.testing.assert_close(said, spread, rtol=0.05, atol=0)


def test_field_of_view_spans_the_outer_columns():
    view = Camera.from_fov(90.0, 1280, 720)
    edges = torch.tensor([[-0.5, 359.5], [1279.5, 359.5], [639.5, 359.5]], dtype=torch.float64)
    rays = view.rays(edges)
    torch.testing.assert_close(rays[:, 0], torch.tensor([-1.0, 1.0, 0.0], dtype=torch.float64))
    assert rays[2, 1] == 0
    assert view.image_size == (720, 1280)
    assert float(Camera.from_fov(60, 640, 480).intrinsics[0, 0]) == pytest.approx(320 * 3**0.5)


@pytest.mark.parametrize("degrees", [0.0, 180.0, -60.0, float("nan"), float("inf")])
def test_impossible_fields_of_view_are_refused(degrees):
    with pytest.raises(ValueError, match="fov: expected a horizontal field of view of 10 to 179 degrees"):
        Camera.from_fov(degrees, 640, 480)


def test_a_fingerprint_tells_cameras_apart_and_nothing_else():
    cam = camera(BROWN[5])
    same = [cam.to(dtype=torch.float32), camera([*BROWN[5], 0.0, 0.0, 0.0]), camera(BROWN[5])]
    assert {each.fingerprint() for each in same} == {cam.fingerprint()}
    others = [
        camera(BROWN[4]),
        camera([]),
        camera([0.0] * 4, "fisheye"),
        camera(BROWN[5], focal=1100.01),
        cam.cropped(0, 1, 720, 1280),
        cam.cropped(0, 0, 721, 1280),
    ]
    assert len({each.fingerprint() for each in [cam, *others]}) == 7
    assert cam.fingerprint().isprintable()
    assert camera([-0.0] * 5).fingerprint() == camera([]).fingerprint()
