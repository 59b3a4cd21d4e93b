"""``lanebev run --speed``: the vehicle's speed beside a drive."""

import pytest
import torch

from lanebev.app.config import RunConfig
from lanebev.app.drive.sources import make_source
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import MotionConfig
from lanebev.estimation.joint.layout import layout
from lanebev.estimation.mount import MountEstimator
from lanebev.io.state import load_state
from tests.app.straight_road import FRAMES, fails, run

PARTS = {"calibrator": JointCalibrator(), "mount": MountEstimator()}
JOINT = ("--calibrator", "joint", "--no-video")


def speed_after(out):
    """The speed that the state of a run holds, and its standard deviation, m/s."""
    like = {part: each.initial_state(1, torch.float64) for part, each in PARTS.items()}
    found = load_state(out / "state.safetensors", like)
    state, place = found.states["calibrator"], layout(6).speed
    return MotionConfig().speed + float(state.mean[0, place]), float(state.cov[0, place, place].sqrt())


def frames_of(data, source="images", **settings):
    config = RunConfig(str(data / source), str(data / "camera.yaml"), **settings)
    return list(make_source(config))


@pytest.mark.parametrize("extra", [(), ("--smooth",)])
def test_a_run_with_the_speed_given(data, tmp_path, extra):
    (tmp_path / "speed.csv").write_text("time,speed_kmh\n0,18\n1,18\n")
    assert run(data, *JOINT, *extra, "--speed", str(tmp_path / "speed.csv"), out=tmp_path / "given") == 0
    assert run(data, *JOINT, *extra, out=tmp_path / "not") == 0
    assert speed_after(tmp_path / "given")[0] == pytest.approx(5.0, abs=0.2)
    assert speed_after(tmp_path / "given")[1] < 0.5
    assert speed_after(tmp_path / "not") == (pytest.approx(20.0, abs=1.0), pytest.approx(9.0, rel=0.1))


def test_speeds_are_those_of_the_whole_source(data, tmp_path):
    each, timed = tmp_path / "each.txt", tmp_path / "timed.csv"
    each.write_text("".join(f"{number}\n" for number in range(FRAMES)))
    timed.write_text("0,0\n0.2,2\n")
    assert [frame.speed for frame in frames_of(data, speed=str(each))] == list(range(FRAMES))
    assert [frame.speed for frame in frames_of(data, speed=str(each), start=0.05, every=2)] == [2, 4]
    for source in ("images", "drive.mp4"):
        found = [frame.speed for frame in frames_of(data, source, speed=str(timed), start=0.05, fps=30.0)]
        times = [number / (30.0 if source == "images" else 25.0) for number in range(2, FRAMES)]
        assert found == pytest.approx([min(10 * time, 2.0) for time in times], abs=1e-6)
    assert frames_of(data)[0].speed is None


def test_speeds_of_other_times_are_noticed(data, tmp_path):
    path = tmp_path / "speed.csv"
    path.write_text("time,speed\n0,5\n1000,5\n2000,5\n3000,5\n")  # ms
    remark = "speed: 4 of 6 frames have none within a second; are its times in seconds?"
    config = RunConfig(str(data / "images"), str(data / "camera.yaml"), speed=str(path), fps=1.0)
    assert make_source(config).problem.endswith(remark)
    path.write_text("time,speed\n0,5\n1,5\n2,5\n3,5\n4,5\n5,5\n")
    assert "speed" not in make_source(config).problem
    with pytest.raises(ValueError, match="expected times in seconds, got numbers of the 6 frames; write tit"):
        frames_of(data, speed=str(path), fps=30.0)
    path.write_text("time,speed\n0,5\n")
    image = str(data / "images" / "*0.png")
    config = RunConfig(image, str(data / "camera.yaml"), speed=str(path))
    assert [frame.speed for frame in make_source(config)] == [5.0]


def test_speeds_that_may_be_in_kmh_are_noticed(data, tmp_path):
    speed = tmp_path / "speed.txt"
    for value, words in (
        (50, "speed: up to 50 m/s, 180 km/h; if it is in km/h, title it speed_kmh"),
        (40, ""),
    ):
        speed.write_text(f"{value}\n" * FRAMES)
        config = RunConfig(str(data / "images"), str(data / "camera.yaml"), speed=str(speed), fps=30.0)
        assert make_source(config).problem == words


def test_speeds_that_do_not_fit_are_one_line(capsys, data, tmp_path):
    wrong, later = tmp_path / "wrong.txt", tmp_path / "later.csv"
    wrong.write_text("5\n6\n")
    later.write_text("1700000000.0,5\n1700000000.1,5\n")
    fixed = ("run", data / "images", "--camera", data / "camera.yaml", "--out", tmp_path / "out")
    fails(
        capsys,
        [*fixed, "--speed", wrong],
        f"expected a speed for each of {FRAMES} frames, got 2; or add",
    )
    fails(
        capsys,
        [*fixed, "--speed", later],
        "expected times since the first frame, 0 to 0.20 s, got 1700000000",
    )
    fails(capsys, [*fixed, "--speed", tmp_path / "none.csv"], "none.csv: No such file")
    fails(capsys, [*fixed, "--speed", wrong, "--stills"], "speed: expected a drive, got --stills")
    words = "speed topic: expected a bag as the source, got ", "; leave --speed-topic out"
    fails(capsys, [*fixed, "--speed-topic", "/odom"], *words)
    fails(
        capsys, [*fixed, "--speed-topic", "/odom", "--speed", wrong], "expected a file or a topic, got both"
    )
    stream = ("run", "-", "--camera", data / "camera.yaml", "--out", tmp_path / "out")
    fails(capsys, [*stream, "--speed", wrong], "expected no --speed with a stream")
    assert not (tmp_path / "out").exists()
