"""``lanebev run --smooth``: two passes over a drive, every pose from all of it."""

import csv
import json
import signal
import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest
import torch

from lanebev import Camera, Extrinsics
from lanebev.app.config import RunConfig
from lanebev.app.continued.smoothing import StoredStates
from lanebev.app.drive.observers import NetworkObserver
from lanebev.cli import main
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.io.state import load_state
from lanebev.io.video.writer import VideoWriter
from lanebev.testing.moments import table1_pose
from tests.drawn_road import PLACES, boundary, on_rows

HEIGHT, WIDTH, FRAMES, FPS = 240, 416, 20, 25
CAMERA = Camera.from_parameters(330, 330, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
FILES = {"extrinsics.csv", "filtered.csv", "covariance.csv", "lanes.json", "report.html", "state.safetensors"}
FILES |= {"calibration.yaml"}


def lane_lines():
    """TuSimple lines of a camera that swings, end points with a noise of 1 px, boundaries told."""
    noise = np.random.default_rng(0)
    z = torch.logspace(0.6, 1.8, 40, dtype=torch.float64)
    lines = []
    for k in range(FRAMES):
        pose = Extrinsics.from_values(*table1_pose(k / FPS))
        rows = list(range(HEIGHT // 2, HEIGHT, 6))
        lanes = [on_rows(boundary(CAMERA, place, z, pose), rows, WIDTH, noise) for place in PLACES]
        fields = {
            "raw_file": f"drive.mp4/{k:06d}",
            "lanes": lanes,
            "h_samples": rows,
            "boundary": [1, 2, 3, 4],
        }
        lines.append(json.dumps(fields))
    return "\n".join(lines)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    CAMERA.to_file(folder / "camera.yaml")
    noise = np.random.default_rng(0)
    with VideoWriter(folder / "drive.mp4", Fraction(FPS)) as writer:
        for _ in range(FRAMES):
            writer.write(noise.integers(60, 90, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    (folder / "lanes.json").write_text(lane_lines())
    return folder


def arguments(data, out, *more):
    camera, lanes = str(data / "camera.yaml"), str(data / "lanes.json")
    return [
        "run",
        str(data / "drive.mp4"),
        "--camera",
        camera,
        "--lanes",
        lanes,
        "--lane-width",
        "3.7",
        "--out",
        str(out),
        *more,
    ]


def poses(path):
    with open(path, newline="") as file:
        return np.array(
            [[float(value) for value in list(row.values())[2:10]] for row in csv.DictReader(file)]
        )


@pytest.fixture(scope="module")
def runs(data, tmp_path_factory):
    """Output folders of a run and of a smoothed one."""
    folder = tmp_path_factory.mktemp("runs")
    for name, more in (("plain", []), ("smooth", ["--smooth"])):
        assert main(arguments(data, folder / name, "--no-video", *more)) == 0
    return folder


@pytest.mark.slow
def test_errors_and_sigmas_get_smaller_and_the_filters_rows_stay(runs):
    truth = np.array([table1_pose(k / FPS) for k in range(FRAMES)]) * [*[180 / np.pi] * 3, 1]
    filtered, smoothed = poses(runs / "smooth" / "filtered.csv"), poses(runs / "smooth" / "extrinsics.csv")
    assert (runs / "smooth" / "filtered.csv").read_bytes() == (runs / "plain" / "extrinsics.csv").read_bytes()
    before, after = (np.sqrt(((found[:, :4] - truth) ** 2)[2:-2].mean(0)) for found in (filtered, smoothed))
    assert (after < 0.9 * before).all()
    assert (smoothed[:, 4:] <= filtered[:, 4:] + 2e-6).all()
    np.testing.assert_allclose(smoothed[-1], filtered[-1], atol=2e-6)


@pytest.mark.slow
def test_every_output_tells_the_smoothed_pose(runs):
    assert {path.name for path in (runs / "smooth").iterdir()} == FILES
    sigmas = poses(runs / "smooth" / "extrinsics.csv")[:, 4]
    covariances = np.genfromtxt(runs / "smooth" / "covariance.csv", delimiter=",", names=True)
    np.testing.assert_allclose(np.degrees(np.sqrt(covariances["pitch_pitch"])), sigmas, atol=2e-6)
    page = (runs / "smooth" / "report.html").read_text()
    assert "every pose is from the whole drive, later frames too" in page
    assert "estimated pose: from all frames (smoothed)" in page
    lines = [(runs / name / "lanes.json").read_text().splitlines() for name in ("plain", "smooth")]
    assert [json.loads(line)["seen"] for line in lines[0]] == [json.loads(line)["seen"] for line in lines[1]]
    assert lines[0][:-1] != lines[1][:-1]  # the curves are by the smoothed pose


@pytest.mark.slow
def test_the_state_is_that_of_the_filter_so_that_a_run_goes_on_from_it(runs):
    states = [load_state(runs / name / "state.safetensors").states for name in ("plain", "smooth")]
    torch.testing.assert_close(*states, rtol=0, atol=0)


@pytest.mark.slow
def test_a_resumed_run_is_smoothed_from_its_first_frame_on(data, runs, tmp_path):
    more = ["--smooth", "--no-video", "--resume", str(runs / "smooth")]
    assert main(arguments(data, tmp_path / "again", *more)) == 0
    smoothed, filtered = (poses(tmp_path / "again" / name) for name in ("extrinsics.csv", "filtered.csv"))
    assert not np.allclose(smoothed[0, :4], filtered[0, :4], atol=1e-4)
    assert (smoothed[:, 4:] <= filtered[:, 4:] + 2e-6).all()


@pytest.mark.slow
def test_the_network_looks_once_and_videos_show_the_smoothed_pose(data, tmp_path, monkeypatch):
    seen = []
    original = NetworkObserver.__call__
    monkeypatch.setattr(
        NetworkObserver, "__call__", lambda self, frame: seen.append(frame.number) or original(self, frame)
    )
    options = arguments(data, tmp_path / "out", "--smooth", "--end", "0.2")
    del options[options.index("--lanes") : options.index("--lanes") + 2]
    assert main(options) == 0
    assert sorted(seen) == list(range(5))
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES | {"bev.mp4", "overlay.mp4"}
    assert len((tmp_path / "out" / "lanes.json").read_text().splitlines()) == 5


@pytest.mark.slow
def test_a_run_killed_in_its_second_pass_does_not_look_again(data, tmp_path, monkeypatch):
    options = arguments(data, tmp_path / "out", "--smooth", "--end", "0.2", "--no-video")
    del options[options.index("--lanes") : options.index("--lanes") + 2]
    script = (
        "import os, signal, sys\n"
        "from lanebev.app.recording.recorder import Recorder\n"
        "from lanebev.cli import main\n"
        "Recorder._draw = lambda self, done: os.kill(os.getpid(), signal.SIGKILL)\n"
        "main(sys.argv[1:])\n"
    )
    done = subprocess.run([sys.executable, "-c", script, *options], check=False)
    assert done.returncode == -signal.SIGKILL
    monkeypatch.setattr(NetworkObserver, "__call__", lambda self, frame: pytest.fail("it looked again"))
    assert main(options) == 0
    assert "in the first 5 frames" in (tmp_path / "out" / "report.html").read_text()
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--calibrator", "two-stage"], "smooth: expected --calibrator joint, got two-stage"),
        (["--stills"], "smooth: expected a drive, got --stills"),
    ],
)
def test_what_cannot_be_smoothed_is_one_line(data, tmp_path, capsys, more, words):
    assert main(arguments(data, tmp_path / "out", "--smooth", *more)) == 2
    said = capsys.readouterr().err
    assert said == f"lanebev run: error: {words}\n"
    assert not (tmp_path / "out").exists()


def test_a_stream_has_no_second_pass(data, tmp_path, capsys):
    options = ["run", "-", "--camera", str(data / "camera.yaml"), "--smooth", "--out", str(tmp_path / "out")]
    assert main(options) == 2
    assert "expected no --smooth with a stream, got it; leave it out" in capsys.readouterr().err


@pytest.mark.parametrize(("num", "kilobytes"), [(6, 10.2), (4, 8.53)])
def test_kept_states_come_back_to_the_bit(num, kilobytes, tmp_path):
    """With four boundaries the sensitivity (1, 4, 4) is a square too, but not symmetric."""
    calibrator = JointCalibrator(num_boundaries=num)
    kept, states = StoredStates(calibrator.initial_state(1, dtype=torch.float64), tmp_path), []
    for k in range(3):
        state = calibrator.initial_state(1, dtype=torch.float64)
        slope = torch.arange(4.0 * num, dtype=torch.float64).view(1, 4, num)
        state = state._replace(pose_sensitivity=slope, mean=state.mean + k, reasons=state.reasons + k)
        states.append(state._replace(phase=state.phase + 0.1 * k))
        kept.append(states[-1])
    assert len(kept) == 3
    torch.testing.assert_close(kept[1:], states[1:], rtol=0, atol=0)
    torch.testing.assert_close(kept[-3], states[0], rtol=0, atol=0)
    with pytest.raises(IndexError):
        kept[3]
    size = kept._numbers.all().nbytes / 3
    assert size == pytest.approx(1000 * kilobytes, rel=0.03)  # of six boundaries as the documentation says
    assert list(tmp_path.iterdir()) == []  # the file has no name, and ends with its process


def test_smoothing_is_off_unless_asked_for():
    assert not RunConfig("a.mp4", "camera.yaml").smooth
