"""The pose's dependence on the focal length, against calibrations with a wrong one."""

import math

import pytest
import torch

from lanebev import Extrinsics, JointCalibrator, LaneSegments, image_from_road_points
from lanebev.estimation.joint.measurement.observations import observe
from lanebev.estimation.joint.measurement.residuals import boundary_residuals
from lanebev.geometry.focal import focal_covariance, pose_by_log_focal
from lanebev.testing.moments import CAMERA, moments, table1_pose
from lanebev.testing.moments import observe as see
from tools.focal_information import frame_information

INTRINSICS = torch.tensor([[[1000.0, 0, 640], [0, 1000.0, 360], [0, 0, 1]]], dtype=torch.float64)


def pose_of(*values):
    return Extrinsics(*(torch.tensor([value], dtype=torch.float64) for value in values))


def lanes(pose):
    """Exact segments of five boundaries, 3.7 m apart."""
    z = torch.linspace(5.0, 40.0, 20, dtype=torch.float64)
    ends, index = [], []
    for k, place in enumerate((-9.25, -5.55, -1.85, 1.85, 5.55)):
        points = torch.stack([torch.full_like(z, place), z], dim=-1)[None]
        pixels = image_from_road_points(points, INTRINSICS, pose)[0][0]
        ends.append(torch.stack([pixels[:10], pixels[10:]], dim=1))
        index += [k] * 10
    ones = torch.ones(1, 50, dtype=torch.float64)
    return LaneSegments(torch.cat(ends)[None], torch.tensor([index]), ones, 0.3 * ones)


@pytest.mark.parametrize("truth", [(0.05, 0.03, 0.0, 1.5), (-0.04, -0.02, 0.03, 1.3), (0.1, 0.0, -0.05, 2.0)])
def test_derivative_is_what_a_calibration_with_a_longer_focal_length_gives(truth):
    pose, change = pose_of(*truth), 0.01
    segments = lanes(pose)
    found = []
    for factor in (1.0, math.exp(change)):
        wrong = INTRINSICS * INTRINSICS.new_tensor([[factor], [factor], [1.0]])
        wrong[:, :2, 2] = INTRINSICS[:, :2, 2]
        calibrator = JointCalibrator()
        state = calibrator.initial_state(1, dtype=torch.float64)
        for _ in range(10):
            calibration, state = calibrator(segments, wrong, state, 1 / 30, 3.7)
        found.append(calibration.extrinsics.stack()[0])
    expected = (found[1] - found[0]) / change
    torch.testing.assert_close(pose_by_log_focal(pose, INTRINSICS)[0], expected, atol=2e-3, rtol=0.05)


def test_closed_form_at_zero_roll():
    slope = pose_by_log_focal(pose_of(0.05, 0.0, 0.0, 1.5), INTRINSICS)[0]
    assert slope[0].item() == pytest.approx(-math.sin(0.05) * math.cos(0.05), abs=1e-9)
    assert slope[1:3].abs().max() < 1e-9
    level = pose_by_log_focal(pose_of(0.0, 0.0, 0.0, 1.5), INTRINSICS)[0]
    assert level.abs().max() < 1e-12  # the horizon through the principal point stays there


def test_covariance_is_that_of_the_focal_lengths_share():
    pose = pose_of(0.05, 0.03, 0.02, 1.5)
    covariance = focal_covariance(pose, INTRINSICS, 0.1)
    slope = pose_by_log_focal(pose, INTRINSICS)[0]
    torch.testing.assert_close(covariance[0], 0.01 * torch.outer(slope, slope))
    assert not focal_covariance(pose, INTRINSICS, 0.0).any()
    assert torch.equal(
        focal_covariance(pose, INTRINSICS, torch.tensor([0.1], dtype=torch.float64)), covariance
    )
    with pytest.raises(ValueError, match="focal_std: expected a share of the focal length"):
        focal_covariance(pose, INTRINSICS, -0.1)


def test_rows_are_independent():
    poses = torch.tensor([[0.05, 0.03, 0.0, 1.5], [-0.1, 0.0, 0.05, 1.2]], dtype=torch.float64)
    both = pose_by_log_focal(Extrinsics.unstack(poses), INTRINSICS.expand(2, 3, 3))
    alone = pose_by_log_focal(Extrinsics.unstack(poses[1:]), INTRINSICS)
    torch.testing.assert_close(both[1:], alone, rtol=1e-12, atol=1e-15)


def test_straight_lanes_are_another_poses_at_any_focal_length_and_bends_are_not():
    """So no drive along straight lanes tells it; ``tools.focal_information`` prints what bends do."""
    straight, bend = (frame_information(radius) for radius in (math.inf, 300.0))
    assert straight.share < 1e-20
    assert bend.share > 1e-4
    assert 0.03 < bend.std < 0.15  # from one frame, were the road as even as assumed
    assert max(map(abs, bend.biases)) > 0.03  # which it is not


@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_another_pose_explains_straight_lanes_to_rounding(factor):
    """Far beyond the linearisation: the residual vanishes at the pose found with a wrong focal length."""
    segments, places = lanes(pose_of(0.05, 0.03, 0.02, 1.5)), (torch.arange(6).double() - 2.5) * 3.7
    wrong = INTRINSICS * INTRINSICS.new_tensor([[factor], [factor], [1.0]])
    wrong[:, :2, 2] = INTRINSICS[:, :2, 2]
    seen = observe(segments, wrong, 6)
    params = torch.tensor([[0.05 / factor, 0.03 / factor, 0.02, 1.5, 0.0, 0.0, 0.0]], dtype=torch.float64)
    for _ in range(8):
        at = boundary_residuals(params, places[segments.boundary], seen)
        step = torch.linalg.lstsq(at.jacobian[0, :5].mT, at.distance.flatten(1)[0]).solution
        params[:, :5] -= step
    assert (params[0, :2] - torch.tensor([0.05, 0.03])).abs().min() > 0.005
    assert boundary_residuals(params, places[segments.boundary], seen).distance.abs().max() < 1e-9


@pytest.mark.slow
def test_focal_lengths_drawn_from_their_sigma_leave_errors_as_large_as_the_covariance_says():
    rows, generator = 64, torch.Generator().manual_seed(1)
    factor = (0.1 * torch.randn(rows, generator=generator, dtype=torch.float64)).exp()
    assumed = CAMERA.repeat(rows, 1, 1)
    assumed[:, 0, 0] *= factor
    assumed[:, 1, 1] *= factor
    calibrator = JointCalibrator()
    state = calibrator.initial_state(rows, dtype=torch.float64)
    mount = (math.radians(3), math.radians(-2), math.radians(1), 0.0)
    drive = moments(0.3, motion=lambda t: tuple(map(sum, zip(table1_pose(t), mount, strict=True))))
    for moment, segments in see(drive, rows, 1.0, 8, 0, torch.float64):
        calibration, state = calibrator(segments, assumed, state, moment.dt, 3.7)
    error = calibration.extrinsics.stack() - torch.tensor(moment.pose, dtype=torch.float64)

    def nees(covariance):
        return float((error * torch.linalg.solve(covariance, error)).sum(-1).mean()) / 4

    assert nees(calibration.covariance) > 20
    by_focal = focal_covariance(calibration.extrinsics, assumed, 0.1)
    assert 0.6 < nees(calibration.covariance + by_focal) < 1.4
