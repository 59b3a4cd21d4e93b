"""The road's vertical curvature in the joint calibrator."""

import math
from dataclasses import replace

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import JointConfig, MotionConfig
from lanebev.estimation.joint.filter.evidence import hill_variance
from lanebev.estimation.joint.filter.start import with_roll_of_prior, with_vertical_curvature
from lanebev.estimation.joint.frame.single_frame import fit_single_frame
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.joint.layout import NUM_COMMON
from lanebev.estimation.joint.measurement.observations import boundary_places, observe
from lanebev.estimation.joint.measurement.residuals import HEIGHT, ROLL, VERTICAL, boundary_residuals, look
from lanebev.observation.segments import LaneSegments
from lanebev.testing.moments import CAMERA, FPS, WIDTH, Moment, moments
from lanebev.testing.moments import observe as see
from lanebev.types import Extrinsics
from tests.estimation.joint_drives import DOUBLE, follow, run

torch.set_num_threads(1)


def crest(
    vertical: float, frames: int = 1, rows: int = 2, sigma: float = 0.0, far: float = 40.0
) -> list[tuple[Moment, LaneSegments]]:
    """Return a drive over a crest, or through a dip, whose segments are given a sigma of 1 px at least."""
    drive = moments(frames / FPS, lambda t, m: replace(m, near=5.0, far=far, profile=vertical))
    seen = list(see(drive, rows, sigma, 20, 3, DOUBLE))
    return [(moment, one._replace(sigma=one.sigma.clamp(min=1.0))) for moment, one in seen]


@pytest.mark.parametrize("vertical", [3e-4, -3e-4])
def test_boundaries_over_a_crest_and_through_a_dip_are_exact(vertical):
    """No distance is left at the true vertical curvature, and some pixels are on a plane road."""
    moment, segments = crest(vertical, far=50.0)[0]
    seen = observe(segments, CAMERA.expand(2, 3, 3), 6)
    places = boundary_places(WIDTH, 6, seen.sigma).gather(1, seen.boundary)
    params = torch.zeros(2, NUM_COMMON, dtype=DOUBLE)
    params[:, :5] = torch.tensor([*moment.pose, moment.offset], dtype=DOUBLE)
    none = torch.zeros(2, dtype=DOUBLE)
    params[:, VERTICAL] = vertical
    found = boundary_residuals(params, places, seen, none)
    assert found.valid[seen.weight > 0].all()
    assert found.distance.abs().max() < 1e-3  # px; the drive's curves are polygons
    assert found.z.max() == pytest.approx(50.0, rel=0.1)
    params[:, VERTICAL] = 0.0
    assert boundary_residuals(params, places, seen, none).distance.abs().max() > 3.0


def test_the_road_behind_a_crest_is_not_seen():
    """Over R = 1 km from 1.5 m up the sight touches the road at 55 m; points count up to 0.8 of that."""
    z = torch.tensor([[20.0, 30.0], [35.0, 43.0], [30.0, 45.0]], dtype=DOUBLE)
    slopes = 1.5 / z + 0.5e-3 * z
    ends = torch.stack([torch.zeros_like(z), slopes], dim=-1) * 1050.0 + CAMERA[:2, 2]
    one = torch.ones(1, 3, dtype=DOUBLE)
    segments = LaneSegments(ends[None], torch.full((1, 3), 2), one, one)
    seen = observe(segments, CAMERA[None], 6)
    params = torch.zeros(1, NUM_COMMON, dtype=DOUBLE)
    params[:, HEIGHT], params[:, VERTICAL] = 1.5, 1e-3
    sight = look(params, seen, torch.zeros(1, dtype=DOUBLE))
    torch.testing.assert_close(sight.z[0, :5], z.mT.flatten()[:5])
    assert sight.valid.tolist() == [[True, True, False]]
    assert sight.z.isfinite().all()


def test_a_start_knows_how_a_crest_would_change_it():
    """The pose of a plane road, fitted to a crest, is off by the derivative times the curvature."""
    curvature = 1e-5
    moment, segments = crest(curvature)[0]
    fit = fit_single_frame(segments, CAMERA.expand(2, 3, 3), WIDTH)
    error = fit.extrinsics.stack() - torch.tensor(moment.pose, dtype=DOUBLE)
    pitch, height = (curvature * fit.by_vertical_curvature[:, [0, HEIGHT]]).unbind(-1)
    torch.testing.assert_close(error[:, 0], pitch, rtol=0.05, atol=0.0)
    torch.testing.assert_close(error[:, HEIGHT], height, rtol=0.05, atol=0.0)
    assert (pitch.abs() > math.radians(0.005)).all()


def test_the_vertical_curvature_of_a_start_is_correlated_with_the_error_that_it_causes():
    cov, by = torch.eye(3, dtype=DOUBLE)[None], torch.tensor([[2.0, 0.0, -1.0]], dtype=DOUBLE)
    found = with_vertical_curvature(cov, by, 0.5)[0]
    expected = [[2.0, 0, -0.5, -0.5], [0, 1, 0, 0], [-0.5, 0, 1.25, 0.25], [-0.5, 0, 0.25, 0.25]]
    torch.testing.assert_close(found, torch.tensor(expected, dtype=DOUBLE))


def test_the_roll_of_a_start_on_one_lane_is_the_priors_however_precise_the_lines():
    """Two lines have nothing to tell of roll, but with a noise of 0.1 px a crest would turn the fit far."""
    drive = moments(1 / FPS, lambda t, m: replace(m, near=4.0, far=60.0, visible=(2, 3)))
    (_, segments), *_ = see(drive, 8, 0.1, 20, 5, DOUBLE)
    fit = fit_single_frame(segments, CAMERA.expand(8, 3, 3), WIDTH)
    prior = JointConfig().prior
    by_crest = prior.vertical_curvature_std * fit.by_vertical_curvature[:, ROLL]
    assert (by_crest.abs() > 2 * prior.roll_std).any()
    params, cov, by_vertical = with_roll_of_prior(fit, prior)
    assert params[:, ROLL].tolist() == pytest.approx([prior.roll] * 8)
    assert cov[:, ROLL, ROLL].sqrt().tolist() == pytest.approx([prior.roll_std] * 8)
    torch.testing.assert_close(by_vertical[:, ROLL], torch.zeros(8, dtype=DOUBLE))
    _, state = run(JointCalibrator(), [(drive[0], segments)])
    assert (state.cov[:, ROLL, ROLL].sqrt() < 1.01 * prior.roll_std).all()


def test_a_start_keeps_what_a_lane_tells_of_the_other_parameters_given_roll():
    """Of the information, the prior replaces what is left about roll; a roll that the fit tells is kept."""
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(2, 7, 7, generator=generator, dtype=DOUBLE)
    information = root @ root.mT + torch.eye(7, dtype=DOUBLE)
    information[0] *= 1e4
    params = 0.1 * torch.randn(2, 7, generator=generator, dtype=DOUBLE)
    params[:, ROLL] = 0.1
    ((_, segments),) = crest(0.0)
    fit = fit_single_frame(segments, CAMERA.expand(2, 3, 3), WIDTH)._replace(
        extrinsics=Extrinsics.unstack(params[:, :4]),
        offset=params[:, 4],
        curvature=params[:, 5:],
        covariance=torch.linalg.inv(information),
    )
    prior = FramePrior(roll=0.02, roll_std=0.1)
    moved, cov, _ = with_roll_of_prior(fit, prior)
    torch.testing.assert_close(moved[0], params[0])
    torch.testing.assert_close(cov[0], fit.covariance[0])
    others = [k for k in range(7) if k != ROLL]
    of_others, across = information[1][others][:, others], information[1][others, ROLL]
    expected = information[1].clone()
    expected[ROLL, ROLL] = prior.roll_std**-2 + across @ torch.linalg.solve(of_others, across)
    torch.testing.assert_close(torch.linalg.inv(cov[1]), expected)
    by_roll = -torch.linalg.solve(of_others, across)
    torch.testing.assert_close(moved[1, others], params[1, others] + by_roll * (0.02 - params[1, ROLL]))
    far = FramePrior(roll=0.02, roll_std=0.05)  # 1.6 sigmas away
    torch.testing.assert_close(with_roll_of_prior(fit, far)[0], params)


def test_a_clear_vertical_curvature_is_its_own_prior_and_is_remembered():
    cfg = JointConfig(motion=MotionConfig(hill_memory=20.0))
    state = JointCalibrator(cfg).initial_state(3, DOUBLE)
    mean, cov = state.mean.clone(), state.cov.clone()
    mean[:, VERTICAL] = torch.tensor([0.0, 2e-5, -5e-5])
    cov[:, VERTICAL, VERTICAL] = 1e-10
    found = hill_variance(state._replace(mean=mean, cov=cov), torch.zeros(3, dtype=DOUBLE), cfg)
    torch.testing.assert_close(found, torch.tensor([0.0, 0.0, 2.1e-9], dtype=DOUBLE), rtol=1e-6, atol=1e-18)
    later = hill_variance(state._replace(hills=found), torch.full((3,), 20.0, dtype=DOUBLE), cfg)
    torch.testing.assert_close(later, found / math.e, rtol=1e-6, atol=1e-18)


def test_the_dip_behind_a_crest_is_expected():
    """A crest and a dip of R = 8 km in 7 s: pitch's errors against its standard deviations."""

    def change(t, moment):
        return replace(moment, near=5.0, far=40.0, profile=1.2e-4 * math.sin(2 * math.pi * t / 7))

    ratios = []
    for memory in (20.0, 1e-3):
        calibrator = JointCalibrator(motion=MotionConfig(hill_memory=memory))
        followed = follow(moments(8.0, change), calibrator, rows=4, per_boundary=15, seed=3)[100:]
        ratios.append(float(torch.stack([(one.error / one.sigma)[:, 0].square() for one in followed]).mean()))
    assert ratios[0] < 1.5
    assert ratios[1] > 1.5 * ratios[0]


def test_a_crest_in_one_row_is_estimated_and_leaves_the_other_as_it_is():
    calibrator = JointCalibrator()
    curved, plane = (crest(p, frames=100, rows=1, sigma=0.5) for p in (1e-4, 0.0))
    pairs = [
        (moment, LaneSegments(*(torch.cat(parts) for parts in zip(one, other, strict=True))))
        for (moment, one), (_, other) in zip(curved, plane, strict=True)
    ]
    both, state = run(calibrator, pairs)
    alone, _ = run(calibrator, plane)
    assert state.mean[:, VERTICAL].tolist() == [pytest.approx(1e-4, rel=0.15), pytest.approx(0.0, abs=2e-6)]
    truth = torch.tensor(curved[-1][0].pose, dtype=DOUBLE)
    assert (both.extrinsics.stack() - truth)[0, 0].abs() < math.radians(0.02)  # 0.09° on a plane road
    torch.testing.assert_close(both.extrinsics.stack()[1], alone.extrinsics.stack()[0])
