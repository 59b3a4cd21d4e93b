"""What a run writes: the promised files, a row for every frame, and what it says of them."""

import json
import math
import shutil
import sys

import av
import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from lanebev import Extrinsics, JointCalibrator
from lanebev.app.summary import untracked_words
from lanebev.estimation.lane_width_prior import LANE_WIDTH, LANE_WIDTH_STD
from lanebev.estimation.mount import MountReason
from lanebev.io.opening import open_source
from lanebev.io.results import CSV_COLUMNS, ExtrinsicsRow, write_extrinsics
from lanebev.io.state import load_state
from tests.app.straight_road import CAMERA, FRAMES, POSE, ROWS, lane_lines, run, table
from tests.drawn_road import PLACES, boundary
from tests.io.video.damaged import packets_of
from tools import pseudo_ground_truth


def test_a_run_on_a_video_finds_the_pose(drive):
    rows = table(drive)
    assert tuple(rows[0]) == CSV_COLUMNS
    assert [row["frame"] for row in rows] == [str(i) for i in range(FRAMES)]
    assert {row["status"] for row in rows} == {"TRACKING"}
    assert {row["image"] for row in rows} == {""}
    assert rows[1]["time_s"] == "0.040000"
    names = ("pitch_deg", "yaw_deg", "roll_deg", "height_m")
    found = [float(rows[-1][name]) for name in names]
    np.testing.assert_allclose(found[:3], np.degrees(POSE[:3]), atol=0.1)
    assert abs(found[3] - POSE[3]) < 0.02
    assert int(rows[0]["segments"]) >= 16


def test_the_summary_says_why_frames_are_not_tracked():
    def row(number, status, reasons):
        numbers = (0.0, 0.0, 0.0, 1.5, 0.1, 0.1, 0.1, 0.1)
        return ExtrinsicsRow(number, number / 10, *numbers, status, 0, "", reasons)

    rows = [row(i, "UNINITIALISED", "NO_SEGMENTS|NO_START") for i in range(3)]
    rows += [row(3, "COASTING", "FEW_INLIERS"), row(4, "TRACKING", "ROLL_UNSEEN")]
    expected = "4 not tracked: no lane boundaries seen (in 3), what was seen does not fit the road (in 1)"
    assert untracked_words(rows) == [expected]
    assert untracked_words(rows[4:]) == []


def test_every_output_is_there_and_whole(drive):
    names = {path.name for path in drive.iterdir()}
    promised = {"extrinsics.csv", "lanes.json", "bev.mp4", "overlay.mp4", "report.html"}
    assert names == promised | {"state.safetensors", "calibration.yaml", "covariance.csv"}
    mount = yaml.safe_load((drive / "calibration.yaml").read_text())["mount"]
    assert mount["preliminary"]["height_m"] == pytest.approx(POSE[3], abs=0.02)
    assert (mount["valid"], mount["status"]) == (False, "UNCALIBRATED")  # 0.24 s
    assert mount["needs"][0].startswith("pitch: needs 20 s of straight driving; 0 s so far")
    for name, size in (("bev.mp4", (1140, 400)), ("overlay.mp4", None)):
        with av.open(str(drive / name)) as video:
            stream = video.streams.video[0]
            assert stream.codec_context.name == "h264"
            assert size in (None, (stream.height, stream.width))
            assert sum(1 for _ in video.decode(stream)) == FRAMES
    lines = [json.loads(line) for line in (drive / "lanes.json").read_text().splitlines()]
    assert len(lines) == FRAMES
    assert lines[0]["boundary"] == [1, 2, 3, 4]
    assert lines[0]["h_samples"] == list(ROWS)
    page = (drive / "report.html").read_text()
    assert "6 of 6 frames TRACKING" in page
    assert 'src="http' not in page


@pytest.mark.slow
def test_pseudo_ground_truth_compares_the_same_frames(data, tmp_path, capsys, monkeypatch):
    names = ("10", "11", "2")  # a run over images may have another order than the lanes, which have 2, 10, 11
    (tmp_path / "cul").mkdir()
    z = torch.logspace(0.8, 2, 40, dtype=torch.float64)
    for name, height in zip(names, (1.2, 1.4, 1.6), strict=True):
        at = Extrinsics.from_values(POSE[0], POSE[1], POSE[2], height)
        lanes = []
        for offset in PLACES:
            pixels = boundary(CAMERA, offset, z, at).flip(0).numpy()
            y = np.arange(pixels[0, 1] + 1, pixels[-1, 1], 5)
            x = np.interp(y, pixels[:, 1], pixels[:, 0])
            lanes.append(" ".join(f"{u:.3f} {v:.3f}" for u, v in zip(x, y, strict=True)))
        (tmp_path / "cul" / f"{name}.lines.txt").write_text("\n".join(lanes))

    def command(*extra):
        arguments = [tmp_path / "cul", "--camera", data / "camera.yaml", "--out", tmp_path / "pseudo.csv"]
        monkeypatch.setattr(sys, "argv", ["pseudo_ground_truth", *map(str, (*arguments, *extra))])
        try:
            pseudo_ground_truth.main()
        except SystemExit as stopped:
            return stopped.code, capsys.readouterr()
        return 0, capsys.readouterr()

    def estimate(images, heights):
        degrees = [math.degrees(angle) for angle in POSE[:3]]
        rows = [
            ExtrinsicsRow(i, i / 30, *degrees, height, 0.1, 0.1, 0.1, 0.1, "TRACKING", 9, image)
            for i, (image, height) in enumerate(zip(images, heights, strict=True))
        ]
        write_extrinsics(tmp_path / "extrinsics.csv", rows)
        return command("--estimate", tmp_path / "extrinsics.csv")

    images = [f"/elsewhere/cul/{name}.jpg" for name in names]
    for count in (3, 2):  # of 2 the run may know nothing
        status, output = estimate(images[:count], (1.2, 1.4, 1.6)[:count])
        assert status == 0
        said = output.out.splitlines()[-1]
        assert said.startswith(f"rms difference of the estimate, {count} frames: pitch_deg 0.0")
        assert float(said.split()[-1]) < 0.01
    assert float(estimate([""] * 3, (1.6, 1.2, 1.4))[1].out.split()[-1]) < 0.01  # a video's, by position
    status, output = estimate([""] * 2, (1.4, 1.6))
    assert (status, output.err.count("\n")) == (2, 1)
    assert "--estimate: expected 3 rows" in output.err
    status, output = estimate(["/elsewhere/cul/3.jpg"], (1.2,))
    assert (status, output.err.count("\n")) == (2, 1)
    assert "expected an entry for at least one image" in output.err


@pytest.mark.slow
def test_a_lane_file_says_how_much_less_sure_its_pose_is(data, drive, tmp_path):
    lines = [json.loads(line) for line in (data / "video_lanes.json").read_text().splitlines()]
    wide = "\n".join(json.dumps({**line, "pose_sigma_scale": 2.0}) for line in lines)
    (data / "wide.json").write_text(wide)
    assert run(data, source="drive.mp4", lanes="wide.json", out=tmp_path / "out") == 0
    for row, plain in zip(table(tmp_path / "out"), table(drive), strict=True):
        for name, value in row.items():
            if name == "height_std_m":  # the lane width's part is not the detector's
                part = LANE_WIDTH_STD / LANE_WIDTH * float(plain["height_m"])
                own = math.sqrt(float(plain[name]) ** 2 - part**2)
                assert float(value) == pytest.approx(math.hypot(2 * own, part), abs=2e-5)
            elif name.endswith(("std_deg", "std_m")):
                assert float(value) == pytest.approx(2 * float(plain[name]), abs=2e-6)
            else:
                assert value == plain[name]
    assert '"pose_sigma_scale": 2.0' in (tmp_path / "out" / "lanes.json").read_text()


def test_lanes_json_gives_the_same_calibration(data, drive, tmp_path):
    shutil.copy(drive / "lanes.json", data / "again.json")
    assert run(data, source="drive.mp4", lanes="again.json", out=tmp_path / "out") == 0
    assert (tmp_path / "out" / "extrinsics.csv").read_text() == (drive / "extrinsics.csv").read_text()
    assert (tmp_path / "out" / "lanes.json").read_text() == (drive / "lanes.json").read_text()


@pytest.mark.slow
def test_folder_glob_and_stills(data, tmp_path):
    assert run(data, "--fps", "10", out=tmp_path / "folder") == 0
    folder = table(tmp_path / "folder")
    assert [row["image"] for row in folder] == [str(data / "images" / f"{i}.png") for i in range(FRAMES)]
    assert folder[1]["time_s"] == "0.100000"
    assert run(data, "--stills", source="**/*.png", out=tmp_path / "stills") == 0
    stills = table(tmp_path / "stills")
    assert len(stills) == FRAMES
    assert len({row["pitch_deg"] for row in stills}) == 1  # each on its own, and all the same
    shown = [frame.time for frame in open_source(str(tmp_path / "stills" / "bev.mp4"))]
    assert shown == pytest.approx([0.5 * i for i in range(FRAMES)], abs=1e-3)  # long enough to be looked at
    assert float(stills[0]["pitch_deg"]) == pytest.approx(np.degrees(POSE[0]), abs=0.1)


def test_one_image_gives_pictures(data, tmp_path):
    assert run(data, source="images/3.png", out=tmp_path / "out") == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"bev.png", "overlay.png"} <= names
    assert not {"bev.mp4", "overlay.mp4"} & names
    assert len(table(tmp_path / "out")) == 1
    assert "calibration.yaml" not in names


def test_one_image_is_a_still(data, tmp_path):
    """As a drive's first frame its lanes would be taken for equal, and roll for much surer."""
    joint = ("--calibrator", "joint")
    assert run(data, *joint, source="images/3.png", out=tmp_path / "image") == 0
    assert run(data, *joint, "--stills", source="images/3.png", out=tmp_path / "still") == 0
    assert table(tmp_path / "image") == table(tmp_path / "still")
    (tmp_path / "folder").mkdir()
    shutil.copy(data / "images" / "3.png", tmp_path / "folder")
    assert run(data, *joint, source=tmp_path / "folder", out=tmp_path / "drive") == 0
    (image,), (frame,) = table(tmp_path / "image"), table(tmp_path / "drive")
    assert float(image["roll_std_deg"]) > 2 * float(frame["roll_std_deg"])


def test_a_lane_file_may_begin_with_a_byte_order_mark(data, tmp_path):
    lanes = tmp_path / "lanes.json"
    lanes.write_bytes(b"\xef\xbb\xbf" + (data / "lanes.json").read_bytes())
    assert run(data, lanes=lanes, out=tmp_path / "out") == 0


def test_a_damaged_image_in_a_drive_is_a_row(data, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("lanebev.app.recording.recorder.drive_remark", lambda rows: "pose: odd")
    shutil.copytree(data / "images", tmp_path / "images")
    (tmp_path / "images" / "2.png").write_bytes((tmp_path / "images" / "2.png").read_bytes()[:2000])
    assert run(data, source=tmp_path / "images", out=tmp_path / "out") == 0
    rows = table(tmp_path / "out")
    assert len(rows) == FRAMES
    assert rows[2]["status"] == "COASTING"
    assert rows[2]["segments"] == "0"
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("problem: ")]
    assert said[0] == "problem: pose: odd"  # doubts about the drive come first
    assert said[-1].startswith("problem: frame 2")
    assert "truncated" in (tmp_path / "out" / "report.html").read_text()


def test_a_stray_first_image_is_a_row(data, tmp_path):
    images = shutil.copytree(data / "images", tmp_path / "images")
    Image.new("RGB", (32, 18)).save(images / "0.png")
    assert run(data, source=images, out=tmp_path / "out") == 0
    rows = table(tmp_path / "out")
    assert rows[0]["status"] == "UNINITIALISED"
    assert {row["status"] for row in rows[1:]} == {"TRACKING"}


def test_frames_without_lanes_are_rows(data, tmp_path):
    (data / "some.json").write_text("\n".join(lane_lines(["images/1.png"])))
    assert run(data, lanes="some.json", out=tmp_path / "out") == 0
    assert [row["status"] for row in table(tmp_path / "out")][:3] == [
        "UNINITIALISED",
        "TRACKING",
        "COASTING",
    ]


@pytest.mark.slow
def test_a_cut_video_is_reported_and_takes_its_own_lanes(data, tmp_path, capsys):
    packet = packets_of(data / "drive.mp4")[3]
    (tmp_path / "drive.mp4").write_bytes((data / "drive.mp4").read_bytes()[: packet.pos + packet.size + 50])
    shutil.copy(data / "camera.yaml", tmp_path)
    lines = (data / "video_lanes.json").read_text().splitlines()
    (tmp_path / "lanes.json").write_text("\n".join(lines[:5]))
    assert run(tmp_path, source="drive.mp4", out=tmp_path / "out") == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("problem: ")]
    declared = f"video {tmp_path / 'drive.mp4'}: expected 0.24 s as it declares, got 0.20 s; is it cut?"
    assert said[0] == f"problem: {declared}"
    assert said[1].startswith("problem: frame 4: expected a whole frame, got: ")
    assert [row["status"] for row in table(tmp_path / "out")] == 4 * ["TRACKING"] + ["COASTING"]
    own = {"source": "drive.mp4", "lanes": tmp_path / "out" / "lanes.json"}
    assert run(tmp_path, out=tmp_path / "again", **own) == 0
    first, again = (tmp_path / name / "extrinsics.csv" for name in ("out", "again"))
    assert first.read_text() == again.read_text()


@pytest.mark.slow
@pytest.mark.parametrize(("pitch", "said"), [(2.0, False), (-9.0, True)])
def test_a_mount_that_no_frame_fits_is_said(data, tmp_path, capsys, pitch, said):
    text = f"mount: {{pitch_deg: {pitch}, pitch_std_deg: 0.1, yaw_deg: -0.6, yaw_std_deg: 0.1}}\n"
    (tmp_path / "mount.yaml").write_text(text)
    extra = ["--calibrator", "joint", "--mount", f"{tmp_path}/mount.yaml"]
    assert run(data, *extra, "--no-video", "--fps", "25", out=tmp_path / "out") == 0
    assert ("what was seen fits its pose in no frame" in capsys.readouterr().out) == said


def test_the_mount_does_not_learn_in_a_bend(data, tmp_path, monkeypatch):
    monkeypatch.setattr(JointCalibrator, "curvature", lambda _, state: 0.002 + 0 * state.mean[:, 0])
    for name, turning in (("joint", True), ("two-stage", False)):  # which knows no curvature
        assert run(data, "--calibrator", name, out=tmp_path / name) == 0
        mount = load_state(tmp_path / name / "state.safetensors").states["mount"]
        assert bool(((mount["reasons"] & int(MountReason.TURNING)) != 0).all()) == turning
        assert bool((mount["seconds"] == 0).all()) == turning
