"""The motion model of pose, deviations and speed, and how its scale follows the scores."""

import math
from dataclasses import replace

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import MotionConfig
from lanebev.estimation.joint.filter.evidence import adapt_motion_scale
from lanebev.estimation.joint.filter.prediction import predict_state
from lanebev.estimation.joint.measurement.residuals import NUM_SHAPE, ROLL, VERTICAL
from lanebev.estimation.joint.motion.dynamics import RoadMotion, Spread, motion
from lanebev.estimation.joint.motion.low_pass import pose_covariance, pose_transition
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.reasons import Reason
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.geometry.precision import cast_floating
from lanebev.testing.moments import CAMERA, WIDTH, moments
from lanebev.testing.moments import observe as see
from tests.estimation.joint_drives import DOUBLE, PLACE, drive, run

torch.set_num_threads(1)


def no_road(rows: int = 1) -> RoadMotion:
    """A shape that stays."""
    eye = torch.eye(NUM_SHAPE, dtype=DOUBLE).expand(rows, -1, -1)
    none = torch.zeros(rows, NUM_SHAPE, dtype=DOUBLE)
    return RoadMotion(none, none[:, 0], eye, none, none)


def test_pose_process_is_a_butterworth_low_pass():
    """Its spectrum is 1 / (1 + (f / f_c)⁸), and its variance one."""
    covariance = pose_covariance(1.5, torch.zeros((), dtype=DOUBLE))
    frequency = torch.linspace(0.01, 20.0, 20_000, dtype=DOUBLE)
    power = 1 / (1 + (frequency / 1.5) ** 8)
    turn = (2 * math.pi * frequency) ** 2
    for derivative, expected in ((1, turn), (2, turn**2)):
        ratio = float((power * expected).sum() / power.sum())
        assert float(covariance[derivative, derivative]) == pytest.approx(ratio, rel=0.01)
    assert covariance[0, 0] == 1.0


def test_pose_transition_halves_join_and_keeps_the_stationary_covariance():
    dt = torch.tensor([0.02, 0.5, 5.0], dtype=DOUBLE)
    move, noise = pose_transition(dt, 1.0)
    half, half_noise = pose_transition(dt / 2, 1.0)
    torch.testing.assert_close(half @ half, move)
    torch.testing.assert_close(half @ half_noise @ half.mT + half_noise, noise)
    torch.testing.assert_close(move[0, 0, 1], dt[0], rtol=1e-3, atol=0.0)  # constant velocity over a frame
    assert move[2].abs().max() < 1e-3  # and forgotten after seconds
    torch.testing.assert_close(noise[2], pose_covariance(1.0, dt), rtol=1e-3, atol=1e-3)
    none, nothing_new = pose_transition(torch.zeros(1, dtype=DOUBLE), 1.0)
    torch.testing.assert_close(none[0], torch.eye(4, dtype=DOUBLE))
    assert nothing_new.abs().max() < 1e-9


def test_motion_of_each_axis_scales_and_unequal_lanes_forget():
    cfg, dt = MotionConfig(), torch.full((2,), 0.1, dtype=DOUBLE)
    scale = torch.tensor([[1.0] * 4, [1.0, 1.0, 2.0, 1.0]], dtype=DOUBLE)
    unequal = torch.tensor([0.0, 0.12], dtype=DOUBLE)
    vertical = torch.tensor([1e-4, 0.0], dtype=DOUBLE)
    transition, noise = motion(dt, Spread(scale, unequal, vertical), no_road(2), 6, cfg)
    move, density = pose_transition(dt[:1], cfg.bandwidth)
    for row in range(2):
        *chain, mean = PLACE.chain(ROLL)
        torch.testing.assert_close(transition[row][chain][:, chain], move[0])
        variance = (float(scale[row, ROLL]) * cfg.angle_std) ** 2
        torch.testing.assert_close(noise[row][chain][:, chain], variance * density[0])
        # the pose returns to its mean, which moves nothing else
        torch.testing.assert_close(transition[row][chain][:, mean], torch.eye(4).double()[0] - move[0, :, 0])
        assert transition[row, mean, mean] == 1
    settled = math.exp(-0.1 / cfg.unequal_memory)
    own = PLACE.deviations.start
    assert transition[1, own, own] == pytest.approx(settled)
    assert noise[1, own, own] == pytest.approx(0.12**2 * (1 - settled**2) + 0.1 * cfg.deviation_walk**2)
    assert noise[0, own, own] == pytest.approx(0.1 * cfg.deviation_walk**2)
    level = math.exp(-0.1 / cfg.vertical_curvature_memory)
    assert transition[0, VERTICAL, VERTICAL] == pytest.approx(level)
    assert noise[0, VERTICAL, VERTICAL] == pytest.approx(1e-8 * (1 - level**2))  # keeps the variance
    assert noise[1, VERTICAL, VERTICAL] == 0


def test_motion_scale_follows_the_scores_and_decays():
    one = torch.ones(1, 4, dtype=DOUBLE)
    dt, score = torch.full((1,), 1 / 30, dtype=DOUBLE), torch.tensor([[0.0, 1.0, 2.0, -2.0]], dtype=DOUBLE)
    scale = one
    for _ in range(10):
        scale = adapt_motion_scale(scale, score, dt)
    assert scale[0, :2].tolist() == [1.0, 1.0]  # never below one, and unchanged at a mean square of one
    assert scale[0, 2] == scale[0, 3] > 2
    for _ in range(90):
        scale = adapt_motion_scale(scale, torch.ones_like(score), dt)
    assert scale[0, 2] < 2.5


def test_motion_scale_of_roll_stands_still_on_one_lane():
    """There the score of roll is that of the offset."""
    calibrator, intrinsics = JointCalibrator(), CAMERA.expand(1, 3, 3)
    for visible, still in (((2, 3), True), (tuple(range(6)), False)):
        drive = moments(0.5, lambda t, m, only=visible: replace(m, visible=only))
        state, most = calibrator.initial_state(1, dtype=DOUBLE), 1.0
        for k, (moment, segments) in enumerate(see(drive, 1, 1.0, 8, 3, DOUBLE)):
            turned = segments._replace(endpoints=segments.endpoints + 2.0 * (k % 2))
            _, state = calibrator(turned, intrinsics, state, moment.dt, WIDTH)
            most = max(most, float(state.motion_scale[0, ROLL]))
        assert (most == 1.0) == still


def test_minutes_of_nothing_keep_the_covariance_positive_and_bounded():
    calibrator = JointCalibrator()
    state = calibrator.initial_state(1, dtype=DOUBLE)
    unseen = Reason.ROLL_UNSEEN | Reason.HEIGHT_UNSEEN | Reason.DIRECTION_UNSEEN
    state = state._replace(reasons=torch.full_like(state.reasons, int(unseen)))
    for _ in range(300):
        state = predict_state(state, torch.ones(1, dtype=DOUBLE), calibrator.config).state
    cov = state.cov
    size = cov.diagonal(dim1=1, dim2=2).rsqrt()
    assert torch.linalg.eigvalsh(size.unsqueeze(-1) * cov * size.unsqueeze(-2)).min() > 0
    assert cov[0, :3].diagonal().sqrt().max() < 0.3  # the pose stays about its mean


@pytest.mark.slow
def test_straight_road_does_not_tell_the_speed():
    """Noise of the road's curvature stands still in the image; taken for a bend it would stop the car."""
    _, state = run(JointCalibrator(), drive(300, rows=4))
    assert state.mean[:, PLACE.speed].abs().max() < 4.0


def test_speed_wanders_about_its_mean_as_far_as_it_says():
    cfg = MotionConfig()
    time, equal = torch.tensor([1 / 30], dtype=DOUBLE), torch.zeros(1, dtype=DOUBLE)
    one = torch.ones(1, 4, dtype=DOUBLE)
    transition, noise = motion(time, Spread(one, equal, equal), no_road(), 6, cfg)
    fade, more = transition[0, PLACE.speed, PLACE.speed], noise[0, PLACE.speed, PLACE.speed]
    assert float(more / (1 - fade**2)) == pytest.approx(cfg.speed_std**2, rel=0.01)


def moving(rows: int = 3) -> tuple[JointCalibrator, JointState]:
    """A calibrator and a state in which everything is correlated with the speed."""
    calibrator, generator = JointCalibrator(), torch.Generator().manual_seed(0)
    state = calibrator.initial_state(rows, dtype=DOUBLE)
    factor = 0.1 * torch.randn(rows, PLACE.size, PLACE.size, generator=generator, dtype=DOUBLE)
    sensitivity = torch.randn(state.heading_sensitivity.shape, generator=generator, dtype=DOUBLE)
    return calibrator, state._replace(
        cov=state.cov + factor @ factor.mT, heading_sensitivity=sensitivity, phase=state.phase + 1.0
    )


def test_a_given_speed_is_one_more_measurement():
    """Information form of the same update; σ of the speed is 0.5 m/s."""
    calibrator, state = moving()
    after = calibrator.with_speed(state, torch.tensor([3.0, 20.0, 41.0], dtype=DOUBLE))
    row = torch.zeros(PLACE.size, dtype=DOUBLE)
    row[PLACE.speed] = 1.0
    information = torch.linalg.inv(state.cov) + torch.outer(row, row) / 0.5**2
    torch.testing.assert_close(after.cov, torch.linalg.inv(information))
    residual = torch.tensor([-17.0, 0.0, 21.0], dtype=DOUBLE) - state.mean[:, PLACE.speed]
    step = after.cov[:, :, PLACE.speed] * residual.unsqueeze(-1) / 0.5**2
    torch.testing.assert_close(after.mean, state.mean + step)
    assert torch.equal(after.phase, state.phase)
    shift = (
        1e-3 * state.heading_sensitivity[..., 0]
    )  # a boundary's heading moves the mean before, and so after
    moved = calibrator.with_speed(state._replace(mean=state.mean + shift), 20.0)
    found = calibrator.with_speed(state, 20.0)
    torch.testing.assert_close(moved.mean - found.mean, 1e-3 * found.heading_sensitivity[..., 0])


def test_an_unknown_speed_changes_nothing_and_backward_counts_as_standing():
    calibrator, state = moving()
    after = calibrator.with_speed(state, torch.tensor([math.nan, math.inf, -2.0], dtype=DOUBLE))
    standing = calibrator.with_speed(state, 0.0)
    for before, unknown, still in zip(state, after, standing, strict=True):
        assert torch.equal(unknown[:2], before[:2])
        assert torch.equal(unknown[2], still[2])
    single = calibrator.with_speed(cast_floating(state, torch.float32), 5.0)
    assert single.mean.dtype == single.cov.dtype == torch.float32
    with pytest.raises(ValueError, match=r"speed: expected a float or \(3,\), got \(2,\)"):
        calibrator.with_speed(state, torch.ones(2))


def test_the_paper_s_calibrator_estimates_no_speed():
    calibrator = TwoStageCalibrator()
    state = calibrator.initial_state(1)
    assert calibrator.with_speed(state, 5.0) is state
