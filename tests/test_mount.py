"""The slow mount behind the fast pose: blocks, gates, limits with hysteresis, a moved camera, honesty."""

from __future__ import annotations

import math

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.mount import MountEstimator, MountReason, MountState, MountStatus
from lanebev.types import Calibration, Extrinsics, Status

DOUBLE = torch.float64
FPS = 5.0
POSE = (0.02, -0.01, 0.005, 1.4)


def fast(pose, rows: int = 1, std: float = 1e-3, status: Status = Status.TRACKING) -> Calibration:
    values = torch.as_tensor(pose, dtype=DOUBLE).expand(rows, 4)
    cov = torch.diag(torch.full((4,), std**2, dtype=DOUBLE)).expand(rows, 4, 4)
    return Calibration(Extrinsics.unstack(values), cov, torch.full((rows,), int(status)), torch.ones(rows, 1))


def run(mount: MountEstimator, state: MountState, seconds: float, pose=POSE, **inputs):
    rows = state.seconds.shape[0]
    for _ in range(round(seconds * FPS)):
        out, state = mount(fast(pose, rows), state, 1 / FPS, **inputs)
    return out, state


def start(mount: MountEstimator, rows: int = 1) -> MountState:
    return mount.initial_state(rows, dtype=DOUBLE)


def test_progress_runs_to_a_hundred_and_the_estimate_is_the_mean():
    mount = MountEstimator()
    out, state = run(mount, start(mount), 10.0)
    assert out.progress.item() == pytest.approx(50.0)
    assert out.status.item() == MountStatus.UNCALIBRATED
    assert out.reasons.item() == MountReason.FEW_BLOCKS
    out, state = run(mount, state, 10.0)
    assert out.progress.item() == 100.0
    assert out.status.item() == MountStatus.CALIBRATED
    assert out.reasons.item() == MountReason.NONE
    torch.testing.assert_close(out.extrinsics.stack()[0], torch.tensor(POSE, dtype=DOUBLE))


def test_before_anything_is_seen_it_gives_the_prior_and_says_why():
    mount = MountEstimator()
    out, _ = mount(fast(POSE, status=Status.COASTING, std=0.5), start(mount), 0.1)
    assert out.extrinsics.height.item() == 1.5
    assert out.covariance[0].diagonal().sqrt().tolist() == pytest.approx([0.12, 0.15, 0.05, 0.5])
    assert out.progress.item() == 0.0
    expected = MountReason.NOT_TRACKING | MountReason.UNSURE | MountReason.FEW_BLOCKS
    assert out.reasons.item() == expected


@pytest.mark.parametrize(
    ("inputs", "reason"),
    [
        ({"speed": torch.tensor([3.0])}, MountReason.SLOW),
        ({"speed": torch.tensor([math.nan])}, MountReason.SLOW),
        ({"yaw_rate": torch.tensor([0.1])}, MountReason.TURNING),
        ({"curvature": torch.tensor([-1 / 300])}, MountReason.TURNING),
    ],
)
def test_gates_keep_frames_out(inputs, reason):
    mount = MountEstimator()
    out, state = run(mount, start(mount), 5.0, **inputs)
    assert out.progress.item() == 0.0
    assert out.reasons.item() & reason
    open_gates = {"speed": torch.tensor([20.0]), "yaw_rate": torch.tensor([0.01])}
    assert run(mount, state, 4.0, **open_gates)[0].progress.item() == pytest.approx(20.0)


def test_bad_time_and_numbers_change_nothing():
    mount = MountEstimator()
    _, state = run(mount, start(mount), 2.0)
    bad_pose = fast((math.nan, 0.0, 0.0, 1.5))
    for calibration, dt in ((fast(POSE), math.nan), (fast(POSE), 0.0), (fast(POSE), -1.0), (bad_pose, 0.1)):
        out, after = mount(calibration, state, dt)
        assert out.reasons.item() & (MountReason.TIME | MountReason.UNSURE)
        for name in ("blocks", "pose_sum", "seconds"):
            assert torch.equal(getattr(after, name), getattr(state, name))


def test_limits_do_not_flicker():
    mount = MountEstimator(block_time=0.1, num_blocks=3, needed=3, moved_blocks=2)
    state, seen = start(mount), []
    limit = mount.config.upper[0]
    for offset in (-0.01, 0.001, -0.001, 0.001, 0.01, 0.001, -0.001, 0.001, -0.01):
        for _ in range(3):
            out, state = mount(fast((limit + offset, 0.0, 0.0, 1.5)), state, 0.1)
        seen.append(out.status.item() == MountStatus.INVALID)
    assert seen == [False, False, False, False, True, True, True, True, False]
    assert not out.reasons.item() & MountReason.PITCH_LIMIT
    for index, reason in enumerate((MountReason.PITCH_LIMIT, MountReason.YAW_LIMIT, MountReason.ROLL_LIMIT)):
        pose = [0.0, 0.0, 0.0, 1.5]
        pose[index] = 0.5
        out, _ = run(mount, start(mount), 1.0, pose)
        assert out.status.item() == MountStatus.INVALID
        assert out.reasons.item() == reason
    assert run(mount, start(mount), 1.0, (0.0, 0.0, 0.0, 5.0))[0].reasons.item() == MountReason.HEIGHT_LIMIT


def test_moved_camera_restarts_from_recent_blocks_and_hands_over_smoothly():
    mount = MountEstimator()
    _, state = run(mount, start(mount), 40.0)
    moved = (POSE[0] + math.radians(3), *POSE[1:])
    out, state = run(mount, state, 8.2, moved)
    assert out.status.item() == MountStatus.CALIBRATED  # two blocks may be a long hill
    assert out.reasons.item() & MountReason.SUSPECT
    assert out.extrinsics.pitch.item() == pytest.approx(POSE[0], abs=1e-9)  # and do not touch the estimate
    given, last = [out.extrinsics.pitch.item()], None
    for _ in range(70):
        out, state = mount(fast(moved), state, 1 / FPS)
        given.append(out.extrinsics.pitch.item())
        if out.reasons.item() & MountReason.MOVED:
            last = len(given) - 1
            assert out.status.item() == MountStatus.RECALIBRATING
            assert out.progress.item() == pytest.approx(60.0)
            assert out.covariance[0, 0, 0].sqrt() > math.radians(1)  # not yet handed over, and it says so
    steps = torch.tensor(given).diff().abs()
    assert steps.max() < math.radians(3) / 10 + 1e-6  # ten steps
    assert given[last + 10] == pytest.approx(moved[0], abs=1e-6)
    assert out.status.item() == MountStatus.CALIBRATED


def test_one_odd_block_is_dropped():
    mount = MountEstimator()
    _, state = run(mount, start(mount), 24.0)
    _, state = run(mount, state, 4.0, (POSE[0] + 0.05, *POSE[1:]))
    assert state.suspect.item() == 1
    out, state = run(mount, state, 4.0)
    assert state.suspect.item() == 0
    assert out.extrinsics.pitch.item() == pytest.approx(POSE[0], abs=1e-9)
    assert state.filled.sum() == 7


def test_small_real_motion_is_not_a_moved_camera_and_the_covariance_is_honest():
    """Body motion with a correlation time of a second, 64 vehicles: NEES/dof, and no restart."""
    rows, seconds = 64, 60
    generator = torch.Generator().manual_seed(0)
    mount = MountEstimator()
    state = start(mount, rows)
    std = torch.tensor([0.008, 0.012, 0.008, 0.02], dtype=DOUBLE)
    body, fade = torch.zeros(rows, 4, dtype=DOUBLE), math.exp(-1 / FPS)
    for _ in range(round(seconds * FPS)):
        kick = torch.randn(rows, 4, generator=generator, dtype=DOUBLE)
        body = fade * body + math.sqrt(1 - fade**2) * std * kick
        out, state = mount(fast(torch.tensor(POSE, dtype=DOUBLE) + body, rows), state, 1 / FPS)
        assert not (out.reasons & MountReason.MOVED).any()
    assert (out.status == MountStatus.CALIBRATED).all()
    error = out.extrinsics.stack() - torch.tensor(POSE, dtype=DOUBLE)
    nees = (error.square() / out.covariance.diagonal(dim1=1, dim2=2)).mean()
    assert 0.5 < nees < 1.25


def test_row_alone_equals_row_in_batch():
    mount = MountEstimator(block_time=0.3)
    poses = torch.tensor([POSE, (math.nan, 0, 0, 1), (0.0, 0.05, -0.02, 1.2)], dtype=DOUBLE)
    state, alone = start(mount, 3), start(mount)
    for k in range(30):
        calibration = fast(poses + 0.001 * math.sin(k), 3)
        out, state = mount(calibration, state, 0.1)
        row = Calibration(
            Extrinsics.unstack(calibration.extrinsics.stack()[2:]),
            calibration.covariance[2:],
            calibration.status[2:],
            calibration.inliers[2:],
        )
        single, alone = mount(row, alone, 0.1)
    assert torch.equal(single.extrinsics.stack()[0], out.extrinsics.stack()[2])
    assert torch.equal(single.covariance[0], out.covariance[2])
    assert out.extrinsics.stack().isfinite().all()
    assert out.progress[1] == 0


def test_bad_numbers_are_named():
    with pytest.raises(ValueError, match="moved_blocks, needed, num_blocks"):
        MountEstimator(needed=2)
    with pytest.raises(ValueError, match="block_time: expected a positive"):
        MountEstimator(block_time=0.0)
    mount = MountEstimator()
    with pytest.raises(ValueError, match=r"state.blocks: expected \(2, ...\), got \(1, "):
        mount(fast(POSE, 2), start(mount), 0.1)
    with pytest.raises(ValueError, match=r"state: expected MountState, begun by .* got JointState"):
        mount(fast(POSE, 2), JointCalibrator().initial_state(2), 0.1)


def test_exports_and_equals_eager():
    mount = MountEstimator()
    _, state = run(mount, start(mount, 2), 4.0)
    arguments = (fast(POSE, 2), state, torch.tensor([0.1, 0.2], dtype=DOUBLE))
    exported = torch.export.export(mount, arguments).module()
    expected, found = mount(*arguments), exported(*arguments)
    torch.testing.assert_close(found[0].extrinsics.stack(), expected[0].extrinsics.stack())
    for one, other in zip(found[1], expected[1], strict=True):
        torch.testing.assert_close(one, other)


def test_results_have_the_dtype_of_the_state():
    mount = MountEstimator()
    _, state = mount(fast(POSE), mount.initial_state(1), 0.1)
    assert {part.dtype for part in state if part.is_floating_point()} == {torch.float32}
    with pytest.raises(ValueError, match="speed: expected a float or"):
        mount(fast(POSE), state, 0.1, speed=torch.ones(2))
