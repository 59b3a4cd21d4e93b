"""Departures of the road from the model of the two-stage calibrator, and their part in its covariance."""

import math
from dataclasses import replace

import pytest
import torch

from lanebev import TwoStageCalibrator
from lanebev.estimation.two_stage import departures as dep
from lanebev.testing.moments import CAMERA, PLACES, WIDTH, moments, observe
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import lanes
from tools.bench_kinds import drawn, figures_of

DOUBLE = torch.float64
AXES = [0, 1, 4, 5]  # pitch, yaw, roll and height among the rows of the sensitivity
EGO_LANE = (2, 3)


def t(*values):
    return torch.tensor(values, dtype=DOUBLE)


def follow(visible=(0, 1, 2, 3, 4, 5), frames=20, sigma=1e-3, **change):
    """Pose (4,), state and calibration after a drive almost without noise, whose segments claim 1 px."""
    drive = moments(frames / 30, lambda _, m: replace(m, near=5.0, far=40.0, visible=visible, **change))
    calibrator = TwoStageCalibrator()
    state = calibrator.initial_state(1, dtype=DOUBLE)
    with torch.inference_mode():
        for _, segments in observe(drive, 1, sigma, 12, 0, DOUBLE):
            segments = segments._replace(sigma=torch.ones_like(segments.sigma))
            calibration, state = calibrator(segments, CAMERA[None], state, 1 / 30, WIDTH)
    return calibration.extrinsics.stack()[0], state, calibration


def one_of_six(index, size):
    return size * torch.nn.functional.one_hot(torch.tensor(index), 6).to(DOUBLE)


DEPARTURES = {
    "curvature": (0, 2e-5, lambda b: {"curvature": lambda z: torch.full_like(z, b)}),
    "vertical curvature": (1, 1e-5, lambda b: {"profile": b}),
    "heading, left": (2 + 1, 5e-4, lambda b: {"headings": one_of_six(1, b)}),
    "heading, right": (2 + 3, 5e-4, lambda b: {"headings": one_of_six(3, b)}),
    "deviation, left": (8 + 1, 5e-3, lambda b: {"places": PLACES + one_of_six(1, b)}),
    "deviation, right": (8 + 4, 5e-3, lambda b: {"places": PLACES + one_of_six(4, b)}),
}


@pytest.mark.parametrize("visible", [(0, 1, 2, 3, 4, 5), (1, 2, 3)])
@pytest.mark.parametrize("kind", DEPARTURES)
def test_the_sensitivity_is_the_change_of_the_pose_by_a_departure(kind, visible):
    """The calibrator itself on a road with the departure and on one without."""
    column, size, change = DEPARTURES[kind]
    straight, state, _ = follow(visible)
    moved, _, _ = follow(visible, **change(size))
    said = state.sensitivity[0, AXES, column]
    found = (moved - straight) / size
    largest = t(20.0, 20.0, 20.0, 100.0) if column < 2 else t(1.0, 1.0, 1.0, 3.0)
    if column - 8 not in visible and column - 2 not in visible and column >= 2:
        assert said.abs().max() == 0
    assert ((found - said).abs() < 0.05 * said.abs() + 0.03 * largest).all(), (found, said)


def test_the_error_of_an_unseen_roll_is_in_the_height():
    pose = (0.0, 0.0, 0.02, 1.5)
    _, _, calibration = follow(EGO_LANE, pose=pose, offset=-0.6)
    upright, state, _ = follow(EGO_LANE, pose=(0.0, 0.0, 0.0, 1.5), offset=-0.6)
    error = calibration.extrinsics.height[0] - 1.5
    assert abs(error) > 0.01
    assert float(error) == pytest.approx(-0.02 * float(state.sensitivity[0, 5, -1]), rel=0.1)
    assert float(upright[3]) == pytest.approx(1.5, abs=1e-4)
    assert float(error**2 / calibration.covariance[0, 3, 3]) < 1


def test_road_distances_by_hand():
    rays = t([[[[0.3, 0.1, 1.0], [0.0, -0.1, 1.0]]]]).view(1, 1, 2, 3)
    found = dep.road_distances(rays, torch.eye(3, dtype=DOUBLE)[None], t(1.5))
    assert found.flatten().tolist() == pytest.approx([15.0, 200.0])  # the second is over the horizon


def test_feet_lie_on_a_line_through_the_vanishing_point_and_are_the_nearest():
    rays = t([[[[0.2, 0.1, 1.0], [0.4, 0.2002, 1.0]]]]).view(1, 1, 2, 3)
    ahead = t([0.0, 0.0, 1.0])
    residual = 0.2 * t(0.2002) - 0.4 * t(0.1)
    feet = dep.foot_points(rays, ahead, residual.view(1, 1), t([1.0]))
    first, second = feet[0, 0]
    assert abs(first[0] * second[1] - first[1] * second[0]) < 1e-8
    moved = (feet - rays)[0, 0, :, :2]
    along = t([0.4, 0.2002], [0.2, 0.1])  # each end along its line through the other's vanishing ray
    assert (moved * along).sum(-1).tolist() == pytest.approx([0.0, 0.0], abs=1e-12)
    wild = dep.foot_points(rays, ahead, residual.view(1, 1), t([1e-14]))
    assert (wild - rays).abs().max() < 0.1 * moved.abs().max()  # noise does not explain this residual


def test_noise_does_not_look_like_a_curved_road():
    """Mean and spread of single frames' estimates in units of their sigmas, on a straight road."""
    drive = moments(1.0, lambda _, m: replace(m, near=5.0, far=40.0))
    calibrator = TwoStageCalibrator(departure_memory=1e-4)  # every frame for itself
    state, scores = calibrator.initial_state(24, dtype=DOUBLE), []
    with torch.inference_mode():
        for _, segments in observe(drive, 24, 1.0, 20, 1, DOUBLE):
            _, state = calibrator(segments, CAMERA.expand(24, 3, 3), state, 1 / 30, WIDTH)
            cov = torch.linalg.inv(state.shape[..., :2])
            scores.append((cov @ state.shape[..., 2:]).squeeze(-1) / cov.diagonal(dim1=1, dim2=2).sqrt())
    score = torch.stack(scores[3:])
    assert (score.mean((0, 1)).abs() < 0.1).all()  # of 648: 2.5 sigmas. At the end points themselves 0.2
    assert ((score.std((0, 1)) - 1).abs() < 0.1).all()


def linear_frames(headings, noise, seed, num=6, each=10):
    """Information on two shared parameters and the headings, in a linear model with known truth."""
    generator = torch.Generator().manual_seed(seed)
    rows = headings.shape[0]
    shared = torch.randn(1, num, each, 2, generator=generator, dtype=DOUBLE)
    own = 1 + torch.rand(1, num, each, generator=generator, dtype=DOUBLE)
    error = noise * torch.randn(rows, num, each, generator=generator, dtype=DOUBLE)
    shared = shared.mean(2, keepdim=True) * own.unsqueeze(-1)  # as on a line through the vanishing point
    measured = own * headings.unsqueeze(-1) + error
    columns = torch.cat([shared, own.unsqueeze(-1) * torch.eye(num, dtype=DOUBLE)[:, None]], dim=-1)
    columns = columns.flatten(1, 2).expand(rows, -1, -1) / noise
    matrix = columns.mT @ columns
    return matrix, (columns.mT @ measured.flatten(1).unsqueeze(-1) / noise).squeeze(-1)


@pytest.mark.parametrize("size", [0.0, 0.003, 0.03])
def test_the_variance_of_the_boundaries_own_headings_is_found(size):
    headings = size * torch.randn(4000, 6, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    squares, share, freedom, weight = dep.boundary_moments(*linear_frames(headings, 0.02, 1), 2, 6).mT
    assert (weight == 1).all()
    noise = 0.02**2 / 10 / (7 / 3) * float(share[0])  # of a mean of ten, with E own² = 7/3
    left = 0.5 * noise  # one and a half times the noise is subtracted
    assert float(squares.mean()) == pytest.approx(size**2 * float(share[0]) - left, rel=0.1, abs=0.3 * noise)
    assert 3.0 < float(freedom[0]) <= 4.0  # six boundaries, two shared parameters


def test_two_boundaries_show_no_scatter_of_headings():
    headings = 0.03 * torch.randn(50, 2, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    matrix, vector = linear_frames(headings, 0.02, 1, num=2)
    _, share, freedom, _ = dep.boundary_moments(matrix, vector, 2, 2).mT
    assert share.max() < 1e-2
    assert freedom.max() < 0.1


def test_the_shape_is_that_of_a_fit_of_pitch_yaw_and_shape():
    """The Schur complement against the inverse of the whole matrix."""
    root = torch.randn(3, 10, 10, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    matrix, vector = root @ root.mT, root[:, 0]
    found = dep.shape_information(matrix, vector)
    prior = torch.diag(t(1.0, 1.0, 0.0, 0.0))
    cov = torch.linalg.inv(matrix[:, :4, :4] + prior)
    torch.testing.assert_close(torch.linalg.inv(found[..., :2]), cov[:, 2:, 2:])
    estimate = (cov @ vector[:, :4, None])[:, 2:]
    torch.testing.assert_close(torch.linalg.solve(found[..., :2], found[..., 2:]), estimate)


def test_the_mean_square_of_the_shape_is_its_estimate_s_without_the_noise():
    strong = t([[1e12, 0.0, 2e9], [0.0, 1e12, -1e8]])  # 2e-3 and -1e-4, each ± 1e-6
    assert dep.shape_moment(strong)[0].tolist() == pytest.approx([4e-6, 1e-8], rel=1e-3)
    weak = t([[1e6, 0.0, 9e2], [0.0, 1e8, 9e3]])  # 0.9 sigmas
    assert dep.shape_moment(weak)[0].tolist() == [0.0, 0.0]
    assert dep.shape_moment(torch.zeros(1, 2, 3, dtype=DOUBLE))[0].tolist() == [0.0, 0.0]


def test_a_sum_fades_and_unused_frames_change_nothing():
    before, now = t([4.0], [4.0]), t([1.0], [1.0])
    found = dep.faded_sum(now, before, t(math.log(2), math.log(2)), torch.tensor([True, False]), 1.0)
    assert found.flatten().tolist() == pytest.approx([3.0, 4.0])


def test_the_variance_of_a_boundary_by_hand():
    """Two frames with six squares of 1e-4 rad² and a share of 1.9 each; what they show not, half shown."""
    moments_ = t([[2e-4, 3.8, 3.6, 2.0], [-1.0, 0.0, 1.0, 2.0]])
    found = dep.boundary_variance(moments_, t([0.0, 4e-4]))[0]
    assert float(found[0]) == pytest.approx(1e-4 / 2.0 * (1 + 2 / 2.0))
    assert float(found[1]) == pytest.approx(4e-4 * math.sqrt(0.004))
    nothing = dep.boundary_variance(torch.zeros(1, 2, 4, dtype=DOUBLE), t([1e-6, 25e-4]))[0]
    assert nothing.tolist() == pytest.approx([1e-6, 25e-4])


def test_the_variance_where_nothing_is_shown_by_hand():
    """κ of 1e-4/m and a lane 3 m wide at a height of 1.5 m: boundaries' curvatures of 1e-4/m."""
    found = dep.unseen_variance(t([1.0, 1e-8]), t(1.0), t(0.01), 0.05)[0]
    assert found.tolist() == pytest.approx([(25.0 * 1e-4) ** 2, 0.0125])


def test_a_roll_that_no_camera_has_is_in_its_variance():
    by_deviation = t([0.0, 0.03, -0.06, 0.03, 0.0, 0.0]).expand(3, -1)
    roll = t(0.0, 0.05, 0.3)
    found = dep.no_boundary_deviation(by_deviation, roll, 0.05)
    of_roll = found * by_deviation.square().sum(-1)
    density = 20 * math.exp(-0.5) / math.sqrt(2 * math.pi) * 0.03  # 1/m, of the outer line's position
    odds = 0.25 / (3.6 * density)
    assert of_roll.tolist() == pytest.approx([0.0, odds / (1 + odds) * 0.05**2, 0.3**2], rel=1e-3)
    assert dep.no_boundary_deviation(torch.zeros(1, 6, dtype=DOUBLE), t(0.1), 0.05).tolist() == [0.0]


def test_the_covariance_is_that_of_independent_departures():
    sensitivity = torch.randn(2, 4, 15, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    found = dep.covariance_by_departures(
        sensitivity, t([1.0, 2.0]).expand(2, 2), t([3.0, 4.0]).expand(2, 2), t(5.0, 5.0)
    )
    variances = t(1.0, 2.0, *[3.0] * 6, *[4.0] * 6, 5.0)
    torch.testing.assert_close(found, sensitivity @ variances.diag() @ sensitivity.mT)


def test_the_pose_is_the_paper_s_and_a_straight_road_adds_almost_nothing():
    with_, without = TwoStageCalibrator(), TwoStageCalibrator(departures=False)
    a, b = (each.initial_state(16, dtype=DOUBLE) for each in (with_, without))
    drive = moments(1.0)
    with torch.inference_mode():
        for _, segments in observe(drive, 16, 1.0, 30, 0, DOUBLE):
            more, a = with_(segments, CAMERA.expand(16, 3, 3), a, 1 / 30, WIDTH)
            less, b = without(segments, CAMERA.expand(16, 3, 3), b, 1 / 30, WIDTH)
    assert torch.equal(more.extrinsics.stack(), less.extrinsics.stack())
    ratio = more.covariance.diagonal(dim1=1, dim2=2) / less.covariance.diagonal(dim1=1, dim2=2)
    assert (ratio >= 1).all()
    assert (ratio.mean(0) < 1.15).all()


def test_frames_without_lanes_keep_what_was_learnt():
    calibrator = TwoStageCalibrator()
    _, state, _ = follow(places=PLACES + t(0.1, -0.1, 0.0, 0.05, -0.1, 0.15))
    nothing = lanes()._replace(weight=torch.zeros_like(lanes().weight))
    _, after = calibrator(nothing, K[None], state, 1 / 30)
    assert torch.equal(after.scatter, state.scatter)
    assert torch.equal(after.shape, state.shape)
    torch.testing.assert_close(after.sensitivity[:, 4:6], state.sensitivity[:, 4:6], rtol=0.5, atol=0.05)
    assert after.sensitivity.isfinite().all()


HONEST = {  # largest NEES/dof, least within 3 sigma in the worst second, least NEES/dof of the filters alone
    "constant bend, R 300 m": (1.3, 0.97, 300),
    "crest or dip, R 5 to 20 km": (1.5, 0.95, 3),
    "lanes unequal by 10 cm": (1.5, 0.97, 50),
    "standing in a street, boundaries wander by 15 cm": (2.0, 0.95, 50),
    "motion up to 1.5°, 1.2 Hz, ego lane, roll drawn": (1.3, 0.97, 5),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", HONEST)
def test_errors_are_as_large_as_the_covariance_says_on_roads_that_the_model_does_not_describe(kind):
    most, within, alone = HONEST[kind]
    drives = [drive._replace(moments=()) for drive in drawn(kind, range(60_000, 60_006))]
    found = figures_of(drives, TwoStageCalibrator())
    assert found.nees < most
    assert found.within > within
    paper = figures_of(drives, TwoStageCalibrator(departures=False))
    assert paper.nees > alone
    assert paper.rmse == found.rmse
