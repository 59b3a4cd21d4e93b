"""The joint calibrator: interface, life cycle, gradients, rows, precision, export."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator, follow_lane_change
from lanebev.estimation.joint.dynamics import (
    MEANS,
    NUM_COMMON,
    NUM_SEEN,
    RATES,
    SHAPE,
    SPEED,
    STEPS,
    MotionConfig,
    motion,
    spring,
)
from lanebev.estimation.joint.measurement import (
    CURVATURE,
    HEIGHT,
    KNOT_SPACING,
    NUM_STEPS,
    OFFSET,
    ROLL,
    boundary_places,
    boundary_residuals,
    observe,
)
from lanebev.estimation.joint.road import come_nearer, straight_or_bend, turn_along
from lanebev.estimation.joint.single_frame import FramePrior
from lanebev.estimation.joint.state import JointConfig, Reason, begin
from lanebev.estimation.joint.update import iterate
from lanebev.observation.segments import LaneSegments
from lanebev.testing.scenarios import CAMERA, FPS, PLACES, WIDTH, moments
from lanebev.testing.scenarios import observe as see
from lanebev.types import Status

torch.set_num_threads(1)
DOUBLE = torch.float64
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
    params = torch.zeros(2, NUM_SEEN, dtype=DOUBLE)
    params[:, :5] = torch.tensor([*moment.pose, moment.offset], dtype=DOUBLE)
    params[:, SHAPE] = 1e-5 * torch.randn(2, 1 + NUM_STEPS, generator=generator, dtype=DOUBLE)
    phase = torch.tensor([0.0, 7.3], dtype=DOUBLE)
    found = boundary_residuals(params, places, seen, phase)
    full = torch.func.jacfwd(lambda p: boundary_residuals(p, places, seen, phase).distance)(params)
    expected = torch.stack([full[row, :, :, row] for row in range(2)]).flatten(1, 2)
    # taken at the foot point, some tenths of a pixel away, where it is the total derivative
    near = found.valid.repeat_interleave(2, dim=1) & (found.distance.flatten(1).abs() < 1.0)
    gap = (found.jacobian.mT - expected) / expected.abs().amax(1, keepdim=True)
    assert near.sum() > 100
    assert gap[near].abs().max() < 0.01


def test_road_comes_nearer_by_the_way_that_was_driven():
    """A clothoid seen ahead is the same clothoid after 23 m, of which the knots passed two."""
    rate, size = 4e-5, NUM_COMMON + 6
    mean = torch.zeros(1, size, dtype=DOUBLE)
    mean[:, SHAPE.start] = 1e-3
    mean[:, STEPS] = rate * KNOT_SPACING
    cov = torch.eye(size, dtype=DOUBLE)[None] * 1e-10
    cov[:, SPEED, SPEED] = 64.0
    cfg = MotionConfig(speed=20.0)
    none = torch.zeros(1, dtype=DOUBLE)
    after, spread, phase = come_nearer(mean, cov, none, torch.tensor([1.15], dtype=DOUBLE), cfg)
    assert phase.item() == pytest.approx(3.0)
    turned = turn_along(mean[:, SHAPE], none, torch.tensor([23.0], dtype=DOUBLE))[0]
    torch.testing.assert_close(turned, mean[0, SHAPE], rtol=0.02, atol=0.0)  # R > 300 m: a slight turn
    assert after[0, SHAPE.start].item() == pytest.approx(turned[:3].sum().item())
    steps = torch.cat([turned[3:], turned.new_zeros(2)])
    torch.testing.assert_close(after[0, STEPS], steps)
    # an unknown speed is an unknown curvature on a clothoid, here 8 m/s · 1.15 s · rate
    assert spread[0, SHAPE.start, SHAPE.start].sqrt().item() == pytest.approx(8 * 1.15 * rate, rel=0.01)
    torch.testing.assert_close(spread, spread.mT)


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


def test_spring_is_constant_velocity_when_soft_and_halves_join():
    dt = torch.tensor([0.02, 0.5], dtype=DOUBLE)
    move, noise = (part.view(2, 2, 2) for part in spring(dt, 2.2))
    half, half_noise = (part.view(2, 2, 2) for part in spring(dt / 2, 2.2))
    torch.testing.assert_close(half @ half, move)
    torch.testing.assert_close(half @ half_noise @ half.mT + half_noise, noise, rtol=1e-3, atol=1e-9)
    soft, soft_noise = (part.view(2, 2, 2) for part in spring(dt, 1e-6))
    torch.testing.assert_close(soft[:, 0, 1], dt, rtol=1e-5, atol=0)
    torch.testing.assert_close(soft_noise[:, 0, 0], dt**3 / 3, rtol=1e-5, atol=0)


def test_what_is_held_returns_by_a_stiffer_spring_and_unequal_lanes_forget():
    cfg, dt = MotionConfig(), torch.full((2,), 0.1, dtype=DOUBLE)
    held = torch.tensor([[False] * 4, [False, False, True, False]])
    unequal = torch.tensor([0.0, 0.12], dtype=DOUBLE)
    transition, noise = motion(dt, held, unequal, 6, cfg)
    for row, rate, factor in ((0, cfg.spring, 1.0), (1, cfg.held_spring, cfg.held_factor)):
        x = [2, RATES.start + 2]  # roll and its rate
        move, density = spring(dt[:1], rate)
        torch.testing.assert_close(transition[row][x][:, x].flatten(), move[0])
        torch.testing.assert_close(noise[row][x][:, x].flatten(), factor * cfg.angular_density * density[0])
        assert transition[row, 2, MEANS.start + 2] == pytest.approx(1 - float(move[0, 0]))
    torch.testing.assert_close(transition[0, 0], transition[1, 0])  # pitch is seen in both
    settled = math.exp(-0.1 / cfg.unequal_memory)
    assert transition[1, NUM_COMMON, NUM_COMMON] == pytest.approx(settled)
    assert noise[1, NUM_COMMON, NUM_COMMON] == pytest.approx(
        0.12**2 * (1 - settled**2) + 0.1 * cfg.deviation_walk**2
    )


def test_minutes_of_nothing_keep_the_covariance_positive_and_bounded():
    cfg = MotionConfig()
    calibrator = JointCalibrator()
    state = calibrator.initial_state(1, dtype=DOUBLE)
    mean, cov, phase = state.mean, state.cov, state.phase
    dt, unequal = torch.ones(1, dtype=DOUBLE), torch.zeros(1, dtype=DOUBLE)
    held = torch.ones(1, 4, dtype=torch.bool)
    for _ in range(300):
        mean, cov, phase = come_nearer(mean, cov, phase, dt, cfg)
        transition, noise = motion(dt, held, unequal, 6, cfg)
        mean, cov = (transition @ mean.unsqueeze(-1)).squeeze(-1), transition @ cov @ transition.mT + noise
    size = cov.diagonal(dim1=1, dim2=2).rsqrt()
    assert torch.linalg.eigvalsh(size.unsqueeze(-1) * cov * size.unsqueeze(-2)).min() > 0
    assert cov[0, :3].diagonal().sqrt().max() < 0.3  # the pose stays about its mean


def test_update_equals_a_plain_gauss_newton_on_all_data():
    """One linear step against stacked least squares with the prior as rows."""
    frames = drive(6)
    calibrator = JointCalibrator()
    _, state = run(calibrator, frames[:5])
    seen = observe(frames[5][1], cameras(2), 6)
    places = boundary_places(WIDTH, 6, seen.sigma).gather(1, seen.boundary)
    scale = torch.ones(2, dtype=DOUBLE)
    update = iterate(state.mean, state.cov, state.mean, scale, places, seen, state.phase, 1, state.cov)
    at = boundary_residuals(
        state.mean[:, :NUM_SEEN],
        places + state.mean[:, NUM_COMMON:].gather(1, seen.boundary),
        seen,
        state.phase,
    )
    for row in range(2):
        jacobian = torch.zeros(at.jacobian.shape[-1], state.mean.shape[1], dtype=DOUBLE)
        jacobian[:, :NUM_SEEN] = at.jacobian[row].mT
        boundary = seen.boundary[row].repeat_interleave(2)
        jacobian[torch.arange(len(boundary)), NUM_COMMON + boundary] = at.jacobian[row, 4]
        weight = (update.trust[row] * seen.weight[row] / seen.sigma[row] ** 2).repeat_interleave(2).sqrt()
        root = torch.linalg.inv(torch.linalg.cholesky(state.cov[row]))
        rows = torch.cat([jacobian * weight.unsqueeze(-1), root])
        right = torch.cat([-at.distance[row].flatten() * weight, torch.zeros(len(root), dtype=DOUBLE)])
        step = torch.linalg.lstsq(rows, right.unsqueeze(-1)).solution.squeeze(-1)
        scaled = (update.mean[row] - state.mean[row] - step) / state.cov[row].diagonal().sqrt()
        assert scaled.abs().max() < 1e-6


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
    assert state.mean[:, SPEED].abs().max() < 4.0


@pytest.mark.slow
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
def test_deviations_change_their_numbers_with_the_boundaries(shift, monkeypatch):
    """Who moves a lane to the right has what was boundary k + 1 for boundary k."""
    calibrator = JointCalibrator()
    seen = observe(drive(1)[0][1], cameras(2), 6)
    state = calibrator.initial_state(2, dtype=DOUBLE)
    mean = state.mean.clone()
    mean[:, NUM_COMMON:] = torch.arange(1.0, 7.0)
    answer = (torch.full((2,), shift, dtype=DOUBLE), torch.ones(2, dtype=DOUBLE))
    monkeypatch.setattr("lanebev.estimation.joint.calibrator.best_shift", lambda *_: answer)
    positions = boundary_places(WIDTH, 6, mean)
    moved, _, _ = follow_lane_change(state._replace(mean=mean), positions, seen, calibrator.config)
    k = torch.arange(6) + int(shift)
    expected = torch.where((k >= 0) & (k < 6), k + 1.0, 0.0).double()
    torch.testing.assert_close(moved[:, NUM_COMMON:], expected.expand(2, -1))
    torch.testing.assert_close(moved[:, OFFSET] - mean[:, OFFSET], answer[0] * WIDTH)


def test_a_clothoids_steps_are_its_rate_by_the_knots_spacing():
    calibrator = JointCalibrator()
    params = torch.tensor([[0.0, 0, 0, 1.5, 0, 2e-3, 1e-4]], dtype=DOUBLE)
    mean, _ = begin(params, 1e-12 * torch.eye(7, dtype=DOUBLE)[None], calibrator.config)
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
    transition, noise = motion(time, torch.zeros(1, 4, dtype=torch.bool), equal, 6, cfg)
    fade, more = transition[0, SPEED, SPEED], noise[0, SPEED, SPEED]
    assert float(more / (1 - fade**2)) == pytest.approx(cfg.speed_std**2, rel=0.01)
