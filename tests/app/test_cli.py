"""The command line: one line and status 2 on bad input; a run that ends early leaves nothing half-written."""

import contextlib
import io
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
import yaml

from lanebev.app.config import RunConfig
from tests.app.straight_road import fails, lane_lines, run


def test_a_report_that_nobody_reads_is_no_error(data, tmp_path, monkeypatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr("sys.stdout", full)
        assert run(data, out=tmp_path / "out") == 0
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
        assert run(data, out=tmp_path / "out") == 130
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "lanebev run: interrupted, nothing written\n"
    assert list(tmp_path.iterdir()) == []


def test_bad_input_is_one_line_and_status_2(data, tmp_path, capsys):
    camera, out = data / "camera.yaml", tmp_path / "out"
    good = ["run", data / "images", "--camera", camera, "--lanes", data / "lanes.json", "--out", out]
    fails(capsys, ["run", tmp_path / "none.mp4", "--camera", camera], "none.mp4", "nothing there")
    fails(capsys, ["run", data / "images"], "--camera")
    fails(capsys, [], "demo", "run", "--help")
    fails(capsys, [*good, "--lane-widht", "3"], "--lane-widht 3; see lanebev run --help")
    fails(capsys, [*good, "b.jpg", "c.jpg"], "unrecognized arguments: b.jpg c.jpg; a glob needs quotes")
    fails(capsys, [*good, *[f"{i:05d}.jpg" for i in range(3000)]], " …; a glob needs quotes; see lan")
    fails(capsys, [*good, "--lane-width", "wide"], "argument --lane-width: expected a number, got 'wide'")
    fails(capsys, [*good, "--every", "2.5"], "argument --every: expected a whole number, got '2.5'")
    fails(capsys, [*good, "--lane-width", "37"], "lane width: expected 1 to 10 m, got 37")
    fails(capsys, [*good, "--fps", "0"], "fps: expected")
    fails(capsys, [*good, "--stills", "--resume", tmp_path], "resume: expected a drive")
    for option in ("--out", "--lanes", "--camera", "--resume"):
        fails(capsys, [*good, option, ""], f"argument {option}: expected a path, got an empty string")
    fails(capsys, ["run", "", "--camera", camera], "SOURCE: expected a path, got an empty string")
    fails(capsys, ["demo", "--out", ""], "argument --out: expected a path, got an empty string")
    fails(capsys, [*good, "--calibrator", "magic"], "invalid choice: 'magic'")
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
        fails(capsys, ["run", data / source, *arguments], *words)
        assert list(tmp_path.iterdir()) == []

    case("bad.yaml", "fx: expected", camera={**fields, "fx": 0})
    case("expected one for the source's 416 x 240", camera={**fields, "width": 640})
    text = (data / "lanes.json").read_text()
    case("bad.json, line 6", "is the file cut", lanes=text[:-40])
    case("at least one image", lanes="\n".join(lane_lines(["elsewhere.png"])))
    words = (
        "expected 6 entries, one per frame",
        "write an entry without lanes for frames that were not looked",
    )
    case(*words, lanes="\n".join(text.splitlines()[:4]), source="drive.mp4")
    more = "\n".join(lane_lines(f"{i}.png" for i in range(8)))
    case("expected 6 entries", "give the folder of those images", lanes=more, source="drive.mp4")


def test_an_undecodable_single_image_writes_nothing(data, tmp_path, capsys):
    (tmp_path / "1.jpg").write_bytes(b"\xff\xd8\xff")
    arguments = ["run", tmp_path / "1.jpg", "--camera", data / "camera.yaml", "--out", tmp_path / "out"]
    fails(capsys, arguments, "1.jpg", "expected a whole image")
    assert [path.name for path in tmp_path.iterdir()] == ["1.jpg"]


@pytest.mark.slow
def test_a_link_to_itself_is_one_line(data, tmp_path, capsys):
    (tmp_path / "link").symlink_to("link")
    for option in ("--camera", "--lanes"):
        given = {"--camera": data / "camera.yaml", "--lanes": data / "lanes.json", option: tmp_path / "link"}
        fails(capsys, ["run", data / "images", *sum(given.items(), ())], "link", "oo many", "links")


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
        fails(
            capsys, arguments, f"input {out / word}: expected a file that the run does not", "another folder"
        )
        assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before

    case(source=out / "bev.mp4", word="bev.mp4")
    case(source=out / "*.png", word="bev.png")
    case(source=out / "bev.png", word="bev.png")
    case(camera=out / "calibration.yaml", word="calibration.yaml")
    case(lanes=out / "lanes.json", word="lanes.json")
    case(lanes=out, word="lanes.json")
    lanes = {"source": "drive.mp4", "lanes": out / "lanes.json"}
    assert run(data, out=tmp_path / "other", **lanes) == 0
    assert run(data, "--resume", str(out), out=out, source="drive.mp4", lanes="video_lanes.json") == 0
    assert (out / "images").is_dir()


def test_files_that_no_run_wrote_are_not_replaced_or_removed(data, drive, tmp_path, capsys):
    out, state = tmp_path / "out", "state.safetensors"
    out.mkdir()
    for name in ("lanes.json", "calibration.yaml", "run.mcap"):
        (out / name).write_text("mine")
        given = ["run", data / "images", "--camera", data / "camera.yaml", "--lanes", data / "lanes.json"]
        fails(capsys, [*given, "--out", out], "out: expected a new one or an earlier run's, got one with a f")
        assert (out / name).read_text() == "mine"
        (out / name).unlink()
    shutil.copy(drive / state, out)
    assert run(data, "--resume", str(out), out=out, source="drive.mp4", lanes="video_lanes.json") == 0


def test_an_unwritable_folder_is_one_line(data, tmp_path, capsys):
    (tmp_path / "file").write_text("not a folder")
    for out in (tmp_path / "file", tmp_path / "file" / "out"):
        arguments = ["run", data / "images", "--camera", data / "camera.yaml", "--lanes", data / "lanes.json"]
        fails(capsys, [*arguments, "--calibrator", "two-stage", "--out", out], "output folder", "--out")
    assert (tmp_path / "file").read_text() == "not a folder"


def test_an_interrupted_run_leaves_nothing(data, tmp_path, capsys, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("lanebev.estimation.tracker.Tracker.drive_frame", interrupt)
    assert run(data, out=tmp_path / "out") == 130
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
        assert run(data, out=tmp_path / "out") == 128 + number
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
    lanes.write_text(lane_lines([os.fsdecode(b"0\xff.png")])[0])
    stdout = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr("sys.stdout", stdout)
    assert run(data, source=images, lanes=lanes, out=tmp_path / "out") == 0
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
    fails(capsys, ["compare", "a", "b"], "lanebev compare: error: expected enough memory, got too little")
