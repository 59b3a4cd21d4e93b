"""Parts of a long drive: where they are cut, their order, and that the whole is the uncut drive."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch

from lanebev.app.config import RunConfig
from lanebev.app.continued.part_observation import observe_part
from lanebev.app.demo import write_drive
from lanebev.app.drive.observers import NetworkObserver
from lanebev.app.fleet import worker
from lanebev.app.fleet.manifest import Drive
from lanebev.app.fleet.plan import (
    Outcome,
    Part,
    duration,
    earlier_outcome,
    is_done,
    parts_of,
    tasks_of,
    write_mark,
)
from lanebev.app.fleet.queue import TaskQueue
from lanebev.app.run import run
from lanebev.io.state import load_state
from lanebev.io.video.writer import VideoWriter
from lanebev.render import Drive as RenderedDrive
from lanebev.report.run_folder import read_run

OUTPUTS = ("extrinsics.csv", "covariance.csv", "lanes.json", "calibration.yaml", "bev.mp4", "overlay.mp4")


def test_parts_cover_the_drive():
    assert parts_of(0, 100, 30) == [Part(0, 30), Part(30, 60), Part(60, None)]
    assert parts_of(5, 40, 30) == [Part(5, None)]
    assert parts_of(0, float("inf"), 30) == [Part(0, None)]


@pytest.fixture
def drive(tmp_path):
    """A drive of ten seconds, of which nine are taken."""
    with VideoWriter(tmp_path / "a.mp4", Fraction(5)) as writer:
        for _ in range(50):
            writer.write(np.zeros((32, 32, 3), np.uint8))
    return Drive("one", "c", "unknown", "", RunConfig(str(tmp_path / "a.mp4"), "c.yaml", end=9.0))


def test_a_long_video_has_parts(tmp_path, drive):
    assert duration(drive.config.source) == pytest.approx(10.0, abs=0.2)
    assert duration(tmp_path / "none.mp4") == float("inf")
    task = tasks_of([drive], tmp_path, 3.0)["one"]
    times = [(part.config.start, part.config.end) for part in task.parts]
    assert times == [(0.0, 3.0), (3.0, 6.0), (6.0, 9.0)]
    assert task.parts[2].name == "one, part 2"
    assert task.parts[2].config.out == str(tmp_path / "drives" / ".one.part-002")
    assert task.config == replace(drive.config, out=str(tmp_path / "drives" / "one"))
    uncut = [tasks_of([drive], tmp_path, 30.0), tasks_of([drive], tmp_path)]
    lanes = replace(drive, config=replace(drive.config, lanes="lanes.json"))
    uncut.append(tasks_of([lanes], tmp_path, 3.0))
    assert [each["one"].parts for each in uncut] == [(), (), ()]
    assert uncut[0]["one"].fingerprint == task.fingerprint


def test_a_part_in_a_gap_of_the_times_has_no_frames(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", Fraction(5)) as writer:
        for time in (0.0, 0.2, 0.4, 8.0, 8.2, 8.4):
            writer.write(np.zeros((32, 32, 3), np.uint8), time)
    config = RunConfig(str(tmp_path / "a.mp4"), fov=60.0, lanes=str(tmp_path / "lanes.json"))
    Path(config.lanes).write_text(
        "".join(f'{{"raw_file": "{k}", "h_samples": [9], "lanes": []}}\n' for k in range(6))
    )
    counts = [
        observe_part(replace(config, start=start, end=end), tmp_path / "part.json")
        for start, end in ((0.0, 3.0), (3.0, 6.0), (6.0, None))
    ]
    assert counts == [3, 0, 3]
    with pytest.raises(ValueError, match="expected some of the 6 frames to be taken, got none"):
        run(replace(config, start=3.0, end=6.0, out=str(tmp_path / "out")))


def test_parts_come_first_and_the_whole_when_all_are_there(tmp_path, drive):
    task = tasks_of([drive], tmp_path, 3.0)["one"]
    Path(task.parts[1].config.out).mkdir(parents=True)
    task.parts[1].result.write_text("")
    write_mark(task.parts[1], Outcome(task.parts[1].name, frames=15))
    assert is_done(task.parts[1])
    queue = TaskQueue([task], batch=1, retries=0)
    assert [queue.waiting.popleft() for _ in range(2)] == [(task.parts[0],), (task.parts[2],)]
    assert queue.end(task.parts[0], Outcome("one, part 0")) is None
    assert not queue.waiting
    assert queue.end(task.parts[2], Outcome("one, part 2")) is None
    assert list(queue.waiting) == [(task,)]
    assert queue.end(task, Outcome("one", frames=3)) == Outcome("one", frames=3)


def test_a_part_that_fails_fails_the_drive(tmp_path, drive):
    task = tasks_of([drive], tmp_path, 3.0)["one"]
    queue = TaskQueue([task], batch=1, retries=0)
    queue.waiting.clear()
    bad = Outcome(task.parts[1].name, failure="no", is_final=True)
    for part, outcome in zip(task.parts, (Outcome("one, part 0"), bad, Outcome("one, part 2")), strict=True):
        ended = queue.end(part, outcome)
    assert ended == Outcome("one", failure="one, part 1: no", is_final=True)
    assert not queue.waiting


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"start": 0.12, "every": 2, "end": 0.72}])
def test_a_cut_drive_is_the_uncut_one_to_the_byte(tmp_path, monkeypatch, settings):
    folder = tmp_path / "in"
    folder.mkdir()
    write_drive(RenderedDrive(4, (96, 160), 16, 20.0), folder.__truediv__)
    config = RunConfig(f"{folder}/drive.mp4", f"{folder}/camera.yaml", **settings)
    task = tasks_of([Drive("one", "c", "unknown", "", config)], tmp_path, 0.25)["one"]
    assert len(task.parts) >= 2
    looked, original = [], NetworkObserver.__call__
    monkeypatch.setattr(
        NetworkObserver, "__call__", lambda self, frame: looked.append(frame) or original(self, frame)
    )
    parts = worker.run_tasks(task.parts)
    (whole,) = worker.run_tasks([task])
    assert not any(outcome.failure for outcome in (*parts, whole)), (parts, whole)
    assert sum(outcome.frames for outcome in parts) == whole.frames == len(looked)
    assert earlier_outcome(task) == whole
    assert [path.name for path in (tmp_path / "drives").iterdir()] == ["one"]
    (tmp_path / "drives" / "one").rename(tmp_path / "cut")
    run(task.config)  # into the same folder, which the report names
    reports = [read_run(each) for each in (tmp_path / "cut", tmp_path / "drives" / "one")]
    assert replace(reports[0], name="one") == reports[1]
    assert reports[0].pictures
    states = [load_state(tmp_path / each / "state.safetensors").states for each in ("cut", "drives/one")]
    torch.testing.assert_close(*states, rtol=0, atol=0)
    for name in OUTPUTS:
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "drives/one" / name).read_bytes(), name
