"""The index page and the plan of a fleet, without Ray."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest

from lanebev.app.config import BACKENDS, RunConfig
from lanebev.app.fleet.collect import collect_frames
from lanebev.app.fleet.fleet import fleet, write_mounts
from lanebev.app.fleet.manifest import Drive
from lanebev.app.fleet.mounts import DriveMount, stretches
from lanebev.app.fleet.page import CameraMounts, fleet_page
from lanebev.app.fleet.plan import (
    Outcome,
    earlier_outcome,
    failure_path,
    settings_fingerprint,
    tasks_of,
    write_mark,
)
from lanebev.report.verdict import Verdict

HOSTILE = "<script>alert(1)<_script>\"'&é…"


def _drive(tmp_path, name, camera="front"):
    config = RunConfig(str(tmp_path / "a.mp4"), str(tmp_path / "c.yaml"))
    return Drive(name, camera, "2026-03-01", "2026-03-01", config)


@pytest.fixture
def camera():
    mounts = [
        DriveMount(
            HOSTILE, f"2026-03-0{i + 1}", np.full(4, 0.01 * i), np.full(4, 0.003), np.array([i == 2] * 4)
        )
        for i in range(4)
    ]
    mounts[1].pose[2] = mounts[1].std[2] = np.nan
    return CameraMounts(HOSTILE, mounts, stretches(mounts))


def test_every_name_is_escaped(tmp_path, camera):
    drives = [_drive(tmp_path, HOSTILE, HOSTILE), _drive(tmp_path, f"{HOSTILE}2")]
    outcomes = {
        HOSTILE: Outcome(HOSTILE, frames=7, seconds=1.25),
        drives[1].name: Outcome(drives[1].name, failure=f"video {HOSTILE}: no"),
    }
    page = fleet_page(HOSTILE, drives, outcomes, {HOSTILE: Verdict("fair", HOSTILE, "", ())}, [camera])
    assert "<script>alert" not in page
    assert "1 drives finished, 1 failed, 7 frames" in page
    assert "&lt;script&gt;alert(1)" in page
    assert 'href="drives/%3Cscript%3Ealert%281%29%3C_script%3E%22%27%26%C3%A9%E2%80%A6/report.html"' in page
    assert 'src="http' not in page


def test_mounts_are_written_as_json(tmp_path, camera):
    write_mounts(tmp_path / "mounts.json", [camera])
    (found,) = json.loads((tmp_path / "mounts.json").read_text())
    assert [stretch["drives"] for stretch in found["stretches"]] == [2, 2]
    assert found["drives"][1]["roll_deg"] is None
    assert found["drives"][3]["pitch_deg"] == pytest.approx(np.degrees(0.03))
    assert found["drives"][2]["moved"] == ["pitch", "yaw", "roll", "height"]


def test_files_that_no_fleet_wrote_stay(tmp_path):  # frames/mine.parquet was deleted
    pytest.importorskip("ray", reason="Ray is not installed")
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    mine, former = (
        tmp_path / "frames" / "mine.parquet",
        tmp_path / "frames" / "camera=a" / "day=b" / "c.parquet",
    )
    former.parent.mkdir(parents=True)
    for path in (mine, former, tmp_path / "index.html"):
        path.write_text("mine")
    collect_frames([], tmp_path)
    assert (mine.exists(), former.exists()) == (True, False)
    for name in ("a.mp4", "c.yaml"):
        (tmp_path / name).write_text("")
    (tmp_path / "drives.csv").write_text("video,camera\na.mp4,c.yaml\n")
    with pytest.raises(ValueError, match=r"one with a file index\.html and no folder drives; give another"):
        fleet(str(tmp_path / "drives.csv"), str(tmp_path))
    assert (tmp_path / "index.html").read_text() == "mine"


def test_what_is_finished_is_known_until_something_changes(tmp_path):
    (tmp_path / "a.mp4").write_text("video")
    drive = _drive(tmp_path, "one")
    task = tasks_of([drive], tmp_path / "out")["one"]
    assert earlier_outcome(task) is None
    folder = tmp_path / "out" / "drives" / "one"
    folder.mkdir(parents=True)
    (folder / "extrinsics.csv").write_text("")
    done = Outcome("one", frames=3, seconds=1.5)
    write_mark(task, done)
    assert earlier_outcome(task) == done
    exported = replace(drive.config, exported=str(tmp_path / "exported"))
    before = [settings_fingerprint(replace(exported, backend=name)) for name in BACKENDS]
    (tmp_path / "exported").mkdir()
    after = [settings_fingerprint(replace(exported, backend=name)) for name in BACKENDS]
    assert [one == other for one, other in zip(before, after, strict=True)] == [True, False]
    narrow = replace(drive, config=replace(drive.config, lane_width=3.5))
    other = tasks_of([narrow], tmp_path / "out")["one"]
    assert earlier_outcome(other) is None
    os.utime(tmp_path / "a.mp4", (1, 1))
    changed = tasks_of([drive], tmp_path / "out")["one"]
    assert earlier_outcome(changed) is None
    failed = Outcome("one", failure="no video", is_final=True)
    write_mark(changed, failed)
    assert earlier_outcome(changed) == failed
    write_mark(changed, done)
    assert earlier_outcome(changed) == done
    assert not failure_path(changed).exists()
    (folder / "fleet.json").write_text("{")
    assert earlier_outcome(changed) is None


@pytest.mark.parametrize(
    "settings", [{"source": "images"}, {"source": "images/*.jpg"}, {"lanes": "images"}], ids=str
)
def test_a_changed_file_of_a_folder_or_a_glob_is_noticed(tmp_path, settings):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.jpg").write_text("old")
    paths = {name: str(tmp_path / path) for name, path in settings.items()}
    config = replace(_drive(tmp_path, "one").config, **paths)
    before = settings_fingerprint(config)
    assert settings_fingerprint(config) == before
    (tmp_path / "images" / "0.jpg").write_text("new and longer")
    changed = settings_fingerprint(config)
    (tmp_path / "images" / "1.jpg").write_text("another")
    assert len({before, changed, settings_fingerprint(config)}) == 3
