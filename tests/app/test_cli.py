"""The command line as a person uses it: outputs as promised, one clear line and status 2 on bad input."""

import contextlib
import csv
import io
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from fractions import Fraction

import av
import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from safetensors import safe_open
from safetensors.torch import save_file

from lanebev import Camera, Extrinsics, JointCalibrator, image_from_road_points
from lanebev.app.config import RunConfig
from lanebev.app.summary import untracked_words
from lanebev.cli import main
from lanebev.estimation.lane_width_prior import LANE_WIDTH, LANE_WIDTH_STD
from lanebev.estimation.mount import MountReason
from lanebev.io.results import CSV_COLUMNS, ExtrinsicsRow, write_extrinsics
from lanebev.io.state import load_state
from lanebev.io.video import open_source
from lanebev.io.video_writer import VideoWriter
from tools import pseudo_ground_truth

HEIGHT, WIDTH, FRAMES = 240, 416, 6
CAMERA = Camera.from_parameters(330, 330, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
OFFSETS = (-5.5, -1.8, 1.9, 5.6)
POSE = (0.03, -0.01, 0.005, 1.4)
ROWS = range(0, HEIGHT, 10)


def _lane_lines(names):
    """TuSimple lines of a straight road with 3.7 m lanes; no boundary index."""
    z = torch.logspace(0.5, 2.3, 300, dtype=torch.float64)
    lanes = []
    for offset in OFFSETS:
        road = torch.stack([torch.full_like(z, offset), z], dim=-1)[None]
        pixels = image_from_road_points(road, CAMERA.intrinsics[None], Extrinsics.from_values(*POSE))[0][0]
        x, y = pixels.flip(0).numpy().T
        on_rows = np.interp(ROWS, y, x, left=-2, right=-2)
        lanes.append([round(v, 2) if 0 <= v < WIDTH else -2 for v in on_rows])
    return [json.dumps({"raw_file": name, "lanes": lanes, "h_samples": list(ROWS)}) for name in names]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with a camera file, a video, images, and lanes for both."""
    root = tmp_path_factory.mktemp("data")
    fields = {
        "fx": 330,
        "fy": 330,
        "cx": (WIDTH - 1) / 2,
        "cy": (HEIGHT - 1) / 2,
        "width": WIDTH,
        "height": HEIGHT,
    }
    (root / "camera.yaml").write_text(yaml.safe_dump(fields))
    noise = np.random.default_rng(0)
    (root / "images").mkdir()
    with VideoWriter(root / "drive.mp4", Fraction(25)) as writer:
        for i in range(FRAMES):
            image = noise.integers(60, 90, (HEIGHT, WIDTH, 3), dtype=np.uint8)
            writer.write(image)
            Image.fromarray(image).save(root / "images" / f"{i}.png")
    (root / "video_lanes.json").write_text("\n".join(_lane_lines(f"x/{i}" for i in range(FRAMES))))
    names = [f"images/{i}.png" for i in range(FRAMES)]
    (root / "lanes.json").write_text("\n".join(_lane_lines(names)))
    return root


def _run(data, *extra, source="images", lanes="lanes.json", out):
    fixed = ["--camera", str(data / "camera.yaml"), "--lanes", str(data / lanes), "--calibrator", "two-stage"]
    return main(["run", str(data / source), *fixed, "--out", str(out), *extra])


def _table(folder):
    with open(folder / "extrinsics.csv", newline="") as file:
        return list(csv.DictReader(file))


def _fails(capsys, arguments, *words):
    """The command says one line with these words, returns 2."""
    try:
        status = main([str(argument) for argument in arguments])
    except SystemExit as exit_:
        status = exit_.code
    output = capsys.readouterr()
    assert status == 2
    assert output.out == ""
    assert output.err.count("\n") == 1, output.err
    for word in words:
        assert word in output.err, output.err


@pytest.fixture(scope="module")
def drive(data, tmp_path_factory):
    """Outputs of a run on the video."""
    out = tmp_path_factory.mktemp("out") / "drive"
    assert _run(data, source="drive.mp4", lanes="video_lanes.json", out=out) == 0
    return out


def test_a_run_on_a_video_finds_the_pose(drive):
    rows = _table(drive)
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
        for offset in (-5.55, -1.85, 1.85, 5.55):
            road = torch.stack([torch.full_like(z, offset), z], dim=-1)[None]
            pixels = image_from_road_points(road, CAMERA.intrinsics[None], at)[0][0].flip(0).numpy()
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
    assert _run(data, source="drive.mp4", lanes="wide.json", out=tmp_path / "out") == 0
    for row, plain in zip(_table(tmp_path / "out"), _table(drive), strict=True):
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
    assert _run(data, source="drive.mp4", lanes="again.json", out=tmp_path / "out") == 0
    assert (tmp_path / "out" / "extrinsics.csv").read_text() == (drive / "extrinsics.csv").read_text()
    assert (tmp_path / "out" / "lanes.json").read_text() == (drive / "lanes.json").read_text()


@pytest.mark.slow
def test_folder_glob_and_stills(data, tmp_path):
    assert _run(data, "--fps", "10", out=tmp_path / "folder") == 0
    folder = _table(tmp_path / "folder")
    assert [row["image"] for row in folder] == [str(data / "images" / f"{i}.png") for i in range(FRAMES)]
    assert folder[1]["time_s"] == "0.100000"
    assert _run(data, "--stills", source="**/*.png", out=tmp_path / "stills") == 0
    stills = _table(tmp_path / "stills")
    assert len(stills) == FRAMES
    assert len({row["pitch_deg"] for row in stills}) == 1  # each on its own, and all the same
    shown = [frame.time for frame in open_source(str(tmp_path / "stills" / "bev.mp4"))]
    assert shown == pytest.approx([0.5 * i for i in range(FRAMES)], abs=1e-3)  # long enough to be looked at
    assert float(stills[0]["pitch_deg"]) == pytest.approx(np.degrees(POSE[0]), abs=0.1)


def test_one_image_gives_pictures(data, tmp_path):
    assert _run(data, source="images/3.png", out=tmp_path / "out") == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"bev.png", "overlay.png"} <= names
    assert not {"bev.mp4", "overlay.mp4"} & names
    assert len(_table(tmp_path / "out")) == 1
    assert "calibration.yaml" not in names


def test_one_image_is_a_still(data, tmp_path):
    """As a drive's first frame its lanes would be taken for equal, and roll for much surer."""
    joint = ("--calibrator", "joint")
    assert _run(data, *joint, source="images/3.png", out=tmp_path / "image") == 0
    assert _run(data, *joint, "--stills", source="images/3.png", out=tmp_path / "still") == 0
    assert _table(tmp_path / "image") == _table(tmp_path / "still")
    (tmp_path / "folder").mkdir()
    shutil.copy(data / "images" / "3.png", tmp_path / "folder")
    assert _run(data, *joint, source=tmp_path / "folder", out=tmp_path / "drive") == 0
    (image,), (frame,) = _table(tmp_path / "image"), _table(tmp_path / "drive")
    assert float(image["roll_std_deg"]) > 2 * float(frame["roll_std_deg"])


@pytest.mark.slow
@pytest.mark.parametrize("calibrator", ["two-stage", "joint"])
def test_resuming_gives_what_an_uninterrupted_run_gives(data, tmp_path, calibrator, capsys):
    for part, numbers in (("whole", range(6)), ("first", range(3)), ("second", range(3, 6))):
        (tmp_path / part).mkdir()
        for i in numbers:
            shutil.copy(data / "images" / f"{i}.png", tmp_path / part / f"{i}.png")
        lines = "\n".join(_lane_lines(f"{part}/{i}.png" for i in numbers))
        (tmp_path / part / "lanes.json").write_text(lines)
        resume = ["--resume", str(tmp_path / "out_first")] if part == "second" else []
        sources = {"source": tmp_path / part, "lanes": tmp_path / part / "lanes.json"}
        out = tmp_path / f"out_{part}"
        assert _run(data, "--calibrator", calibrator, *resume, out=out, **sources) == 0
    estimates = slice(2, 11)  # after frame and time, up to the status
    whole, second = (
        [list(row.values())[estimates] for row in _table(tmp_path / f"out_{part}")]
        for part in ("whole", "second")
    )
    assert whole[3:] == second
    one, other = (
        load_state(tmp_path / f"out_{part}" / "state.safetensors").states for part in ("whole", "second")
    )
    assert _run(data, "--calibrator", calibrator, "--lane-width", "3.5", *resume, out=out, **sources) == 0
    assert "resume: the state was saved with lanes 3.7 m wide, now they are 3.5 m" in capsys.readouterr().out
    assert set(one) == {"calibrator", "mount"}
    for name in one:
        assert all(torch.equal(one[name][field], other[name][field]) for field in one[name])


@pytest.mark.slow
def test_a_damaged_state_is_reported_and_a_missing_one_refused(data, tmp_path, capsys):
    assert _run(data, source="images/[3].png", out=tmp_path / "out") == 0
    state, resume = tmp_path / "out" / "state.safetensors", ["--resume", str(tmp_path / "out")]
    with safe_open(state, "pt") as file:
        fields = {name: file.get_tensor(name) for name in file.keys() if "reasons" not in name}  # noqa: SIM118
        save_file(fields, state, file.metadata())  # of another version of lanebev
    assert _run(data, *resume, "--lane-width", "3", source="images/3.png", out=tmp_path / "next") == 0
    said = capsys.readouterr().out
    assert "state ignored" in said
    assert "saved with lanes" not in said  # it is not used
    state.write_bytes(state.read_bytes()[:-5])
    assert _run(data, *resume, source="images/3.png", out=tmp_path / "next") == 0
    assert "state ignored" in capsys.readouterr().out
    images, camera, lanes = data / "images", data / "camera.yaml", data / "lanes.json"
    arguments = ["run", images, "--camera", camera, "--lanes", lanes, "--out", tmp_path / "third"]
    _fails(capsys, [*arguments, "--resume", data], "resume: expected the output folder", "state.safetensors")
    assert not (tmp_path / "third").exists()


@pytest.mark.slow
def test_the_state_of_the_other_calibrator_is_a_mistake(data, tmp_path, capsys):
    for one, other in (("joint", "two-stage"), ("two-stage", "joint")):
        folder = tmp_path / one
        assert _run(data, "--calibrator", one, source="images/[3].png", out=folder) == 0
        capsys.readouterr()
        before = {path.name: path.read_bytes() for path in folder.iterdir()}
        arguments = ["run", data / "images", "--camera", data / "camera.yaml", "--lanes", data / "lanes.json"]
        for out in (folder, tmp_path / "next"):
            _fails(
                capsys,
                [*arguments, "--calibrator", other, "--resume", folder, "--out", out],
                f"resume: expected a state of the {other} calibrator, got one of the {one} calibrator",
                f"give --calibrator {one} or leave out --resume",
            )
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
        assert not (tmp_path / "next").exists()


def test_the_state_of_another_camera_is_a_mistake(data, tmp_path, capsys):
    assert _run(data, out=tmp_path / "out") == 0
    fields = yaml.safe_load((data / "camera.yaml").read_text())
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump(fields | {"fx": fields["fx"] + 40}))
    arguments = ["run", data / "images", "--camera", other, "--lanes", data / "lanes.json"]
    arguments += ["--calibrator", "two-stage", "--resume", tmp_path / "out", "--out", tmp_path / "next"]
    capsys.readouterr()
    _fails(capsys, arguments, "resume: expected a state of the camera in", "got another camera's")
    assert not (tmp_path / "next").exists()


@pytest.mark.slow
def test_resuming_with_the_camera_that_a_run_wrote(data, tmp_path):
    fields = yaml.safe_load((data / "camera.yaml").read_text())
    camera = tmp_path / "camera.yaml"
    camera.write_text(yaml.safe_dump(fields | {"distortion": [-0.001, 0.0001, 0.0, 0.0]}))
    fixed = ["--lanes", str(data / "lanes.json"), "--calibrator", "two-stage"]
    first = ["run", str(data / "images"), "--camera", str(camera), "--out", str(tmp_path / "one"), *fixed]
    assert main(first) == 0
    again = ["--camera", str(tmp_path / "one" / "calibration.yaml"), "--resume", str(tmp_path / "one")]
    assert main(["run", str(data / "images"), *again, "--out", str(tmp_path / "two"), *fixed]) == 0


def test_a_report_that_nobody_reads_is_no_error(data, tmp_path, monkeypatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr("sys.stdout", full)
        assert _run(data, out=tmp_path / "out") == 0
        monkeypatch.undo()
        with contextlib.suppress(OSError):
            full.close()
    assert (tmp_path / "out" / "extrinsics.csv").exists()


def test_a_second_ctrl_c_waits_until_the_first_has_cleaned_up(data, tmp_path, capsys, monkeypatch):
    def stop(*_):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("lanebev.estimation.tracker.Tracker.drive_frame", stop)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert _run(data, out=tmp_path / "out") == 130
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "lanebev run: interrupted, nothing written\n"
    assert list(tmp_path.iterdir()) == []


def test_a_lane_file_may_begin_with_a_byte_order_mark(data, tmp_path):
    lanes = tmp_path / "lanes.json"
    lanes.write_bytes(b"\xef\xbb\xbf" + (data / "lanes.json").read_bytes())
    assert _run(data, lanes=lanes, out=tmp_path / "out") == 0


@pytest.mark.slow
def test_a_refused_state_is_kept_beside_what_replaces_it(data, tmp_path, capsys):
    out, names = tmp_path / "out", ("state.safetensors", "calibration.yaml")
    (tmp_path / "link").symlink_to(out, target_is_directory=True)
    assert _run(data, source="images/[3].png", out=out) == 0
    for number in ("", "1"):  # the second does not take the place of the first
        (out / names[0]).write_bytes((out / names[0]).read_bytes()[: -5 - len(number)])
        before = [(out / name).read_bytes() for name in names]
        assert _run(data, "--resume", str(tmp_path / "link"), source="images/3.png", out=out) == 0
        kept = [f"{name}.refused{number}" for name in names]
        assert f"calibration starts anew; kept as {kept[0]}, {kept[1]}" in capsys.readouterr().out
        assert [(out / name).read_bytes() for name in kept] == before
        assert load_state(out / names[0]).problem is None
    (out / names[0]).write_bytes(before[0])
    assert _run(data, "--resume", str(out), source="images/3.png", out=tmp_path / "next") == 0
    assert not list((tmp_path / "next").glob("*.refused*"))  # it stays where it is
    assert (out / names[0]).read_bytes() == before[0]


def test_a_damaged_image_in_a_drive_is_a_row(data, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("lanebev.app.recorder.drive_remark", lambda rows: "pose: odd")
    shutil.copytree(data / "images", tmp_path / "images")
    (tmp_path / "images" / "2.png").write_bytes((tmp_path / "images" / "2.png").read_bytes()[:2000])
    assert _run(data, source=tmp_path / "images", out=tmp_path / "out") == 0
    rows = _table(tmp_path / "out")
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
    assert _run(data, source=images, out=tmp_path / "out") == 0
    rows = _table(tmp_path / "out")
    assert rows[0]["status"] == "UNINITIALISED"
    assert {row["status"] for row in rows[1:]} == {"TRACKING"}


def test_frames_without_lanes_are_rows(data, tmp_path):
    (data / "some.json").write_text("\n".join(_lane_lines(["images/1.png"])))
    assert _run(data, lanes="some.json", out=tmp_path / "out") == 0
    assert [row["status"] for row in _table(tmp_path / "out")][:3] == [
        "UNINITIALISED",
        "TRACKING",
        "COASTING",
    ]


def test_bad_input_is_one_line_and_status_2(data, tmp_path, capsys):
    camera, out = data / "camera.yaml", tmp_path / "out"
    good = ["run", data / "images", "--camera", camera, "--lanes", data / "lanes.json", "--out", out]
    _fails(capsys, ["run", tmp_path / "none.mp4", "--camera", camera], "none.mp4", "nothing there")
    _fails(capsys, ["run", data / "images"], "--camera")
    _fails(capsys, [], "demo", "run", "--help")
    _fails(capsys, [*good, "--lane-widht", "3"], "unrecognized arguments: --lane-widht")
    _fails(capsys, [*good, "b.jpg", "c.jpg"], "unrecognized arguments: b.jpg c.jpg; a glob needs quotes")
    _fails(capsys, [*good, *[f"{i:05d}.jpg" for i in range(3000)]], " …; a glob needs quotes; see lan")
    _fails(capsys, [*good, "--lane-width", "wide"], "invalid float value: 'wide'")
    _fails(capsys, [*good, "--lane-width", "37"], "lane width: expected 1 to 10 m, got 37")
    _fails(capsys, [*good, "--fps", "0"], "fps: expected")
    _fails(capsys, [*good, "--stills", "--resume", tmp_path], "resume: expected a drive")
    for option in ("--out", "--lanes", "--camera", "--resume"):
        _fails(capsys, [*good, option, ""], f"argument {option}: expected a path, got an empty string")
    _fails(capsys, ["run", "", "--camera", camera], "SOURCE: expected a path, got an empty string")
    _fails(capsys, ["demo", "--out", ""], "argument --out: expected a path, got an empty string")
    _fails(capsys, [*good, "--calibrator", "magic"], "invalid choice: 'magic'")
    assert list(tmp_path.iterdir()) == []


def test_bad_camera_or_lane_file_writes_nothing(data, tmp_path, capsys):
    fields = yaml.safe_load((data / "camera.yaml").read_text())
    out = tmp_path / "a" / "out"

    def case(*words, camera=None, lanes=None, source="images"):
        if camera is not None:
            (data / "bad.yaml").write_text(yaml.safe_dump(camera))
        if lanes is not None:
            (data / "bad.json").write_text(lanes)
        arguments = ["--camera", data / ("camera.yaml" if camera is None else "bad.yaml")]
        arguments += ["--lanes", data / ("lanes.json" if lanes is None else "bad.json"), "--out", out]
        _fails(capsys, ["run", data / source, *arguments], *words)
        assert list(tmp_path.iterdir()) == []

    case("bad.yaml", "fx: expected", camera={**fields, "fx": 0})
    case("expected one for the source's 416 x 240", camera={**fields, "width": 640})
    text = (data / "lanes.json").read_text()
    case("bad.json, line 6", "is the file cut", lanes=text[:-40])
    case("at least one image", lanes="\n".join(_lane_lines(["elsewhere.png"])))
    case("expected 6 entries, one per frame", lanes="\n".join(text.splitlines()[:4]), source="drive.mp4")


def test_an_undecodable_single_image_writes_nothing(data, tmp_path, capsys):
    (tmp_path / "1.jpg").write_bytes(b"\xff\xd8\xff")
    arguments = ["run", tmp_path / "1.jpg", "--camera", data / "camera.yaml", "--out", tmp_path / "out"]
    _fails(capsys, arguments, "1.jpg", "expected a whole image")
    assert [path.name for path in tmp_path.iterdir()] == ["1.jpg"]


@pytest.mark.slow
def test_a_run_does_not_replace_what_it_reads(data, drive, tmp_path, capsys):
    out = tmp_path / "out"
    shutil.copytree(drive, out)
    shutil.copy(data / "drive.mp4", out / "bev.mp4")
    shutil.copytree(data / "images", out / "images")
    shutil.copy(data / "images" / "0.png", out / "bev.png")
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}

    def case(
        source=data / "drive.mp4", camera=data / "camera.yaml", lanes=data / "video_lanes.json", word=""
    ):
        arguments = ["run", source, "--camera", camera, "--lanes", lanes, "--out", out]
        _fails(
            capsys, arguments, f"input {out / word}: expected a file that the run leaves", "another folder"
        )
        assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before

    case(source=out / "bev.mp4", word="bev.mp4")
    case(source=out / "*.png", word="bev.png")
    case(source=out / "bev.png", word="bev.png")
    case(camera=out / "calibration.yaml", word="calibration.yaml")
    case(lanes=out / "lanes.json", word="lanes.json")
    case(lanes=out, word="lanes.json")
    lanes = {"source": "drive.mp4", "lanes": out / "lanes.json"}
    assert _run(data, out=tmp_path / "other", **lanes) == 0
    assert _run(data, "--resume", str(out), out=out, source="drive.mp4", lanes="video_lanes.json") == 0
    assert (out / "images").is_dir()


@pytest.mark.slow
def test_a_cut_video_is_reported_and_takes_its_own_lanes(data, tmp_path, capsys):
    with av.open(str(data / "drive.mp4")) as container:
        end = [packet.pos + packet.size for packet in container.demux(video=0) if packet.size][3]
    (tmp_path / "drive.mp4").write_bytes((data / "drive.mp4").read_bytes()[: end + 50])
    shutil.copy(data / "camera.yaml", tmp_path)
    lines = (data / "video_lanes.json").read_text().splitlines()
    (tmp_path / "lanes.json").write_text("\n".join(lines[:5]))
    assert _run(tmp_path, source="drive.mp4", out=tmp_path / "out") == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("problem: ")]
    declared = f"video {tmp_path / 'drive.mp4'}: expected 0.24 s as it declares, got 0.20 s; is it cut?"
    assert said[0] == f"problem: {declared}"
    assert said[1].startswith("problem: frame 4: expected a whole frame, got: ")
    assert [row["status"] for row in _table(tmp_path / "out")] == 4 * ["TRACKING"] + ["COASTING"]
    own = {"source": "drive.mp4", "lanes": tmp_path / "out" / "lanes.json"}
    assert _run(tmp_path, out=tmp_path / "again", **own) == 0
    first, again = (tmp_path / name / "extrinsics.csv" for name in ("out", "again"))
    assert first.read_text() == again.read_text()


@pytest.mark.slow
def test_the_mount_does_not_learn_in_a_bend(data, tmp_path, monkeypatch):
    monkeypatch.setattr(JointCalibrator, "curvature", lambda _, state: 0.002 + 0 * state.mean[:, 0])
    for name, turning in (("joint", True), ("two-stage", False)):  # which knows no curvature
        assert _run(data, "--calibrator", name, out=tmp_path / name) == 0
        mount = load_state(tmp_path / name / "state.safetensors").states["mount"]
        assert bool(((mount["reasons"] & int(MountReason.TURNING)) != 0).all()) == turning
        assert bool((mount["seconds"] == 0).all()) == turning


def test_an_unwritable_folder_is_one_line(data, tmp_path, capsys):
    (tmp_path / "file").write_text("not a folder")
    for out in (tmp_path / "file", tmp_path / "file" / "out"):
        arguments = ["run", data / "images", "--camera", data / "camera.yaml", "--lanes", data / "lanes.json"]
        _fails(capsys, [*arguments, "--calibrator", "two-stage", "--out", out], "output folder", "--out")
    assert (tmp_path / "file").read_text() == "not a folder"


def test_an_interrupted_run_leaves_nothing(data, tmp_path, capsys, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("lanebev.estimation.tracker.Tracker.drive_frame", interrupt)
    assert _run(data, out=tmp_path / "out") == 130
    assert capsys.readouterr().err == "lanebev run: interrupted, nothing written\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_stopped_by_the_system_leaves_nothing(data, tmp_path, capsys, monkeypatch, number):
    def stop(*_):
        os.kill(os.getpid(), number)
        time.sleep(10)

    before = signal.signal(number, signal.SIG_DFL)  # the tests may run under nohup
    monkeypatch.setattr("lanebev.estimation.tracker.Tracker.drive_frame", stop)
    try:
        assert _run(data, out=tmp_path / "out") == 128 + number
        assert capsys.readouterr().err == "lanebev run: interrupted, nothing written\n"
        assert list(tmp_path.iterdir()) == []
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)


def test_names_and_terminals_without_the_signs(data, tmp_path, monkeypatch):
    images = tmp_path / "images"
    images.mkdir()
    shutil.copy(data / "images" / "0.png", os.fsencode(images) + b"/0\xff.png")
    lanes = tmp_path / "lanes.json"
    lanes.write_text(_lane_lines([os.fsdecode(b"0\xff.png")])[0])
    stdout = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr("sys.stdout", stdout)
    assert _run(data, source=images, lanes=lanes, out=tmp_path / "out") == 0
    stdout.flush()
    assert b"1 TRACKING" in stdout.buffer.getvalue()
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"extrinsics.csv", "report.html"}


@pytest.mark.slow
def test_module_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "lanebev", "--help"], capture_output=True, text=True, check=True
    )
    assert "demo" in done.stdout
    assert "run" in done.stdout


@pytest.mark.slow
def test_weights_are_there_after_one_import():
    script = "import lanebev; print(lanebev.weights.read_metadata()['seed'])"
    subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)


def test_config_checks_itself():
    with pytest.raises(ValueError, match="calibrator: expected joint or two-stage"):
        RunConfig("a", "b", "c", calibrator="x")


def test_too_little_memory_is_one_line(capsys, monkeypatch):
    def compare(**_):
        raise MemoryError

    monkeypatch.setattr("lanebev.app.compare.compare", compare)
    _fails(capsys, ["compare", "a", "b"], "lanebev compare: error: expected enough memory, got too little")
