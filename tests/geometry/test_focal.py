"""The pose's dependence on the focal length, against calibrations with a wrong one."""

import math

import pytest
import torch

from lanebev import Calibration, Extrinsics, JointCalibrator, LaneSegments, Status, image_from_road_points
from lanebev.geometry.focal import pose_by_log_focal, with_focal_std

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


def test_covariance_grows_by_the_focal_lengths_share():
    pose = pose_of(0.05, 0.03, 0.02, 1.5)
    covariance = torch.diag(torch.tensor([1e-6, 1e-6, 1e-6, 1e-4], dtype=torch.float64))[None]
    status, inliers = torch.tensor([int(Status.TRACKING)]), torch.ones(1, 1)
    before = Calibration(pose, covariance, status, inliers)
    after = with_focal_std(before, INTRINSICS, 0.1)
    slope = pose_by_log_focal(pose, INTRINSICS)[0]
    torch.testing.assert_close(after.covariance[0], covariance[0] + 0.01 * torch.outer(slope, slope))
    assert torch.equal(with_focal_std(before, INTRINSICS, 0.0).covariance, covariance)
    rows = with_focal_std(before, INTRINSICS, torch.tensor([0.1], dtype=torch.float64))
    assert torch.equal(rows.covariance, after.covariance)
    with pytest.raises(ValueError, match="focal_std: expected a share of the focal length"):
        with_focal_std(before, INTRINSICS, -0.1)


def test_rows_are_independent():
    poses = torch.tensor([[0.05, 0.03, 0.0, 1.5], [-0.1, 0.0, 0.05, 1.2]], dtype=torch.float64)
    both = pose_by_log_focal(Extrinsics.unstack(poses), INTRINSICS.expand(2, 3, 3))
    alone = pose_by_log_focal(Extrinsics.unstack(poses[1:]), INTRINSICS)
    torch.testing.assert_close(both[1:], alone, rtol=1e-12, atol=1e-15)
