"""Signs and round trips of the angles."""

import itertools
import math

import cv2
import numpy as np
import pytest
import torch

from lanebev.geometry import rotation
from lanebev.geometry.road import horizon_line, image_from_road_points
from lanebev.types import Extrinsics

ANGLES = [math.radians(a) for a in (-10.0, -1.0, 0.0, 5.0)]


def t(*values):
    return [torch.tensor([v], dtype=torch.float64) for v in values]


def test_convention_pitch_down_raises_the_horizon():
    pitch, yaw, roll, height = t(0.05, 0.0, 0.0, 1.5)
    intrinsics = torch.tensor([[[1000.0, 0, 500], [0, 1000, 300], [0, 0, 1]]], dtype=torch.float64)
    a, b, c = horizon_line(Extrinsics(pitch, yaw, roll, height), intrinsics)[0]
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
    a, b, c = horizon_line(Extrinsics(pitch, yaw, roll, height), intrinsics)[0]
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


POSES = torch.tensor(
    [[0.1, 0.2, -0.3, 1.5], [-0.05, -0.1, 0.02, 2.5], [0.0, 0.0, 0.0, 1.2], [0.3, -1.1, 0.4, 0.8]],
    dtype=torch.float64,
)


def about(axis, angle):
    vector = np.zeros(3)
    vector[axis] = float(angle)
    return cv2.Rodrigues(vector)[0]


def test_convention_camera_from_road_is_roll_then_yaw_then_pitch():
    matrices = Extrinsics.unstack(POSES).camera_from_road()
    for (pitch, yaw, roll, height), matrix in zip(POSES, matrices, strict=True):
        expected = about(0, pitch) @ about(1, yaw) @ about(2, roll)
        np.testing.assert_allclose(matrix[:3, :3].numpy(), expected, atol=1e-12)
        above = matrix @ torch.tensor([0.0, -float(height), 0.0, 1.0]).double()  # where the camera is
        torch.testing.assert_close(above, torch.tensor([0.0, 0.0, 0.0, 1.0]).double())


def test_road_from_camera_is_the_inverse():
    extrinsics = Extrinsics.unstack(POSES)
    product = extrinsics.camera_from_road() @ extrinsics.road_from_camera()
    torch.testing.assert_close(product, torch.eye(4).double().expand(4, 4, 4))


def test_projection_and_rotation_vector_are_those_of_opencv():
    extrinsics = Extrinsics.unstack(POSES)
    intrinsics = torch.tensor([[[800.0, 0.0, 640.0], [0.0, 810.0, 360.0], [0.0, 0.0, 1.0]]]).double()
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(50, 3, generator=generator, dtype=torch.float64) * torch.tensor([8.0, 2.0, 40.0])
    points = points - torch.tensor([4.0, 2.0, -3.0])  # up to 2 m above the road
    rvec, tvec = extrinsics.rvec_tvec()
    homogeneous = torch.cat([points, torch.ones(50, 1)], dim=-1)
    seen = homogeneous @ extrinsics.projection(intrinsics.expand(4, 3, 3)).mT  # (4, 50, 3)
    compared = 0
    for row in range(4):
        pixels, _ = cv2.projectPoints(
            points.numpy(), rvec[row].numpy(), tvec[row].numpy(), intrinsics[0].numpy(), None
        )
        front = seen[row, :, 2] > 0.1
        found = (seen[row, :, :2] / seen[row, :, 2:])[front]
        np.testing.assert_allclose(found.numpy(), pixels[:, 0][front.numpy()], rtol=1e-9, atol=1e-8)
        compared += int(front.sum())
    assert compared > 120


def test_projection_of_the_road_is_that_of_road_points():
    extrinsics = Extrinsics.unstack(POSES)
    intrinsics = torch.tensor([[800.0, 0.0, 640.0], [0.0, 810.0, 360.0], [0.0, 0.0, 1.0]]).double()
    road = torch.tensor([[1.5, 0.0, 12.0, 1.0]]).double()
    seen = road @ extrinsics.projection(intrinsics.expand(4, 3, 3)).mT
    expected, valid = image_from_road_points(
        road[:, [0, 2]].expand(4, 1, 2), intrinsics.expand(4, 3, 3), extrinsics
    )
    found = seen[..., :2] / seen[..., 2:]
    torch.testing.assert_close(found[valid], expected[valid])


def test_rotation_vectors_of_no_rotation_have_a_gradient():
    values = torch.zeros(1, 4, dtype=torch.float64, requires_grad=True)
    rvec, _ = Extrinsics.unstack(values).rvec_tvec()
    jacobian = torch.stack([torch.autograd.grad(part, values, retain_graph=True)[0][0] for part in rvec[0]])
    torch.testing.assert_close(jacobian, torch.eye(3, 4).double())
