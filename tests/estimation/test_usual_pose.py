"""Roll and height that the lanes tell badly, against those that the drive has shown."""

import math
from dataclasses import replace

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.filter.usual_pose import has_odd_line
from lanebev.estimation.joint.measurement.observations import observations
from lanebev.estimation.joint.measurement.residuals import HEIGHT
from lanebev.tensors import map_tensors
from lanebev.testing.moments import CAMERA, FPS, WIDTH, moments, observe
from lanebev.testing.motions import sinusoids
from tests.estimation.joint_drives import DOUBLE
from tools.bench_kinds import drawn
from tools.random_drives import NARROWING
from tools.replay.kinds import EGO_LANE, Generated, knock
from tools.replay.recording import Recording, record, replay

torch.set_num_threads(1)

SECOND = 30


def heights(drive: Recording) -> tuple[torch.Tensor, torch.Tensor]:
    """Errors and standard deviations of the height (T,), m."""
    made = replay(JointCalibrator(), [drive])
    return made.pose[:, 0, HEIGHT] - drive.truth[:, HEIGHT], made.covariance[:, 0, HEIGHT, HEIGHT].sqrt()


def test_a_lane_that_becomes_narrower_leaves_the_height_in_doubt():
    """The right line moves in by 0.8 m at one place: the height seems to be 0.4 m more."""
    [drive] = drawn(NARROWING, [60_004])
    drive.segments.weight[7 * SECOND : 7 * SECOND + 3] = 0  # frames without lanes tell nothing new
    error, std = heights(drive)
    narrower = slice(6 * SECOND, 9 * SECOND)
    assert error[narrower].abs().min() > 0.2
    assert (error.abs() < 3 * std)[narrower].all()
    assert std[3 * SECOND] < 0.06  # before


@pytest.mark.parametrize("frame", [3 * SECOND, 6 * SECOND])
def test_forward_derivatives_of_the_covariance_are_differences(frame):
    """Before and after the lane becomes narrower."""
    [drive] = drawn(NARROWING, [60_004])
    calibrator = JointCalibrator()
    state = calibrator.initial_state(1, dtype=DOUBLE)

    def variance(seen, state):
        out, after = calibrator(seen, CAMERA[None], state, 1 / FPS, WIDTH)
        return out.covariance[0, HEIGHT, HEIGHT], after

    for k in range(frame):
        _, state = variance(map_tensors(lambda part, k=k: part[k : k + 1], drive.segments), state)
    seen = map_tensors(lambda part: part[frame : frame + 1], drive.segments)
    ends = seen.endpoints.double()
    along = torch.randn(ends.shape, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)

    def moved(by):
        return variance(seen._replace(endpoints=ends + by * along), state)[0]

    one = torch.ones((), dtype=DOUBLE)
    _, derivative = torch.func.jvp(moved, (0 * one,), (one,))
    torch.testing.assert_close(derivative, (moved(1e-5) - moved(-1e-5)) / 2e-5, rtol=1e-2, atol=1e-12)


def test_a_camera_that_swings_is_not_in_doubt():
    [drive] = drawn("motion up to 1.5°, 1.2 Hz, ego lane", [60_001])
    error, std = heights(drive)
    assert error.abs().max() < 0.06
    assert std.max() < 0.06


def test_a_camera_that_was_knocked_is_in_doubt_for_some_seconds():
    """Its pitch changes too, for good."""
    by = (math.radians(3), math.radians(-3), 0.0, 0.25)

    def change(t, moment):
        return replace(knock(by)(t, moment), visible=EGO_LANE)

    def later(t, moment):
        return change(t - 4.0, moment)

    drive = record(Generated("", lambda: moments(10.0, later, sinusoids(1))), 1)
    error, std = heights(drive)
    assert (std[6 * SECOND : 8 * SECOND] > 0.1).all()
    assert (std[9 * SECOND :] < 0.06).all()
    assert (error[6 * SECOND :].abs() < 0.06).all()


def test_a_line_of_which_hardly_anything_fits_is_odd():
    [(_, seen)] = observe(moments(1 / 30), 3, 1.0, 10, 0, DOUBLE)
    inliers = torch.ones(3, 60, dtype=DOUBLE)
    of_line = seen.boundary == 1
    inliers[1][of_line[1]] = 0.1
    inliers[2][of_line[2].nonzero()[:5]] = 0.0
    odd = has_odd_line(observations(seen, CAMERA.expand(3, 3, 3)), inliers, 6)
    assert odd.tolist() == [False, True, False]
    few = seen._replace(weight=seen.weight * (of_line.cumsum(1) <= 3))
    assert not has_odd_line(observations(few, CAMERA.expand(3, 3, 3)), inliers, 6)[1]
