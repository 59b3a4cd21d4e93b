"""The slow mount behind the fast pose: blocks, gates, limits with hysteresis, a moved camera, honesty."""

import math

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.mount import (
    MountCalibration,
    MountConfig,
    MountEstimator,
    MountReason,
    MountState,
    MountStatus,
    describe_mount,
)
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
    bad_pose, bad_covariance = fast((math.nan, 0.0, 0.0, 1.5)), fast(POSE)
    bad_covariance = bad_covariance._replace(covariance=-bad_covariance.covariance)
    times = ((fast(POSE), math.nan), (fast(POSE), 0.0), (fast(POSE), -1.0))
    for calibration, dt in (*times, (bad_pose, 0.1), (bad_covariance, 0.1)):
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
    assert state.suspect.tolist() == [[1, 0, 0, 0]]
    out, state = run(mount, state, 4.0)
    assert not state.suspect.any()
    assert out.extrinsics.pitch.item() == pytest.approx(POSE[0], abs=1e-9)
    assert state.filled.sum(1).tolist() == [[7, 8, 8, 8]]


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


def with_std(pose, std) -> Calibration:
    """A tracked frame with one sigma for each axis."""
    plain = fast(pose)
    return plain._replace(covariance=torch.tensor(std, dtype=DOUBLE).square().diag()[None])


ROLL_UNSEEN = (1e-3, 1e-3, 0.05, 1e-2)


def test_an_axis_that_is_never_seen_does_not_hold_up_the_others():
    mount = MountEstimator()
    state = start(mount)
    for _ in range(round(21 * FPS)):
        out, state = mount(with_std(POSE, ROLL_UNSEEN), state, 1 / FPS)
    calibrated, waiting = int(MountStatus.CALIBRATED), int(MountStatus.UNCALIBRATED)
    assert out.axis_status.tolist() == [[calibrated, calibrated, waiting, calibrated]]
    assert out.axis_progress.tolist() == [[100.0, 100.0, 0.0, 100.0]]
    assert out.status.item() == MountStatus.PARTIAL
    assert out.progress.item() == 0.0
    assert out.covariance[0, 2, 2].sqrt().item() == pytest.approx(mount.config.prior_std[2])
    words = describe_mount(out)
    assert words[0] == "pitch: calibrated"
    needs = "roll: needs 20 s of straight driving with two lanes in view; 0 s so far"
    assert words[2] == f"{needs} (this frame does not determine it)"


def test_a_move_seen_on_one_axis_withdraws_what_dates_from_before_it():
    mount = MountEstimator()
    _, state = run(mount, start(mount), 40.0)
    moved = (POSE[0] + math.radians(4), POSE[1], POSE[2], POSE[3])
    reasons = 0
    for _ in range(round(13 * FPS)):
        out, state = mount(with_std(moved, ROLL_UNSEEN), state, 1 / FPS)
        reasons |= out.axis_reasons[0, 2].item()
    assert reasons & MountReason.WITHDRAWN
    assert out.axis_status[0, 2].item() == MountStatus.RECALIBRATING
    assert out.axis_progress[0, 2].item() == 0.0
    assert out.status.item() == MountStatus.RECALIBRATING
    assert out.covariance[0, 2, 2].sqrt() > 0.04
    for _ in range(round(10 * FPS)):
        out, state = mount(with_std(moved, ROLL_UNSEEN), state, 1 / FPS)
    assert out.axis_status[0, 0].item() == MountStatus.CALIBRATED
    assert out.extrinsics.pitch.item() == pytest.approx(moved[0], abs=1e-6)


def test_frames_too_unsure_to_be_used_withdraw_what_they_contradict():
    mount = MountEstimator()
    _, state = run(mount, start(mount), 40.0)
    unsure = (0.011, 1e-3, 1e-3, 1e-2)
    far = (POSE[0] + 0.1, *POSE[1:])
    out, state = mount(with_std(far, unsure), state, 1 / FPS)
    assert out.axis_reasons[0, 0].item() & MountReason.SUSPECT
    assert out.axis_status[0, 0].item() == MountStatus.CALIBRATED
    for _ in range(round(13 * FPS)):
        out, state = mount(with_std(far, unsure), state, 1 / FPS)
    assert out.axis_status[0, 0].item() == MountStatus.RECALIBRATING
    assert out.axis_status[0, 1].item() == MountStatus.CALIBRATED


def test_an_estimate_ages():
    mount = MountEstimator()
    fresh, state = run(mount, start(mount), 40.0)
    out, state = mount(fast(POSE, status=Status.LOST), state, 3600.0)
    drift = torch.tensor(mount.config.drift_std, dtype=DOUBLE)
    grown = (out.covariance - fresh.covariance)[0].diagonal().sqrt()
    torch.testing.assert_close(grown, drift, rtol=2e-2, atol=0.0)
    assert (out.axis_reasons & int(MountReason.STALE)).all()
    assert "not confirmed for a long time" in describe_mount(out)[0]
    renewed, _ = run(mount, state, 4.0)
    assert not (renewed.axis_reasons & int(MountReason.STALE)).any()
    assert (renewed.covariance[0].diagonal() < out.covariance[0].diagonal()).all()


def test_words_say_what_a_moved_or_unusable_axis_is():
    mounted = MountCalibration(
        *fast(POSE)[:2],
        status=torch.zeros(1, dtype=torch.int64),
        progress=torch.zeros(1),
        reasons=torch.zeros(1, dtype=torch.int64),
        axis_status=torch.tensor([[3, 2, 0, 1]]),
        axis_progress=torch.tensor([[60.0, 100.0, 40.0, 100.0]]),
        axis_reasons=torch.tensor([[16, 64, 20, 512]]),
    )
    assert describe_mount(mounted, MountConfig()) == [
        "pitch: restarted because the camera was moved: needs 20 s of straight driving; 12 s so far",
        "yaw: not usable (outside the limits of a usable mount)",
        "roll: needs 20 s of straight driving with two lanes in view; 8 s so far (the vehicle is too slow)",
        "height: calibrated (the latest frames contradict the estimate)",
    ]


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
    with pytest.raises(ValueError, match="lower: expected a tuple of 4 numbers"):
        MountEstimator(lower=(0.0, 1.0))
    with pytest.raises(ValueError, match="moved_blocks, needed, num_blocks"):
        MountEstimator(needed=2)
    with pytest.raises(ValueError, match="block_time: expected a positive"):
        MountEstimator(block_time=0.0)
    mount = MountEstimator()
    with pytest.raises(ValueError, match=r"state.blocks: expected \(2, ...\), got \(1, "):
        mount(fast(POSE, 2), start(mount), 0.1)
    with pytest.raises(ValueError, match=r"state: expected MountState, begun by .* got JointState"):
        mount(fast(POSE, 2), JointCalibrator().initial_state(2), 0.1)


@pytest.mark.slow
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
