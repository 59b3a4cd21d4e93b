"""A detector whose errors exceed its sigmas: the image says less, what was known before does not."""

import math

import pytest
import torch

from lanebev import JointCalibrator, Status, TwoStageCalibrator
from lanebev.estimation.joint.frame_prior import FramePrior, prior_of_mount, temper_frame
from lanebev.estimation.still import calibrate_still
from lanebev.testing.segments import INTRINSICS, lanes, no_lanes, stack_rows

DOUBLE = torch.float64
GAUSSIAN = FramePrior(pitch=0.02, yaw=0.01, roll=-0.01, height=1.4, freedom=1e9)


def posterior(measured, noise):
    """Product of the prior ``GAUSSIAN`` and a measurement (4,) with covariance ``noise``."""
    mean = GAUSSIAN.mean(measured)[:4]
    known, told = GAUSSIAN.std(measured)[:4].square().reciprocal().diag(), torch.linalg.inv(noise)
    covariance = torch.linalg.inv(known + told)
    return (covariance @ (known @ mean + told @ measured))[None], covariance[None]


def test_a_tempered_frame_is_one_with_more_noise():
    generator = torch.Generator().manual_seed(1)
    root = torch.randn(4, 4, generator=generator, dtype=DOUBLE) * 0.05
    noise = root @ root.T + 1e-3 * torch.eye(4, dtype=DOUBLE)
    measured = torch.tensor([0.1, -0.1, 0.06, 1.8], dtype=DOUBLE)
    found = temper_frame(*posterior(measured, noise), GAUSSIAN, 1.6)
    expected = posterior(measured, 1.6**2 * noise)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)


def test_a_factor_of_one_changes_nothing_and_a_large_one_leaves_the_prior():
    given = posterior(torch.tensor([0.1, -0.1, 0.06, 1.8], dtype=DOUBLE), 1e-4 * torch.eye(4, dtype=DOUBLE))
    torch.testing.assert_close(temper_frame(*given, GAUSSIAN, 1.0), given, rtol=1e-9, atol=1e-12)
    pose, covariance = temper_frame(*given, GAUSSIAN, 1e6)
    torch.testing.assert_close(pose[0], GAUSSIAN.mean(pose)[:4], rtol=0, atol=1e-5)
    torch.testing.assert_close(covariance[0].diagonal().sqrt(), GAUSSIAN.std(pose)[:4], rtol=1e-4, atol=0)


def test_a_prior_that_is_contradicted_does_not_pull():
    """Student's t: at 40 standard deviations its weight is 1 / 400."""
    far = posterior(torch.tensor([0.02, 0.01, 2.0, 1.4], dtype=DOUBLE), 1e-4 * torch.eye(4, dtype=DOUBLE))
    heavy = FramePrior(pitch=0.02, yaw=0.01, roll=-0.01, height=1.4)
    pose, _ = temper_frame(*far, heavy, 2.0)
    assert float(pose[0, 2]) == pytest.approx(float(far[0][0, 2]), rel=1e-2)
    assert float(temper_frame(*far, GAUSSIAN, 2.0)[0][0, 2]) < 0.9 * float(far[0][0, 2])


def test_scaled_stills_keep_to_their_mount_and_rows_that_have_not_begun():
    mount = prior_of_mount((0.03, 0.0, 0.01, 1.5), (0.001, math.inf, 0.001, 0.01))
    calibrator = JointCalibrator(prior=mount)
    rows = stack_rows(lanes(boundaries=(1, 2, 3)), no_lanes(), lanes(seed=2))
    found = calibrate_still(calibrator, rows, INTRINSICS.expand(3, 3, 3), 3.7)
    scaled = calibrator.scale_still(found, 1.6)
    assert found.status.tolist() == [Status.TRACKING, Status.UNINITIALISED, Status.TRACKING]
    assert torch.equal(scaled.extrinsics.stack()[1], found.extrinsics.stack()[1])
    assert torch.equal(scaled.covariance[1], found.covariance[1])
    sigmas = scaled.covariance.diagonal(dim1=1, dim2=2).sqrt()
    before = found.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert (sigmas[[0, 2], 2] < 1.01 * mount.roll_std).all()
    assert (sigmas[[0, 2]] > before[[0, 2]]).all()
    apart = (pose.extrinsics.roll[0] - mount.roll for pose in (scaled, found))
    assert abs(next(apart)) < abs(next(apart))


def test_what_has_no_prior_is_scaled_as_a_whole():
    calibrator = TwoStageCalibrator()
    found = calibrate_still(calibrator, lanes(), INTRINSICS[None], 3.7)
    torch.testing.assert_close(calibrator.scale_still(found, 2.0).covariance, 4.0 * found.covariance)


def test_the_pose_about_a_mount_is_nearly_gaussian():
    known = prior_of_mount((0.0, 0.0, 0.0, 1.5), (0.001, 0.001, 0.001, 0.01))
    assert known.freedom > 10 > FramePrior().freedom
    assert prior_of_mount((0.0,) * 4, (math.inf,) * 4) == FramePrior()
