"""What ten minutes of a GPU survive, without one."""

import math
import sys

import pytest
import torch

from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from train import gpu_run, processes
from train.evaluate_roads import OWN_KINDS
from train.gpu_run import held_out_recall, pose_scale, time_parts, train_until
from train.processes import Measurement, Training


class Clock:
    """Time that passes only in sleep."""

    def __init__(self):
        self.now = 0.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


class Breaking(Training):
    """A training that ends as told: (after seconds, status, of memory)."""

    def __init__(self, clock, ends, tmp_path):
        super().__init__(tmp_path / "c.yaml", tmp_path, tmp_path / "log", [])
        self.clock, self.ends, self.begun, self.shares, self.killed = clock, list(ends), [], [], False

    def start(self, seconds):
        self.begun.append(seconds)
        self.shares.append(self.batch_share)
        self.current = self.ends.pop(0)
        self.since = self.clock.now

    def ended(self):
        after, status, _ = self.current
        return status if self.clock.now - self.since >= after else None

    def out_of_memory(self):
        return self.current[2]

    def stop(self):
        self.killed = True


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(gpu_run, "time", clock)
    return clock


def run(clock, ends, tmp_path, deadline=325.0):
    training, snapshots = Breaking(clock, ends, tmp_path), []
    train_until(training, deadline, lambda number: snapshots.append((number, clock.now)))
    return training, snapshots


def test_a_run_that_goes_well_leaves_two_snapshots(clock, tmp_path):
    training, snapshots = run(clock, [(320, 0, False)], tmp_path)
    assert training.begun == [300.0]  # 25 s to start
    assert [number for number, _ in snapshots] == [1, 2]
    assert snapshots[0][1] == pytest.approx(125, abs=1)
    assert not training.killed


def test_out_of_memory_goes_on_with_half_the_batch(clock, tmp_path):
    training, _ = run(clock, [(30, 1, True), (20, 1, True), (1e9, 0, False)], tmp_path)
    assert training.shares == [1.0, 0.5, 0.25]
    assert training.begun[1] == pytest.approx(325 - 30 - 25)


def test_what_breaks_for_other_reasons_goes_on_as_it_was_but_not_for_ever(clock, tmp_path):
    training, _ = run(clock, [(1, 1, False)] * 20, tmp_path)
    assert training.shares == [1.0] * 7


def test_a_run_that_does_not_end_is_ended(clock, tmp_path):
    training, _ = run(clock, [(1e9, 0, False)], tmp_path)
    assert training.killed
    assert clock.now < 325 + 22


def test_training_hears_its_process(tmp_path, monkeypatch, capsys):
    command = [sys.executable, "-c", "print('CUDA out of memory'); raise SystemExit(1)"]
    popen = processes.subprocess.Popen
    monkeypatch.setattr(processes.subprocess, "Popen", lambda _, **kwargs: popen(command, **kwargs))
    training = Training(tmp_path / "c.yaml", tmp_path, tmp_path / "fit.log", [])
    training.start(5)
    training._process.wait(30)
    assert training.ended() == 1
    assert training.out_of_memory()
    assert "out of memory" in (tmp_path / "fit.log").read_text()
    assert "out of memory" in capsys.readouterr().out
    assert training.checkpoint() is None


def test_measurements_are_lines_of_json_and_end_in_time(tmp_path, monkeypatch):
    (tmp_path / "says.py").write_text("print('a table'); print('{\"a\": 1}')")
    (tmp_path / "hangs.py").write_text("import time; print('{\"a\": 2}', flush=True); time.sleep(1000)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert Measurement("says").result(60) == [{"a": 1}]
    assert Measurement("hangs").result(1) in ([{"a": 2}], [])


def test_recall_is_measured_on_all_kinds_within_the_time_and_breaks_nothing(tmp_path, monkeypatch, capsys):
    network = LaneSegmenter(SegmenterConfig(base_width=4, decoder_width=4, image_size=(32, 48))).eval()
    monkeypatch.setattr(gpu_run, "trained_segmenter", lambda _: (network,))
    found = held_out_recall(tmp_path, len(OWN_KINDS), math.inf)
    assert {record["name"] for record in found if record["by"] == "kind"} == set(OWN_KINDS)
    assert held_out_recall(tmp_path, len(OWN_KINDS), -math.inf) == []
    monkeypatch.undo()
    assert held_out_recall(tmp_path / "none.safetensors", 1, math.inf) == []
    assert "none.safetensors" in capsys.readouterr().out


@pytest.mark.parametrize(("until", "deadline"), [(1000.0, 125.0), (120.0, 115.0)])
def test_recall_takes_its_time_at_most(tmp_path, monkeypatch, until, deadline):
    clock, given = Clock(), []
    clock.now = 100.0
    monkeypatch.setattr(gpu_run, "time", clock)
    monkeypatch.setattr(gpu_run, "trained_segmenter", lambda _: (torch.nn.Identity(),))
    monkeypatch.setattr(gpu_run, "evaluate", lambda *arguments: given.append(arguments[-1]) or {})
    held_out_recall(tmp_path, 8, until)
    assert given == [deadline]


def test_timing_the_parts_ends_in_time_and_the_run_goes_on(tmp_path, capsys):
    time_parts(tmp_path, 0.01)
    assert "took too long" in capsys.readouterr().out


def test_scale_of_the_pose_is_that_measured_with_the_sigma_scale_and_never_below_one():
    noise = [
        {"factor": 1.0, "pose_sigma_scale": 3.0},
        {"factor": 2.25, "pose_sigma_scale": 0.7},
    ]
    assert pose_scale(noise) == {"sigma_scale": 2.25, "pose_sigma_scale": 1.0}
    assert pose_scale([]) == {}
    assert pose_scale([{"factor": 2.25, "pose_sigma_scale": None}]) == {}


def complaint(monkeypatch, capsys, tmp_path, minutes):
    """What the command says that ends with status 2."""
    monkeypatch.setattr("sys.argv", ["gpu_run", f"--minutes={minutes}", f"--out={tmp_path / 'out'}"])
    with pytest.raises(SystemExit) as stop:
        gpu_run.main()
    assert stop.value.code == 2
    return capsys.readouterr().err


def test_a_time_without_training_is_refused_before_it_begins(monkeypatch, capsys, tmp_path):
    said = complaint(monkeypatch, capsys, tmp_path, 1)
    assert (
        said == "error: --minutes: expected more than 1.0, which start, export and evaluation take, got 1\n"
    )
    assert not (tmp_path / "out").exists()


def test_too_little_time_for_a_checkpoint_is_one_line_with_the_remedy(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(gpu_run, "train_until", lambda *_: None)
    said = complaint(monkeypatch, capsys, tmp_path, 1.5)
    assert "expected a checkpoint of 53 s of training, got none; give more than --minutes 1.5, unless" in said
