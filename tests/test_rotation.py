"""Signs and round trips of the angles."""

import itertools
import math

import pytest
import torch

from lanebev.geometry import rotation
from lanebev.types import Extrinsics

ANGLES = [math.radians(a) for a in (-10.0, -1.0, 0.0, 5.0)]


def t(*values):
    return [torch.tensor([v], dtype=torch.float64) for v in values]


def test_convention_pitch_down_raises_the_horizon():
    pitch, yaw, roll, height = t(0.05, 0.0, 0.0, 1.5)
    intrinsics = torch.tensor([[[1000.0, 0, 500], [0, 1000, 300], [0, 0, 1]]], dtype=torch.float64)
    a, b, c = rotation.horizon_line(Extrinsics(pitch, yaw, roll, height), intrinsics)[0]
    assert b > 0  # the road's side is positive
    assert float(-(a * 500 + c) / b) == pytest.approx(300 - 1000 * math.tan(0.05))


def test_convention_yaw_left_moves_the_vanishing_point_right():
    v = rotation.vanishing_dir_from_pitch_yaw(*t(0.0, 0.1))[0]
    assert v[0] > 0
    assert float(v[0] / v[2]) == pytest.approx(math.tan(0.1))


def test_convention_roll_counter_clockwise_from_behind_lowers_the_horizon_on_the_right():
    # The camera's right side is up, so the level horizon falls to the right in the image.
    pitch, yaw, roll, height = t(0.0, 0.0, 0.1, 1.5)
    intrinsics = torch.eye(3, dtype=torch.float64)[None]
    a, b, c = rotation.horizon_line(Extrinsics(pitch, yaw, roll, height), intrinsics)[0]
    y_left, y_right = (float(-(a * x + c) / b) for x in (-1.0, 1.0))
    assert y_right > y_left
    assert (y_right - y_left) / 2 == pytest.approx(math.tan(0.1))


def test_matrices_are_the_design_pages():
    pitch, yaw, roll = 0.1, -0.2, 0.3
    s, c = math.sin, math.cos
    world = torch.tensor(
        [[1, 0, 0], [0, c(pitch), -s(pitch)], [0, s(pitch), c(pitch)]], dtype=torch.float64
    ) @ torch.tensor([[c(yaw), 0, s(yaw)], [0, 1, 0], [-s(yaw), 0, c(yaw)]], dtype=torch.float64)
    turn = torch.tensor([[c(roll), s(roll), 0], [-s(roll), c(roll), 0], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(rotation.cam_from_world(*t(pitch, yaw))[0], world)
    torch.testing.assert_close(rotation.road_from_cam(*t(pitch, yaw, roll))[0], turn @ world.T)


@pytest.mark.parametrize(("pitch", "yaw", "roll"), list(itertools.product(ANGLES, repeat=3)))
def test_angles_round_trip_over_all_signs(pitch, yaw, roll):
    matrix = rotation.road_from_cam(*t(pitch, yaw, roll))
    back = rotation.angles_from_matrix(matrix)
    assert [float(x) for x in back] == pytest.approx([pitch, yaw, roll], abs=1e-12)
    torch.testing.assert_close(matrix @ matrix.mT, torch.eye(3, dtype=torch.float64)[None])


@pytest.mark.parametrize("degrees", [5.0, 10.0])
def test_deviation_yaw_is_exact_where_the_papers_form_is_not(degrees):
    angle = math.radians(degrees)
    v = rotation.vanishing_dir_from_pitch_yaw(*t(angle, angle))
    _, yaw = rotation.pitch_yaw_from_vanishing_dir(3.0 * v)
    assert float(yaw) == pytest.approx(angle, abs=1e-12)
    papers = math.atan2(float(v[0, 0]), float(v[0, 2]))
    assert math.degrees(abs(papers - angle)) > {5.0: 0.015, 10.0: 0.13}[degrees]


def test_vanishing_dir_gradcheck_at_zero():
    zero = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda p, y: rotation.pitch_yaw_from_vanishing_dir(rotation.vanishing_dir_from_pitch_yaw(p, y)),
        (zero, zero.detach().clone().requires_grad_()),
    )


def test_vanishing_dir_shape_is_checked():
    with pytest.raises(ValueError, match=r"vanishing_dir: expected \(\.\.\., 3\), got \(2, 2\)"):
        rotation.pitch_yaw_from_vanishing_dir(torch.zeros(2, 2))
