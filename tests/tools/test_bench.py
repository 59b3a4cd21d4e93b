"""The bench tool runs, and its figures mean what they say."""

import json
from dataclasses import replace

import pytest
import torch

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.testing.evaluation import Track, recovery, summarise
from lanebev.testing.moments import WIDTH
from tools.bench_calibration import main, smallest_eigenvalue, stream
from tools.bench_kinds import ALLOWED, FIRST_SEED, measure
from tools.bench_mixed import FIRST_SEED as FIRST_MIXED
from tools.bench_mixed import draw, run_drive, table_row


@pytest.mark.slow
def test_quick_bench_writes_json(tmp_path):
    report = main(["--quick", "--calibrators", "joint", "two-stage", "--out", str(tmp_path)])
    written = json.loads((tmp_path / "bench.json").read_text())
    assert written["scenarios"].keys() == report["scenarios"].keys() == {"straight", "straight 5-40 m"}
    for figures in written["scenarios"].values():
        assert set(figures) == {"joint", "two-stage"}
        assert all(0 < value < 1 for value in figures["joint"]["rmse"])
        assert figures["joint"]["time_in_status"]["TRACKING"] == 1.0


@pytest.mark.slow
def test_stream_reports_drift_memory_and_precision():
    found = stream(60, rows=2)
    assert found["rows_not_tracking"] == 0
    assert found["smallest_eigenvalue_of_correlation"] > 0
    assert max(found["float32_from_float64_sigmas"]) < 0.05
    assert len(found["memory_mb"]) == 2


def track(errors: list[float], hard: list[bool]) -> Track:
    """One row, the same error in all four, unit variances and bounds."""
    error = torch.tensor(errors, dtype=torch.float64)[:, None, None].expand(-1, 1, 4)
    one = torch.ones_like(error)
    status = torch.ones(len(errors), 1, dtype=torch.int64)
    return Track(error, one, error.square().sum(-1), status, one, torch.tensor(hard))


def test_figures_of_a_known_track():
    errors = [9.0] * 15 + [1.0, 2.0, 3.0, 1.0]
    run = track(errors, [False] * 16 + [True, True, False])
    figures = summarise(run, torch.full((4,), 0.6, dtype=torch.float64))
    assert figures["ratio_to_bound"] == pytest.approx([1.0] * 4)  # the first half second is left out
    assert figures["nees_per_dof"] == pytest.approx(1.0)
    assert figures["hard"]["largest"][3] == pytest.approx(300.0)  # cm
    assert figures["hard"]["nees_per_dof"] == pytest.approx(6.5)
    assert figures["recovery_s"] == 0.0


def test_recovery_counts_from_the_end_of_the_hard_frames():
    hard = [False, True, False, False, False]
    usual = torch.ones(4, dtype=torch.float64)
    assert recovery(track([0, 9, 5, 3, 1], hard), usual) == pytest.approx(2 / 30)
    assert recovery(track([0, 9, 5, 3, 3], hard), usual) is None


def test_smallest_eigenvalue_is_of_the_correlations():
    cov = torch.tensor([[[1e-12, 5e-7], [5e-7, 1.0]]])
    assert smallest_eigenvalue(cov) == pytest.approx(0.5, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cut, ego lane", "knock"])
def test_shocks_of_drives_on_which_nothing_was_chosen(kind):
    found = measure(kind, [FIRST_SEED + 500, FIRST_SEED + 501])
    assert max(found.back) <= ALLOWED
    assert found.within >= 0.97


def test_drives_drawn_at_random_are_the_same_for_a_seed_and_change_lanes_without_a_jump():
    seed = next(k for k in range(2000, 2050) if "lane change" in draw(k).difficulties)
    drive, again = draw(seed), draw(seed)
    assert [moment.pose for moment in drive.moments] == [moment.pose for moment in again.moments]
    offsets = torch.tensor([moment.offset for moment in drive.moments]).diff().abs()
    assert (offsets > WIDTH - 0.5).sum() == 1  # where the numbers of the boundaries change
    assert ((offsets < 0.5) | (offsets > WIDTH - 0.5)).all()


def test_a_drive_drawn_at_random_is_calibrated_and_its_row_has_the_shares():
    drive = draw(FIRST_MIXED)
    short = replace(drive, moments=drive.moments[: len(drive.moments) // 8])
    errors = run_drive(short, FIRST_MIXED, JointCalibrator())
    evaluated = [moment for moment in short.moments if not moment.tag]
    assert 0 < len(errors.nees) <= len(evaluated)
    assert (errors.within() > 0.9).all()
    wrong = errors._replace(by_sigma=torch.tensor([[0.0, 2.9, 3.1, 9.0]]), nees=torch.tensor([2.0]))
    assert table_row("one", [wrong]) == "| one | 1 | 2.00 | 100.0 100.0 0.0 0.0 |"
    assert table_row("none", []) == "| none | 0 | – | – |"
