"""TwoStageCalibrator over time: gaps, strange time steps, loss and recovery."""

import math

import pytest
import torch

from lanebev import LaneSegments, Status, TwoStageCalibrator
from lanebev.estimation.reasons import Reason
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import POSE, lanes, no_lanes
from tests.estimation.calibrated import drive, finite


def test_life_cycle_track_coast_lost_and_back():
    calibrator = TwoStageCalibrator(lost_after=0.5)
    frames = [no_lanes()] * 2 + [lanes(seed=s) for s in range(10)] + [no_lanes()] * 30
    outputs, state = drive(calibrator, frames)
    statuses = [int(o.status[0]) for o in outputs]
    assert statuses[:2] == [Status.UNINITIALISED] * 2
    assert statuses[2:12] == [Status.TRACKING] * 10
    assert statuses[12:26] == [Status.COASTING] * 14
    assert statuses[-1] == Status.LOST
    sigmas = torch.stack([o.covariance[0].diagonal() for o in outputs[12:26]])
    assert (sigmas.diff(dim=0)[:, :2] > 0).all()
    elsewhere = (-0.06, 0.05, -0.03, 1.7)  # found again without help, wherever the camera is now
    out, state = calibrator(lanes(elsewhere), K[None], state, 1 / 30)
    assert out.status.tolist() == [Status.TRACKING]
    assert out.extrinsics.stack()[0].tolist() == pytest.approx(elsewhere, abs=0.02)


def test_a_jump_is_reacquired():
    calibrator = TwoStageCalibrator()
    before, after = (0.0, 0.0, 0.0, 1.5), (0.12, -0.1, 0.0, 1.5)
    frames = [lanes(before, seed=s) for s in range(5)] + [lanes(after, seed=s) for s in range(15)]
    outputs, _ = drive(calibrator, frames)
    assert outputs[-1].status.tolist() == [Status.TRACKING]
    assert outputs[-1].extrinsics.stack()[0].tolist() == pytest.approx(after, abs=0.01)


@pytest.mark.slow
def test_garbage_never_runs_away_and_is_recovered_from():
    generator = torch.Generator().manual_seed(3)
    shape = lanes().weight.shape[1]
    garbage = [
        LaneSegments(
            torch.rand(8, shape, 2, 2, generator=generator, dtype=torch.float64) * 700 + 10,
            torch.randint(0, 6, (8, shape), generator=generator),
            torch.ones(8, shape, dtype=torch.float64),
            torch.ones(8, shape, dtype=torch.float64),
        )
        for _ in range(60)
    ]
    clean = LaneSegments(*(part.expand(8, *part.shape[1:]) for part in lanes()))
    results, _ = drive(TwoStageCalibrator(), [clean, *garbage, *[clean] * 40])
    poses = torch.stack([calibration.extrinsics.stack() for calibration in results])
    assert poses.isfinite().all()
    assert poses[..., 2].abs().max() < 0.8
    assert (poses[..., 3] > 0.1).all()
    torch.testing.assert_close(poses[-1], poses[0], atol=0.05, rtol=0.0)


@pytest.mark.parametrize("dt", [0.0, -1.0, 30.0, float("nan"), float("inf")])
def test_strange_time_steps_are_survived(dt):
    calibrator = TwoStageCalibrator()
    _, state = drive(calibrator, [lanes(seed=s) for s in range(3)])
    out, _ = calibrator(lanes(seed=9), K[None], state, dt)
    assert finite(out)
    assert out.extrinsics.stack()[0].tolist() == pytest.approx(POSE, abs=0.01)


@pytest.mark.parametrize("dt", [0.0, -0.05])
def test_a_frame_given_again_says_nothing_new(dt):
    calibrator = TwoStageCalibrator()
    outputs, state = drive(calibrator, [lanes(seed=s) for s in range(3)])
    out, after = calibrator(lanes(seed=2), K[None], state, dt)
    assert after.reasons.tolist() == [Reason.TIME]
    assert all(map(torch.equal, after[:-1], state[:-1]))
    assert torch.equal(out.covariance, outputs[-1].covariance)
    assert out.status.tolist() == [Status.COASTING]  # nothing of it was used
    assert out.inliers.sum() == 0


@pytest.mark.parametrize("dt", [float("nan"), float("inf"), -float("inf")])
def test_a_time_that_is_not_known_is_guessed(dt):
    calibrator = TwoStageCalibrator()
    _, state = drive(calibrator, [lanes(seed=s) for s in range(3)])
    guessed, _ = calibrator(lanes(seed=9), K[None], state, dt)
    given, _ = calibrator(lanes(seed=9), K[None], state, 1 / 30)
    assert torch.equal(guessed.covariance, given.covariance)


def test_in_a_gap_the_pose_goes_on_for_a_fifth_of_a_second_and_then_holds_still():
    calibrator = TwoStageCalibrator()
    turning = [lanes((0.03 + 0.002 * i, -0.02, 0.015, 1.45), seed=i) for i in range(20)]
    outputs, state = drive(calibrator, turning)
    pitches = [outputs[-1].extrinsics.pitch[0]]
    for _ in range(15):
        out, state = calibrator(no_lanes(), K[None], state, 1 / 30)
        pitches.append(out.extrinsics.pitch[0])
    steps = torch.stack(pitches).diff()
    assert (steps[:5] > 0.001).all()
    assert steps[7:].abs().max() < 1e-12


@pytest.mark.parametrize("dt", [0.5, 0.9, 1.2])
def test_across_one_long_interval_roll_and_height_hold_still(dt):
    """Their rates times a second would lead to where the widths are another pose's."""
    calibrator = TwoStageCalibrator()
    turning = [lanes((0.03, -0.02, 0.015 + 0.003 * i, 1.45 + 0.01 * i), seed=i) for i in range(12)]
    _, state = drive(calibrator, turning)
    out, _ = calibrator(lanes((0.03, -0.02, 0.048, 1.56), seed=12), K[None], state, dt)
    assert int(out.status[0]) == Status.TRACKING
    assert abs(float(out.extrinsics.roll[0]) - 0.048) < math.radians(0.15)
    assert abs(float(out.extrinsics.height[0]) - 1.56) < 0.01


def test_a_wide_prediction_searches_instead_of_gating():
    """Too wide to tell right segments from wrong ones, though the gap is a short one."""
    calibrator = TwoStageCalibrator(angular_acceleration_density=4.0)
    _, state = drive(calibrator, [lanes(seed=s) for s in range(5)])
    wild = lanes(seed=8)
    aside = 40 * torch.randn(wild.endpoints.shape, generator=torch.Generator().manual_seed(0)).double()
    wild = wild._replace(endpoints=wild.endpoints + aside)
    both = LaneSegments(*(torch.cat(parts, 1) for parts in zip(lanes(seed=7), wild, strict=True)))
    out, _ = calibrator(both, K[None], state, 0.19)
    assert out.inliers[0, :48].mean() > 0.9
    assert out.inliers[0, 48:].mean() < 0.3
