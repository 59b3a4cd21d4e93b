"""The measurement update against plain least squares and automatic derivatives."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.filter.lane_change import renumber
from lanebev.estimation.joint.filter.prediction import predict_state
from lanebev.estimation.joint.filter.update import (
    frame_information,
    kalman_gain,
    membership,
    observed_step,
    posterior_covariance,
)
from lanebev.estimation.joint.layout import NUM_COMMON, SHAPE
from lanebev.estimation.joint.measurement.observations import boundary_places, observe
from lanebev.estimation.joint.measurement.residuals import (
    NUM_SHAPE,
    OFFSET,
    ROLL,
    VERTICAL,
    boundary_distances,
    boundary_residuals,
    foot_points,
    look,
)
from lanebev.testing.moments import CAMERA, FPS, PLACES, WIDTH, moments
from lanebev.testing.moments import observe as see
from tests.estimation.joint_drives import DOUBLE, OBLIQUE, PLACE, cameras, drive, run

torch.set_num_threads(1)


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
