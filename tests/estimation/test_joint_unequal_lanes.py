"""What unequal lanes and single deviating boundaries do to pose and covariance."""

import math
from dataclasses import replace

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.evidence import CALL, deviation_prior_std
from lanebev.estimation.joint.filter.scatter import remembered_sensitivity, summed_places
from lanebev.estimation.joint.layout import NUM_POSE
from lanebev.estimation.joint.measurement.observations import boundary_places
from lanebev.estimation.joint.measurement.residuals import HEIGHT, NUM_SHAPE, OFFSET, ROLL
from lanebev.estimation.joint.output import (
    as_calibration,
    beyond_filter,
    deviation_by_break,
    learned_road,
    single_deviation,
    unverified_deviation,
)
from lanebev.estimation.reasons import Reason
from lanebev.testing.moments import PLACES, WIDTH, moments
from lanebev.testing.moments import observe as see
from tests.estimation.joint_drives import DOUBLE, drive, fitted_frame, follow, nothing, run
from tools.bench_kinds import drawn, figures_of
from tools.random_drives import CROWN

torch.set_num_threads(1)

PLANE = JointConfig(crossfall_break_std=0.0)


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


def test_deviations_that_three_boundaries_cannot_show_count_until_a_fourth_is_in_view():
    sensitivity = torch.zeros(3, 4, 6, dtype=DOUBLE)
    sensitivity[:, ROLL, 1:4] = torch.tensor([-0.05, 0.1, -0.05], dtype=DOUBLE)
    sensitivity[1, HEIGHT, 4], sensitivity[2, HEIGHT, 4] = 0.015 / 4, 0.03
    none, straight = torch.zeros(3, 6, dtype=DOUBLE), torch.zeros(3, dtype=DOUBLE)
    found = unverified_deviation(
        sensitivity, none, straight, straight, JointConfig(lane_deviation_std=0.1)
    ).sqrt()
    expected = torch.tensor([0.1, 0.1 * math.sqrt(0.75), 0.0], dtype=DOUBLE)
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


def information_on(deviations, std, visible=(0, 1, 2, 3, 4, 5)):
    """(B, 6, 7) on deviations (B, 6), measured to a standard deviation beside any pose of equal lanes."""
    x = torch.arange(6, dtype=DOUBLE)[list(visible)]
    by_pose = torch.linalg.qr(torch.stack([torch.ones_like(x), x, x.square()], dim=-1)).Q
    matrix = torch.zeros(6, 6, dtype=DOUBLE)
    left = (torch.eye(len(x), dtype=DOUBLE) - by_pose @ by_pose.mT) / std**2
    matrix[torch.tensor(visible).unsqueeze(-1), torch.tensor(visible)] = left
    vector = (deviations @ matrix).unsqueeze(-1)
    return torch.cat([matrix.expand(len(deviations), 6, 6), vector], dim=-1)


def learned_deviation(places, deviations, cfg=PLANE):
    """On a road that is plane across."""
    return learned_road(places, deviations, by_break().expand(len(places), 4, 6), cfg).deviation


def test_the_size_of_deviations_is_learned_from_the_difference_that_four_boundaries_show():
    """Against the densities of that difference, a normal deviate of each possible size and its noise."""
    noise, visible = 0.002, (1, 2, 3, 4)
    pattern = torch.tensor([0.0, 1.0, -3.0, 3.0, -1.0, 0.0], dtype=DOUBLE) / math.sqrt(20)
    shown = torch.tensor([0.0, 0.004, 0.01, 0.03, 0.1], dtype=DOUBLE)
    places = information_on(shown.unsqueeze(-1) * pattern, noise, visible)
    none = torch.zeros(len(shown), 6, dtype=DOUBLE)
    sizes = 0.05 * torch.tensor([0.0, 0.15, 0.6, 2.4], dtype=DOUBLE)
    spread = (sizes.square() + noise**2).sqrt()
    density = (-0.5 * (shown.unsqueeze(-1) / spread).square()).exp() / spread
    share = density * torch.tensor([0.957, 0.03, 0.01, 0.003], dtype=DOUBLE)
    expected = (share * sizes.square()).sum(-1) / share.sum(-1)
    found = learned_deviation(places, none)
    torch.testing.assert_close(found, expected)
    assert found[0].sqrt() < 0.012
    assert (found.diff() > 0).all()
    equal = JointConfig(lane_deviation_std=0.0, crossfall_break_std=0.0)
    assert (learned_deviation(places, none, equal) == 0).all()


def test_a_line_that_bounds_no_lane_tells_nothing_of_the_lanes():
    generator = torch.Generator().manual_seed(0)
    deviations = 0.03 * torch.randn(20, 6, generator=generator, dtype=DOUBLE)
    without = information_on(deviations, 0.002, (0, 1, 2, 3))
    deviations[:, 4] = -0.9
    found = learned_deviation(information_on(deviations, 0.002, (0, 1, 2, 3, 4)), deviations)
    expected = learned_deviation(without, 0 * deviations)
    torch.testing.assert_close(found, expected, rtol=0.05, atol=1e-6)


def by_break():
    """Deviations (1, 4, 6) by changes of the crossfall, seen from 0.3 m left of the lane's middle."""
    state = JointCalibrator().initial_state(1, DOUBLE)
    state.mean[:, OFFSET], state.mean[:, HEIGHT] = 0.3, 1.5
    return deviation_by_break(PLACES[None], state)


def test_a_line_beyond_a_change_of_the_crossfall_is_seen_nearer_or_farther_aside():
    at, change = PLACES + 0.3, 1e-6
    for k, side in ((1, -1), (2, -1), (3, 1), (4, 1)):
        lower = change * (side * (at - at[k])).clamp(min=0.0)
        expected = (at * 1.5 / (1.5 + lower) - at) / change
        torch.testing.assert_close(by_break()[0, k - 1], expected, rtol=1e-5, atol=1e-5)


def test_what_frames_tell_of_the_crossfall_is_the_average_over_where_it_may_change():
    """Against the densities of the vector of information, normal with the covariance of each possibility."""
    cfg, around = JointConfig(), by_break()[0]
    change = torch.tensor([0.0, 0.02, 0.04], dtype=DOUBLE)
    shown = change.unsqueeze(-1) * around[1] + 0.002 * torch.tensor([0.0, 1.0, -1.0, 1.0, 0.0, 0.0])
    places = information_on(shown, 0.002, (0, 1, 2, 3, 4))
    matrix, pull = places[0, :, :-1], places[..., -1]
    none, one = torch.zeros(3, 6, dtype=DOUBLE), torch.eye(6, dtype=DOUBLE)
    found = learned_road(places, none, around.expand(3, 4, 6), cfg)
    kinds = [(size, k) for size in range(4) for k in (None, 0, 1, 2, 3)]
    logs, squares = [], []
    for size, k in kinds:
        own = (0.05 * (0.0, 0.15, 0.6, 2.4)[size]) ** 2 * one
        spread = own if k is None else own + 0.04**2 * torch.outer(around[k], around[k])
        share = (0.957, 0.03, 0.01, 0.003)[size] * (0.8 if k is None else (0.02, 0.08, 0.08, 0.02)[k])
        inverse = torch.linalg.inv(one + matrix @ spread)
        evidence = 0.5 * ((pull @ spread) * (pull @ inverse.mT)).sum(-1)
        logs.append(evidence + 0.5 * torch.logdet(inverse) + math.log(share))
        along = torch.zeros(6, dtype=DOUBLE) if k is None else around[k]
        mean = 0.04**2 * (pull @ inverse.mT) @ along
        squares.append(mean.square() + 0.04**2 - 0.04**4 * along @ inverse @ matrix @ along)
    weights = torch.stack(logs).softmax(0)
    for k in range(4):
        here = [number for number, kind in enumerate(kinds) if kind[1] == k]
        expected = sum(weights[number] * squares[number] for number in here)
        torch.testing.assert_close(found.breaks[:, k], expected, rtol=1e-6, atol=1e-12)
    assert found.breaks[0, :3].sum().sqrt() < 0.003  # no line in view is beyond the last
    assert found.breaks[2, 1].sqrt() == pytest.approx(0.04, rel=0.2)


def test_a_crown_does_not_make_the_roll_sure_and_wrong():
    """Lines beyond a crown fit a plane road and another roll, or nearly so."""
    drives = drawn(CROWN, range(60_000, 60_004))
    sure, doubting = (
        figures_of(drives, JointCalibrator(crossfall_break_std=std)).nees for std in (0.0, 0.04)
    )
    assert doubting < 0.5 * sure


def test_the_lanes_that_were_seen_keep_what_they_showed_under_their_new_numbers():
    deviations = torch.tensor([[0.0, 0.01, 0.02, -0.01, 0.03, 0.0]], dtype=DOUBLE)
    before = information_on(deviations, 0.002, (1, 2, 3, 4))
    moved = information_on(deviations.roll(-1, 1), 0.002, (0, 1, 2, 3))
    nothing_new = torch.zeros_like(before)
    step, right = torch.zeros(1, dtype=DOUBLE), torch.ones(1, dtype=DOUBLE)
    args = nothing_new, deviations, before
    torch.testing.assert_close(summed_places(*args, right, step, JointConfig()), moved)
    after = summed_places(*args, 0 * right, step + 20.0, JointConfig())
    torch.testing.assert_close(after, before / math.e)
    once = summed_places(
        information_on(0 * deviations, 0.002), deviations, 0 * before, step, step, JointConfig()
    )
    torch.testing.assert_close(
        once, information_on(deviations, 0.002)
    )  # the filter's deviations are part of it


def test_a_small_difference_of_four_boundaries_may_be_a_large_one_of_their_lanes():
    """Boundaries out of place by 2 cm, of which the fourth shows 4 mm: roll and height err by as much."""
    places, equal = PLACES.clone(), PLACES
    places[1:5] += torch.tensor([0.02, -0.02, -0.014, 0.02], dtype=DOUBLE)
    sigmas = []
    for there in (places, equal):
        drive = moments(3.0, lambda t, m, there=there: replace(m, visible=(1, 2, 3, 4), places=there))
        last = follow(drive, rows=4)[-1]
        sigmas.append(last.sigma)
        assert (last.error.abs() < 3 * last.sigma).all()
    unequal, same = (sigma[:, ROLL].rad2deg() for sigma in sigmas)
    assert (unequal > 0.04).all()
    assert (same < 0.03).all()


def test_outliers_beside_unequal_lanes_are_no_bend():
    """Deviations are uncertain only together with the pose: end points beside their boundary are outliers."""
    out = torch.tensor([0.066, 0.027, 0.006, 0.062, -0.045, -0.017], dtype=DOUBLE)
    drive = moments(4.0, lambda t, m: replace(m, near=6.0, far=73.0, outliers=0.25, places=PLACES + out))
    followed = follow(drive, rows=8, sigma=0.7, per_boundary=30, seed=1)[30:]
    for frame in followed:
        assert (frame.state.evidence[:, NUM_POSE : NUM_POSE + NUM_SHAPE].abs() < CALL).all()
    yaw = torch.stack([(frame.error / frame.sigma)[:, 1] for frame in followed])
    assert (yaw.abs() < 3).double().mean() > 0.98


@pytest.mark.parametrize("visible", [(1, 2, 3), (2, 3, 4)])
def test_two_lanes_that_differ_are_within_the_standard_deviations(visible):
    """Nothing shows that a lane is 10 cm wider than the other: roll and height are wrong, and may be."""
    places = PLACES.clone()
    places[visible[0]] += 0.05
    places[visible[2]] += 0.05
    drive = moments(0.5, lambda t, m: replace(m, visible=visible, places=places))
    followed = follow(drive, rows=2)
    for frame in followed:
        assert (frame.error.abs() < 4 * frame.sigma).all()
    last = followed[-1]
    assert (last.error[:, ROLL].abs() > math.radians(0.2)).all()
    assert (last.sigma[:, ROLL] < math.radians(1.0)).all()
    assert (last.sigma[:, :2] < math.radians(0.1)).all()  # pitch and yaw do not depend on it


def test_the_covariance_changes_gradually_when_boundaries_come_and_go():
    """All six for a second, the middle three for a second, then four."""

    def change(t, moment):
        visible = (0, 1, 2, 3, 4, 5) if t < 0.99 else (1, 2, 3) if t < 1.99 else (1, 2, 3, 4)
        return replace(moment, visible=visible)

    sigma = torch.stack([frame.sigma[0, ROLL].rad2deg() for frame in follow(moments(2.5, change))])
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
    assert left[24] == 0
    torch.testing.assert_close(remembered_sensitivity(four, 0 * four, step, cfg), four)
    gone = remembered_sensitivity(three, four, step, cfg)
    assert gone[0, ROLL, 4] == pytest.approx(0.03 * math.exp(-1 / 600))
    changed = remembered_sensitivity(three, four, torch.full_like(step, torch.inf), cfg)
    torch.testing.assert_close(changed, three)


def test_the_sensitivity_of_a_start_is_that_of_its_fit():
    """Put a boundary out of place by 1 mm: the fit changes by as much as its sensitivity says."""
    moved = PLACES.clone()
    moved[3] += 0.001
    (before, scatter), (after, _) = (fitted_frame(places=places) for places in (PLACES, moved))
    expected = 0.001 * scatter.sensitivity[0, :, 3]
    torch.testing.assert_close((after - before)[0], expected, rtol=0.05, atol=2e-6)


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
    straight = state._replace(
        vertical=torch.zeros_like(state.vertical)
    )  # by chance the boundaries seem curved
    positions = boundary_places(WIDTH, 6, state.mean)
    out = as_calibration(straight, torch.zeros_like(out.inliers), positions, JointConfig())
    added = out.covariance[0, 3, 3] - state.cov[0, HEIGHT, HEIGHT]
    torch.testing.assert_close(added, more, rtol=1e-6, atol=0)
