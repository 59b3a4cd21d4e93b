"""Starts of the joint filter from one frame's fit: straight roads and bends."""

import math
from dataclasses import replace

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.filter.start import start_moments
from lanebev.estimation.joint.frame.bends import straight_or_bend
from lanebev.estimation.joint.layout import STEPS
from lanebev.estimation.joint.measurement.residuals import CURVATURE
from lanebev.estimation.joint.measurement.road_curve import KNOT_SPACING, NUM_STEPS
from lanebev.testing.moments import WIDTH, moments
from lanebev.testing.moments import observe as see
from lanebev.types import Status
from tests.estimation.joint_drives import DOUBLE, cameras, nothing, run

torch.set_num_threads(1)
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
    mean, spread, _ = straight_or_bend(params, cov, STRAIGHT, BEND, 0.2)
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
    mean, spread, _ = straight_or_bend(params, cov, STRAIGHT, BEND, 0.2)
    assert (mean[0, 1] - params[0, 1]) / (3e-5 * 15) == pytest.approx(3e-5**2 / (3e-5**2 + 1e-4**2), rel=0.05)
    assert spread[0, 1, 1] < cov[0, 1, 1]
    params, cov = fitted_bend((2e-3, 0.0), (3e-5, 1e-6))
    mean, spread, _ = straight_or_bend(params, cov, STRAIGHT, BEND, 0.2)
    torch.testing.assert_close(mean, params)
    torch.testing.assert_close(spread, cov)
    params, cov = fitted_bend((5e-4, 2e-6), (2e-4, 4e-6))
    exact = straight_or_bend(params, cov, STRAIGHT, BEND, 0.2)
    single = straight_or_bend(params.float(), cov.float(), STRAIGHT.float(), BEND.float(), 0.2)
    for got, expected in zip(single, exact, strict=True):
        torch.testing.assert_close(got.double(), expected, rtol=1e-3, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("crown", "least"), [(0.0, 0.5), (0.04, 0.4)])
@pytest.mark.parametrize("radius", [math.inf, 2000.0, 1000.0, 500.0])
def test_single_images_of_bends_with_vague_lines_are_honest(radius, crown, least):
    """Four boundaries to 40 m at 2.5 px: whether R = 1,000 m is a bend cannot be told for sure.

    Such a frame does not show either that the road has no crown, unless the calibrator is told so.
    """
    calibrator = JointCalibrator(crossfall_break_std=crown)
    visible, bent = (1, 2, 3, 4), lambda z: torch.full_like(z, 1 / radius)
    errors = []
    for seed, moment in enumerate(moments(2.0)[3::20]):
        moment = replace(moment, visible=visible, far=40.0, curvature=bent)
        frames = list(see([moment], 60, 2.5, 8, seed, DOUBLE))
        out, _ = run(calibrator, frames)
        error = out.extrinsics.stack() - torch.tensor(moment.pose, dtype=DOUBLE)
        errors.append((error * torch.linalg.solve(out.covariance, error)).sum(-1) / 4)
    assert least < torch.cat(errors).mean() < 2.0


def test_a_clothoids_steps_are_its_rate_by_the_knots_spacing():
    calibrator = JointCalibrator()
    params = torch.tensor([[0.0, 0, 0, 1.5, 0, 2e-3, 1e-4]], dtype=DOUBLE)
    mean, _ = start_moments(params, 1e-12 * torch.eye(7, dtype=DOUBLE)[None], 0 * params, calibrator.config)
    torch.testing.assert_close(mean[:, CURVATURE], params[:, 5])
    torch.testing.assert_close(mean[0, STEPS], torch.full((NUM_STEPS,), 1e-4 * KNOT_SPACING, dtype=DOUBLE))


def test_frames_that_tell_nothing_do_not_end_a_contradiction():
    """A start whose second line is named wrongly is 10 deg off in roll until frames have contradicted it."""
    still = lambda t: (0.03, -0.02, 0.01, 1.5)  # noqa: E731
    in_view = [(1, 2), *[(1, 2, 3)] * 2, (1,), (2,), *[(1, 2, 3)] * 8]
    change = lambda t, moment: replace(moment, visible=in_view[round(30 * t)])  # noqa: E731
    drive = moments(len(in_view) / 30, change, still)
    frames = [segments for _, segments in see(drive, 3, 1.0, 12, 0, DOUBLE)]
    frames[0] = frames[0]._replace(boundary=torch.where(frames[0].boundary == 2, 5, frames[0].boundary))
    frames[4] = nothing(frames[4])
    calibrator = JointCalibrator()
    state, outs = calibrator.initial_state(3, dtype=DOUBLE), []
    for segments in frames:
        out, state = calibrator(segments, cameras(3), state, 1 / 30, WIDTH)
        outs.append(out)
    wrong = [(out.extrinsics.roll - 0.01).abs() / out.covariance[:, 2, 2].sqrt() for out in outs]
    assert (outs[2].extrinsics.roll < -0.1).all()  # the wrong start
    for k in (2, 3, 4):
        assert (outs[k].status == Status.COASTING).all()
        assert (wrong[k] < 3).all()
    assert (outs[-1].status == Status.TRACKING).all()
    assert (wrong[-1] < 3).all()
    assert (outs[-1].extrinsics.roll > -0.01).all()
