"""Kalibr's radial cameras beside the projections of their papers, point by point."""

import math

import numpy as np
import pytest
import torch

from lanebev import Camera
from lanebev.camera.approximation import kannala_brandt_like

FOCAL, CENTRE, SIZE = (310.0, 305.0), (322.0, 176.0), (360, 640)


def _double_sphere(x, y, z, xi, alpha):
    distance = math.sqrt(x * x + y * y + z * z)
    second = math.sqrt(x * x + y * y + (xi * distance + z) ** 2)
    return alpha * second + (1 - alpha) * (xi * distance + z)


def _extended_unified(x, y, z, alpha, beta):
    return alpha * math.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z


def _field_of_view(x, y, z, omega):
    radius = math.hypot(x, y) / z
    return math.hypot(x, y) / (math.atan(2 * radius * math.tan(omega / 2)) / omega) if radius else z


CAMERAS = [
    ("ds", "none", _double_sphere, (-0.2, 0.59)),
    ("ds", "none", _double_sphere, (0.18, 0.6)),
    ("eucm", "none", _extended_unified, (0.6, 1.1)),
    ("eucm", "none", _extended_unified, (0.7, 0.6)),
    ("pinhole", "fov", _field_of_view, (0.9,)),
    ("pinhole", "fov", _field_of_view, (0.5,)),
]


def _file(path, model, distortion, shape, resolution=SIZE[::-1]):
    before, after = (shape, ()) if distortion == "none" else ((), shape)
    path.write_text(
        f"cam0:\n  camera_model: {model}\n  distortion_model: {distortion}\n"
        f"  intrinsics: {[*before, *FOCAL, *CENTRE]}\n  distortion_coeffs: {list(after)}\n"
        f"  resolution: {list(resolution)}\n"
    )
    return path


@pytest.mark.parametrize(("model", "distortion", "depth", "shape"), CAMERAS)
def test_a_camera_images_points_where_its_paper_says(tmp_path, model, distortion, depth, shape):
    camera = Camera.from_file(_file(tmp_path / "camchain.yaml", model, distortion, shape))
    assert (camera.model, camera.image_size) == ("fisheye", SIZE)
    angle, turn = np.meshgrid(np.radians(np.arange(0.5, 60, 5)), np.radians(np.arange(0, 360, 30)))
    x, y, z = 3 * np.sin(angle) * np.cos(turn), 3 * np.sin(angle) * np.sin(turn), 3 * np.cos(angle)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    expected = np.array(
        [
            [
                FOCAL[0] * a / depth(a, b, c, *shape) + CENTRE[0],
                FOCAL[1] * b / depth(a, b, c, *shape) + CENTRE[1],
            ]
            for a, b, c in points
        ]
    )
    inside = ((expected >= 0) & (expected <= (SIZE[1] - 1, SIZE[0] - 1))).all(-1)
    assert inside.sum() > 60
    pixels, seen = camera.project(torch.from_numpy(points[inside]))
    assert seen.all()
    np.testing.assert_allclose(pixels.numpy(), expected[inside], atol=0.02)
    rays = camera.rays(torch.from_numpy(expected[inside])).numpy()
    np.testing.assert_allclose(rays, points[inside] / points[inside, 2:], atol=1e-3)


@pytest.mark.parametrize(
    ("model", "distortion", "shape", "words"),
    [
        ("ds", "none", (-1.5, 0.5), "expected a lens that images larger angles farther out"),
        ("eucm", "none", (0.5, -20.0), "up to the image's corners, got one that does not; calibrate with"),
        ("pinhole", "fov", (0.0,), "expected a lens that images larger angles farther out"),
        ("pinhole", "fov", (2.6,), r"equals within 0.5 px, got one off by \d"),
        ("pinhole", "fov", (0.9, 0.1), "distortion_coeffs: expected 1 number"),
    ],
)
def test_what_is_no_such_lens_is_one_clear_line(tmp_path, model, distortion, shape, words):
    with pytest.raises(ValueError, match=words):
        Camera.from_file(_file(tmp_path / "camchain.yaml", model, distortion, shape))


def test_a_kannala_brandt_lens_is_its_own_nearest():
    k = (0.01, -0.02, 0.003, -0.0004)

    def radius(angle):
        return 1.2 * angle * (1 + sum(each * angle ** (2 * i + 2) for i, each in enumerate(k)))

    scale, found = kannala_brandt_like(radius, 1.0, 300.0)
    assert scale == pytest.approx(1.2, abs=1e-9)
    assert found == pytest.approx(k, abs=1e-6)


def test_what_the_lens_does_outside_the_image_does_not_count():
    def radius(angle):
        return angle * (1 - 0.2 * angle**2)  # turns at 74 degrees, where it is 0.86

    scale, found = kannala_brandt_like(radius, 0.7, 300.0)
    assert (scale, *found) == pytest.approx((1.0, -0.2, 0.0, 0.0, 0.0), abs=1e-6)
    with pytest.raises(ValueError, match="expected a lens that images larger angles farther out"):
        kannala_brandt_like(radius, 0.9, 300.0)


def test_a_lens_of_huge_coefficients_is_one_clear_line():
    with pytest.raises(ValueError, match="expected a lens that a Kannala-Brandt lens equals within"):
        kannala_brandt_like(lambda angle: angle + 1e308 * angle**4, 1.0, 1e3)
