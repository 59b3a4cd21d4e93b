"""What both calibrators promise: precision, bad rows, padded frames, dtypes, and names in errors."""

import math

import pytest
import torch

from lanebev import JointCalibrator, LaneSegments, Status, TwoStageCalibrator
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import POSE, lanes, no_lanes, stack_rows
from tests.calibrators import CALIBRATORS
from tests.estimation.calibrated import drive, finite


@pytest.mark.parametrize("kind", [TwoStageCalibrator, JointCalibrator])
def test_lane_width_uncertainty_reaches_the_covariance(kind):
    plain, _ = drive(kind(), [lanes()] * 3)
    unsure, _ = drive(kind(lane_width_std=0.1), [lanes()] * 3)
    added = unsure[-1].covariance[0, 3, 3] - plain[-1].covariance[0, 3, 3]
    assert float(added.sqrt()) == pytest.approx(float(plain[-1].extrinsics.height[0]) * 0.1 / 3.7, rel=1e-6)


def single(values):
    """The same in float32."""
    return type(values)(*(v.float() if v.is_floating_point() else v for v in values))


@CALIBRATORS
def test_autocast_changes_nothing_and_gradients_flow(calibrator):
    found = []
    for enabled in (False, True):
        segments = single(lanes())
        ends = segments.endpoints.requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            out, _ = calibrator(segments, K[None].float(), calibrator.initial_state(1), 1 / 30)
        assert out.covariance.dtype == torch.float32
        found.append((*out.extrinsics, torch.autograd.grad(out.extrinsics.pitch.sum(), ends)[0]))
    assert found[1][-1].abs().sum() > 0
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


@CALIBRATORS
@pytest.mark.parametrize("width", [12.0, 370.0, 0.37, -3.7, math.nan])
def test_a_row_with_an_impossible_lane_width_does_not_start(calibrator, width):
    """Lanes in feet would make the camera 4.6 m high, and the status TRACKING."""
    both, state = stack_rows(lanes(), lanes()), calibrator.initial_state(2)
    out, _ = calibrator(both, K.expand(2, 3, 3), state, 1 / 30, torch.tensor([3.7, width]))
    assert out.status.tolist() == [Status.TRACKING, Status.UNINITIALISED]
    assert finite(out)


@CALIBRATORS
@pytest.mark.parametrize("width", [0.9, 12.0])
def test_one_narrow_strip_or_wide_gap_among_lanes_is_possible(calibrator, width):
    widths = torch.tensor([[3.7, 3.7, 3.7, 3.7, width]])
    out, _ = calibrator(lanes(), K[None], calibrator.initial_state(1), 1 / 30, widths)
    assert out.status.tolist() == [Status.TRACKING]


@CALIBRATORS
@pytest.mark.parametrize("kind", ["nan", "index", "weight"])
def test_what_cannot_be_used_keeps_no_row_from_starting(calibrator, kind):
    junk = lanes(per=40)
    junk = {
        "nan": junk._replace(endpoints=junk.endpoints * torch.nan),
        "index": junk._replace(boundary=junk.boundary + 99),
        "weight": junk._replace(weight=junk.weight * torch.inf),
    }[kind]
    both = LaneSegments(*(torch.cat(parts, 1) for parts in zip(lanes(), junk, strict=True)))
    outputs, _ = drive(calibrator, [both])
    assert outputs[0].status.tolist() == [Status.TRACKING]
    assert outputs[0].extrinsics.stack()[0].tolist() == pytest.approx(POSE, abs=0.02)


BAD_ROWS = {
    "intrinsics nan": (torch.nan, 3.7),
    "intrinsics zero": (0.0, 3.7),
    "lane width nan": (1.0, torch.nan),
    "lane width zero": (1.0, 0.0),
    "lane width negative": (1.0, -3.7),
    "lane width infinite": (1.0, torch.inf),
}


@CALIBRATORS
@pytest.mark.parametrize("kind", sorted(BAD_ROWS))
def test_a_row_without_camera_or_lane_width_sees_nothing(calibrator, kind):
    factor, width = BAD_ROWS[kind]
    good = torch.ones(2, 1, 1, dtype=torch.float64) * K
    _, state = drive(calibrator, [stack_rows(lanes(seed=s), lanes(seed=s)) for s in range(3)])
    segments = stack_rows(lanes(seed=4), lanes(seed=4))
    expected, _ = calibrator(segments, good, state, 1 / 30)
    bad = torch.cat([good[:1] * factor, good[1:]])
    out, after = calibrator(segments, bad, state, 1 / 30, torch.tensor([width, 3.7], dtype=torch.float64))
    assert out.status.tolist() == [Status.COASTING, Status.TRACKING]
    assert out.inliers[0].sum() == 0
    assert finite(out)
    assert all(part.isfinite().all() for part in after)
    torch.testing.assert_close(out.extrinsics.stack()[1], expected.extrinsics.stack()[1])


@CALIBRATORS
@pytest.mark.parametrize("count", [0, 1])
def test_frames_of_no_or_one_segment_are_as_padded_ones(calibrator, count):
    _, started = drive(calibrator, [lanes(seed=s) for s in range(3)])
    for state in (calibrator.initial_state(1, dtype=torch.float64), started):
        few = LaneSegments(*(v[:, :count] for v in lanes(seed=5)))
        one, _ = calibrator(few, K[None], state, 1 / 30)
        padded, _ = calibrator(stack_rows(few, no_lanes()), K.expand(2, 3, 3), twice(state), 1 / 30)
        assert one.inliers.shape == (1, count)
        assert one.status[0] == padded.status[0]
        assert one.status[0] in (Status.UNINITIALISED, Status.COASTING)
        torch.testing.assert_close(one.extrinsics.stack()[0], padded.extrinsics.stack()[0])
        torch.testing.assert_close(one.covariance[0], padded.covariance[0])


def twice(state):
    return type(state)(*(v.repeat(2, *[1] * (v.ndim - 1)) for v in state))


@CALIBRATORS
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_have_the_dtype_of_the_state_whatever_comes(calibrator, dtype):
    state, width = calibrator.initial_state(1, dtype=dtype), torch.full((1, 5), 3.7)
    expected, _ = calibrator(lanes(), K[None], calibrator.initial_state(1, dtype=torch.float64), 0.1, width)
    for segments, intrinsics in ((single(lanes()), K), (lanes(), K.float())):
        out, after = calibrator(segments, intrinsics[None], state, torch.tensor(0.1), width)
        assert out.covariance.dtype == out.inliers.dtype == after[0].dtype == dtype
        torch.testing.assert_close(
            out.extrinsics.stack().double(), expected.extrinsics.stack(), atol=1e-4, rtol=0
        )


@CALIBRATORS
def test_what_does_not_fit_the_batch_is_named(calibrator):
    segments, cameras = stack_rows(lanes(), lanes()), K.expand(2, 3, 3)
    state = calibrator.initial_state(2, dtype=torch.float64)
    name = state._fields[0]
    for count in (1, 3):
        with pytest.raises(ValueError, match=rf"state.{name}: expected \(2, ...\), got \({count}, "):
            calibrator(segments, cameras, calibrator.initial_state(count, dtype=torch.float64), 0.1)
    with pytest.raises(ValueError, match=f"state.{name}: expected float32 or float64, got torch.bfloat16"):
        calibrator(segments, cameras, state._replace(**{name: state[0].bfloat16()}), 0.1)
    other = TwoStageCalibrator() if isinstance(calibrator, JointCalibrator) else JointCalibrator()
    for wrong in (None, other.initial_state(2, dtype=torch.float64)):
        message = rf"state: expected {type(state).__name__}, begun by .*, got {type(wrong).__name__}"
        with pytest.raises(ValueError, match=message):
            calibrator(segments, cameras, wrong, 0.1)
    with pytest.raises(ValueError, match=r"dt: expected a float or \(2,\), got \(3,\)"):
        calibrator(segments, cameras, state, torch.ones(3))
    with pytest.raises(ValueError, match="lane_width: expected 1 to 10 m, got inf"):
        calibrator(segments, cameras, state, 0.1, math.inf)
