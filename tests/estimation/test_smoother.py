"""The smoother: against least squares over a whole drive, and what it does to drives of the joint filter."""

from dataclasses import replace

import pytest
import torch

from lanebev.estimation import kalman
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.filter.prediction import predict_state
from lanebev.estimation.joint.layout import POSE, layout
from lanebev.estimation.joint.measurement.residuals import OFFSET, ROLL
from lanebev.estimation.joint.smoother import link_states, smooth_drive, smooth_states
from lanebev.estimation.reasons import Reason
from lanebev.geometry.precision import cast_floating
from lanebev.tensors import map_tensors
from lanebev.testing.evaluation import frame_bound, rms
from lanebev.testing.moments import CAMERA, FPS, WIDTH, moments, observe

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
    return (
        transition,
        noise,
        normal(frames, seen, size),
        0.5 + normal(frames, seen).square(),
        normal(frames, seen),
    )


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
    """Mean and covariance of all states at once, by the normal equations."""
    transition, noise, jacobian, variance, measured = problem
    frames, size = transition.shape[:2]
    matrix, vector = (
        torch.zeros(frames * size, frames * size, dtype=DOUBLE),
        torch.zeros(frames * size, dtype=DOUBLE),
    )
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
    linked = torch.ones(6, 3, 3, dtype=torch.bool)
    for ours, dense in zip(smoothed(problem, filtered(problem), linked), least_squares(problem), strict=True):
        torch.testing.assert_close(ours, dense, rtol=1e-9, atol=1e-11)


def test_a_cut_divides_a_drive_into_two():
    problem = linear_problem()
    linked = torch.ones(6, 3, 3, dtype=torch.bool)
    linked[3] = False
    ours = smoothed(problem, filtered(problem, linked.flatten(1).any(-1)), linked)
    parts = [tuple(part[some] for part in problem) for some in (slice(0, 3), slice(3, 6))]
    dense = [state for part in parts for state in least_squares(part)]
    for one, other in zip(ours, dense, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11)


def masked_gain(linked):
    transition, noise = (part[:2] for part in linear_problem()[:2])
    step = noise[0], transition[1], noise[1]
    return *step, kalman.smoother_gain(*step, linked)


def test_an_entry_that_is_not_linked_tells_nothing_of_the_state_before():
    known = torch.tensor([True, False, True])
    cov, transition, noise, gain = masked_gain(known.expand(3, 3))
    chosen = transition[known]
    expected = cov @ chosen.mT @ (chosen @ cov @ chosen.mT + noise[known][:, known]).inverse()
    assert (gain[:, 1] == 0).all()
    torch.testing.assert_close(gain[:, known], expected, rtol=1e-10, atol=1e-12)


def test_blocks_are_smoothed_each_by_itself():
    block = torch.tensor([True, False, True])
    cov, transition, noise, gain = masked_gain(block.unsqueeze(-1) == block)
    predicted = transition @ cov @ transition.mT + noise
    for some in (block, ~block):
        alone = (transition @ cov)[some][:, some].mT @ predicted[some][:, some].inverse()
        torch.testing.assert_close(gain[some][:, some], alone, rtol=1e-10, atol=1e-12)
        assert (gain[some][:, ~some] == 0).all()


def test_with_a_gain_of_zero_the_covariance_stays():
    cov, transition, noise, gain = masked_gain(torch.zeros(3, 3, dtype=torch.bool))
    assert (gain == 0).all()
    torch.testing.assert_close(kalman.smoother_covariance(cov, transition, noise, gain), cov)


def drive(change=None, seconds: float = 2.0, rows: int = 2, per_boundary: int = 12, dt=None, begin_at=0):
    """Moments, calibrations, states and intervals of a drive by the joint filter."""
    calibrator = JointCalibrator()
    state = calibrator.initial_state(rows, dtype=DOUBLE)
    seen, calibrations, states, intervals = [], [], [], []
    for k, (moment, segments) in enumerate(
        observe(moments(seconds, change), rows, 1.0, per_boundary, 0, DOUBLE)
    ):
        step = 1 / FPS if dt is None else dt(k)
        state = calibrator.initial_state(rows, dtype=DOUBLE) if k == begin_at else state
        out, state = calibrator(segments, CAMERA.expand(rows, 3, 3), state, step, WIDTH)
        seen.append((moment, segments))
        calibrations.append(out)
        states.append(state)
        intervals.append(torch.full((rows,), step, dtype=DOUBLE))
    return seen, calibrations, states, intervals, calibrator.config


OTHERS = [entry for entry in range(PLACE.size) if entry != PLACE.speed]


def truth_of(seen):
    return torch.tensor([moment.pose for moment, _ in seen], dtype=DOUBLE).unsqueeze(1)


@pytest.fixture(scope="module")
def plain():
    return drive()


def test_the_last_frame_is_the_filters_and_no_covariance_is_larger(plain):
    """Nor that of the speed, which the filter estimates in part only, so that both together are not best."""
    _, calibrations, states, intervals, config = plain
    smooth = smooth_drive(calibrations, states, intervals, config)
    torch.testing.assert_close(smooth[-1], calibrations[-1], rtol=0, atol=1e-15)
    assert [frame.status.tolist() for frame in smooth] == [frame.status.tolist() for frame in calibrations]
    for state, before in zip(list(smooth_states(states, intervals, config))[::-1], states, strict=True):
        size = before.cov.diagonal(dim1=1, dim2=2).sqrt()
        less = (before.cov - state.cov) / (size.unsqueeze(-1) * size.unsqueeze(-2))
        assert torch.linalg.eigvalsh(less[:, OTHERS][:, :, OTHERS]).min() > -1e-6
        assert less[:, PLACE.speed, PLACE.speed].min() > -1e-6
        assert torch.linalg.eigvalsh(state.cov / (size.unsqueeze(-1) * size.unsqueeze(-2))).min() > -1e-9


def test_the_filters_prediction_is_repeated_to_rounding(plain):
    """F P Fᵀ + W is the covariance that the filter updated, its evidence's noise included."""
    _, _, states, intervals, config = plain
    before, after, dt = states[20], states[21], intervals[21]
    link = link_states(before, after, dt, config)
    predicted, *_ = predict_state(before, dt, config)
    torch.testing.assert_close(link.predicted, predicted.mean, rtol=0, atol=0)
    cov = link.transition @ before.cov @ link.transition.mT + link.noise
    assert ((cov - predicted.cov).diagonal(dim1=1, dim2=2) > -1e-12).all()
    assert link.linked[:, OTHERS][:, :, OTHERS].all()
    assert not link.linked[:, PLACE.speed, OTHERS].any()
    assert not link.linked[:, OTHERS, PLACE.speed].any()
    assert link.linked[:, PLACE.speed, PLACE.speed].all()


def test_errors_and_sigmas_get_smaller_and_agree(plain):
    seen, calibrations, states, intervals, config = plain
    smooth = smooth_drive(calibrations, states, intervals, config)
    bound = torch.stack([frame_bound(*frame) for frame in seen]).mean((0, 1)).sqrt()
    errors = torch.stack([frame.extrinsics.stack() for frame in smooth]) - truth_of(seen)
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


def smoothed_poses(part):
    return torch.stack([frame.extrinsics.stack() for frame in smooth_drive(*part)])


def test_a_new_start_divides_a_drive_into_two():
    _, calibrations, states, intervals, config = drive(seconds=0.6, rows=1, begin_at=8)
    assert states[8].reasons[0] & Reason.RESTARTED
    whole = smoothed_poses((calibrations, states, intervals, config))
    for some in (slice(0, 8), slice(8, None)):
        alone = smoothed_poses((calibrations[some], states[some], intervals[some], config))
        torch.testing.assert_close(whole[some], alone, rtol=0, atol=1e-12)


def test_a_lane_change_lets_offset_and_deviations_go():
    seen, calibrations, states, intervals, config = drive(
        lambda t, moment: replace(moment, shift=int(t > 0.4)), seconds=0.8
    )
    k = next(k for k, state in enumerate(states) if state.reasons[0] & Reason.LANE_CHANGE)
    linked = link_states(states[k - 1], states[k], intervals[k], config).linked
    told = [OFFSET, *range(PLACE.size)[PLACE.deviations]]
    assert not linked[0][:, told].any()
    assert linked[0].sum() == len(OTHERS) * (len(OTHERS) - len(told)) + 1  # the speed by itself
    smooth = smooth_drive(calibrations, states, intervals, config)[k - 8 : k + 8]
    errors = torch.stack([frame.extrinsics.stack() for frame in smooth]) - truth_of(seen)[k - 8 : k + 8]
    sigmas = torch.stack([frame.covariance.diagonal(dim1=1, dim2=2).sqrt() for frame in smooth])
    assert (errors.abs() < 4 * sigmas).all()


def test_a_skipped_frame_has_the_pose_of_the_frame_before():
    _, calibrations, states, intervals, config = drive(
        seconds=0.6, rows=1, dt=lambda k: 0.0 if k == 12 else 1 / FPS
    )
    poses = smoothed_poses((calibrations, states, intervals, config))
    assert states[12].reasons[0] & Reason.TIME
    torch.testing.assert_close(poses[12], poses[11], rtol=0, atol=1e-9)
    assert not torch.allclose(poses[12], poses[13], rtol=0, atol=1e-5)


def test_with_one_lane_roll_and_the_other_entries_are_smoothed_each_by_themselves():
    """Else their correlated errors, that the filter does not correct, make pitch worse than the filter's."""
    seen, calibrations, states, intervals, config = drive(
        lambda t, moment: replace(moment, visible=(2, 3)), seconds=2.0
    )
    linked = link_states(states[-2], states[-1], intervals[-1], config).linked
    assert not linked[0, PLACE.chain(ROLL)[0], PLACE.chain(0)[0]]
    errors = smoothed_poses((calibrations, states, intervals, config)) - truth_of(seen)
    before = torch.stack([frame.extrinsics.stack() for frame in calibrations]) - truth_of(seen)
    assert (rms(errors[5:-5]) < 0.85 * rms(before[5:-5]))[:2].all()


def test_single_precision_is_enough_for_the_states(plain):
    _, _, states, intervals, config = plain
    single = [cast_floating(state, torch.float32) for state in states]
    exact = smooth_states(states, intervals, config)
    for state, other in zip(exact, smooth_states(single, intervals, config), strict=True):
        sigma = state.cov.diagonal(dim1=1, dim2=2)[:, POSE].sqrt()
        assert other.mean.dtype == torch.float32
        assert ((other.mean - state.mean)[:, POSE].abs() < 0.1 * sigma).all()


def test_lengths_that_differ_and_no_frames(plain):
    _, calibrations, states, intervals, config = plain
    with pytest.raises(ValueError, match="expected one of each a frame, got 60, 59, 60"):
        smooth_drive(calibrations, states[1:], intervals, config)
    assert smooth_drive([], [], [], config) == []
