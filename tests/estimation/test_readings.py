"""Single images read in many ways: how much an answer leans on one of them is in its sigmas."""

import math
from dataclasses import replace

import pytest
import torch

from lanebev import JointCalibrator, LaneSegments, Status
from lanebev.estimation.joint.config import ReadingConfig
from lanebev.estimation.joint.frame.averaging import distance, mixture_moments, window
from lanebev.estimation.joint.frame.readings import log_prior, log_prior_of_half, readings
from lanebev.estimation.joint.frame.single_frame import fit_single_frame
from lanebev.estimation.still import calibrate_still
from lanebev.testing.moments import CAMERA, Moment, observe
from lanebev.testing.segments import INTRINSICS, POSE, lanes, no_lanes, stack_rows

DOUBLE = torch.float64


def still(segments, width=3.7, intrinsics=INTRINSICS, **numbers):
    rows = len(segments.weight)
    calibrator = JointCalibrator(**numbers)
    return calibrate_still(calibrator, segments, intrinsics.expand(rows, 3, 3), width)


def sigmas(calibration):
    return calibration.covariance.diagonal(dim1=1, dim2=2).sqrt()


def street(count, seed):
    """Stills of streets: lanes 0.3 m apart in width, lines 0.6 degrees in direction.

    40 % have a line up to 2 m and some degrees off, which bounds no lane.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*size):
        return torch.randn(*size, generator=generator, dtype=DOUBLE)

    def uniform():
        return float(torch.rand(1, generator=generator))

    rows, poses = [], []
    for _ in range(count):
        edges = torch.cat([torch.zeros(1, dtype=DOUBLE), (3.5 + 0.3 * normal(5)).clamp(2.5, 5.0).cumsum(0)])
        places, headings = edges - (edges[2] + edges[3]) / 2, 0.01 * normal(6)
        visible = tuple(range(int(3 * uniform()), 4 + int(3 * uniform())))
        if uniform() < 0.4:
            line = visible[int(uniform() * len(visible))]
            places[line] += 4.0 * uniform() - 2.0
            headings[line] += 0.05 * float(normal(1))
        spread = torch.tensor([0.035, 0.035, 0.017, 0.15], dtype=DOUBLE)
        pose = torch.tensor([0.0, 0.0, 0.0, 1.5], dtype=DOUBLE) + spread * normal(4)
        moment = Moment(
            tuple(pose.tolist()),
            0.4 * float(normal(1)),
            places,
            headings,
            visible=visible,
            near=4.0,
            far=45.0,
        )
        rows.append(
            next(observe([replace(moment, outliers=0.1)], 1, 2.0, 8, int(1e6 * uniform()), DOUBLE))[1]
        )
        poses.append(pose)
    return stack_rows(*rows), torch.stack(poses)


@pytest.mark.slow
def test_streets_are_within_three_sigma():
    segments, truth = street(80, 2)
    found = still(segments, 3.5, CAMERA, lane_width_std=0.15)  # of the mean of a street's lanes
    begun = found.status == int(Status.TRACKING)
    assert begun.double().mean() > 0.9
    error = (found.extrinsics.stack() - truth)[begun].abs()
    assert (error <= 3 * sigmas(found)[begun]).double().mean() >= 0.95
    best = fit_single_frame(segments, CAMERA.expand(80, 3, 3), 3.5)  # the likeliest reading, if it is right
    error = (best.extrinsics.stack() - truth)[begun].abs()
    assert (error <= 3 * sigmas(best)[begun, :4]).double().mean() < 0.7


class Best(JointCalibrator):
    """Takes the likeliest reading."""

    def weigh_still(self, calibration, *_):
        return calibration


@pytest.mark.slow
def test_equal_lanes_stay_as_sharp_as_they_are():
    truth = torch.tensor(POSE, dtype=DOUBLE)
    segments = stack_rows(*(lanes(per=24, noise=1.0, seed=seed) for seed in range(60)))
    found, rows = still(segments), 60
    error = found.extrinsics.stack() - truth
    nees = (error * torch.linalg.solve(found.covariance, error)).sum(-1).mean() / 4
    assert 0.7 < nees < 1.3
    best = calibrate_still(Best(), segments, INTRINSICS.expand(rows, 3, 3), 3.7)
    ratio = error.square().mean(0) / (best.extrinsics.stack() - truth).square().mean(0)
    assert (ratio < 1.1).all()


def test_three_boundaries_leave_roll_to_the_prior_of_the_lane_widths():
    """With three lines any widths fit: the roll is as doubtful as the widths are unequal."""
    three, six = still(lanes(boundaries=(1, 2, 3))), still(lanes())
    assert sigmas(three)[0, 2].rad2deg() > 0.5
    assert sigmas(six)[0, 2].rad2deg() < 0.15


def test_height_leans_on_the_width_of_the_ego_lane():
    """One lane tells nothing of how wide it is: 0.4 m of 3.7, in part of the readings."""
    found = still(lanes(boundaries=(2, 3)))
    assert 0.05 < sigmas(found)[0, 3] / POSE[3] < 0.2


def test_an_arrow_in_every_lane_may_be_what_halves_the_lanes():
    """Lines half a lane apart: the image of a camera at twice the height."""
    doubled = (*POSE[:3], 2 * POSE[3])
    found = still(lanes(doubled))
    height, sigma = float(found.extrinsics.height), float(sigmas(found)[0, 3])
    assert sigma > 0.4
    assert abs(height - POSE[3]) < 3 * sigma
    assert abs(height - doubled[3]) < 3 * sigma
    usual = still(lanes())
    assert sigmas(usual)[0, 3] < 0.03  # a camera at 0.7 m is not likely


def test_a_line_that_bounds_no_lane():
    segments = lanes()
    fake = segments.boundary == 4
    moved = lanes(offset=1.3).endpoints  # a metre to the side
    segments = segments._replace(endpoints=torch.where(fake[..., None, None], moved, segments.endpoints))
    found = still(segments)
    error = (found.extrinsics.stack()[0] - torch.tensor(POSE)).abs()
    assert (error <= 3 * sigmas(found)[0]).all()
    assert found.inliers[0][fake[0]].max() < 0.2
    assert found.inliers[0][~fake[0]].mean() > 0.7


def test_rows_do_not_touch_and_what_has_not_begun_stays():
    one, other, none = lanes(seed=1), lanes((-0.02, 0.01, 0.0, 1.7), (1, 2, 3), seed=2), no_lanes()
    together = still(stack_rows(one, none, other))
    assert together.status.tolist() == [1, 0, 1]
    for row, alone in ((0, still(one)), (2, still(other))):
        assert torch.allclose(together.extrinsics.stack()[row], alone.extrinsics.stack()[0], atol=1e-7)
        assert torch.allclose(together.covariance[row], alone.covariance[0], rtol=1e-4, atol=1e-12)
    nothing = JointCalibrator().initial_state(1, dtype=DOUBLE).mean[0, :4]
    assert torch.equal(together.extrinsics.stack()[1], nothing)


def test_moments_of_a_mixture():
    mean = torch.tensor([[[0.0, 1.0], [2.0, 1.0]]], dtype=DOUBLE)
    cov = torch.eye(2, dtype=DOUBLE).expand(1, 2, 2, 2)
    total, spread = mixture_moments(mean, cov, torch.tensor([[0.25, 0.75]], dtype=DOUBLE))
    assert total.tolist() == [[1.5, 1.0]]
    assert spread[0].tolist() == [[1.75, 0.0], [0.0, 1.0]]


def test_occams_window():
    weight = window(torch.tensor([[0.0, math.log(0.5), math.log(0.01)]], dtype=DOUBLE), 0.05)
    assert weight[0].tolist() == pytest.approx([2 / 3, 1 / 3, 0.0])


def test_readings_close_up_beyond_a_wrong_line():
    ways = readings(6, ReadingConfig(), torch.zeros((), dtype=DOUBLE))
    closes = (ways.shift != 0).any(-1)
    arrow = ways.shift[closes & ways.wrong[:, 3]][0]
    assert arrow.tolist() == [0, 0, 0, 0, -1, -1]
    left = ways.shift[closes & ways.wrong[:, 1]][0]
    assert left.tolist() == [1, 0, 0, 0, 0, 0]
    assert not ways.wrong[: len(ReadingConfig().deviation_std)].any()


def test_priors_of_what_is_not_there():
    cfg = ReadingConfig(no_boundary_probability=0.2, another_probability=0.5, kind_probability=(0.25,) * 4)
    ways = readings(6, cfg, torch.zeros((), dtype=DOUBLE))
    there = torch.tensor([[False, False, True, True, True, True]])
    prior = log_prior(ways, there, cfg)[0]
    wrong = ways.wrong.any(-1)
    assert torch.equal(prior.isinf(), ways.wrong[:, :2].any(-1))
    assert prior[~wrong].exp().unique().tolist() == pytest.approx([0.2])
    assert log_prior_of_half(there, cfg).exp().tolist() == pytest.approx([0.1])


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"deviation_std": (0.1,)}, "kind_probability: expected as many of each, got 1, 4, 4, 4"),
        ({"no_boundary_std": (0.0, 0.1)}, "expected positive numbers"),
        ({"least_weight": 0.0}, "least_weight: expected more than 0 and at most 1, got 0"),
    ],
)
def test_a_bad_config(numbers, message):
    with pytest.raises(ValueError, match=message):
        ReadingConfig(**numbers)


def test_gradients_flow():
    segments = lanes(per=4)
    ends = segments.endpoints.clone().requires_grad_(True)
    found = still(LaneSegments(ends, *segments[1:]))
    found.extrinsics.stack().sum().backward()
    assert ends.grad.isfinite().all()
    assert ends.grad.abs().max() > 0


def test_distance_is_in_sigmas():
    cov = torch.diag(torch.tensor([4.0, 9.0], dtype=DOUBLE))[None]
    assert float(distance(torch.tensor([[2.0, 3.0]], dtype=DOUBLE), cov)) == pytest.approx(1.0)


def test_where_readings_agree_the_likeliest_stands():
    segments = lanes()
    best = calibrate_still(Best(), segments, INTRINSICS[None], 3.7)
    assert torch.allclose(still(segments).extrinsics.stack(), best.extrinsics.stack(), atol=1e-12)
