"""The smoother: against least squares over a whole drive, and what it does to drives of the joint filter."""

from __future__ import annotations

import pytest
import torch

from lanebev.estimation import kalman
from lanebev.estimation.joint.calibrator import JointCalibrator, predict_state
from lanebev.estimation.joint.layout import POSE, layout
from lanebev.estimation.joint.measurement import OFFSET
from lanebev.estimation.joint.smoother import link_states, smooth_drive, smooth_states
from lanebev.estimation.reasons import Reason
from lanebev.testing.evaluation import frame_bound, rms
from lanebev.testing.scenarios import CAMERA, FPS, WIDTH, Moment, moments, observe
from lanebev.types import Status, map_tensors

torch.set_num_threads(1)
DOUBLE = torch.float64
PLACE = layout(6)


def linear_problem(frames: int = 6, size: int = 3, seen: int = 2):
    """A random linear Gaussian drive: F, W, H, Q, measurements, and the first frame's prior."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=DOUBLE)

    transition = torch.eye(size, dtype=DOUBLE) + 0.3 * normal(frames, size, size)
    root = normal(frames, size, size)
    noise = 0.1 * root @ root.mT + 0.01 * torch.eye(size, dtype=DOUBLE)
    return transition, noise, normal(frames, seen, size), 0.5 + normal(frames, seen).square(), normal(frames, seen)


def filtered(problem, links=None):
    """Means and covariances after every frame, from a prior N(0, I); where links are cut, it starts anew."""
    transition, noise, jacobian, variance, measured = problem
    frames, size = transition.shape[:2]
    mean, cov = torch.zeros(size, dtype=DOUBLE), torch.eye(size, dtype=DOUBLE)
    found = []
    for k in range(frames):
        if k:
            mean, cov = kalman.predict(mean, cov, transition[k], noise[k])
        if links is not None and not links[k]:
            mean, cov = torch.zeros_like(mean), torch.eye(size, dtype=DOUBLE)
        info = kalman.information(measured[k] - jacobian[k] @ mean, jacobian[k], variance[k])
        mean, cov = kalman.update(mean, cov, *info)
        found.append((mean, cov))
    return found


def smoothed(problem, found, linked):
    transition, noise, *_ = problem
    mean, cov = found[-1]
    result = [(mean, cov)]
    for k in range(len(found) - 2, -1, -1):
        own_mean, own_cov = found[k]
        step = (own_cov, transition[k + 1], noise[k + 1])
        gain = kalman.smoother_gain(*step, linked[k + 1])
        predicted = transition[k + 1] @ own_mean
        mean = own_mean + gain @ (mean - predicted)
        cov = kalman.smoother_covariance(*step, gain) + gain @ cov @ gain.mT
        result.append((mean, cov))
    return result[::-1]


def least_squares(problem):
    """Mean and covariance of all states at once, by the normal equations of prior, motion and measurements."""
    transition, noise, jacobian, variance, measured = problem
    frames, size = transition.shape[:2]
    matrix, vector = torch.zeros(frames * size, frames * size, dtype=DOUBLE), torch.zeros(frames * size, dtype=DOUBLE)
    place = [slice(k * size, (k + 1) * size) for k in range(frames)]
    matrix[place[0], place[0]] += torch.eye(size, dtype=DOUBLE)
    for k in range(frames):
        matrix[place[k], place[k]] += jacobian[k].mT @ (jacobian[k] / variance[k].unsqueeze(-1))
        vector[place[k]] += jacobian[k].mT @ (measured[k] / variance[k])
        if k:
            step = torch.zeros(size, frames * size, dtype=DOUBLE)
            step[:, place[k]], step[:, place[k - 1]] = torch.eye(size, dtype=DOUBLE), -transition[k]
            matrix += step.mT @ noise[k].inverse() @ step
    cov = matrix.inverse()
    mean = cov @ vector
    return [(mean[each], cov[each, each]) for each in place]


def test_equals_least_squares_over_all_frames():
    problem = linear_problem()
    linked = torch.ones(6, 3, dtype=torch.bool)
    for ours, dense in zip(smoothed(problem, filtered(problem), linked), least_squares(problem), strict=True):
        torch.testing.assert_close(ours, dense, rtol=1e-9, atol=1e-11)


def test_a_cut_divides_a_drive_into_two():
    problem = linear_problem()
    linked = torch.ones(6, 3, dtype=torch.bool)
    linked[3] = False
    ours = smoothed(problem, filtered(problem, linked.any(-1)), linked)
    parts = [tuple(part[some] for part in problem) for some in (slice(0, 3), slice(3, 6))]
    dense = [state for part in parts for state in least_squares(part)]
    for one, other in zip(ours, dense, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11)


def test_an_entry_that_is_not_linked_tells_nothing_of_the_state_before():
    cov, transition, noise = (part[0] for part in linear_problem()[:2] + (linear_problem()[1],))
    cov, transition, noise = noise, transition, noise
    linked = torch.tensor([True, False, True])
    gain = kalman.smoother_gain(cov, transition, noise, linked)
    assert (gain[:, 1] == 0).all()
    chosen = transition[linked]
    expected = cov @ chosen.mT @ (chosen @ cov @ chosen.mT + noise[linked][:, linked]).inverse()
    torch.testing.assert_close(gain[:, linked], expected, rtol=1e-10, atol=1e-12)


def drive(change=None, seconds: float = 2.0, rows: int = 2, per_boundary: int = 12, seed: int = 0, dt=None):
    """Moments, calibrations, states and intervals of a drive by the joint filter."""
    calibrator = JointCalibrator()
    state = calibrator.initial_state(rows, dtype=DOUBLE)
    seen, calibrations, states, intervals = [], [], [], []
    for k, (moment, segments) in enumerate(observe(moments(seconds, change), rows, 1.0, per_boundary, seed, DOUBLE)):
        step = 1 / FPS if dt is None else dt(k)
        out, state = calibrator(segments, CAMERA.expand(rows, 3, 3), state, step, WIDTH)
        seen.append((moment, segments))
        calibrations.append(out)
        states.append(state)
        intervals.append(torch.full((rows,), step, dtype=DOUBLE))
    return seen, calibrations, states, intervals, calibrator.config


@pytest.fixture(scope="module")
def plain():
    return drive()


def test_the_last_frame_is_the_filters_and_no_covariance_is_larger(plain):
    _, calibrations, states, intervals, config = plain
    smooth = smooth_drive(calibrations, states, intervals, config)
    torch.testing.assert_close(smooth[-1], calibrations[-1], rtol=0, atol=1e-15)
    assert [frame.status.tolist() for frame in smooth] == [frame.status.tolist() for frame in calibrations]
    for state, before in zip(list(smooth_states(states, intervals, config))[::-1], states, strict=True):
        size = before.cov.diagonal(dim1=1, dim2=2).sqrt()
        less = (before.cov - state.cov) / (size.unsqueeze(-1) * size.unsqueeze(-2))
        assert torch.linalg.eigvalsh(less).min() > -1e-6
        assert torch.linalg.eigvalsh(state.cov / (size.unsqueeze(-1) * size.unsqueeze(-2))).min() > -1e-9


def test_the_filters_prediction_is_repeated_to_rounding(plain):
    """F P Fᵀ + W is the covariance that the filter updated, its evidence's noise included."""
    _, _, states, intervals, config = plain
    before, after, dt = states[20], states[21], intervals[21]
    link = link_states(before, after, dt, config)
    predicted = predict_state(before, dt, config)
    torch.testing.assert_close(link.predicted, predicted.mean, rtol=0, atol=0)
    cov = link.transition @ before.cov @ link.transition.mT + link.noise
    assert ((cov - predicted.cov).diagonal(dim1=1, dim2=2) > -1e-12).all()
    assert link.linked.all()


def test_errors_and_sigmas_get_smaller_and_agree(plain):
    seen, calibrations, states, intervals, config = plain
    smooth = smooth_drive(calibrations, states, intervals, config)
    truth = torch.tensor([moment.pose for moment, _ in seen], dtype=DOUBLE).unsqueeze(1)
    bound = torch.stack([frame_bound(*frame) for frame in seen]).mean((0, 1)).sqrt()
    errors = torch.stack([frame.extrinsics.stack() for frame in smooth]) - truth
    cov = torch.stack([frame.covariance for frame in smooth])
    nees = (errors * torch.linalg.solve(cov, errors)).sum(-1).mean() / 4
    middle = errors[10:-10].square().mean((0, 1)).sqrt() / bound
    assert (middle < torch.tensor([0.7, 0.9, 0.8, 0.7])).all()
    assert 0.4 < nees < 1.6


def test_rows_are_smoothed_by_themselves(plain):
    _, calibrations, states, intervals, config = plain
    both = smooth_drive(calibrations, states, intervals, config)
    first = [map_tensors(lambda part: part[:1], state) for state in states]
    alone = smooth_states(first, [dt[:1] for dt in intervals], config)
    for state, frame in zip(alone, both[::-1], strict=True):
        torch.testing.assert_close(state.mean[:, POSE], frame.extrinsics.stack()[:1], rtol=1e-9, atol=1e-12)
