"""What the joint calibrator promises on the paper's road and on hard ones, with few runs of short drives.

The full figures are those of ``tools.reproduce_table1 --calibrator joint`` and ``tools.bench_calibration``.
"""

import math
from dataclasses import replace
from functools import lru_cache

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.reasons import Reason
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.observation.segments import LaneSegments
from lanebev.testing.evaluation import UNITS, WARM_UP, Track, summarise, track
from lanebev.testing.experiment import Experiment
from lanebev.testing.moments import CAMERA, PLACES, WIDTH, Moment, curves, moments, observe
from lanebev.testing.scenarios import SCENARIOS
from lanebev.types import Status
from tests.estimation.joint_drives import follow
from tools.reproduce_table1 import VARIANCES, run, table

torch.set_num_threads(1)
ROWS = 4
LOST = int(Status.LOST)


@lru_cache(maxsize=8)
def bench(
    name: str, first: float = 0.0, last: float = 99.0, rows: int = ROWS, two_stage: bool = False
) -> Track:
    """Seconds first to last of a scenario."""
    seconds, change = SCENARIOS[name]
    drive = moments(min(seconds, last), change)[round(30 * first) :]
    with torch.inference_mode():
        return track(TwoStageCalibrator() if two_stage else JointCalibrator(), drive, rows)


def rmse(run: Track) -> torch.Tensor:
    """(4,) deg and cm after the first half second."""
    return run.errors[WARM_UP:].square().mean((0, 1)).sqrt() * UNITS


def hard_part(run: Track) -> tuple[torch.Tensor, torch.Tensor, float]:
    """RMSE (4,), largest sigma (4,) and NEES/dof of the named frames."""
    hard = summarise(run)["hard"]
    return torch.tensor(hard["rmse"]), torch.tensor(hard["largest_sigma"]), hard["nees_per_dof"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("vertical_std", "pitch_limit"), [(1e-6, 1.0), (FramePrior().vertical_curvature_std, 1.1)]
)
def test_table1_is_at_the_bound_with_an_honest_covariance(vertical_std, pitch_limit):
    """8 runs of 50 frames: 400 errors a cell, so three standard errors above the target pass.

    The bound is that of a road known to be plane. Not to know it costs a tenth in pitch in these frames.
    """
    runs, count = 8, 50
    calibrator = JointCalibrator(prior=FramePrior(vertical_curvature_std=vertical_std))
    with torch.inference_mode():
        rows = table(run(calibrator, replace(Experiment(), num_frames=count), runs, torch.float64, 0))
    assert len(rows) == len(VARIANCES)
    slack = 1 + 3 / math.sqrt(2 * runs * count)
    for row in rows:
        ratio = [here / bound for here, bound in zip(row["here"], row["bound"], strict=True)]
        limits = [
            pitch_limit,
            1.2,
            1.0,
            1.0,
        ]  # yaw: the start weighs six times as much in 50 frames as in 300
        assert all(r < limit * slack for r, limit in zip(ratio, limits, strict=True)), (
            row["variance"],
            ratio,
        )
        assert 0.8 < row["nees_per_dof"] < 1.25
        assert row["tracking"] == 1.0


@pytest.mark.slow
def test_half_of_all_segments_wrong_costs_at_most_half_more():
    clean = bench("straight", last=4.4)
    dirty = bench("50 % outliers, 5 % wrong index", last=4.4)
    assert (rmse(dirty) < 1.5 * rmse(clean) * 1.1).all()  # four rows: six per cent of noise in each
    assert (dirty.status == Status.TRACKING).all()
    assert summarise(dirty)["nees_per_dof"] < 1.25


@pytest.mark.slow
def test_curves_cost_at_most_the_double_and_bias_the_two_stages():
    """From the straight through a 60 m clothoid into R = 300 m at 30 m/s, segments at 5-40 m."""
    straight, curved = bench("straight 5-40 m", last=2.2), bench("curves R 300 m, 5-40 m", 0.5, 4.5)
    assert (rmse(curved) < 2 * rmse(straight)).all()
    assert 0.7 < summarise(curved)["nees_per_dof"] < 1.4
    biased = bench("curves R 300 m, 5-40 m", 1.2, 3.5, rows=1, two_stage=True)
    assert rmse(biased)[1] > 20 * rmse(curved)[1]


@pytest.mark.slow
def test_a_sharp_bend_turns_the_curvature_and_neither_roll_nor_height():
    """From the straight through a 20 m clothoid into R = 60 m at 15 m/s, three boundaries in sight.

    A filter that lets curvature follow slowly takes the bend for roll and height: 2 deg and 7 cm.
    """
    straight = bench("straight 5-40 m", last=2.2)
    bent = bench("sharp bends R 60 m, three boundaries", 2.0, 9.0)
    pitch, _, roll, height = (rmse(bent) / rmse(straight)).tolist()
    assert max(pitch, roll, height) < 4  # three boundaries up to 30 m instead of six up to 40
    assert rmse(bent)[1] < 0.25
    assert summarise(bent)["nees_per_dof"] < 3
    assert (bent.status == Status.TRACKING).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "first", "last"),
    [("lane change", 3.2, 5.0), ("bumps 1 deg in 0.2 s", 0.0, 1.8), ("exit", 2.4, 4.8)],
)
def test_lane_changes_bumps_and_exits_leave_no_trace(name, first, last):
    """Hard frames are within 1.235 of the straight road's per-frame bound, NEES at most 1.25; never lost."""
    run = bench(name, first, last)
    error, _, nees = hard_part(run)
    bound = bench("straight", last=2.2).bounds[WARM_UP:].mean((0, 1)).sqrt() * UNITS
    assert (error < 1.235 * bound).all()
    assert nees < 1.25
    assert (run.status == Status.TRACKING).all()


@pytest.mark.slow
def test_two_seconds_of_nothing_stay_within_sigmas_that_stop_growing():
    """The pose swings by 1.5 deg: error below 2 deg and 5 cm RMS, sigma below 2 deg and 5 cm, no drift."""
    run = bench("2 s of nothing", 2.4, 5.4)
    error, sigma, nees = hard_part(run)
    assert (error < torch.tensor([2.0, 2.0, 1.2, 5.0])).all()
    assert (sigma < torch.tensor([2.0, 2.0, 2.0, 5.0])).all()
    assert (sigma > torch.tensor([1.0, 1.0, 1.0, 3.0])).all()
    assert nees < 1.25
    assert (run.status[run.hard] == Status.COASTING).all()
    assert (run.status[-1] == Status.TRACKING).all()
    again = run.errors[-5:].square().mean((0, 1)).sqrt() * UNITS
    assert (again < 1.5 * rmse(bench("straight", last=2.2))).all()


@pytest.mark.slow
def test_one_lane_holds_roll_with_growing_sigma():
    """Pitch and yaw as ever; roll's error is the swing of 1 deg that cannot be seen, and no drift."""
    run = bench("one lane for 4 s", 2.4, 6.0)
    error, _, nees = hard_part(run)
    assert (error < torch.tensor([0.03, 0.04, 1.2, 2.0])).all()
    assert nees < 1.25
    roll = run.variances[run.hard][:, :, 2].mean(1).sqrt() * UNITS[2]
    assert roll[0] < 0.5
    assert 1.0 < roll[-1] < 2.0
    assert (roll[10:] >= roll[:-10] - 0.05).all()
    assert (run.status == Status.TRACKING).all()


@pytest.mark.slow
def test_one_boundary_is_within_its_sigmas():
    run = bench("one boundary for 2 s", 2.3, 5.0)
    error, sigma, nees = hard_part(run)
    assert (error < torch.tensor([1.5, 1.5, 1.2, 5.0])).all()
    assert (sigma < torch.tensor([2.0, 2.0, 2.0, 5.0])).all()
    assert nees < 1.25


@pytest.mark.slow
def test_garbage_neither_starts_nor_moves_the_filter():
    run = bench("garbage at first and in between", 0.0, 3.7, rows=2)
    assert (run.status[:9] == Status.UNINITIALISED).all()
    assert (run.status[11:89] == Status.TRACKING).all()
    assert (run.status[91:104] == Status.COASTING).all()
    assert (run.status[-5:] == Status.TRACKING).all()
    assert hard_part(run)[2] < 1.25


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["wrong boundaries", "whole frames misnumbered", "short dashes", "bad clock", "braking"]
)
def test_other_hard_roads_stay_near_the_straight_one(name):
    run = bench(name, 2.5 if name == "braking" else 0.0, 3.8 if name == "braking" else 1.5)
    assert (rmse(run) < 1.4 * rmse(bench("straight", last=2.2))).all()
    assert summarise(run)["nees_per_dof"] < 1.25
    skipped = torch.zeros(len(run.status), dtype=torch.bool)
    if name == "bad clock":  # frames 3 and 5 of ten come twice and late: not used, and said to be so
        skipped = torch.isin(torch.arange(len(run.status)) % 10, torch.tensor([3, 5]))
    assert (run.status[~skipped] == Status.TRACKING).all()
    assert (run.status[skipped] == Status.COASTING).all()


@pytest.mark.slow
def test_far_start_is_found_in_the_first_frame():
    run = bench("far start", last=0.8)
    assert (run.status == Status.TRACKING).all()
    assert (rmse(run) < 1.5 * rmse(bench("straight", last=2.2))).all()


@pytest.mark.slow
def test_unequal_lanes_show_in_the_covariance_of_height():
    """Boundaries up to 15 cm off: height cannot be known to a millimetre, and does not pretend to be."""
    run = bench("unequal lanes", last=1.5)
    assert (rmse(run)[:3] < torch.tensor([0.02, 0.06, 0.15])).all()
    assert rmse(run)[3] < 3.0
    assert (run.variances[WARM_UP:, :, 3].sqrt() * UNITS[3] > 0.6).all()
    assert summarise(run)["nees_per_dof"] < 1.25


@pytest.mark.slow
def test_a_boundary_where_none_can_be_is_not_believed_for_a_frame():
    """A vague detector takes the foot of a barrier for a lane's edge once: its sigmas would let it pass."""
    places = PLACES + torch.tensor([0.0, 1.0, 0, 0, 0, 0], dtype=torch.float64)
    drive = moments(1.0, lambda t, moment: replace(moment, places=places) if t > 0.95 else moment)
    followed = follow(drive, rows=2, sigma=20.0, per_boundary=30)
    believed = [frame.calibration.inliers[frame.segments.boundary == 1].mean() for frame in followed]
    assert torch.stack(believed[10:-2]).min() > 0.8
    assert believed[-1] == 0


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.03, 0.1])
def test_unequal_lanes_are_honest_on_most_roads(size):
    """After a second the median NEES/dof is below 1.25, and one road in eight at most is above 2.

    Deviations that look just like another pose cannot be told from it: some road is always worse.
    """
    draws = size * torch.randn(8, 6, generator=torch.Generator().manual_seed(11), dtype=torch.float64)
    nees = []
    for places in PLACES + draws:
        drive = moments(1.7, lambda t, moment, own=places: replace(moment, places=own))
        with torch.inference_mode():
            nees.append(track(JointCalibrator(), drive, 1).nees[30:].mean() / 4)
    assert torch.stack(nees).median() < 1.25
    assert (torch.stack(nees) > 2).sum() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [1.0, 8.0])
def test_a_boundary_where_none_can_be_is_not_believed(sigma):
    """The foot of a barrier, a metre nearer than a lane's edge, by a sharp detector or by a vague one."""
    shift = torch.tensor([0.0, 1.0, 0, 0, 0, 0], dtype=torch.float64)
    drive = moments(1.0, lambda t, moment: replace(moment, places=PLACES + shift))
    last = follow(drive, rows=2, sigma=sigma, per_boundary=30)[-1]
    foot, inliers = last.segments.boundary == 1, last.calibration.inliers
    assert (inliers[foot] < 0.5).all()
    assert inliers[~foot].mean() > 0.95
    assert (last.error.abs() < 4 * last.sigma).all()


@pytest.mark.slow
def test_lost_after_long_nothing_and_recovers_without_help():
    def change(t: float, moment: Moment) -> Moment:
        return replace(moment, visible=() if 0.5 <= t < 1.5 else moment.visible)

    with torch.inference_mode():
        run = track(JointCalibrator(lost_after=0.6), moments(2.0, change), 2)
    assert (run.status[40:45] == LOST).all()
    assert (run.status[46:] == Status.TRACKING).all()
    assert (run.errors[50:].abs() * UNITS < torch.tensor([0.05, 0.15, 0.08, 0.8])).all()


def _cut(t: float, moment: Moment) -> Moment:
    """From 1 s on another vehicle's camera."""
    if t < 1.0:
        return moment
    pose = (moment.pose[0] - 0.05, moment.pose[1] + 0.05, moment.pose[2] - 0.035, moment.pose[3] + 0.9)
    return replace(moment, pose=pose, offset=moment.offset + 0.8)


@pytest.mark.parametrize("visible", [(0, 1, 2, 3, 4, 5), (2, 3)])
def test_comes_back_within_half_a_second_of_a_cut_and_is_honest_before(visible):
    """All lanes or the ego lane in view; roll stays at its prior with the latter."""
    drive = moments(1.5, lambda t, m: replace(_cut(t, m), visible=visible))
    with torch.inference_mode():
        run = track(JointCalibrator(), drive, 3, per_boundary=8)
    assert (run.status[29] == Status.TRACKING).all()
    assert (run.status[31:34] == Status.COASTING).all()
    assert (run.errors.square() <= 9 * run.variances).double().mean() > 0.97
    assert (run.status[-1] == Status.TRACKING).all()
    late = run.errors[-2:].square().mean((0, 1)).sqrt() * UNITS
    limits = [0.04, 0.12, 0.05, 1.0] if len(visible) == 6 else [0.15, 0.2, 4.0, 8.0]
    assert (late < torch.tensor(limits)).all(), late


@pytest.mark.slow
@pytest.mark.parametrize("name", ["50 % outliers, 5 % wrong index", "unequal lanes", "bumps 1 deg in 0.2 s"])
def test_does_not_start_anew_without_a_shock(name):
    drive = moments(1.3, SCENARIOS[name][1])
    for k, frame in enumerate(follow(drive, rows=3, per_boundary=8, seed=1)):
        started = (frame.state.reasons & int(Reason.RESTARTED)) != 0
        assert started.tolist() == [k == 0] * 3


def test_a_cut_in_one_row_leaves_the_others_as_they_are():
    calibrator = JointCalibrator()
    usual, cut = (list(observe(moments(1.3, c), 1, 1.0, 8, 2, torch.float64)) for c in (None, _cut))
    both, alone = (calibrator.initial_state(rows, dtype=torch.float64) for rows in (2, 1))
    with torch.inference_mode():
        for (moment, one), (_, other) in zip(usual, cut, strict=True):
            pair = LaneSegments(*(torch.cat(parts) for parts in zip(one, other, strict=True)))
            _, both = calibrator(pair, CAMERA.expand(2, 3, 3), both, moment.dt, WIDTH)
            _, alone = calibrator(one, CAMERA[None], alone, moment.dt, WIDTH)
    torch.testing.assert_close(both.mean[:1], alone.mean, rtol=1e-9, atol=1e-12)
    assert both.mean[1, 3] > 2.0  # m: this one started anew


def test_a_crest_is_lower_than_its_tangent_plane():
    """Where the road is 8 cm lower at 40 m its lines are seen 8 cm lower."""
    moment = Moment((0.0, 0.0, 0.0, 1.5), near=5.0, far=40.0, profile=1e-4)
    pixels, _ = curves(moment)
    z = torch.tensor([5.0, 40.0], dtype=torch.float64)
    rows = CAMERA[1, 1] * (1.5 + 0.5e-4 * z.square()) / z + CAMERA[1, 2]
    torch.testing.assert_close(pixels[3, [0, -1], 1], rows)
    torch.testing.assert_close(pixels[3, [0, -1], 0], CAMERA[0, 0] * WIDTH / 2 / z + CAMERA[0, 2])
