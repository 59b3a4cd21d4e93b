"""A camera's mount over its drives: means, drift and moves that are known."""

import math

import numpy as np
import pytest
import torch

from lanebev.app.fleet.mounts import (
    block_calibrations,
    days,
    drive_mounts,
    stretches,
    weighted_mean,
    weighted_slope,
)
from lanebev.estimation.mount import MountEstimator
from lanebev.types import Calibration, Extrinsics, Status

POSE = (0.03, -0.01, 0.005, 1.4)


def _state(pose, seconds=41, seed=0, std=(0.003, 0.003, 0.003, 0.01)):
    """The state after a drive of a frame a second about a mount; roll is not seen where std is large."""
    estimator = MountEstimator()
    state = estimator.initial_state(1, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(seconds):
        noise = torch.randn(4, generator=generator, dtype=torch.float64) * torch.tensor(std)
        calibration = Calibration(
            Extrinsics.unstack((torch.tensor(pose, dtype=torch.float64) + noise)[None]),
            torch.diag(torch.tensor(std, dtype=torch.float64) ** 2)[None],
            torch.tensor([int(Status.TRACKING)]),
            torch.zeros(1, 0),
        )
        _, state = estimator(calibration, state, 1.0)
    return state


def _day(number):
    return f"2026-03-{number:02d}"


def test_a_mean_by_hand():
    mean, std = weighted_mean(np.array([1.0, 4.0, np.nan]), np.array([1.0, 2.0, 1.0]))
    assert mean == pytest.approx((1 + 4 / 4) / 1.25)
    assert std == pytest.approx(math.sqrt((0.6**2 + 2.4**2 / 4) / 1.25))  # chi squared 1.8 of one degree
    assert weighted_mean(np.array([2.0]), np.array([0.5])) == pytest.approx((2.0, 0.5))
    assert all(map(math.isnan, weighted_mean(np.array([np.nan]), np.array([1.0]))))


def test_a_slope_by_hand():
    slope, std = weighted_slope(np.array([0.0, 1.0, 2.0]), np.array([1.0, 1.5, 2.0]), np.array([0.1] * 3))
    assert slope == pytest.approx(0.5)
    assert std == pytest.approx(0.1 / math.sqrt(2))
    for times in ([0.0, 0.2, 0.4], [0.0, np.nan, 2.0]):
        assert math.isnan(weighted_slope(np.array(times), np.array([1.0, 1.5, 2.0]), np.array([0.1] * 3))[0])


def test_days_count_zones():
    assert days("2026-03-02") - days("2026-03-01") == 1
    assert days("2026-03-01T02:00+02:00") == days("2026-03-01T00:00")
    assert math.isnan(days(""))


def test_blocks_come_back_oldest_first():
    state = _state(POSE, seconds=10)
    blocks = block_calibrations(state, 4.0)
    assert [seconds for _, seconds in blocks] == [4.0, 4.0, 2.0]
    for (calibration, _), expected in zip(blocks, (1, 0), strict=False):
        torch.testing.assert_close(calibration.extrinsics.stack()[0], state.blocks[0, expected])
    torch.testing.assert_close(blocks[2][0].extrinsics.stack()[0], state.pose_sum[0] / state.seconds[0])


def test_drives_of_a_steady_camera_are_one_stretch():
    mounts = drive_mounts([(f"d{i}", _day(1 + i), _state(POSE, seed=i)) for i in range(5)])
    assert not any(mount.moved.any() for mount in mounts)
    (stretch,) = stretches(mounts)
    assert (stretch.first, stretch.last, stretch.drives) == ("d0", "d4", 5)
    assert (np.abs(stretch.pose - POSE) < 4 * stretch.std).all()
    assert (stretch.std < mounts[0].std).all()
    assert (np.abs(stretch.drift) < 4 * stretch.drift_std).all()


@pytest.mark.slow
def test_drift_is_found():
    rate = 0.001  # rad a day
    states = [
        (f"d{i}", _day(1 + i), _state((POSE[0] + rate * i, *POSE[1:]), seed=i, seconds=81)) for i in range(8)
    ]
    (stretch,) = stretches(drive_mounts(states))
    assert stretch.drift[0] == pytest.approx(rate, abs=3 * stretch.drift_std[0])
    assert stretch.drift[0] > 2 * stretch.drift_std[0]


def test_a_move_between_drives_begins_a_stretch():
    moved = (POSE[0] + 0.04, *POSE[1:])
    states = [(f"d{i}", _day(1 + i), _state(POSE if i < 2 else moved, seed=i)) for i in range(4)]
    mounts = drive_mounts(states)
    assert [mount.moved[0] for mount in mounts] == [False, False, True, False]
    first, second = stretches(mounts)
    assert (first.last, second.first, second.drives) == ("d1", "d2", 2)
    assert first.pose[0] == pytest.approx(POSE[0], abs=0.004)
    assert second.pose[0] == pytest.approx(moved[0], abs=0.004)


def test_an_axis_without_evidence_is_not_known():
    state = _state(POSE, std=(0.003, 0.003, 0.3, 0.01))
    (mount,) = drive_mounts([("one", "", state)])
    assert np.isfinite(mount.pose).tolist() == [True, True, False, True]
    (stretch,) = stretches([mount])
    assert math.isnan(stretch.pose[2])
    empty = MountEstimator().initial_state(1, dtype=torch.float64)
    (nothing,) = drive_mounts([("none", "", empty)])
    assert np.isnan(nothing.pose).all()
    assert stretches([]) == []
