"""What a run does when the disk is full, another run has its folder, or it is killed."""

import ast
import contextlib
import dataclasses
import itertools
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from lanebev import Camera
from lanebev.app.config import RunConfig
from lanebev.app.continued.recovery import recover_run
from lanebev.app.drive.observers import NetworkObserver
from lanebev.app.run import run
from lanebev.cli import main
from lanebev.io.opening import open_source
from lanebev.io.output.folder import OutputFolder
from lanebev.io.output.lock import FolderLock
from lanebev.io.state import load_state, save_state
from tests.app.noise_drive import write_drive

ROOT = Path(__file__).parents[2]
HOSTILE = "<script>alert(1)</script>\"'&é…"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A camera file, a video and its lanes."""
    return write_drive(tmp_path_factory.mktemp("data"))


def _arguments(data, out, *extra):
    return ["run", str(data / "drive.mp4"), "--camera", str(data / "camera.yaml"), "--out", str(out), *extra]


def test_a_full_disk_is_one_line_and_leaves_nothing(data, tmp_path, capsys):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (6000, before[1]))
    try:
        status = main(_arguments(data, tmp_path / "out", "--lanes", str(data / "drive.json")))
        with pytest.raises(OSError, match="too large"):
            save_state(tmp_path / "state", {"large": torch.zeros(10_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    said = capsys.readouterr().err
    assert status == 2
    assert said.count("\n") == 1
    assert "expected room for the outputs, got: File too large; make room or give another" in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("is_there", [False, True])
def test_the_second_run_into_a_folder_is_one_line(data, tmp_path, capsys, is_there):
    out = tmp_path / "out"
    if is_there:
        out.mkdir()
    with OutputFolder(out) as folder:
        (folder / "bev.png").write_text("mine")
        assert main(_arguments(data, out, "--lanes", str(data / "drive.json"))) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "got: another run writes into it now; give another with --out" in said
        assert (folder / "bev.png").read_text() == "mine"
    assert [path.name for path in out.iterdir()] == ["bev.png"]
    with OutputFolder(out):
        pass  # it is free again


def test_a_lock_ends_with_its_holder(tmp_path):
    first, second = FolderLock(tmp_path / "a"), FolderLock(tmp_path / "a")
    assert first.acquire()
    assert not second.acquire()
    shutil.rmtree(tmp_path / "a")
    assert second.acquire()  # of a folder made anew
    first.release()
    second.release()
    second.release()


def test_what_a_killed_process_left_is_not_published(tmp_path):
    for target in (tmp_path / "new", tmp_path / "there"):
        beside = tmp_path
        if target.name == "there":
            target.mkdir()
            beside = target
        left = beside / f".{target.name}.partial"
        left.mkdir()
        (left / "bev.png").write_text("half")
        with OutputFolder(target) as folder:
            assert folder.left("bev.png").read_text() == "half"
            (folder / "extrinsics.csv").write_text("whole")
        assert [path.name for path in target.iterdir()] == ["extrinsics.csv"]


@pytest.fixture(scope="module")
def looked(data, tmp_path_factory):
    """Outputs of a run by the network that nothing disturbed."""
    out = tmp_path_factory.mktemp("whole") / "out"
    run(RunConfig(str(data / "drive.mp4"), str(data / "camera.yaml"), str(out)))
    return out


def _killed(data, out, lanes):
    """Leave what a run by the network leaves that is killed after it wrote ``lanes``."""
    script = (
        "import os, signal, sys\n"
        "from lanebev.app.recording.recorder import Recorder\n"
        "from lanebev.cli import main\n"
        "draw = Recorder._draw\n"
        f"def kill(self, done):\n"
        f"    if done.frame.number == {lanes}: os.kill(os.getpid(), signal.SIGKILL)\n"
        "    draw(self, done)\n"
        "Recorder._draw = kill\n"
        "main(sys.argv[1:])\n"
    )
    done = subprocess.run([sys.executable, "-c", script, *_arguments(data, out)], check=False)
    assert done.returncode == -signal.SIGKILL


@pytest.mark.slow
def test_a_killed_run_is_taken_up(data, looked, tmp_path, monkeypatch):
    out = tmp_path / "out"
    _killed(data, out, 4)
    left = tmp_path / ".out.partial"
    lines = (left / "lanes.json").read_text().splitlines(keepends=True)
    assert len(lines) == 4
    (left / "lanes.json").rename(left / ".seen.json")  # and again, when it had not yet come as far
    (left / "lanes.json").write_text("".join(lines[:2]) + lines[2][:50])
    seen = []
    original = NetworkObserver.__call__
    monkeypatch.setattr(
        NetworkObserver, "__call__", lambda self, frame: seen.append(frame.number) or original(self, frame)
    )
    report = run(RunConfig(str(data / "drive.mp4"), str(data / "camera.yaml"), str(out)))
    assert seen == [4, 5]
    assert report.facts["reused"] == "detections of a run that was killed, in the first 4 frames"
    for name in ("extrinsics.csv", "covariance.csv", "lanes.json", "calibration.yaml"):
        assert (out / name).read_bytes() == (looked / name).read_bytes()
    states = [load_state(folder / "state.safetensors").states for folder in (out, looked)]
    torch.testing.assert_close(*states, rtol=0, atol=0)
    assert {path.name for path in out.iterdir()} == {path.name for path in looked.iterdir()}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_killed_run_of_other_settings_is_not_taken_up(data, tmp_path):
    text = (data / "drive.json").read_text().replace("x/", "drive.mp4/00000")
    lines = [f"{line}\n" for line in text.splitlines()]
    config = RunConfig(str(data / "drive.mp4"), str(data / "camera.yaml"), str(tmp_path / "out"))
    camera, source = Camera.from_file(config.camera), open_source(config.source)

    class Looks(NetworkObserver):
        workers = 1

        def __init__(self):
            pass

        def __call__(self, frame):
            return "looked"

        def restored(self, found):
            return found.name

    def taken(config):
        """How many of three frames a run takes that finds two whole lines and a half; it is killed too."""
        with contextlib.suppress(KeyError), OutputFolder(config.out) as out:
            observer = recover_run(out, config, source, camera, Looks())
            count = sum(observer(frame) != "looked" for frame in itertools.islice(source, 3))
            assert count == observer.frames
            (out / "lanes.json").write_text("".join(lines[:2]) + lines[2][:20])
            shutil.copytree(out / "", tmp_path / "kept")
            raise KeyError
        shutil.move(tmp_path / "kept", tmp_path / ".out.partial")
        return count

    assert [taken(config) for _ in range(3)] == [0, 2, 2]
    assert taken(dataclasses.replace(config, lane_width=3.5)) == 0
    assert taken(dataclasses.replace(config, lane_width=3.5)) == 2
    os.utime(data / "camera.yaml")
    assert taken(dataclasses.replace(config, lane_width=3.5)) == 0


def test_the_report_escapes_every_name(data, tmp_path):
    folder = tmp_path / HOSTILE.replace("/", "_")
    shutil.copytree(data, folder)
    source = folder / f"{HOSTILE.replace('/', '_')}.mp4"
    (folder / "drive.mp4").rename(source)
    (folder / "camera.yaml").rename(folder / "<b>c.yaml")
    arguments = ["--camera", str(folder / "<b>c.yaml"), "--lanes", str(folder / "drive.json")]
    assert main(["run", str(source), *arguments, "--out", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "&lt;script&gt;alert(1)" in page
    assert "<script>alert" not in page
    assert "<b>c.yaml" not in page
    assert json.loads((tmp_path / "out" / "lanes.json").read_text().splitlines()[0])["raw_file"]
    assert yaml.safe_load((tmp_path / "out" / "calibration.yaml").read_text())


def _calls(tree):
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call)]


@pytest.mark.slow
def test_nothing_is_unpickled():
    for path in (ROOT / "lanebev").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import)]
        names = {alias.name for node in imports for alias in node.names}
        assert not names & {"pickle", "shelve", "marshal", "dill", "joblib", "cloudpickle"}, path
        for call in _calls(tree):
            text = ast.unparse(call.func)
            keywords = {word.arg: ast.unparse(word.value) for word in call.keywords}
            assert text != "torch.load" or keywords.get("weights_only") == "True", path
            assert text not in ("yaml.load", "yaml.unsafe_load", "eval", "exec"), path
            assert keywords.get("allow_pickle", "False") == "False", path
    for path in itertools.chain.from_iterable(
        (ROOT / name).rglob("*.py") for name in ("train", "tools", "examples")
    ):
        for call in _calls(ast.parse(path.read_text(encoding="utf-8"))):
            keywords = {word.arg: ast.unparse(word.value) for word in call.keywords}
            is_load = ast.unparse(call.func) == "torch.load"
            assert not is_load or keywords.get("weights_only") == "True", path
