"""The joint calibrator: interface, life cycle, gradients, rows, precision, export."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch

from lanebev import batch
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.dynamics import MotionConfig, RoadMotion, motion
from lanebev.estimation.joint.evidence import CALL, adapt_motion_scale, deviation_prior_std
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.joint.lane_change import renumber
from lanebev.estimation.joint.layout import NUM_COMMON, NUM_POSE, SHAPE, STEPS, layout
from lanebev.estimation.joint.low_pass import pose_covariance, pose_transition
from lanebev.estimation.joint.measurement import (
    CURVATURE,
    HEIGHT,
    NUM_SHAPE,
    OFFSET,
    ROLL,
    VERTICAL,
    boundary_distances,
    boundary_residuals,
    foot_points,
    look,
)
from lanebev.estimation.joint.observations import boundary_places, observe
from lanebev.estimation.joint.output import beyond_filter, single_deviation, unverified_deviation
from lanebev.estimation.joint.prediction import predict_state
from lanebev.estimation.joint.restart import scatter_of_fit
from lanebev.estimation.joint.road import propagate_road_shape, turn_along
from lanebev.estimation.joint.road_curve import (
    KNOT_SPACING,
    NUM_STEPS,
    curve_by_shape,
    road_curve,
    road_shape,
)
from lanebev.estimation.joint.scatter import remembered_sensitivity
from lanebev.estimation.joint.single_frame import fit_observations
from lanebev.estimation.joint.start import state_from_fit, straight_or_bend
from lanebev.estimation.joint.update import (
    frame_information,
    kalman_gain,
    membership,
    observed_step,
    posterior_covariance,
)
from lanebev.estimation.reasons import Reason
from lanebev.observation.segments import LaneSegments
from lanebev.testing.moments import CAMERA, FPS, PLACES, WIDTH, moments
from lanebev.testing.moments import observe as see
from lanebev.types import Status

torch.set_num_threads(1)
DOUBLE = torch.float64
PLACE = layout(6)
OBLIQUE = CAMERA * torch.tensor([[1.1], [0.9], [1.0]]).double()  # pixels that are neither square nor upright
OBLIQUE[0, 1] = 30.0


def drive(frames: int, rows: int = 2, per_boundary: int = 8, sigma: float = 1.0, seed: int = 0):
    return list(see(moments(frames / FPS), rows, sigma, per_boundary, seed, DOUBLE))


def cameras(rows: int):
    return CAMERA.expand(rows, 3, 3)


def run(calibrator, frames, state=None, dt=1 / FPS):
    rows = frames[0][1].boundary.shape[0]
    state = calibrator.initial_state(rows, dtype=DOUBLE) if state is None else state
    for _, segments in frames:
        out, state = calibrator(segments, cameras(rows), state, dt, WIDTH)
    return out, state


def nothing(segments: LaneSegments) -> LaneSegments:
    return segments._replace(weight=torch.zeros_like(segments.weight))


def test_first_frame_is_enough_and_the_interface_is_that_of_all_calibrators():
    frames = drive(1, rows=3)
    calibrator = JointCalibrator()
    before = calibrator.initial_state(3, dtype=DOUBLE)
    assert (before.status == Status.UNINITIALISED).all()
    out, state = run(calibrator, frames)
    truth = torch.tensor(frames[0][0].pose, dtype=DOUBLE)
    assert (out.status == Status.TRACKING).all()
    assert (state.reasons & Reason.RESTARTED).all()
    assert out.covariance.shape == (3, 4, 4)
    assert out.inliers.shape == frames[0][1].boundary.shape
    assert (out.extrinsics.stack() - truth).abs().max() < 0.02


def test_doubt_about_lanes_outlasts_frames_that_show_nothing():
    """A boundary 0.1 m out of place puts height in doubt, and an empty or skipped frame leaves it there."""
    places = PLACES + 0.1 * (torch.arange(6) == 5)
    frames = list(see(moments(0.8, lambda t, m: replace(m, places=places)), 2, 1.0, 30, 0, DOUBLE))
    calibrator = JointCalibrator()
    before, state = run(calibrator, frames)
    assert (before.covariance[:, 3, 3].sqrt() > 0.005).all()
    again, _ = run(calibrator, frames[-1:], state, dt=0.0)
    assert torch.equal(again.covariance, before.covariance)
    empty = [(frames[-1][0], nothing(frames[-1][1]))]
    after, _ = run(calibrator, empty, state)
    variances = (out.covariance.diagonal(dim1=1, dim2=2) for out in (after, before))
    assert torch.div(*variances).min() > 0.99


def test_a_start_on_one_lane_says_that_roll_is_unseen():
    frames = drive(1, per_boundary=30)
    _, segments = frames[0]
    middle = segments._replace(weight=segments.weight * ((segments.boundary == 2) | (segments.boundary == 3)))
    out, state = run(JointCalibrator(), [(frames[0][0], middle)])
    assert (state.reasons & Reason.RESTARTED).all()
    assert (state.reasons & Reason.ROLL_UNSEEN).all()
    assert not (state.reasons & Reason.HEIGHT_UNSEEN).any()
    whole, state = run(JointCalibrator(), frames)
    assert not (state.reasons & Reason.ROLL_UNSEEN).any()
    assert (out.covariance[:, 2, 2] > 10 * whole.covariance[:, 2, 2]).all()


def test_a_sharp_line_beside_a_vague_one_is_no_outlier():
    """The prediction errs by more than the sharp line's sigma: that casts no doubt on the line."""
    frames = drive(90, sigma=0.1)[::3]
    calibrator = JointCalibrator()
    state = calibrator.initial_state(2, dtype=DOUBLE)
    for _, segments in frames:
        sharp, vague = segments.boundary == 2, segments.boundary == 3
        segments = segments._replace(
            weight=segments.weight * (sharp | vague), sigma=torch.where(vague, 5.0, segments.sigma)
        )
        out, state = calibrator(segments, cameras(2), state, 3 / FPS, WIDTH)
        assert (out.inliers[sharp & (segments.weight > 0)] > 0.5).all()
    truth = torch.tensor(frames[-1][0].pose, dtype=DOUBLE)
    assert (out.extrinsics.stack() - truth)[:, :2].abs().max() < math.radians(0.1)


def test_inliers_lie_where_the_pose_has_them():
    """Sharp segments of one boundary that contradict each other are no inliers for the rest being vague."""
    frames = drive(30, sigma=0.1)[::3]
    calibrator = JointCalibrator()
    state = calibrator.initial_state(2, dtype=DOUBLE)
    for _, segments in frames:
        own = (segments.boundary == 3) & (segments.weight > 0)
        sharp = own & (own.cumsum(-1) <= 4)
        side = 2.0 * (own.cumsum(-1) % 2) - 1.0
        aside = torch.where(sharp, 3.0 * side, 0.0)  # px
        ends = segments.endpoints + torch.stack([aside, torch.zeros_like(aside)], -1).unsqueeze(-2)
        sigma = torch.where(sharp, 0.1, 5.0).to(segments.sigma)
        out, state = calibrator(
            segments._replace(endpoints=ends, sigma=sigma), cameras(2), state, 3 / FPS, WIDTH
        )
        assert (out.status == Status.TRACKING).all()
        assert (out.inliers[~sharp & (segments.weight > 0)] > 0.5).all()
        assert ((out.inliers > 0.5) & sharp).sum(-1).max() <= 2


def test_life_cycle_with_reasons():
    calibrator = JointCalibrator(lost_after=1.0)
    frames = drive(56)
    _, state = run(calibrator, frames[:10])
    empty = nothing(frames[0][1])
    out, state = calibrator(empty, cameras(2), state, 1 / FPS, WIDTH)
    assert (out.status == Status.COASTING).all()
    assert (state.reasons & Reason.NO_SEGMENTS).all()
    early = out.covariance[0].diagonal()
    for _ in range(8):
        out, state = calibrator(empty, cameras(2), state, 0.15, WIDTH)
    assert (out.status == Status.LOST).all()
    assert (out.covariance[0].diagonal() > early).all()
    out, state = run(calibrator, frames[51:52], state)
    assert (out.status == Status.TRACKING).all()
    assert (state.reasons & Reason.RESTARTED).all()
    out, state = run(calibrator, frames[52:56], state)
    truth = torch.tensor(frames[55][0].pose, dtype=DOUBLE)
    error = out.extrinsics.stack() - truth
    assert (error.abs() < 5 * out.covariance.diagonal(dim1=1, dim2=2).sqrt()).all()


def test_one_lane_and_one_boundary_say_what_is_unseen():
    calibrator = JointCalibrator()
    frames = drive(12)
    _, state = run(calibrator, frames[:10])
    for boundaries, reasons in (
        ((2, 3), Reason.ROLL_UNSEEN),
        ((2,), Reason.ROLL_UNSEEN | Reason.HEIGHT_UNSEEN | Reason.DIRECTION_UNSEEN),
    ):
        segments = frames[10][1]
        there = torch.zeros_like(segments.weight)
        for boundary in boundaries:
            there = there + (segments.boundary == boundary)
        _, after = calibrator(segments._replace(weight=there), cameras(2), state, 1 / FPS, WIDTH)
        assert (after.reasons & reasons == reasons).all()


@pytest.mark.parametrize("dt", [0.0, -0.01])
def test_duplicate_and_late_frames_change_nothing_and_keep_their_time(dt):
    calibrator = JointCalibrator()
    frames = drive(12)
    before, state = run(calibrator, frames[:10])
    out, skipped = calibrator(frames[3][1], cameras(2), state, dt, WIDTH)
    assert torch.equal(out.extrinsics.stack(), before.extrinsics.stack())
    assert (skipped.reasons & Reason.TIME).all()
    assert (out.status == Status.COASTING).all()  # nothing of the frame was used
    assert out.inliers.sum() == 0
    torch.testing.assert_close(skipped.early, torch.full((2,), -dt, dtype=DOUBLE))
    direct, _ = calibrator(frames[10][1], cameras(2), state, 1 / FPS, WIDTH)
    after, state = calibrator(frames[10][1], cameras(2), skipped, 1 / FPS - dt, WIDTH)
    torch.testing.assert_close(after.extrinsics.stack(), direct.extrinsics.stack())
    assert (state.early == 0).all()


def test_time_that_is_not_known_is_guessed():
    calibrator = JointCalibrator()
    frames = drive(11)
    _, state = run(calibrator, frames[:10])
    expected, _ = calibrator(frames[10][1], cameras(2), state, 1 / 30, WIDTH)
    for dt in (math.nan, math.inf, -1e9):
        found, after = calibrator(frames[10][1], cameras(2), state, dt, WIDTH)
        torch.testing.assert_close(found.extrinsics.stack(), expected.extrinsics.stack())
        assert (after.reasons & Reason.TIME).all()


def test_row_alone_equals_row_in_batch_beside_degenerate_rows():
    frames = drive(8, rows=3)
    calibrator = JointCalibrator()
    state, alone = calibrator.initial_state(3, dtype=DOUBLE), calibrator.initial_state(1, dtype=DOUBLE)
    for _, segments in frames:
        ends = segments.endpoints.clone()
        ends[0] = math.nan
        weight = segments.weight.clone()
        weight[1] = 0
        mixed = segments._replace(endpoints=ends, weight=weight)
        out, state = calibrator(mixed, cameras(3), state, 1 / FPS, WIDTH)
        single = LaneSegments(*(part[2:] for part in mixed))
        one, alone = calibrator(single, cameras(1), alone, 1 / FPS, WIDTH)
    torch.testing.assert_close(one.extrinsics.stack()[0], out.extrinsics.stack()[2], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(one.covariance[0], out.covariance[2], rtol=1e-7, atol=1e-15)
    assert all(part.isfinite().all() for part in (*out.extrinsics, out.covariance))
    assert (out.status[:2] == Status.UNINITIALISED).all()


def test_a_batch_in_blocks_equals_one_at_once(monkeypatch):
    frames = drive(6, rows=5)
    expected, state = run(JointCalibrator(), frames)
    monkeypatch.setattr(batch, "_BLOCK", 20_000)  # two rows
    found, after = run(JointCalibrator(), frames)
    torch.testing.assert_close(found.extrinsics.stack(), expected.extrinsics.stack(), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(found.inliers, expected.inliers, rtol=1e-6, atol=1e-9)
    for part, other in zip(after, state, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-6, atol=1e-9)


def test_order_of_segments_and_of_end_points_does_not_matter():
    frames = drive(5)
    mixed = []
    for moment, segments in frames:
        order = torch.randperm(segments.boundary.shape[1], generator=torch.Generator().manual_seed(1))
        swapped = LaneSegments(*(part[:, order] for part in segments))
        mixed.append((moment, swapped._replace(endpoints=swapped.endpoints.flip(2))))
    one, _ = run(JointCalibrator(), frames)
    other, _ = run(JointCalibrator(), mixed)
    torch.testing.assert_close(one.extrinsics.stack(), other.extrinsics.stack(), rtol=1e-8, atol=1e-9)


def test_spline_jacobian_equals_jacfwd():
    generator = torch.Generator().manual_seed(0)
    moment, segments = drive(1, sigma=0.3)[0]
    other = OBLIQUE @ CAMERA.inverse()
    ends = segments.endpoints @ other[:2, :2].mT + other[:2, 2]
    seen = observe(segments._replace(endpoints=ends), OBLIQUE.expand(2, 3, 3), 6)
    places = boundary_places(WIDTH, 6, seen.sigma).gather(1, seen.boundary)
    params = torch.zeros(2, NUM_COMMON, dtype=DOUBLE)
    params[:, :5] = torch.tensor([*moment.pose, moment.offset], dtype=DOUBLE)
    params[:, SHAPE] = 1e-5 * torch.randn(2, NUM_SHAPE, generator=generator, dtype=DOUBLE)
    params[:, VERTICAL] = torch.tensor([1e-4, -3e-4], dtype=DOUBLE)  # over a crest and through a dip
    phase = torch.tensor([0.0, 7.3], dtype=DOUBLE)
    found = boundary_residuals(params, places, seen, phase)
    full = torch.func.jacfwd(lambda p: boundary_residuals(p, places, seen, phase).distance)(params)
    expected = torch.stack([full[row, :, :, row] for row in range(2)]).flatten(1, 2)
    # taken at the foot point, some tenths of a pixel away, where it is the total derivative
    near = found.valid.repeat(1, 2) & (found.distance.flatten(1).abs() < 1.0)
    gap = (found.jacobian.mT - expected) / expected.abs().amax(1, keepdim=True)
    assert near.sum() > 100
    assert gap[near].abs().max() < 0.01


def test_road_comes_nearer_by_the_way_that_was_driven():
    """A clothoid seen ahead is the same clothoid after 23 m, of which the knots passed two."""
    rate = 4e-5
    mean = torch.zeros(1, PLACE.size, dtype=DOUBLE)
    mean[:, SHAPE.start] = 1e-3
    mean[:, STEPS] = rate * KNOT_SPACING
    cov = torch.eye(NUM_SHAPE, dtype=DOUBLE)[None] * 1e-10
    cfg = MotionConfig(speed=20.0)
    none = torch.zeros(1, dtype=DOUBLE)
    after = propagate_road_shape(mean, cov, none, torch.tensor([1.15], dtype=DOUBLE), PLACE, cfg)
    assert after.phase.item() == pytest.approx(3.0)
    turned = turn_along(mean[:, SHAPE], none, torch.tensor([23.0], dtype=DOUBLE))[0]
    torch.testing.assert_close(turned, mean[0, SHAPE], rtol=0.02, atol=0.0)  # R > 300 m: a slight turn
    assert after.shape[0, 0].item() == pytest.approx(turned[:3].sum().item())
    steps = torch.cat([turned[3:], turned.new_zeros(2)])
    torch.testing.assert_close(after.shape[0, 1:], steps)
    # an unknown speed is an unknown curvature on a clothoid: by 1 m/s · 1.15 s · rate
    assert after.by_speed[0, 0].item() == pytest.approx(1.15 * rate, rel=0.01)
    torch.testing.assert_close(after.transition[0] @ mean[0, SHAPE], after.shape[0], rtol=0.02, atol=1e-6)


@pytest.mark.parametrize("phase", [0.0, 6.0])
def test_the_curve_is_the_sum_of_its_basis_and_the_integral_of_its_curvature(phase):
    generator = torch.Generator().manual_seed(0)
    shape = 1e-3 * torch.randn(2, NUM_SHAPE, generator=generator, dtype=DOUBLE)
    z = torch.linspace(0.0, 90.0, 9001, dtype=DOUBLE).expand(2, -1)
    behind = torch.full((2,), phase, dtype=DOUBLE)
    road = road_shape(shape, behind)
    curve = road_curve(z, road)
    tilt = torch.linspace(-3.0, 3.0, 9001, dtype=DOUBLE).expand(2, -1)
    rows = torch.cat(curve_by_shape(z, 2 + tilt, tilt, road), dim=1)
    total = (shape.unsqueeze(1) @ rows).squeeze(1)
    torch.testing.assert_close(total, (2 + tilt) * curve.bend + tilt * curve.heading)
    heading = torch.cumulative_trapezoid(curve.curvature, dx=0.01)
    torch.testing.assert_close(curve.heading[:, 1:], heading, rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(
        curve.bend[:, 1:], torch.cumulative_trapezoid(curve.heading, dx=0.01), rtol=1e-4, atol=1e-6
    )
    assert (curve.heading[:, 0].abs() < 1e-15).all()


@pytest.mark.parametrize("phase", [0.0, 6.0])
def test_the_frame_turns_along_an_arc_and_its_shape_stays(phase):
    """On an arc the road ahead looks the same everywhere: b'' = κ (1 - κ² Z²)^(-3/2)."""
    curvature, way = 1 / 60, 3.0

    def bend(behind):
        z = KNOT_SPACING * torch.arange(NUM_STEPS + 1, dtype=DOUBLE) - behind
        return curvature * (1 - (curvature * z.clamp(max=36)).square()) ** -1.5

    before = bend(phase)
    shape = torch.cat([before[:1], before.diff()])[None]
    turned = turn_along(shape, *torch.tensor([[phase], [way]], dtype=DOUBLE))[0].cumsum(0)
    near = slice(1, 4)  # knots at 10 to 30 m
    missed = (turned - bend(phase + way))[near].abs().amax()
    assert missed < 0.25 * (before - bend(phase + way))[near].abs().amax()


def test_turning_along_at_once_is_turning_along_in_steps():
    """And a way beyond all knots leaves each with what it has where it is passed."""
    shape = torch.tensor([[1 / 60, 1e-3, 3e-3, -2e-3, 0.0, 0.0]], dtype=DOUBLE)
    none = torch.zeros(1, dtype=DOUBLE)
    at_once = turn_along(shape, none, none + 8.0)
    assert (at_once - shape).abs().max() > 1e-3
    by_steps = shape
    for _ in range(16):  # the knots stay where they are, so they turn about the camera alone
        by_steps = turn_along(by_steps, none, none + 0.5)
    torch.testing.assert_close(by_steps.cumsum(-1), at_once.cumsum(-1), rtol=0.05, atol=0.0)
    far, farther = (turn_along(shape, none, none + way) for way in (50.0, 5000.0))
    torch.testing.assert_close(far, farther)
    assert (turn_along(torch.zeros_like(shape), none, none + 8.0) == 0).all()


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
    transition, noise = motion(dt, scale, unequal, vertical, no_road(2), PLACE, cfg)
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
    cfg, one = JointConfig(), torch.ones(1, 4, dtype=DOUBLE)
    dt, score = torch.full((1,), 1 / 30, dtype=DOUBLE), torch.tensor([[0.0, 1.0, 2.0, -2.0]], dtype=DOUBLE)
    scale = one
    for _ in range(10):
        scale = adapt_motion_scale(scale, score, dt, cfg)
    assert scale[0, :2].tolist() == [1.0, 1.0]  # never below one, and unchanged at a mean square of one
    assert scale[0, 2] == scale[0, 3] > 2
    for _ in range(90):
        scale = adapt_motion_scale(scale, torch.ones_like(score), dt, cfg)
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


def test_prior_of_unequal_lanes_makes_roll_honest():
    """Places fitted by offset, height and roll (1, x, x²): what is left gives the prior of the error."""
    places = (torch.arange(6, dtype=DOUBLE) - 2.5) * 3.7
    by_pose = torch.stack([torch.ones_like(places), places, places.square()], dim=-1)
    out = 0.04 * torch.randn(20_000, 6, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    error = out @ torch.linalg.pinv(by_pose).mT
    left = out - error @ by_pose.mT
    size = deviation_prior_std(left, JointConfig())
    spread = torch.linalg.inv(by_pose.mT @ by_pose)[2, 2].sqrt() * size
    opened = size > 0.02  # m; below, lanes count as nearly equal
    chi2 = (error[opened, 2] / spread[opened]).square()
    assert opened.double().mean() > 0.8
    assert 0.6 < chi2.mean() < 1.3
    assert (chi2 < 9).double().mean() > 0.97


def test_one_boundary_out_of_place_counts_until_the_filter_holds_unequal_lanes():
    """Half of six deviations are seen, so that those of unequal lanes keep half of their variance."""
    cfg = JointConfig()
    size = cfg.open_deviation
    out = torch.tensor([[-0.4, 0.0, 0.0, 0.013, 0.0, 0.0]] * 3 + [[0.011] + [0.0] * 5], dtype=DOUBLE)
    held = torch.tensor([0.0, 0.5 * size**2 / 6, 0.5 * size**2, 0.0], dtype=DOUBLE)
    single = single_deviation(out, cfg).unsqueeze(-1)
    found = beyond_filter(single, held.unsqueeze(-1).expand(-1, 6)).sqrt().squeeze(-1)
    expected = torch.tensor([size, size * math.sqrt(0.75), 0.0, 0.0], dtype=DOUBLE)
    torch.testing.assert_close(found, expected)


def test_deviations_that_three_boundaries_cannot_show_count_less_with_each_further_one():
    """Where lanes are unequal, one further boundary is in its place by chance with a probability of 0.4 %."""
    sensitivity = torch.zeros(3, 4, 6, dtype=DOUBLE)
    sensitivity[:, ROLL, 1:4] = torch.tensor([-0.05, 0.1, -0.05], dtype=DOUBLE)
    sensitivity[1, HEIGHT, 4], sensitivity[2, HEIGHT, 4] = 0.015 / 4, 0.03
    none, straight = torch.zeros(3, 6, dtype=DOUBLE), torch.zeros(3, dtype=DOUBLE)
    found = unverified_deviation(
        sensitivity, none, straight, straight, JointConfig(lane_deviation_std=0.1)
    ).sqrt()
    expected = torch.tensor([0.1, 0.1 * math.sqrt(0.75), 0.1 * 0.004**0.5], dtype=DOUBLE)
    torch.testing.assert_close(found, expected.unsqueeze(-1).expand(-1, 6))
    apart = none.clone()
    apart[:, 4] = -0.9  # bounds no lane
    alone = unverified_deviation(
        sensitivity, apart, straight, straight, JointConfig(lane_deviation_std=0.1)
    ).sqrt()
    torch.testing.assert_close(alone, torch.full_like(alone, 0.1))
    held = torch.full((3, 6), 0.02**2 / 3, dtype=DOUBLE)  # half of their sum is 0.02²
    left = beyond_filter(
        unverified_deviation(sensitivity, none, straight, straight, JointConfig(lane_deviation_std=0.1)), held
    )
    assert left[0].tolist() == [pytest.approx(0.1**2 - 0.02**2)] * 6


def test_outliers_beside_unequal_lanes_are_no_bend():
    """Deviations are uncertain only together with the pose: end points beside their boundary are outliers."""
    out = torch.tensor([0.066, 0.027, 0.006, 0.062, -0.045, -0.017], dtype=DOUBLE)
    drive = moments(4.0, lambda t, m: replace(m, near=6.0, far=73.0, outliers=0.25, places=PLACES + out))
    calibrator = JointCalibrator()
    state, yaw = calibrator.initial_state(8, dtype=DOUBLE), []
    for k, (moment, segments) in enumerate(see(drive, 8, 0.7, 30, 1, DOUBLE)):
        calibration, state = calibrator(segments, CAMERA.expand(8, 3, 3), state, moment.dt, WIDTH)
        if k >= 30:
            assert (state.evidence[:, NUM_POSE : NUM_POSE + NUM_SHAPE].abs() < CALL).all()
            yaw.append(
                (calibration.extrinsics.yaw - moment.pose[1]).square() / calibration.covariance[:, 1, 1]
            )
    assert (torch.stack(yaw) < 9).double().mean() > 0.98


@pytest.mark.parametrize("visible", [(1, 2, 3), (2, 3, 4)])
def test_two_lanes_that_differ_are_within_the_standard_deviations(visible):
    """Nothing shows that a lane is 10 cm wider than the other: roll and height are wrong, and may be."""
    places = PLACES.clone()
    places[visible[0]] += 0.05
    places[visible[2]] += 0.05
    drive = moments(0.5, lambda t, m: replace(m, visible=visible, places=places))
    calibrator = JointCalibrator()
    state = calibrator.initial_state(2, dtype=DOUBLE)
    for moment, segments in see(drive, 2, 1.0, 20, 0, DOUBLE):  # from the first frame on
        calibration, state = calibrator(segments, CAMERA.expand(2, 3, 3), state, moment.dt, WIDTH)
        error = calibration.extrinsics.stack() - torch.tensor(moment.pose, dtype=DOUBLE)
        sigma = calibration.covariance.diagonal(dim1=1, dim2=2).sqrt()
        assert (error.abs() < 4 * sigma).all()
    assert (error[:, ROLL].abs() > math.radians(0.2)).all()
    assert (sigma[:, ROLL] < math.radians(1.0)).all()
    assert (sigma[:, :2] < math.radians(0.1)).all()  # pitch and yaw do not depend on it


def test_the_covariance_changes_gradually_when_boundaries_come_and_go():
    """All six for a second, the middle three for a second, then four."""

    def change(t, moment):
        visible = (0, 1, 2, 3, 4, 5) if t < 0.99 else (1, 2, 3) if t < 1.99 else (1, 2, 3, 4)
        return replace(moment, visible=visible)

    calibrator = JointCalibrator()
    state, sigmas = calibrator.initial_state(1, dtype=DOUBLE), []
    for moment, segments in see(moments(2.5, change), 1, 1.0, 20, 0, DOUBLE):
        calibration, state = calibrator(segments, CAMERA.expand(1, 3, 3), state, moment.dt, WIDTH)
        sigmas.append(calibration.covariance[0, ROLL, ROLL].sqrt().rad2deg())
    sigma = torch.stack(sigmas)
    assert sigma[29] < 0.02
    assert (sigma[30:60] < 0.05).all()  # the six have shown that lanes are equal
    assert (sigma[60:] < 0.05).all()


def test_equal_lanes_are_trusted_some_time_after_a_fourth_boundary_is_seen():
    four = torch.zeros(1, 4, 12, dtype=DOUBLE)
    four[:, ROLL, 1:5] = torch.tensor([-0.05, 0.1, -0.05, 0.03], dtype=DOUBLE)
    three = four.clone()
    three[..., 4] = 0.0
    cfg, step = JointConfig(), torch.full((1,), 1 / 30, dtype=DOUBLE)
    none = torch.zeros(1, 6, dtype=DOUBLE)
    seen, left = three, []
    for _ in range(25):
        found = unverified_deviation(seen[..., :6], none, none[:, 0], none[:, 0], cfg)
        left.append(float(found[0, 0].sqrt()))
        seen = remembered_sensitivity(four, seen, step, cfg)
    assert left[0] == pytest.approx(0.05)
    assert 0.03 < left[1] < 0.05
    assert left[8] > 0.02
    assert left[24] == pytest.approx(0.05 * math.sqrt(0.004))
    torch.testing.assert_close(remembered_sensitivity(four, 0 * four, step, cfg), four)
    gone = remembered_sensitivity(three, four, step, cfg)
    assert gone[0, ROLL, 4] == pytest.approx(0.03 * math.exp(-1 / 600))
    changed = remembered_sensitivity(three, four, torch.full_like(step, torch.inf), cfg)
    torch.testing.assert_close(changed, three)


def test_the_sensitivity_of_a_start_is_that_of_its_fit():
    """Put a boundary out of place by 1 mm: the fit changes by as much as its sensitivity says."""
    moved = PLACES.clone()
    moved[3] += 0.001

    def fitted(places):
        drive = moments(1 / 30, lambda t, m: replace(m, places=places))
        _, segments = next(iter(see(drive, 1, 0.0, 20, 0, DOUBLE)))
        segments = segments._replace(sigma=torch.ones_like(segments.sigma))
        seen = observe(segments, CAMERA[None], 6)
        own = boundary_places(WIDTH, 6, seen.sigma).expand(1, -1).gather(1, seen.boundary)
        fit = fit_observations(seen, own, FramePrior())
        return fit.extrinsics.stack(), scatter_of_fit(fit, own, seen, JointConfig()).sensitivity

    (before, sensitivity), (after, _) = fitted(PLACES), fitted(moved)
    torch.testing.assert_close((after - before)[0], 0.001 * sensitivity[0, :, 3], rtol=0.05, atol=2e-6)


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


def test_update_equals_a_plain_gauss_newton_on_all_data():
    """One linear step and its covariance against stacked least squares with the prior as rows."""
    frames = drive(6)
    calibrator = JointCalibrator()
    _, state = run(calibrator, frames[:5])
    seen = observe(frames[5][1], cameras(2), 6)
    places = boundary_places(WIDTH, 6, seen.sigma).gather(1, seen.boundary)
    places = places + state.mean[:, PLACE.deviations].gather(1, seen.boundary)
    at = boundary_residuals(state.mean[:, :NUM_COMMON], places, seen, state.phase)
    scale, doubt = torch.ones(2, dtype=DOUBLE), state.cov[:, PLACE.observed, PLACE.observed]
    frame = frame_information(at, scale, doubt, seen, membership(seen.boundary, 6, like=doubt))
    estimated, mean = torch.ones_like(state.mean), state.mean[:, PLACE.observed]
    moved = observed_step(mean, doubt, mean, frame, estimated[:, PLACE.observed])
    gain = kalman_gain(state.cov, moved, frame, estimated)
    change = (gain @ moved.pull.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(change[:, PLACE.observed], moved.mean - mean, rtol=1e-6, atol=1e-12)
    cov = posterior_covariance(state.cov, frame.matrix, gain)
    for row in range(2):
        jacobian = torch.zeros(at.jacobian.shape[-1], PLACE.size, dtype=DOUBLE)
        jacobian[:, :NUM_COMMON] = at.jacobian[row].mT
        boundary = seen.boundary[row].repeat(2)
        jacobian[torch.arange(len(boundary)), NUM_COMMON + boundary] = at.jacobian[row, OFFSET]
        weight = frame.trust[row] * seen.weight[row] / (frame.scale[row] * seen.sigma[row]) ** 2
        weight = weight.repeat(2).sqrt()
        root = torch.linalg.inv(torch.linalg.cholesky(state.cov[row]))
        rows = torch.cat([jacobian * weight.unsqueeze(-1), root])
        right = torch.cat([-at.distance[row].flatten() * weight, torch.zeros(len(root), dtype=DOUBLE)])
        step = torch.linalg.lstsq(rows, right.unsqueeze(-1)).solution.squeeze(-1)
        std = state.cov[row].diagonal().sqrt()
        assert ((change[row] - step) / std).abs().max() < 1e-6
        expected = torch.linalg.inv(rows.mT @ rows)
        assert ((cov[row] - expected) / std / std.unsqueeze(-1)).abs().max() < 1e-6


def test_weights_allow_for_the_predicted_variance_of_the_end_points():
    """(J6) with h P hᵀ of each end point, one at a time, on unequal lanes; with all correlations."""
    uneven = moments(1.0, lambda t, m: replace(m, places=PLACES + torch.tensor([0.1, 0, -0.1, 0.1, 0, -0.1])))
    frames, calibrator = list(see(uneven, 2, 1.0, 8, 0, DOUBLE)), JointCalibrator()
    _, state = run(calibrator, frames)
    seen = observe(frames[-1][1], cameras(2), 6)
    own = state.mean[:, PLACE.deviations].gather(1, seen.boundary)
    places = boundary_places(WIDTH, 6, seen.sigma).gather(1, seen.boundary) + own
    at = boundary_residuals(state.mean[:, :NUM_COMMON], places, seen, state.phase)
    member = membership(seen.boundary, 6, like=own)
    full = torch.cat([at.jacobian, member * at.jacobian[:, OFFSET, None]], dim=1)
    cov = state.cov[:, PLACE.observed, PLACE.observed]
    trust = frame_information(at, torch.ones(2, dtype=DOUBLE), cov, seen, member).trust
    count = seen.boundary.shape[1]
    for row, segment in itertools.product(range(2), range(count)):
        first, second = (full[row, :, end * count + segment] for end in (0, 1))
        variance = float(
            seen.sigma[row, segment] ** 2 + 0.5 * (first @ cov[row] @ first + second @ cov[row] @ second)
        )
        squared = float(at.distance[row, :, segment].square().sum())
        inlier = math.exp(-0.5 * squared / variance) / (2 * math.pi * variance)
        outlier = 0.3 / (0.2 * float(seen.focal[row])) ** 2
        assert float(trust[row, segment]) == pytest.approx(inlier / (inlier + outlier), rel=1e-9)


def test_considered_entries_keep_their_mean_and_variance():
    """Schmidt: on one lane roll stays, and its doubt stays in what is estimated."""
    frames = drive(8, per_boundary=30)
    calibrator = JointCalibrator()
    _, state = run(calibrator, frames[:6])
    segments = frames[6][1]
    ego = (segments.boundary == 2) | (segments.boundary == 3)
    predicted, *_ = predict_state(state, torch.full((2,), 1 / FPS, dtype=DOUBLE), calibrator.config)
    _, after = calibrator(segments._replace(weight=segments.weight * ego), cameras(2), state, 1 / FPS, WIDTH)
    for entry in PLACE.chain(ROLL):
        torch.testing.assert_close(after.mean[:, entry], predicted.mean[:, entry])
        torch.testing.assert_close(after.cov[:, entry, entry], predicted.cov[:, entry, entry])
    assert (after.cov[:, 0, 0] < predicted.cov[:, 0, 0]).all()


def test_distances_at_the_feet_are_those_of_the_residuals_and_close_to_them_nearby():
    moment, segments = drive(1, sigma=1.0)[0]
    seen = observe(segments, cameras(2), 6)
    places = boundary_places(WIDTH, 6, seen.sigma).gather(1, seen.boundary)
    params = torch.zeros(2, NUM_COMMON, dtype=DOUBLE)
    params[:, :5] = torch.tensor([*moment.pose, moment.offset], dtype=DOUBLE)
    params[:, SHAPE.start], params[:, VERTICAL] = 1e-5, 1e-4
    phase = torch.tensor([0.0, 7.3], dtype=DOUBLE)
    feet = foot_points(params, places, seen, look(params, seen, phase))
    residuals = boundary_residuals(params, places, seen, phase, feet)
    distance, valid = boundary_distances(params, places, seen, feet, phase)
    torch.testing.assert_close(distance, residuals.distance)
    assert torch.equal(valid, residuals.valid)
    moved = params + torch.tensor([2e-4, 2e-4, 2e-4, 2e-3, 2e-3] + [0.0] * (NUM_SHAPE + 1), dtype=DOUBLE)
    old_feet, _ = boundary_distances(moved, places, seen, feet, phase)
    torch.testing.assert_close(
        old_feet, boundary_residuals(moved, places, seen, phase).distance, rtol=0, atol=2e-3
    )


def test_gradient_flows_from_the_pose_to_the_end_points():
    frames = drive(3, rows=1)
    calibrator = JointCalibrator()
    _, state = run(calibrator, frames[:2])
    ends = frames[2][1].endpoints.clone().requires_grad_()

    def pitch_of(points):
        out, _ = calibrator(frames[2][1]._replace(endpoints=points), cameras(1), state, 1 / FPS, WIDTH)
        return out.extrinsics.pitch.sum()

    (slope,) = torch.autograd.grad(pitch_of(ends), ends)
    assert slope.isfinite().all()
    direction = torch.randn(ends.shape, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    step = 1e-5
    with torch.no_grad():
        numeric = (pitch_of(ends + step * direction) - pitch_of(ends - step * direction)) / (2 * step)
    assert (slope * direction).sum().item() == pytest.approx(numeric.item(), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("speed_std", [MotionConfig.speed_std, 1e-3])
def test_float32_follows_float64_within_a_hundredth_of_a_sigma(speed_std):
    """With the speed held at 20 m/s a knot is due every 15 frames to rounding: passed in either frame."""
    frames = drive(150, rows=4)
    calibrator = JointCalibrator(motion=MotionConfig(speed_std=speed_std))
    low, high = calibrator.initial_state(4), calibrator.initial_state(4, dtype=DOUBLE)
    apart = []
    for _, segments in frames:
        single = LaneSegments(*(part.float() if part.is_floating_point() else part for part in segments))
        one, low = calibrator(single, cameras(4).float(), low, 1 / FPS, WIDTH)
        same = LaneSegments(*(part.double() if part.is_floating_point() else part for part in single))
        two, high = calibrator(same, cameras(4), high, 1 / FPS, WIDTH)
        std = two.covariance.diagonal(dim1=1, dim2=2).sqrt()
        apart.append((one.extrinsics.stack().double() - two.extrinsics.stack()) / std)
    assert torch.stack(apart).square().mean((0, 1)).sqrt().max() < 0.01


STRAIGHT, BEND = torch.tensor([1e-4, 3e-6], dtype=DOUBLE), torch.tensor([2e-3, 2e-5], dtype=DOUBLE)


def fitted_bend(curvature, sigma, dtype=DOUBLE):
    """(1, 7) and (1, 7, 7): a fit whose curvature is known to sigma, its yaw thrown off by that of c0."""
    spread = torch.tensor([1e-3, 1e-3, 1e-3, 0.01, 0.01, *sigma], dtype=dtype).diag()
    mix = torch.eye(7, dtype=dtype)
    mix[1, 5] = -15.0  # m
    return torch.tensor([[0.01, 0.02, 0.0, 1.5, 0.0, *curvature]], dtype=dtype), (mix @ spread**2 @ mix.T)[
        None
    ]


def test_straight_or_bend_is_the_mean_of_both_by_their_evidence():
    params, cov = fitted_bend((5e-4, 2e-6), (2e-4, 4e-6))
    mean, spread = straight_or_bend(params, cov, STRAIGHT, BEND, 0.2)
    # by sampling: curvatures of either kind of road, weighed by what is left of the fit without its prior
    torch.manual_seed(0)
    known = torch.linalg.inv(cov[0, 5:, 5:])
    alone = known - BEND.square().reciprocal().diag()
    centre = torch.linalg.solve(alone, known @ params[0, 5:])
    count = 400_000
    kind = torch.where(torch.rand(count, 1) < 0.2, BEND, STRAIGHT)
    drawn = kind * torch.randn(count, 2, dtype=DOUBLE)
    off = drawn - centre
    weight = (-0.5 * ((off @ alone) * off).sum(-1)).exp()
    weight = weight / weight.sum()
    gain = cov[0, :, 5:] @ known
    each = params[0] + (drawn - params[0, 5:]) @ gain.T
    expected = (weight[:, None] * each).sum(0)
    left = cov[0] - gain @ cov[0, 5:, :]
    around = ((each - expected).T * weight) @ (each - expected) + left
    sigma = around.diagonal().sqrt()
    assert ((mean[0] - expected).abs() < 0.02 * sigma).all()
    assert ((spread[0] - around).abs() < 0.02 * sigma[:, None] * sigma).all()


def test_what_is_clearly_straight_or_bent_is_taken_as_that():
    params, cov = fitted_bend((3e-5, 0.0), (3e-5, 1e-6))
    mean, spread = straight_or_bend(params, cov, STRAIGHT, BEND, 0.2)
    assert (mean[0, 1] - params[0, 1]) / (3e-5 * 15) == pytest.approx(3e-5**2 / (3e-5**2 + 1e-4**2), rel=0.05)
    assert spread[0, 1, 1] < cov[0, 1, 1]
    params, cov = fitted_bend((2e-3, 0.0), (3e-5, 1e-6))
    mean, spread = straight_or_bend(params, cov, STRAIGHT, BEND, 0.2)
    torch.testing.assert_close(mean, params)
    torch.testing.assert_close(spread, cov)
    params, cov = fitted_bend((5e-4, 2e-6), (2e-4, 4e-6))
    exact = straight_or_bend(params, cov, STRAIGHT, BEND, 0.2)
    single = straight_or_bend(params.float(), cov.float(), STRAIGHT.float(), BEND.float(), 0.2)
    for got, expected in zip(single, exact, strict=True):
        torch.testing.assert_close(got.double(), expected, rtol=1e-3, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [math.inf, 2000.0, 1000.0, 500.0])
def test_single_images_of_bends_with_vague_lines_are_honest(radius):
    """Two lanes' boundaries to 40 m at 2.5 px: whether R = 1,000 m is a bend cannot be told for sure."""
    visible, bent = (1, 2, 3, 4), lambda z: torch.full_like(z, 1 / radius)
    errors = []
    for seed, moment in enumerate(moments(2.0)[3::20]):
        moment = replace(moment, visible=visible, far=40.0, curvature=bent)
        frames = list(see([moment], 60, 2.5, 8, seed, DOUBLE))
        out, _ = run(JointCalibrator(), frames)
        error = out.extrinsics.stack() - torch.tensor(moment.pose, dtype=DOUBLE)
        errors.append((error * torch.linalg.solve(out.covariance, error)).sum(-1) / 4)
    assert 0.5 < torch.cat(errors).mean() < 2.0


@pytest.mark.slow
def test_straight_road_does_not_tell_the_speed():
    """Noise of the road's curvature stands still in the image; taken for a bend it would stop the car."""
    _, state = run(JointCalibrator(), drive(300, rows=4))
    assert state.mean[:, PLACE.speed].abs().max() < 4.0


@pytest.mark.slow
@pytest.mark.timeout(900)  # 200 s of tracing on an idle core
def test_exports_saves_takes_any_batch_and_equals_eager(tmp_path):
    frames = drive(4)
    calibrator = JointCalibrator(iterations=1, start_iterations=1)  # a smaller graph, traced faster
    _, state = run(calibrator, frames[:3])
    dt = torch.full((2,), 1 / FPS, dtype=DOUBLE)
    arguments = (frames[3][1], cameras(2), state, dt)
    any_batch = {0: torch.export.Dim("batch", min=1, max=8)}
    shapes = [
        type(part)(*(any_batch for _ in part)) if isinstance(part, tuple) else any_batch for part in arguments
    ]
    program = torch.export.export(calibrator, arguments, dynamic_shapes=tuple(shapes))
    torch.export.save(program, tmp_path / "joint.pt2")
    exported = torch.export.load(tmp_path / "joint.pt2").module()
    three = torch.tensor([1, 0, 1])
    arguments = tuple(
        type(part)(*(each[three] for each in part)) if isinstance(part, tuple) else part[three]
        for part in arguments
    )
    expected, after = calibrator(*arguments)
    found, after_exported = exported(*arguments)
    torch.testing.assert_close(found.extrinsics.stack(), expected.extrinsics.stack())
    torch.testing.assert_close(after_exported.cov, after.cov)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="num_boundaries: expected an even number"):
        JointCalibrator(num_boundaries=5)
    with pytest.raises(ValueError, match="iterations: expected at least 1"):
        JointCalibrator(iterations=0)
    with pytest.raises(ValueError, match="config: expected either"):
        JointCalibrator(JointConfig(), iterations=1)
    calibrator = JointCalibrator()
    _, segments = drive(1)[0]
    state = calibrator.initial_state(2, dtype=DOUBLE)
    with pytest.raises(ValueError, match=r"intrinsics: expected \(2, 3, 3\)"):
        calibrator(segments, CAMERA, state, 0.1)
    with pytest.raises(ValueError, match="lane_width: expected 1 to 10 m"):
        calibrator(segments, cameras(2), state, 0.1, -1.0)
    with pytest.raises(ValueError, match="dt: expected a float"):
        calibrator(segments, cameras(2), state, torch.ones(3), WIDTH)
    with pytest.raises(ValueError, match=r"straight: expected sigmas between 0 and those of the prior"):
        JointCalibrator(prior=FramePrior(curvature_std=1e-4))
    with pytest.raises(ValueError, match="state: expected one of 6 boundaries, got one of 4"):
        calibrator(segments, cameras(2), JointCalibrator(num_boundaries=4).initial_state(2), 0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("kept", "sigma"), [((2, 3), 0.05), ((2, 3), 0.3), ((2,), 0.3), ((2,), 1.0)])
def test_float32_bears_one_sharp_lane_beside_a_row_that_sees_all(kept, sigma):
    """The information about what one lane determines is a million times that about the rest."""
    calibrator = JointCalibrator()
    low, high = calibrator.initial_state(2), calibrator.initial_state(2, dtype=DOUBLE)
    frames = drive(40, per_boundary=30, sigma=sigma)
    for number, (_, segments) in enumerate(frames):
        if number > 15:
            few = torch.isin(segments.boundary[0], torch.tensor(kept)) * segments.weight[0]
            segments = segments._replace(weight=torch.stack([few, segments.weight[1]]))
        single = LaneSegments(*(part.float() if part.is_floating_point() else part for part in segments))
        one, low = calibrator(single, cameras(2).float(), low, 1 / FPS, WIDTH)
        two, high = calibrator(segments, cameras(2), high, 1 / FPS, WIDTH)
    std = two.covariance.diagonal(dim1=1, dim2=2).sqrt()
    error = one.extrinsics.stack().double() - torch.tensor(frames[-1][0].pose, dtype=DOUBLE)
    assert (error.abs() < 5 * std).all()
    assert ((one.extrinsics.stack() - two.extrinsics.stack()).abs() < 0.05 * std).all()
    torch.testing.assert_close(one.covariance.double(), two.covariance, rtol=0.02, atol=1e-9)


def test_gradient_by_the_time_is_finite_where_none_passed():
    frames = drive(2)
    calibrator = JointCalibrator()
    _, state = run(calibrator, frames[:1])
    dt = torch.tensor([0.0, 1 / FPS], dtype=DOUBLE, requires_grad=True)
    out, _ = calibrator(frames[1][1], cameras(2), state, dt, WIDTH)
    (slope,) = torch.autograd.grad(out.covariance.sum() + out.extrinsics.stack().sum(), dt)
    assert slope.isfinite().all()
    assert slope[0] == 0
    assert slope[1] != 0


def test_nothing_in_sight_is_no_misfit():
    frames = drive(3)
    calibrator = JointCalibrator()
    _, state = run(calibrator, frames)
    _, state = run(calibrator, [(frames[-1][0], nothing(frames[-1][1]))] * 20, state)
    assert (state.misfit == 0).all()
    assert (state.unseen > 0.5).all()


@pytest.mark.parametrize("shift", [-1.0, 0.0, 1.0])
def test_deviations_change_their_numbers_with_the_boundaries(shift):
    """Who moves a lane to the right has what was boundary k + 1 for boundary k."""
    mean = JointCalibrator().initial_state(2, dtype=DOUBLE).mean.clone()
    mean[:, PLACE.deviations] = torch.arange(1.0, 7.0)
    lanes, width = torch.full((2,), shift, dtype=DOUBLE), torch.full((2,), WIDTH, dtype=DOUBLE)
    moved = renumber(mean, lanes, width, 6)
    k = torch.arange(6) + int(shift)
    expected = torch.where((k >= 0) & (k < 6), k + 1.0, 0.0).double()
    torch.testing.assert_close(moved[:, PLACE.deviations], expected.expand(2, -1))
    torch.testing.assert_close(moved[:, OFFSET] - mean[:, OFFSET], lanes * WIDTH)
    renumbered = (OFFSET, *range(PLACE.size)[PLACE.deviations])
    rest = [i for i in range(PLACE.size) if i not in renumbered]
    assert torch.equal(moved[:, rest], mean[:, rest])


def test_a_clothoids_steps_are_its_rate_by_the_knots_spacing():
    calibrator = JointCalibrator()
    params = torch.tensor([[0.0, 0, 0, 1.5, 0, 2e-3, 1e-4]], dtype=DOUBLE)
    mean, _ = state_from_fit(params, 1e-12 * torch.eye(7, dtype=DOUBLE)[None], 0 * params, calibrator.config)
    torch.testing.assert_close(mean[:, CURVATURE], params[:, 5])
    torch.testing.assert_close(mean[0, STEPS], torch.full((NUM_STEPS,), 1e-4 * KNOT_SPACING, dtype=DOUBLE))


def test_height_doubts_roll_that_is_held_as_the_lane_seen_bends_it():
    """By the second derivative of the height at which a lane seen as it is has its width."""
    frames = drive(10)
    ego = torch.tensor([2, 3])
    frames = [(moment, s._replace(weight=s.weight * torch.isin(s.boundary, ego))) for moment, s in frames]
    out, state = run(JointCalibrator(), frames)
    assert (state.reasons & Reason.ROLL_UNSEEN).all()
    height, middle = state.mean[0, HEIGHT], state.mean[0, OFFSET]
    left, right = middle - WIDTH / 2, middle + WIDTH / 2

    def height_at(roll):
        tangents = [(-(x / height).atan() - roll).tan() for x in (left, right)]
        return WIDTH / (tangents[0] - tangents[1])

    roll = torch.zeros((), dtype=DOUBLE)
    bend = torch.func.grad(torch.func.grad(height_at))(roll)
    more = 3 * (0.5 * bend * state.cov[0, ROLL, ROLL]).square()
    added = out.covariance[0, 3, 3] - state.cov[0, HEIGHT, HEIGHT]
    torch.testing.assert_close(added, more, rtol=1e-6, atol=0)


def test_speed_wanders_about_its_mean_as_far_as_it_says():
    cfg = MotionConfig()
    time, equal = torch.tensor([1 / 30], dtype=DOUBLE), torch.zeros(1, dtype=DOUBLE)
    one = torch.ones(1, 4, dtype=DOUBLE)
    transition, noise = motion(time, one, equal, equal, no_road(), PLACE, cfg)
    fade, more = transition[0, PLACE.speed, PLACE.speed], noise[0, PLACE.speed, PLACE.speed]
    assert float(more / (1 - fade**2)) == pytest.approx(cfg.speed_std**2, rel=0.01)


@pytest.mark.parametrize(
    ("config", "name", "value", "expected"),
    [
        (MotionConfig, "hill_memory", 0.0, "more than 0, got 0.0"),
        (MotionConfig, "offset_memory", math.inf, "a finite number, more than 0, got inf"),
        (MotionConfig, "bandwidth", 0, "a finite number, more than 0, got 0"),
        (MotionConfig, "angle_std", -0.1, "a finite number, at least 0, got -0.1"),
        (MotionConfig, "speed", math.nan, "a finite number, at least 0, got nan"),
        (JointConfig, "scatter_memory", math.nan, "more than 0, got nan"),
        (JointConfig, "assumed_dt", 0.0, "a finite number, more than 0, got 0.0"),
        (JointConfig, "lane_deviation_std", math.inf, "a finite number, at least 0, got inf"),
    ],
)
def test_settings_that_are_no_such_numbers_are_refused(config, name, value, expected):
    with pytest.raises(ValueError, match=f"^{name}: expected {expected}$"):
        config(**{name: value})
    with pytest.raises(TypeError, match=f"^{name}: expected a number, got str$"):
        config(**{name: "1"})


def test_times_may_be_endless_and_walks_zero():
    MotionConfig(deviation_memory=math.inf, mean_angle_walk=0.0, curvature_walk=0)
    JointConfig(scatter_memory=math.inf, lost_after=math.inf, open_pose=0.0)
