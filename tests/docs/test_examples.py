"""Every example runs, and is short."""

import runpy
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from lanebev import (
    BEVGrid,
    BEVWarp,
    Camera,
    LaneBEV,
    LaneSegmenter,
    LineExtractor,
    SegmenterConfig,
    TwoStageCalibrator,
)
from lanebev.export.parts import make_part
from lanebev.export.write import write_onnx
from lanebev.io.video import VideoWriter

EXAMPLES = Path(__file__).parents[2] / "examples"
GOLDEN = Path(__file__).parents[1] / "golden"


def run_example(name, monkeypatch, tmp_path, *arguments):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


def small_step():
    config = SegmenterConfig(base_width=4, decoder_width=8)
    model = LaneBEV(
        LaneSegmenter(config),
        LineExtractor.for_network(config),
        TwoStageCalibrator(num_hypotheses=20),
        BEVWarp(BEVGrid(x=(-6.0, 6.0), z=(6.0, 30.0), resolution=0.5)),
    )
    intrinsics = [[80.0, 0.0, 63.5], [0.0, 80.0, 31.5], [0.0, 0.0, 1.0]]
    return make_part("step", model, Camera(torch.tensor(intrinsics), torch.zeros(0), "pinhole", (64, 128)))


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short(path):
    if path.name == "onnx_only.py":
        pytest.skip("it has no library behind it")
    code = [
        line
        for line in path.read_text().splitlines()
        if line and not line.startswith(('"""', "import", "from"))
    ]
    assert len(code) <= 20


def test_another_detectors_boundaries(monkeypatch, tmp_path, capsys):
    run_example("other_detector.py", monkeypatch, tmp_path)
    values = [float(word) for word in capsys.readouterr().out.replace(",", "").split() if word[-1].isdigit()]
    assert values == pytest.approx([0.0, 0.0, 0.0, 3.7 / 2.6], abs=5e-3)


@pytest.mark.slow
def test_features_of_another_network(monkeypatch, tmp_path, capsys):
    run_example("embed.py", monkeypatch, tmp_path)
    assert "torch.Size([1, 1, 114, 40])" in capsys.readouterr().out


@pytest.mark.slow
def test_a_live_loop_ends_with_a_state(monkeypatch, tmp_path, capsys):
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (320, 192))
    for value in (0, 90, 180):
        writer.write(np.full((192, 320, 3), value, np.uint8))
    writer.release()
    run_example("live_loop.py", monkeypatch, tmp_path, tmp_path / "v.avi", 60)
    said = capsys.readouterr().out
    assert said.count("+-") == 3
    assert "does not advance" not in said
    assert (tmp_path / "state.safetensors").is_file()


@pytest.mark.slow
def test_ones_own_video(monkeypatch, tmp_path, capsys):
    with VideoWriter(tmp_path / "drive.mp4", Fraction(20)) as video:
        for _ in range(2):
            video.write(np.asarray(Image.open(GOLDEN / "frame.png")))
    (tmp_path / "camera.yaml").write_text("{fx: 300, fy: 300, cx: 159.5, cy: 89.5, width: 320, height: 180}")
    run_example("own_video.py", monkeypatch, tmp_path, "drive.mp4", "camera.yaml", "out")
    assert "2 frames" in capsys.readouterr().out
    assert (tmp_path / "out" / "report.html").is_file()


WITHOUT_TORCH = """
import runpy, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "lanebev"):
            raise ImportError(f"{name} is not to be imported")

sys.meta_path.insert(0, Refuse())
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.slow
def test_a_step_runs_without_torch(tmp_path):
    """A small step, exported here, in a process that refuses torch."""
    part = small_step()
    write_onnx(part, tmp_path / "step.onnx")
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (128, 64))
    for value in (0, 90, 180):
        writer.write(np.full((64, 128, 3), value, np.uint8))
    writer.release()
    subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, EXAMPLES / "onnx_only.py", "step.onnx", "v.avi", "out.csv"],
        cwd=tmp_path, check=True,
    )  # fmt: skip
    rows = (tmp_path / "out.csv").read_text().splitlines()
    assert rows[0].startswith("frame,pitch_deg,yaw_deg,roll_deg,height_m,std_pitch_deg")
    assert len(rows) == 4
    assert rows[1].endswith(",0")  # UNINITIALISED: no lanes
    assert cv2.imread(str(tmp_path / "out.csv.png")).shape == (48, 24, 3)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_stands_in_the_docs(path):
    pages = (page.read_text(encoding="utf-8") for page in (EXAMPLES.parent / "docs").rglob("*.md"))
    assert any(f'--8<-- "examples/{path.name}"' in page for page in pages)
