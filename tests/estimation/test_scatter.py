"""Scatter of the boundaries about parallel lanes of equal width, and its part in the covariance."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from lanebev import JointCalibrator, LaneSegments
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.filter.lane_change import shifted
from lanebev.estimation.joint.filter.scatter import (
    averaged_moments,
    boundary_scatter,
    determined_sensitivity,
    renumbered_moments,
    scatter_variance,
    start_variance,
    with_headings,
)
from lanebev.estimation.joint.filter.update import information, membership
from lanebev.estimation.joint.measurement.observations import boundary_places, observe
from lanebev.estimation.joint.measurement.residuals import NUM_STRAIGHT, PITCH, ROLL, boundary_residuals
from lanebev.estimation.joint.output import (
    heading_variance,
    no_boundary_deviation,
    unverified_deviation,
    vertical_moment,
    wander_of_two,
)
from lanebev.estimation.mount.config import MountConfig
from lanebev.testing.moments import CAMERA, PLACES, WIDTH, moments
from lanebev.testing.moments import observe as see
from lanebev.testing.segments import stack_rows
from lanebev.testing.streets import wandering
from tests.estimation.joint_drives import fitted_frame, follow

DOUBLE = torch.float64
ONE_FRAME = 1 / 30
CONFIG = JointConfig()
CALIBRATOR = JointCalibrator()


@pytest.mark.parametrize(("place_std", "heading_std"), [(0.04, 0.003), (0.06, 0.003), (0.02, 0.006)])
def test_the_variances_of_places_and_headings_are_found(place_std, heading_std):
    """In the mean of 60 roads, if no boundary is taken for an outlier."""
    draws = torch.randn(60, 2, 6, generator=torch.Generator().manual_seed(3), dtype=DOUBLE)
    frames = []
    for place, heading in draws / draws.std((0, 2), keepdim=True):
        own = {"places": PLACES + place_std * place, "headings": heading_std * heading}
        [moment] = moments(ONE_FRAME, lambda t, m, own=own: replace(m, far=40.0, **own))
        frames.append(next(iter(see([moment], 1, 0.3, 20, 0, DOUBLE)))[1])
    seen = observe(stack_rows(*frames), CAMERA.expand(60, 3, 3), 6)
    params = torch.tensor([*moment.pose, moment.offset, 0.0, 0.0], dtype=DOUBLE).expand(60, -1)
    places = boundary_places(WIDTH, 6, seen.sigma).expand(60, -1).gather(1, seen.boundary)
    residuals = boundary_residuals(params, places, seen)
    straight = residuals._replace(jacobian=residuals.jacobian[:, :NUM_STRAIGHT])
    weight = residuals.valid * seen.weight / seen.sigma.square()
    member = membership(seen.boundary, 6, seen.sigma)
    told = with_headings(*information(straight, weight, member), straight, weight, member)
    precision = torch.ones(60, NUM_STRAIGHT, dtype=DOUBLE)
    found = boundary_scatter(*told, precision, torch.zeros(60, 2, 6 + 4, dtype=DOUBLE))
    squares, _, freedom, weight = found.moments.mean(0)[:, 6:].unbind(-1)
    assert (squares / freedom).sqrt().tolist() == [
        pytest.approx(place_std, rel=0.15, abs=0.008),
        pytest.approx(heading_std, rel=0.15),
    ]
    assert 4.0 < freedom.sum() < 7.0  # 12 numbers, of which the pose and the offset take five
    assert (weight == 1).all()


@pytest.mark.parametrize("visible", [(0, 1, 2, 3, 4, 5), (1, 2, 3, 4), (1, 2, 3)])
def test_parallel_boundaries_add_almost_nothing(visible):
    """With noise of 1 px, after half a second."""
    drive = moments(0.6, lambda t, m: replace(m, visible=visible))
    calibrator = JointCalibrator(lane_deviation_std=0.0, crossfall_break_std=0.0, start_heading_std=0.0)
    last = follow(drive, calibrator, rows=8, seed=4)[-1]
    added = last.sigma.square() / last.state.cov.diagonal(dim1=1, dim2=2)[:, :4]
    assert (added.median(0).values < 1.15).all()
    assert (added >= 1 - 1e-9).all()


def test_the_sensitivity_to_a_heading_is_the_change_of_the_fit():
    headings = torch.zeros(6, dtype=DOUBLE)
    headings[3] = 1e-4
    before, scatter = fitted_frame(headings=0 * headings, far=40.0)
    after, _ = fitted_frame(headings=headings, far=40.0)
    expected = 1e-4 * scatter.sensitivity[0, :, 6 + 3]
    torch.testing.assert_close((after - before)[0], expected, rtol=0.1, atol=2e-6)
    assert expected[PITCH].abs() > 5e-6


@pytest.mark.parametrize("visible", [(0, 1, 2, 3, 4, 5), (2, 3, 4)])
def test_the_sensitivity_to_a_heading_that_lasts_is_the_change_of_the_filter_s_estimate(visible):
    """The same drive, the same noise, and one boundary turned by 0.01 mrad: after each half second."""
    headings = torch.zeros(6, dtype=DOUBLE)
    headings[3] = 1e-5
    states = []
    for turned in (0 * headings, headings):
        change = partial(lambda t, m, turned: replace(m, headings=turned, visible=visible), turned=turned)
        states.append([one.state for one in follow(moments(1.5, change), sigma=0.5, seed=5)[14::15]])
    for before, after in zip(*states, strict=True):
        found = (after.mean - before.mean)[0, :4] / 1e-5
        expected = before.heading_sensitivity[0, :4, 3]
        torch.testing.assert_close(found, expected, rtol=0.1, atol=0.02)
        assert expected.abs().max() > 0.2


def test_after_a_lane_change_the_columns_of_a_sensitivity_are_those_of_the_same_boundaries():
    by_headings = torch.arange(12, dtype=DOUBLE).reshape(1, 2, 6).expand(2, -1, -1)
    found = shifted(by_headings, torch.tensor([1.0, -1.0], dtype=DOUBLE))
    assert found[0].tolist() == [[1, 2, 3, 4, 5, 0], [7, 8, 9, 10, 11, 0]]
    assert found[1].tolist() == [[0, 0, 1, 2, 3, 4], [0, 6, 7, 8, 9, 10]]


def moments_of(squares, freedom, found=(0.0,) * 6, noise=0.0):
    """Moments (1, 2, 6 + 4) of one frame, the same for deviations and headings."""
    return torch.tensor([[[*found, squares, noise, freedom, 1.0]] * 2], dtype=DOUBLE)


def test_frames_that_tell_nothing_leave_the_moments_and_the_first_that_tells_counts_fully():
    tells, tells_nothing = moments_of(4e-4, 2.0), moments_of(0.0, 0.0)  # two boundaries fit parallel lanes
    now = torch.cat([tells, tells_nothing])
    step = torch.full((2,), ONE_FRAME, dtype=DOUBLE)
    first = averaged_moments(now, torch.zeros_like(now), step, 1.0)
    torch.testing.assert_close(scatter_variance(first)[0], scatter_variance(now)[0])
    assert (scatter_variance(first)[1] == 0).all()
    again = averaged_moments(now, first, step, 1.0)
    torch.testing.assert_close(scatter_variance(again)[0], scatter_variance(now)[0])
    later = averaged_moments(moments_of(0.0, 2.0), tells, torch.ones(1, dtype=DOUBLE), 1.0)
    torch.testing.assert_close(scatter_variance(later), math.exp(-1) * scatter_variance(tells))


def test_the_mean_of_the_estimates_tells_what_lasts_and_not_noise():
    """Estimates as noisy as large: squares less noise tell nothing, the mean tells the lasting part only."""
    own, std = torch.tensor([3.0, -1.0, -2.0, 0.0, 2.0, -2.0], dtype=DOUBLE) * 1e-3, 2e-3
    noises = std * torch.randn(400, 6, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    lasting = torch.zeros(1, 2, 10, dtype=DOUBLE)
    without = torch.zeros_like(lasting)
    step = torch.full((1,), ONE_FRAME, dtype=DOUBLE)
    for noise in noises:
        now = moments_of(0.0, 3.0, (own + noise).tolist(), 6 * std**2)
        lasting = averaged_moments(now, lasting, step, 1.0)
        now = moments_of(0.0, 3.0, noise.tolist(), 6 * std**2)
        without = averaged_moments(now, without, step, 1.0)
    frames = 2 / (1 - math.exp(-ONE_FRAME)) - 1  # as many equally weighted ones
    torch.testing.assert_close(lasting[0, :, 7], torch.full((2,), 6 * std**2 / frames, dtype=DOUBLE))
    found = scatter_variance(lasting)
    expected = scatter_variance(moments_of(own.square().sum().item(), 3.0))
    torch.testing.assert_close(found, expected, rtol=0.3, atol=0)
    assert (scatter_variance(without) == 0).all()


def test_after_a_lane_change_the_estimates_are_those_of_the_same_boundaries():
    now = moments_of(1e-4, 3.0, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)).expand(3, -1, -1)
    found = renumbered_moments(now, torch.tensor([0.0, 1.0, -1.0], dtype=DOUBLE))
    assert found[0].equal(now[0])
    assert found[1, 0, :6].tolist() == [2.0, 3.0, 4.0, 5.0, 6.0, 0.0]
    assert found[2, 1, :6].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert found[:, :, 6:].equal(now[:, :, 6:])


def test_few_degrees_of_freedom_enlarge_the_variance():
    few, many = (moments_of(1e-4 * n, n) for n in (1.0, 100.0))
    assert (scatter_variance(few) > 2 * scatter_variance(many)).all()
    assert scatter_variance(many).tolist() == [pytest.approx([1e-4, 1e-4], rel=0.03)]


def test_the_variance_of_a_start_decreases_with_time_and_with_degrees_of_freedom():
    """By e in two seconds, and by e² for each degree of freedom, of deviations and headings together."""
    now = torch.cat([moments_of(0.0, freedom) for freedom in (0.0, 0.25, 1.0)])
    two_seconds = torch.full((3,), 2.0, dtype=DOUBLE)
    later = averaged_moments(now, torch.zeros_like(now), two_seconds, 1.0)
    expected = torch.tensor([0.0, math.exp(-1 - 1), math.exp(-1 - 4)], dtype=DOUBLE)
    torch.testing.assert_close(start_variance(later, 0.003) / 0.003**2, expected)  # the first: no frame yet


def test_headings_smaller_than_the_noise_of_a_frame_are_found_in_a_second():
    """Of 3 mrad, seen with 2 px: in three of four drives, and the covariance contains the error."""
    headings = 3e-3 * torch.tensor([1.0, -0.5, -1.0, 1.5, -1.0, 0.0], dtype=DOUBLE)
    drive = moments(1.5, lambda t, m: replace(m, headings=headings, far=30.0))
    calibrator = JointCalibrator(start_heading_std=0.0)
    last = follow(drive, calibrator, rows=8, sigma=2.0, per_boundary=10, seed=3)[-1]
    found = scatter_variance(last.state.scatter)[:, 1].sqrt()
    assert (found > 1e-3).double().mean() >= 0.75
    assert (last.error.abs() < 3 * last.sigma).all()
    by_filter = last.state.cov[:, PITCH, PITCH]
    assert last.error[:, PITCH].square().mean() > 9 * by_filter.mean()  # which does not contain it


@pytest.mark.parametrize(
    ("visible", "least", "most"), [((0, 1, 2, 3, 4, 5), 1.0, 1.05), ((1, 2, 3), 1.25, 1.5)]
)
def test_a_start_with_few_boundaries_claims_less_and_one_with_all_as_much(visible, least, most):
    """Standard deviation of the pitch with what a start assumes, over that without."""
    [moment] = moments(ONE_FRAME, lambda t, m: replace(m, visible=visible))
    stds = []
    for config in (JointConfig(), JointConfig(start_heading_std=0.0)):
        [frame] = follow([moment], JointCalibrator(config), rows=4, seed=7)
        stds.append(frame.sigma[:, PITCH])
    ratio = stds[0] / stds[1]
    assert ((ratio >= least) & (ratio <= most)).all()


def test_boundaries_that_are_askew_may_be_out_of_place_where_nothing_shows_it():
    sensitivity = torch.zeros(2, 4, 6, dtype=DOUBLE)
    sensitivity[:, ROLL, 1:4] = torch.tensor([-0.05, 0.1, -0.05], dtype=DOUBLE)
    askew = torch.tensor([0.0, 0.01**2], dtype=DOUBLE)
    level = torch.zeros(2, dtype=DOUBLE)  # no roll: no line is odd
    found = unverified_deviation(sensitivity, torch.zeros(2, 6, dtype=DOUBLE), askew, level, CONFIG).sqrt()
    expected = torch.tensor([0.05, math.hypot(0.05, 0.15)], dtype=DOUBLE)
    torch.testing.assert_close(found, expected.unsqueeze(-1).expand(-1, 6))


def test_the_variance_of_an_improbable_roll_is_that_of_the_mixture_with_a_line_that_bounds_no_lane():
    """Against the mixture computed by quadrature: equal lanes and the camera's roll, or a line anywhere."""
    by_outer, prior, freedom = 0.08, CONFIG.prior.roll_std, CONFIG.prior.freedom
    by_place = by_outer * torch.tensor([[0.0, 0.0, 1.0, -2.0, 1.0, 0.0]], dtype=DOUBLE)
    grid = torch.linspace(-400.0, 400.0, 4_000_001, dtype=DOUBLE)
    shape = (1 + grid.square() / freedom) ** (-0.5 * (freedom + 1))
    norm = torch.trapezoid(shape, grid) * prior
    for roll in (0.01, 0.05, 0.15):
        density = (1 + (roll / prior) ** 2 / freedom) ** (-0.5 * (freedom + 1)) / norm * by_outer  # per m
        for misfit, share in ((False, 1 / 5), (True, 1 / 2)):
            odd = share / 3.6
            expected = odd / (odd + (1 - share) * density) * roll**2
            found = no_boundary_deviation(by_place, torch.tensor([roll]), torch.tensor([misfit]), CONFIG)
            assert (found * by_place.square()).sum().item() == pytest.approx(expected.item(), rel=1e-3)
            assert (found[0, 2:4] == 0.2 * found[0, 4]).all()  # the ego lane's boundaries
    assert (
        no_boundary_deviation(0 * by_place, torch.tensor([0.1]), torch.tensor([True]), CONFIG)
        .isfinite()
        .all()
    )
    every_line_bounds = JointConfig(no_boundary_odds=0.0)
    none = no_boundary_deviation(by_place, torch.tensor([0.1]), torch.tensor([True]), every_line_bounds)
    assert (none == 0).all()


def test_a_kerb_taken_for_a_boundary_beside_the_ego_lane_is_in_the_variance_of_roll_and_height():
    """Three lines fit some roll of equal lanes; the kerb is a metre from where a lane would end."""
    kerb = PLACES.clone()
    kerb[4] -= 1.0
    drive = moments(1.5, lambda t, m: replace(m, places=kerb, visible=(2, 3) if t < 0.5 else (2, 3, 4)))
    last = follow(drive)[-1]
    assert math.degrees(last.error[0, ROLL].abs()) > 3.0
    assert (last.error.abs() < 3 * last.sigma).all()


def after(drive, visible, seed=0, sigma=1.0):
    """The last frame of a drive of which only these boundaries are in view."""
    return follow([replace(one, visible=visible) for one in drive], sigma=sigma, seed=seed)[-1]


def test_two_boundaries_determine_how_headings_change_the_other_parameters():
    determined = torch.tensor([[True] * 4, [True, True, False, True], [True, False, False, True]])
    found = determined_sensitivity(determined, 2)
    assert found[0].all()
    assert not found[2].any()
    columns = [False, False, True, True]  # deviations, headings
    assert found[1].tolist() == [columns, columns, [False] * 4, columns]


def test_headings_of_the_ego_lane_s_boundaries_turn_pitch_and_yaw():
    """Lines that meet at a depth of w / Δη have a vanishing point lower by h Δη / w."""
    last = after(moments(0.5), (2, 3))
    by_headings = last.state.heading_sensitivity[0, :2]
    ratio = last.moment.pose[3] / WIDTH
    assert by_headings[0, 2:4].abs().tolist() == [pytest.approx(ratio, rel=0.05)] * 2
    assert by_headings[0, 2:4].sum().abs() < 0.05 * ratio  # equal headings are no pitch
    assert by_headings[1, 2:4].abs().sum().item() == pytest.approx(1.0, rel=0.15)
    assert (by_headings[:, [0, 1, 4, 5]] == 0).all()


def test_a_vertical_curvature_that_two_boundaries_show_may_be_their_own_curvatures():
    """Their scatter is noise; that of six boundaries tells their headings, and a hill nothing of them."""
    of_two, of_six = (after(moments(0.2), visible) for visible in ((2, 3), (0, 1, 2, 3, 4, 5)))
    width, scatter = torch.tensor([WIDTH], dtype=DOUBLE), torch.tensor([0.002**2], dtype=DOUBLE)
    nothing = torch.zeros(1, 2, dtype=DOUBLE)
    for curvature in (0.0, 1e-4):
        expected = 37.0 * curvature * WIDTH / 2 / of_two.moment.pose[3]
        hills = torch.tensor([curvature**2], dtype=DOUBLE)
        by_frames = 1e12 * torch.tensor([[1.0, curvature]], dtype=DOUBLE)
        for known in ({"hills": hills, "vertical": nothing}, {"vertical": by_frames}):
            state = of_two.state._replace(**known)
            found = heading_variance(state, scatter, wander_of_two(state, width), CONFIG).sqrt()
            assert found.item() == pytest.approx(expected, rel=0.02, abs=1e-6)
            state = of_six.state._replace(**known)
            found = heading_variance(state, scatter, wander_of_two(state, width), CONFIG).sqrt()
            assert found.item() == pytest.approx(0.002, rel=0.02)


def test_a_vertical_curvature_smaller_than_its_noise_is_none():
    information = torch.tensor([[1e8, 1e8 * 1.2e-4], [1e8, 1e8 * 2e-4], [0.0, 0.0]], dtype=DOUBLE)
    found = vertical_moment(information)  # the sigma of 1e8 m² is 1e-4/m
    assert found.tolist() == [0.0, pytest.approx(2.13e-8, rel=0.01), 0.0]


@pytest.mark.parametrize("sharpness", [-1e-4, 1e-4])
def test_the_vertical_curvature_of_two_boundaries_is_found_without_the_prior_of_a_plane_road(sharpness):
    """The filter takes the road as plane at first; the sum over frames has the true curvature."""
    drive = moments(0.5, lambda t, m: replace(m, near=4.0, far=30.0, profile=sharpness))
    known, pull = after(drive, (2, 3), sigma=0.3).state.vertical[0].tolist()
    assert pull / known == pytest.approx(sharpness, abs=3 * known**-0.5 + 0.05 * abs(sharpness))


def ego_lane_of_a_street(seed, std, speed):
    """A second between two boundaries that wander."""
    aside = wandering(seed, std)
    return moments(1.0, lambda t, m: replace(m, near=4.0, far=30.0, wander=lambda z: aside(z + speed * t)))


def test_the_ego_lane_of_a_street_is_less_sure_than_that_of_parallel_boundaries():
    """Squares of the error of pitch in standard deviations; the boundaries of the streets wander by 5 cm."""
    squares, of_filter, added = [], [], []
    for seed in range(8):
        street = after(ego_lane_of_a_street(seed, 0.05, 8.0), (2, 3), seed)
        error = street.error[0, PITCH].square()
        squares.append((error / street.sigma[0, PITCH].square()).item())
        of_filter.append((error / street.state.cov[0, PITCH, PITCH]).item())
        parallel = after(moments(1.0, lambda t, m: replace(m, near=4.0, far=30.0)), (2, 3), seed)
        added.append((parallel.sigma[0, PITCH].square() / parallel.state.cov[0, PITCH, PITCH]).item())
    assert sum(squares) < 0.35 * sum(of_filter)
    assert sorted(added)[5] < 1.01  # a fifth of all show a vertical curvature by chance


@pytest.mark.parametrize("speed", [0.0, 8.0])
def test_ego_lanes_of_streets_are_as_far_off_as_they_say(speed):
    """Squares of the errors in standard deviations between boundaries that wander by 15 cm."""
    squares, of_filter = [], []
    for seed in range(8):
        street = after(ego_lane_of_a_street(seed, 0.15, speed), (2, 3), seed)
        squares.append((street.error / street.sigma)[0].square())
        of_filter.append(street.error[0].square() / street.state.cov[0].diagonal()[:4])
    outside, outside_filter = ((torch.stack(each) > 9.0).sum(0) for each in (squares, of_filter))
    assert (outside <= 1).all()  # in one drive of eight the curvatures are equal by chance
    assert (outside_filter[[0, 1]] >= 4).all()


@pytest.mark.parametrize("speed", [0.0, 8.0])
def test_the_covariance_contains_the_boundaries_of_a_street_that_wander(speed):
    """From the first frame on, and while the car stands: the same frames again tell nothing new."""

    def change(aside, t, moment):
        there = replace(moment, near=4.0, far=30.0, visible=(0, 1, 2, 3, 4))
        return replace(there, wander=lambda z: aside(z + speed * t))

    nees, nees_of_filter = [], []
    for seed in range(5):
        for frame in follow(moments(0.5, partial(change, wandering(seed, 0.1))), seed=seed):
            error = frame.error
            for covariance, found in (
                (frame.calibration.covariance, nees),
                (frame.state.cov[:, :4, :4], nees_of_filter),
            ):
                found.append((error @ torch.linalg.inv(covariance[0]) @ error.T).item() / 4)
    assert 0.2 < sum(nees) / len(nees) < 3.0
    assert sum(nees_of_filter) / len(nees_of_filter) > 30.0


def test_skipped_and_unsupported_frames_keep_the_scatter_and_rows_are_independent():
    aside = wandering(1, 0.1)
    drive = moments(0.4, lambda t, m: replace(m, near=4.0, far=30.0, wander=lambda z: aside(z + 8.0 * t)))
    calibrator = JointCalibrator()
    state, alone = (calibrator.initial_state(rows, dtype=DOUBLE) for rows in (3, 1))
    for moment, segments in see(drive, 3, 1.0, 20, 0, DOUBLE):
        _, state = calibrator(segments, CAMERA.expand(3, 3, 3), state, moment.dt, WIDTH)
        first = LaneSegments(*(part[:1] for part in segments))
        _, alone = calibrator(first, CAMERA[None], alone, moment.dt, WIDTH)
    assert (state.scatter[..., 6] > 0).all()
    torch.testing.assert_close(state.scatter[:1], alone.scatter, rtol=1e-9, atol=0)
    nothing = segments._replace(weight=torch.zeros_like(segments.weight))
    _, unsupported = calibrator(nothing, CAMERA.expand(3, 3, 3), state, 1 / 30, WIDTH)
    _, skipped = calibrator(segments, CAMERA.expand(3, 3, 3), state, 0.0, WIDTH)
    for after in (unsupported, skipped):
        assert (after.scatter == state.scatter).all()
        assert (after.pose_sensitivity == state.pose_sensitivity).all()
    assert (skipped.heading_sensitivity == state.heading_sensitivity).all()


@pytest.mark.parametrize(("visible", "roll"), [((1, 2, 3), 1.0), ((2, 3, 4), -2.0), ((1, 2, 3, 4), 1.0)])
def test_a_detectors_factor_is_not_applied_to_the_prior_of_roads(visible, roll):
    """Two lanes do not show whether they are equal; four boundaries do."""
    drive = moments(1.0, lambda t, m: replace(m, visible=visible, far=40.0, pose=_rolled(m.pose, roll)))
    state = CALIBRATOR.initial_state(1, DOUBLE)
    for _, seen in see(drive, 1, 1.0, 12, 4, DOUBLE):
        out, state = CALIBRATOR(seen, CAMERA[None], state, ONE_FRAME, WIDTH)
    scaled, every = CALIBRATOR.scale_drive(out, state, 2.25), out.with_std_scaled(2.25)
    assert torch.linalg.eigvalsh(scaled.covariance - out.covariance).min() > 0
    less = every.covariance - scaled.covariance
    assert torch.linalg.eigvalsh(less).min() > -1e-15
    of_roll, of_all = (each.covariance[0, ROLL, ROLL].sqrt() for each in (scaled, every))
    if len(visible) == 3:
        assert of_roll < 0.6 * of_all
    else:
        assert of_roll == pytest.approx(float(of_all), rel=5e-3)  # a crown is improbable by now
    assert scaled.covariance[0, PITCH, PITCH] > 0.95 * every.covariance[0, PITCH, PITCH]
    same = CALIBRATOR.scale_drive(out, state, 1.0)
    assert torch.equal(same.covariance, out.covariance)
    assert torch.equal(scaled.extrinsics.stack(), out.extrinsics.stack())


def _rolled(pose, degrees):
    pitch, yaw, roll, height = pose
    return (pitch, yaw, roll + math.radians(degrees), height)


def test_the_roll_of_a_mount_is_found_with_two_lanes_in_view():
    """A frame's standard deviation must be small enough for the mount estimate, with a network's factor."""
    drive = moments(2.0, lambda t, m: replace(m, visible=(1, 2, 3), far=40.0, pose=_rolled(m.pose, 1.0)))
    state = CALIBRATOR.initial_state(1, DOUBLE)
    for _, seen in see(drive, 1, 1.0, 12, 4, DOUBLE):
        out, state = CALIBRATOR(seen, CAMERA[None], state, ONE_FRAME, WIDTH)
    largest = MountConfig().largest_std[ROLL]
    assert CALIBRATOR.scale_drive(out, state, 2.25).covariance[0, ROLL, ROLL].sqrt() < largest
    assert out.with_std_scaled(2.25).covariance[0, ROLL, ROLL].sqrt() > largest
