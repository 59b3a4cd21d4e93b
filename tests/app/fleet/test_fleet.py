"""A fleet on Ray: a killed worker, a corrupt file, a second call; the same as single runs."""

import json
import shutil
import signal
import subprocess
import sys
import time

import pytest

from lanebev.app.fleet.fleet import fleet
from lanebev.app.fleet.worker import run_tasks
from lanebev.cli import main
from tests.app.noise_drive import write_drive
from tools import fleet_check

pytest.importorskip("ray", reason="Ray is not installed")
parquet = pytest.importorskip("pyarrow.dataset", reason="pyarrow is not installed")


@pytest.mark.slow
def test_a_fleet_equals_single_runs(tmp_path, capsys):
    arguments = [
        "--drives",
        "3",
        "--network",
        "3",
        "--frames",
        "4",
        "--workers",
        "2",
        "--kills",
        "1",
        "--batch",
        "2",
    ]
    assert fleet_check.main([*arguments, "--no-timing", "--folder", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["finished"], found["failed"], found["equal"], found["killed"]) == (2, 1, 2, 1)
    assert found["second_call"] == "3 drives: 2 finished, 1 failed; 0 run now"
    frames = parquet.dataset(tmp_path / "fleet" / "frames", partitioning="hive").to_table().to_pylist()
    assert {(row["drive"], row["camera"], str(row["day"])) for row in frames} == {
        ("drive-00-drive", "camera-0", "2026-03-01"),
        ("drive-02-drive", "camera-2", "2026-03-03"),
    }
    assert len(frames) == 8
    page = (tmp_path / "fleet" / "index.html").read_text()
    assert "drive-01-drive</b>: video" in page
    assert 'href="drives/drive-00-drive/report.html"' in page
    assert (tmp_path / "fleet" / "drives" / "drive-00-drive" / "report.html").is_file()


@pytest.mark.slow
def test_a_folder_that_is_deleted_meanwhile_fails_the_drives_that_were_in_it(tmp_path, monkeypatch):
    write_drive(tmp_path, frames=3, name="a")
    write_drive(tmp_path, frames=3, name="b")
    (tmp_path / "drives.csv").write_text(
        "video,camera,no_video,lanes\na.mp4,camera.yaml,true,a.json\nb.mp4,camera.yaml,true,b.json\n"
    )

    def outcomes(tasks, _):
        for task in tasks:
            yield from run_tasks([task])
            if task.name == "a":
                shutil.rmtree(tmp_path / "out")

    monkeypatch.setattr("lanebev.app.fleet.fleet.outcomes", outcomes)
    result = fleet(str(tmp_path / "drives.csv"), str(tmp_path / "out"))
    words = "its outputs were deleted meanwhile; the same command runs it again"
    assert {name: outcome.failure for name, outcome in result.outcomes.items()} == {"a": words, "b": ""}
    assert words in (tmp_path / "out" / "index.html").read_text()
    assert len(parquet.dataset(tmp_path / "out" / "frames").to_table()) == 3
    monkeypatch.setattr("lanebev.app.fleet.fleet.outcomes", lambda tasks, _: run_tasks(tasks))
    assert fleet(str(tmp_path / "drives.csv"), str(tmp_path / "out")).text.startswith(
        "2 drives: 2 finished, 0 failed; 1 run now"
    )


def _lines_of(path):
    return path.read_text().count("\n") if path.is_file() else 0


def test_a_fleet_that_is_stopped_while_ray_starts_says_so(tmp_path, monkeypatch, capsys):
    """Ray's own handler of SIGTERM, which is set meanwhile, exits with status 15."""

    def init(**_):
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(number))
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("ray.init", init)
    write_drive(tmp_path, frames=3, name="a")
    (tmp_path / "drives.csv").write_text("video,camera\na.mp4,camera.yaml\n")
    status = main(["fleet", str(tmp_path / "drives.csv"), "--out", str(tmp_path / "out")])
    assert status == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "lanebev fleet: interrupted, finished drives stay\n"


@pytest.mark.slow
def test_a_fleet_that_is_stopped_says_so_and_continues(tmp_path):
    write_drive(tmp_path, frames=3, name="short")
    write_drive(tmp_path, frames=60, name="long")
    (tmp_path / "drives.csv").write_text(
        "video,camera,no_video,lanes\nshort.mp4,camera.yaml,true,short.json\nlong.mp4,camera.yaml,true,\n"
    )
    command = [sys.executable, "-m", "lanebev", "fleet", f"{tmp_path}/drives.csv", "--workers", "1"]
    command += ["--out", f"{tmp_path}/fleet"]
    log = tmp_path / "log"
    with log.open("wb") as file:
        begun = subprocess.Popen(command, stdout=file, stderr=file)
    drives = tmp_path / "fleet" / "drives"
    end = time.monotonic() + 300
    while (
        begun.poll() is None and time.monotonic() < end and _lines_of(drives / ".long.partial/lanes.json") < 5
    ):
        time.sleep(0.05)
    begun.send_signal(signal.SIGTERM)
    assert begun.wait(60) == 128 + signal.SIGTERM
    assert log.read_text() == "lanebev fleet: interrupted, finished drives stay\n"
    assert (drives / "short" / "fleet.json").is_file()
    assert not (drives / "long").exists()
    assert not (tmp_path / "fleet" / ".fleet").exists()
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("2 drives: 2 finished, 0 failed; 1 run now")
    assert "detections of a run that was killed" in (drives / "long" / "report.html").read_text()
