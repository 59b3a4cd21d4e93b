"""Drives of one worker: their frames in one batch, the same digits as alone, failures their own."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from lanebev.app.config import RunConfig
from lanebev.app.demo import write_drive
from lanebev.app.drive.shared_network import SharedNetwork
from lanebev.app.fleet import cluster, worker
from lanebev.app.fleet.cluster import Cluster, outcomes
from lanebev.app.fleet.plan import Outcome, Task
from lanebev.app.fleet.queue import groups_of
from lanebev.app.run import run
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.pipeline import LaneBEV
from lanebev.render import Drive
from tools.fleet_check import COMPARED


class Slow(torch.nn.Module):
    """Says an image's mean as a vertex; raises of batches with a negative one."""

    def __init__(self):
        super().__init__()
        self.sizes = []

    def boundary_vertices(self, image):
        self.sizes.append(tuple(image.shape))
        time.sleep(0.2)
        means = image.mean((1, 2, 3))
        if (means < 0).any():
            raise RuntimeError("a negative image")
        points = means[:, None, None, None].expand(-1, 1, 1, 2)
        ones = torch.ones(len(means), 1, 1)
        return None, BoundaryVertices(points, ones, ones, torch.zeros(len(means), 1, dtype=torch.int64))


def _looked_at(network, images):
    """What each image's thread is given: the vertex, or the exception."""
    found = [None] * len(images)

    def look(number):
        try:
            found[number] = network.vertices(images[number])
        except RuntimeError as error:
            found[number] = error

    threads = [threading.Thread(target=look, args=(number,)) for number in range(len(images))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def test_frames_that_wait_are_one_batch():
    model = Slow()
    network = SharedNetwork(model, most=3)
    values = [float(number) for number in range(8)]
    images = [torch.full((1, 3, 4 if number < 6 else 5, 4), values[number]) for number in range(8)]
    found = _looked_at(network, images)
    assert [float(each.points[0, 0, 0, 0]) for each in found] == values
    assert all(len(part) == 1 for each in found for part in each)
    assert max(size[0] for size in model.sizes) == 3
    assert network.frames == sum(size[0] for size in model.sizes) == 8
    assert network.batches == len(model.sizes) <= 5


def test_one_that_fails_fails_alone():
    images = [torch.full((1, 3, 4, 4), value) for value in (1.0, -1.0, 2.0, 3.0)]
    one, bad, two, three = _looked_at(SharedNetwork(Slow(), most=4), images)
    assert [float(each.points[0, 0, 0, 0]) for each in (one, two, three)] == [1.0, 2.0, 3.0]
    assert str(bad) == "a negative image"


def test_a_batch_of_none_is_refused():
    with pytest.raises(ValueError, match="batch: expected 1 frame or more, got 0"):
        SharedNetwork(Slow(), 0)


def test_a_batch_has_the_digits_of_its_frames():
    model = LaneBEV.from_pretrained().eval()
    drive = Drive(3, (96, 160), 3, 20.0)
    images = torch.cat([drive.frame(number).image for number in range(3)])
    with torch.inference_mode():
        _, together = model.boundary_vertices(images)
        for row in range(3):
            _, alone = model.boundary_vertices(images[row : row + 1])
            for part, own in zip(together, alone, strict=True):
                assert torch.equal(part[row : row + 1], own)


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Two rendered drives and a corrupt one, as tasks."""
    root = tmp_path_factory.mktemp("drives")
    tasks = []
    for number in range(3):
        folder = root / f"{number}"
        folder.mkdir()
        write_drive(Drive(number, (96, 160), 3 + number, 20.0), folder.__truediv__)
        if number == 1:
            (folder / "drive.mp4").write_bytes(b"no video")
        config = RunConfig(f"{folder}/drive.mp4", f"{folder}/camera.yaml", f"{root}/drives/{number}")
        tasks.append(Task(f"{number}", config, f"fingerprint {number}"))
    return root, tasks


@pytest.mark.slow
def test_drives_together_equal_drives_alone(drives):
    root, tasks = drives
    found = worker.run_tasks(tasks)
    assert [bool(outcome.failure) for outcome in found] == [False, True, False]
    assert found[1].is_final
    assert "expected a video that opens" in found[1].failure
    assert [outcome.frames for outcome in found] == [3, 0, 5]
    for task in (tasks[0], tasks[2]):
        run(replace(task.config, out=f"{root}/alone/{task.name}"))
        for name in COMPARED:
            together, alone = root / "drives" / task.name / name, root / "alone" / task.name / name
            assert together.read_bytes() == alone.read_bytes(), name
    before = (root / "drives" / "0" / "extrinsics.csv").stat().st_mtime_ns
    assert worker.run_tasks(tasks[:1]) == found[:1]  # as after a worker that died when it was done
    assert (root / "drives" / "0" / "extrinsics.csv").stat().st_mtime_ns == before


def test_a_network_that_does_not_load_fails_every_drive(tmp_path):
    config = RunConfig("a.mp4", "c.yaml", str(tmp_path / "out"), weights=str(tmp_path / "none.safetensors"))
    found = worker.run_tasks([Task(name, config, "") for name in "ab"])
    assert [outcome.name for outcome in found] == ["a", "b"]
    assert all("none.safetensors" in outcome.failure for outcome in found)


def _task(name, **settings):
    return Task(name, RunConfig("a.mp4", "c.yaml", **settings), "")


def test_groups_share_a_network():
    alone = [_task("b", lanes="l"), _task("c", device="cuda"), _task("h", precision="bfloat16")]
    alone.append(_task("i", network_width=640))
    tasks = [_task("a"), *alone, *map(_task, "defg")]
    groups = [[task.name for task in group] for group in groups_of(tasks, 3)]
    assert groups == [["a", "d", "e"], ["f", "g"], ["b"], ["c"], ["h"], ["i"]]
    assert [len(group) for group in groups_of(tasks, 1)] == [1] * 9


class _RayError(Exception):
    pass


def _ray(run_tasks):
    """A stand-in for Ray that runs a task when its result is asked for."""
    remote = SimpleNamespace(remote=lambda group: (run_tasks, group))
    return SimpleNamespace(
        remote=lambda _: SimpleNamespace(options=lambda **_: remote),
        cluster_resources=lambda: {"CPU": 1},
        wait=lambda references, num_returns: (references[:1], references[1:]),
        get=lambda reference: reference[0](reference[1]),
        shutdown=lambda: None,
        exceptions=SimpleNamespace(RayError=_RayError),
    )


def test_what_fails_is_begun_again_alone_and_then_reported(monkeypatch, tmp_path):
    calls = []

    def run_tasks(group):
        names = "".join(task.name for task in group)
        calls.append(names)
        if "x" in names:
            raise _RayError("killed\nby whom?")
        failing = {"a": 1, "b": 9}
        failed = {name: sum(name in each for each in calls) <= times for name, times in failing.items()}
        return [
            Outcome(task.name, failure="no" if failed.get(task.name) else "", is_final=task.name == "b")
            for task in group
        ]

    monkeypatch.setattr(cluster, "_started", lambda _: _ray(run_tasks))
    tasks = [replace(task, config=replace(task.config, out=str(tmp_path / task.name))) for task in
             map(_task, "abcxd")]  # fmt: skip
    found = {outcome.name: outcome for outcome in outcomes(tasks, Cluster(batch=3, retries=2))}
    assert {name: outcome.failure for name, outcome in found.items()} == {
        "a": "", "b": "no", "c": "", "x": "its worker died: _RayError: killed", "d": ""
    }  # fmt: skip
    assert calls == ["abc", "xd", "a", "b", "x", "d", "b"]
    assert (tmp_path / ".b.failed.json").is_file()
    assert not (tmp_path / ".x.failed.json").exists()
