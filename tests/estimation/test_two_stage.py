"""TwoStageCalibrator: accuracy, covariance, bad rows, and arguments."""

import itertools
import math

import pytest
import torch

from lanebev import LaneSegments, Status, TwoStageCalibrator
from lanebev.estimation.reasons import Reason
from lanebev.estimation.two_stage.direction import incidence
from lanebev.estimation.two_stage.state import TwoStageConfig
from lanebev.geometry.road import great_circle_normals, segment_rays
from lanebev.testing.experiment import Experiment
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import POSE, lanes, no_lanes, stack_rows
from tests.estimation.calibrated import drive, finite
from tools.reproduce_table1 import run, table


@pytest.mark.parametrize(
    "pose", list(itertools.product((-0.05, 0.05), (-0.08, 0.08), (-0.1, 0.1), (1.0, 2.2)))
)
def test_one_exact_frame_gives_the_pose_over_all_signs(pose):
    outputs, _ = drive(TwoStageCalibrator(), [lanes(pose, noise=0.0)])
    assert outputs[0].extrinsics.stack()[0].tolist() == pytest.approx(pose, abs=1e-6)
    assert outputs[0].status.tolist() == [Status.TRACKING]


@pytest.mark.slow
def test_table_one_fast():
    exp = Experiment(num_frames=60, segments_per_boundary=30)
    for row in table(run(TwoStageCalibrator(), exp, 4, torch.float64, 0)):
        assert all(h <= p for h, p in zip(row["here"], row["paper"], strict=True)), row
        assert 0.7 < row["nees_per_dof"] < 1.4
        assert row["tracking"] == 1.0


def test_invariant_to_order_and_end_point_swap():
    segments = lanes()
    order = torch.randperm(48, generator=torch.Generator().manual_seed(2))
    swapped = LaneSegments(*(v[:, order] for v in segments))
    swapped = swapped._replace(endpoints=swapped.endpoints.flip(2))
    a, _ = drive(TwoStageCalibrator(), [segments] * 3)
    b, _ = drive(TwoStageCalibrator(), [swapped] * 3)
    torch.testing.assert_close(a[-1].extrinsics.stack(), b[-1].extrinsics.stack(), atol=1e-9, rtol=0)


DEGENERATE = {
    "one lane": lanes(boundaries=(2, 3)),
    "one boundary": lanes(boundaries=(2,)),
    "empty": no_lanes(),
    "nan": lanes()._replace(endpoints=lanes().endpoints * torch.nan),
    "duplicates": LaneSegments(*(v[:, :1].repeat(1, 48, *([1] * (v.ndim - 2))) for v in lanes())),
    "points": lanes()._replace(endpoints=lanes().endpoints[:, :, :1].repeat(1, 1, 2, 1)),
    "wrong index": lanes()._replace(boundary=lanes().boundary + 40),
    "far out": lanes()._replace(endpoints=lanes().endpoints * 1e30),
    "no sigma": lanes()._replace(sigma=lanes().sigma * 0),
}


@pytest.mark.parametrize("kind", sorted(DEGENERATE))
def test_bad_rows_give_a_status_and_finite_numbers_and_touch_no_other(kind):
    good, bad = [lanes(seed=s) for s in range(4)], DEGENERATE[kind]
    alone, _ = drive(TwoStageCalibrator(), good)
    beside, _ = drive(TwoStageCalibrator(), [stack_rows(bad, g, bad) for g in good])
    for a, b in zip(alone, beside, strict=True):
        assert finite(b)
        torch.testing.assert_close(a.extrinsics.stack()[0], b.extrinsics.stack()[1], atol=1e-10, rtol=0)
        torch.testing.assert_close(a.covariance[0], b.covariance[1], atol=1e-12, rtol=1e-6)
        assert a.status[0] == b.status[1]
    seen = kind == "one lane"
    assert (beside[-1].status[0] == Status.TRACKING) == seen
    if not seen:
        assert beside[-1].inliers[0].sum() == 0


def test_bad_rows_carry_no_nan_gradient():
    segments = stack_rows(lanes(), DEGENERATE["nan"], DEGENERATE["one boundary"])
    ends = segments.endpoints.detach().clone().requires_grad_()
    calibrator = TwoStageCalibrator()
    state = calibrator.initial_state(3, dtype=torch.float64)
    for _ in range(2):
        out, state = calibrator(segments._replace(endpoints=ends), K.expand(3, 3, 3), state, 1 / 30)
    (out.extrinsics.stack().sum() + out.covariance.sum()).backward()
    assert ends.grad.isfinite().all()
    assert ends.grad[0].abs().sum() > 0


@pytest.mark.slow
def test_gradcheck_through_start_and_update():
    segments = lanes(per=3)
    calibrator = TwoStageCalibrator()

    def forward(ends, sigma):
        state = calibrator.initial_state(1, dtype=torch.float64)
        moved = segments._replace(endpoints=ends, sigma=sigma)
        for _ in range(2):
            calibration, state = calibrator(moved, K[None], state, 1 / 30)
        return calibration.extrinsics.stack()

    inputs = (segments.endpoints.requires_grad_(), segments.sigma.requires_grad_())
    assert torch.autograd.gradcheck(forward, inputs, eps=1e-5, atol=1e-6, rtol=2e-3)


def test_reasons_say_what_is_not_determined():
    calibrator = TwoStageCalibrator()
    _, state = drive(calibrator, [lanes(seed=0)])
    assert state.reasons.tolist() == [Reason.RESTARTED]
    unseen = Reason.ROLL_UNSEEN
    for frame, reasons in (
        (lanes(seed=1), Reason.NONE),
        (lanes(boundaries=(2, 3), per=24, seed=2), unseen),
        (no_lanes(), unseen | Reason.NO_SEGMENTS | Reason.DIRECTION_UNSEEN | Reason.HEIGHT_UNSEEN),
        (lanes(boundaries=(2,), seed=3), unseen | 2 | Reason.DIRECTION_UNSEEN | Reason.HEIGHT_UNSEEN),
    ):
        _, state = calibrator(frame, K[None], state, 1 / 30)
        assert Reason(int(state.reasons)) == reasons


def test_one_lane_never_moves_roll_and_says_so():
    calibrator = TwoStageCalibrator()
    frames = [lanes(seed=s) for s in range(10)]
    frames += [lanes(boundaries=(2, 3), per=24, seed=s, noise=2.0) for s in range(60)]
    outputs, _ = drive(calibrator, frames)
    rolls = torch.stack([o.extrinsics.roll[0] for o in outputs])
    assert (rolls[10:] == rolls[9]).all()
    spread = torch.stack([o.covariance[0, 2, 2].sqrt() for o in outputs])
    assert (spread[10:].diff() >= 0).all()
    assert spread[-1] > 10 * spread[9]
    assert abs(float(outputs[-1].extrinsics.height[0]) - POSE[3]) < 0.05
    never, _ = drive(calibrator, [lanes(boundaries=(2, 3), per=24, seed=s) for s in range(20)])
    assert all(float(o.extrinsics.roll[0]) == 0.0 for o in never)
    assert float(never[-1].covariance[0, 2, 2].sqrt()) == pytest.approx(0.05, rel=0.01)


def test_deviation_lines_of_another_direction_do_not_turn_what_tracks():
    """Algorithm 1 would: they are more."""
    wrong = (POSE[0] + 0.03, POSE[1] + 0.08, *POSE[2:])
    few, many = lanes(per=5, seed=1), lanes(wrong, per=20, seed=2)
    both = LaneSegments(*(torch.cat(parts, 1) for parts in zip(few, many, strict=True)))
    begun, _ = drive(TwoStageCalibrator(), [both])
    assert begun[0].extrinsics.stack()[0, :2].tolist() == pytest.approx(wrong[:2], abs=2e-3)
    calibrator = TwoStageCalibrator(min_inlier_share=0.15)
    tracked, _ = drive(calibrator, [lanes(seed=s) for s in range(3, 8)] + [both])
    assert tracked[-1].extrinsics.stack()[0, :2].tolist() == pytest.approx(POSE[:2], abs=2e-3)
    assert int(tracked[-1].status[0]) == Status.TRACKING


def test_gross_outliers_are_left_out():
    generator = torch.Generator().manual_seed(3)
    outputs = []
    calibrator = TwoStageCalibrator()
    state = calibrator.initial_state(1, dtype=torch.float64)
    for seed in range(20):
        good, wild = lanes(seed=seed), lanes(seed=seed + 100)
        ends = wild.endpoints + 200 * torch.randn(wild.endpoints.shape, generator=generator).double()
        both = LaneSegments(*(torch.cat(p, 1) for p in zip(good, wild._replace(endpoints=ends), strict=True)))
        out, state = calibrator(both, K[None], state, 1 / 30)
        outputs.append(out)
    assert outputs[-1].extrinsics.stack()[0].tolist() == pytest.approx(POSE, abs=0.01)
    assert outputs[-1].inliers[0, :48].mean() > 0.9
    assert outputs[-1].inliers[0, 48:].mean() < 0.2


def test_incidence_jacobian_and_noise_equal_autograd():
    """Of a camera whose pixels are not square, at a pose off the axis."""
    camera = torch.tensor([[[900.0, 5.0, 640], [0, 1300, 360], [0, 0, 1]]], dtype=torch.float64)
    segments = lanes(per=2)
    mean = torch.tensor([[0.2, -0.3, 0.1, 0.0]], dtype=torch.float64)

    def residual(mean, ends):
        rays = segment_rays(ends, camera)
        return incidence(mean, great_circle_normals(rays), rays, segments.sigma, camera)

    by_mean, by_ends = torch.func.jacfwd(lambda *x: residual(*x)[0][0], (0, 1))(mean, segments.endpoints)
    _, jacobian, noise = residual(mean, segments.endpoints)
    torch.testing.assert_close(jacobian[0], by_mean[:, 0])
    exact = by_ends[:, 0].square().sum((1, 2, 3)) * segments.sigma[0].square()
    torch.testing.assert_close(noise[0], exact, rtol=0.02, atol=0)  # skew is left out


def test_a_starts_pitch_and_yaw_err_together_as_it_says():
    """Boundaries on one side alone: what tilts the lines' meeting point up moves it sideways."""
    frames = stack_rows(*(lanes(boundaries=(0, 1, 2), seed=seed, noise=1.0) for seed in range(300)))
    outputs, _ = drive(TwoStageCalibrator(departures=False), [frames])
    errors = outputs[0].extrinsics.stack()[:, :2] - torch.tensor(POSE[:2], dtype=torch.float64)
    cov = outputs[0].covariance[:, :2, :2].mean(0)
    said = cov[0, 1] / (cov[0, 0] * cov[1, 1]).sqrt()
    found = torch.corrcoef(errors.T)[0, 1]
    assert said.abs() > 0.5
    assert found == pytest.approx(float(said), abs=0.15)


@pytest.mark.parametrize("width", [3.5, torch.tensor([3.5]), torch.full((1, 5), 3.5)])
def test_lane_width_scales_height_and_per_lane_widths_are_taken(width):
    outputs, _ = drive(TwoStageCalibrator(), [lanes(noise=0.0, width=3.5)] * 2, lane_width=width)
    assert float(outputs[-1].extrinsics.height[0]) == pytest.approx(POSE[3], abs=1e-5)
    wrong, _ = drive(TwoStageCalibrator(), [lanes(noise=0.0, width=3.5)] * 2)
    assert float(wrong[-1].extrinsics.height[0]) == pytest.approx(POSE[3] * 3.7 / 3.5, abs=1e-5)


def test_documented_bias_on_a_curve():
    """paper.md D17: the paper assumes a straight road; R = 860 m costs about a degree of yaw."""
    outputs, _ = drive(TwoStageCalibrator(), [lanes((0.0, 0.0, 0.0, 1.5), noise=0.0, bend=1 / 860)] * 5)
    assert 0.7 < abs(math.degrees(float(outputs[-1].extrinsics.yaw[0]))) < 2.0


def test_float32_follows_float64():
    calibrator = TwoStageCalibrator()
    states = [calibrator.initial_state(1, dtype=d) for d in (torch.float32, torch.float64)]
    for seed in range(30):
        segments = lanes(seed=seed)
        results = []
        for i, dtype in enumerate((torch.float32, torch.float64)):
            cast = LaneSegments(*(v.to(dtype) if v.is_floating_point() else v for v in segments))
            out, states[i] = calibrator(cast, K[None].to(dtype), states[i], 1 / 30)
            results.append(out)
        gap = (results[0].extrinsics.stack().double() - results[1].extrinsics.stack())[0]
        assert (gap.abs() < 0.05 * results[1].covariance[0].diagonal().sqrt()).all()


@pytest.mark.slow
@pytest.mark.parametrize("count", [24, 48])  # all pairs of them are tried, and some
def test_export_equals_eager(count):
    calibrator = TwoStageCalibrator()
    state = calibrator.initial_state(2, dtype=torch.float64)
    segments = stack_rows(lanes(seed=0), lanes(seed=1))
    every = segments.weight.shape[1] // count
    segments = LaneSegments(*(part[:, ::every] for part in segments))
    assert segments.weight.shape == (2, count)

    class Step(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.calibrator = calibrator

        def forward(self, segments, intrinsics, state, dt):
            return self.calibrator(segments, intrinsics, state, dt)

    dt = torch.full((2,), 1 / 30, dtype=torch.float64)
    args = (segments, K.expand(2, 3, 3).contiguous(), state, dt)
    exported = torch.export.export(Step(), args).module()
    for _ in range(3):
        (a, next_a), (b, next_b) = exported(*args), Step()(*args)
        torch.testing.assert_close(a.extrinsics.stack(), b.extrinsics.stack())
        torch.testing.assert_close(next_a.roll_height_cov, next_b.roll_height_cov)
        args = (segments, args[1], type(state)(*next_b), dt)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"endpoints": torch.zeros(8, 30, 4)},
            r"segments.endpoints: expected \(B, N, 2, 2\), got \(8, 30, 4\)",
        ),
        ({"weight": torch.zeros(1, 3)}, r"segments.weight: expected \(1, 48\)"),
        ({"boundary": torch.zeros(1, 48)}, "segments.boundary: expected int64 indices"),
        ({"boundary": torch.zeros(1, 48, dtype=torch.int32)}, "expected int64 indices, got torch.int32"),
    ],
)
def test_shapes_are_checked(change, message):
    calibrator = TwoStageCalibrator()
    with pytest.raises(ValueError, match=message):
        calibrator(lanes()._replace(**change), K[None], calibrator.initial_state(1), 1 / 30)


def test_arguments_are_checked():
    calibrator = TwoStageCalibrator()
    state = calibrator.initial_state(1, dtype=torch.float64)
    with pytest.raises(ValueError, match="lane_width: expected 1 to 10 m"):
        calibrator(lanes(), K[None], state, 1 / 30, -3.7)
    with pytest.raises(ValueError, match=r"lane_width: expected a float, \(1,\) or \(1, 5\), got \(1, 3\)"):
        calibrator(lanes(), K[None], state, 1 / 30, torch.ones(1, 3))
    with pytest.raises(ValueError, match=r"intrinsics: expected \(1, 3, 3\)"):
        calibrator(lanes(), K, state, 1 / 30)
    with pytest.raises(TypeError, match="no_such_number"):
        TwoStageCalibrator(no_such_number=1)
    with pytest.raises(ValueError, match="num_boundaries: expected at least 2"):
        TwoStageConfig(num_boundaries=1)
    with pytest.raises(ValueError, match="lane_deviation_std: expected a finite number, at least 0, got nan"):
        TwoStageConfig(lane_deviation_std=float("nan"))
    with pytest.raises(ValueError, match="departure_memory: expected a finite number, more than 0, got -1"):
        TwoStageConfig(departure_memory=-1.0)
