"""A run by exported parts: the same rows, and one line about files that are missing or of another camera."""

import csv
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from PIL import Image

from lanebev import Camera, JointCalibrator, LaneBEV
from lanebev.app.config import RunConfig
from lanebev.app.config.export import ExportConfig
from lanebev.app.export import export
from lanebev.app.run import run
from lanebev.cli import main
from lanebev.estimation.checks import padded
from lanebev.export import parts, runtime
from lanebev.export.names import PARTS
from lanebev.export.quantize import rendered_views
from lanebev.observation.far_view import FarView, place_crop

FRAME = Path(__file__).parents[1] / "golden" / "frame.png"
CAMERA = "{fx: 300, fy: 300, cx: 159.5, cy: 89.5, width: 320, height: 180, distortion: [-0.1, 0.01, 0, 0]}"


class EagerPart:
    """Computes as the exported file of its name would, by PyTorch: export itself has its own tests."""

    def __init__(self, path):
        self.camera = Camera.from_file(path.parent / "camera.yaml")
        far_view = FarView() if path.stem == "segmenter" else None
        self.part = parts.make_part(path.stem, LaneBEV.from_pretrained(far_view=far_view), self.camera)
        self.facts, self.inputs = self.part.facts, self.part.inputs

    def __call__(self, values):
        with torch.no_grad():
            found = self.part.module(
                *(values[name].to(example.dtype) for name, example in self.inputs.items())
            )
        return dict(zip(self.part.outputs, found, strict=True))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "images").mkdir()
    for number in range(3):
        Image.open(FRAME).save(tmp_path / "images" / f"{number}.png")
    (tmp_path / "images" / "2.png").write_bytes(b"damaged")
    return tmp_path


def settings(folder, **changes):
    paths = {"source": folder / "images", "camera": folder / "camera.yaml", "exported": folder}
    return RunConfig(**{name: str(path) for name, path in paths.items()}, **changes)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"calibrator": "two-stage"},
        {"stills": True},
        {"smooth": True},
        {"stills": True, "far_view": True},
        {"far_view": True},
    ],
    ids=str,
)
def test_the_rows_are_the_same(folder, options, monkeypatch):
    monkeypatch.setattr(runtime, "OnnxPart", EagerPart)
    places = []
    monkeypatch.setattr(
        "lanebev.observation.boundary_detector.place_crop",
        lambda *given: places.append(given) or place_crop(*given),
    )
    for backend in ("torch", "onnxruntime"):
        run(settings(folder, backend=backend, out=str(folder / backend), **options))
    rows = (folder / "torch" / "extrinsics.csv").read_text()
    assert rows.count("TRACKING") == 2
    assert (folder / "onnxruntime" / "extrinsics.csv").read_text() == rows
    far = options.get("far_view", False)
    assert len(places) % 2 == 0  # as many of both
    assert bool(places) == far


@pytest.mark.slow
@pytest.mark.parametrize("calibrator", ["joint", "two-stage"])
def test_a_run_by_a_segmenter_of_8_bits_finds_about_the_same_pose(folder, monkeypatch, caplog, calibrator):
    monkeypatch.setattr("lanebev.app.export.rendered_views", lambda size: rendered_views(size, 2))
    part = {"part": "segmenter", "int8": True, "out": str(folder)}
    assert "segmenter.onnx" in export(ExportConfig(camera=str(folder / "camera.yaml"), **part))
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    exported = runtime.OnnxPart
    monkeypatch.setattr(
        runtime, "OnnxPart", lambda path: (exported if path.stem == "segmenter" else EagerPart)(path)
    )
    rows = {}
    for backend in ("torch", "onnxruntime"):
        out = folder / backend
        run(settings(folder, calibrator=calibrator, backend=backend, out=str(out)))
        rows[backend] = list(csv.DictReader((out / "extrinsics.csv").open()))
    assert [row["status"] for row in rows["onnxruntime"]] == [row["status"] for row in rows["torch"]]
    for name in ("pitch", "yaw", "roll"):
        float_, int8 = (float(rows[backend][1][f"{name}_deg"]) for backend in ("torch", "onnxruntime"))
        assert 0 < abs(int8 - float_) < float(rows["torch"][1][f"{name}_std_deg"])


@pytest.mark.slow
def test_files_of_another_camera_or_calibrator_are_refused(folder, monkeypatch):
    monkeypatch.setattr(runtime, "OnnxPart", EagerPart)
    other = Camera.from_fov(60.0, 640, 360)
    with pytest.raises(
        ValueError, match="this camera, 640 x 360 px without lens, got some for 320 x 180 px pinhole"
    ):
        runtime.onnx_model(folder, other)
    monkeypatch.setattr(runtime, "OnnxPart", lambda path: EagerPart(path.with_stem("joint")))
    with pytest.raises(ValueError, match=r"two-stage\.onnx: expected the two-stage, got the joint"):
        runtime.onnx_calibrator(folder, "two-stage", LaneBEV.from_pretrained().calibrator)
    with pytest.raises(ValueError, match=r"segmenter\.onnx: expected the segmenter, got the joint"):
        runtime.onnx_model(folder, other)


def test_a_segmenter_without_far_view_is_refused(folder, monkeypatch):
    monkeypatch.setattr(runtime, "OnnxPart", lambda path: SimpleNamespace(facts={"part": path.stem}))
    with pytest.raises(ValueError, match=r"segmenter\.onnx: expected a segmenter for far views, got one"):
        runtime.onnx_model(folder, Camera.from_fov(60.0, 640, 360), far_view=True)


def test_a_run_without_the_files_is_one_line(folder, capsys):
    words = ["run", "images", "--camera", "camera.yaml", "--backend", "onnxruntime", "--exported", "nowhere"]
    assert main([str(folder / word) if word in ("images", "camera.yaml") else word for word in words]) == 2
    assert "joint.onnx: expected a file that lanebev export writes, found none" in capsys.readouterr().err


def test_more_segments_than_exported_are_refused():
    segments = parts.LaneSegments(*(torch.zeros(1, 5, *shape) for shape in ((2, 2), (), (), ())))
    calibrator = runtime.with_exported_step(JointCalibrator(), SimpleNamespace(facts={"segments": 4}))
    frame = (segments, torch.eye(3)[None], calibrator.initial_state(1), torch.ones(1), torch.ones(1, 5))
    with pytest.raises(
        ValueError, match="segments: expected 4 at most, as the calibrator was exported for, got 5"
    ):
        calibrator.step(*frame)
    assert padded(segments, 7).endpoints.shape == (1, 7, 2, 2)


def test_settings_are_checked():
    assert PARTS == parts.PARTS
    with pytest.raises(ValueError, match="camera: expected --camera FILE, got none"):
        ExportConfig()
    assert ExportConfig(camera="c", part="warp").parts == ("warp",)
    assert ExportConfig(camera="c", calibrator="two-stage").parts[2] == "two-stage"
    assert ExportConfig(camera="c", far_view=True).parts == ("segmenter", "joint", "step")
    assert ExportConfig(camera="c", part="joint", far_view=True).parts == ("joint",)
    with pytest.raises(
        ValueError, match="part: expected segmenter, joint, two-stage or step with --far-view, got warp"
    ):
        ExportConfig(camera="c", part="warp", far_view=True)
    with pytest.raises(ValueError, match="int8: expected --int8 or --far-view, got both"):
        ExportConfig(camera="c", int8=True, far_view=True)
    for other in ({"format": "torch-export"}, {"part": "warp"}):
        with pytest.raises(ValueError, match="int8: expected --format onnx and the part segmenter"):
            ExportConfig(camera="c", int8=True, **other)
    with pytest.raises(ValueError, match="backend: expected torch or onnxruntime, got 'tvm'"):
        RunConfig(source="s", camera="c", backend="tvm")
    for name in ("weights", "device"):
        with pytest.raises(ValueError, match=f"{name}: expected --backend torch, got onnxruntime"):
            RunConfig(source="s", camera="c", backend="onnxruntime", **{name: "cuda"})


@pytest.mark.slow
def test_export_writes_a_program_that_computes_the_same(folder, monkeypatch):
    out = folder / "programs"
    said = export(
        ExportConfig(camera=str(folder / "camera.yaml"), part="warp", format="torch-export", out=str(out))
    )
    assert "warp.pt2" in said
    assert [path.name for path in out.iterdir()] == ["warp.pt2"]
    part = parts.make_part("warp", LaneBEV.from_pretrained(), Camera.from_file(folder / "camera.yaml"))
    one = [value[:1] for value in part.inputs.values()]
    monkeypatch.setattr("lanebev.view.blocks.traced", lambda: True)  # cell by cell, as a program has it
    for found, expected in zip(
        torch.export.load(out / "warp.pt2").module()(*one), part.module(*one), strict=True
    ):
        torch.testing.assert_close(found, expected)


def test_each_part_is_named_before_it_is_exported(folder, monkeypatch, capsys):
    """Since the joint calibrator takes minutes."""
    said = []

    def write(part, path):
        said.append(capsys.readouterr().err)
        path.write_bytes(b"")

    monkeypatch.setattr("lanebev.app.export.write_onnx", write)
    words = ["--camera", str(folder / "camera.yaml"), "--far-view", "--out", str(folder / "named")]
    assert main(["export", *words]) == 0
    names = ("segmenter", "joint", "step")
    assert said == [f"lanebev export: {name}, {n} of 3\n" for n, name in enumerate(names, 1)]


def test_an_export_that_cannot_be_written_is_one_line(folder, capsys):
    (folder / "file").write_text("")
    words = [
        "export",
        "--camera",
        str(folder / "camera.yaml"),
        "--part",
        "warp",
        "--out",
        str(folder / "file"),
    ]
    assert main(words) == 2
    assert "expected one that can be written" in capsys.readouterr().err
