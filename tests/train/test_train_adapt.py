"""Labels from a run's own result, a config that trains on them, and trunks of image classifiers."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from lanebev.camera.model import Camera
from lanebev.estimation.joint.frame.boundary_curves import Boundaries
from lanebev.io.results import ExtrinsicsRow, write_extrinsics
from lanebev.observation.polylines import image_rows
from lanebev.observation.resnet import ResNet18
from lanebev.observation.segmenter import SegmenterConfig
from lanebev.types import Extrinsics
from tests.drawn_road import boundary
from train.__main__ import main
from train.backbone import load_backbone
from train.datasets import labelled_image, read_entries
from train.module import Segmentation
from train.pseudo_labels import smoothed, write_labels

CAMERA = Camera.from_parameters(600, 600, 320, 180, 640, 360)
POSE = (2.0, 0.5, 0.3, 1.4)  # deg, deg, deg, m
OFFSETS = {1: -5.55, 2: -1.85, 3: 1.85, 4: 5.55}  # m
FRAMES = 9
MISSED, STRAY = (4, 3), (2, 5)  # frame and boundary


def line(offset):
    """x on the rows of lanes.json of a straight boundary, -2 where there is none."""
    z = torch.linspace(2, 200, 4000, dtype=torch.float64)
    pose = Extrinsics.from_values(*np.radians(POSE[:3]), POSE[3])
    x, y = boundary(CAMERA, offset, z, pose).flip(0).unbind(-1)
    rows = image_rows(360)
    across = np.interp(rows, y, x, -2.0, -2.0)
    return np.where((across >= 0) & (across <= 639), across, -2.0)


@pytest.fixture
def run(tmp_path):
    """A run's folder and its images: one boundary missed in one frame, one strayed into another."""
    result, source = tmp_path / "result", tmp_path / "frames"
    result.mkdir()
    source.mkdir()
    rows, entries = [], []
    for number in range(FRAMES):
        Image.new("RGB", (640, 360), (90, 90, 90)).save(source / f"{number:03d}.png")
        there = [k for k in OFFSETS if (number, k) != MISSED]
        lanes = [line(OFFSETS[k]).tolist() for k in there]
        if number == STRAY[0]:
            there, lanes = [*there, STRAY[1]], [*lanes, line(8.0).tolist()]
        found = {"h_samples": image_rows(360).tolist(), "raw_file": f"{number:03d}.png"}
        entries.append(found | {"lanes": lanes, "boundary": there})
        status = "COASTING" if number == 8 else "TRACKING"
        rows.append(ExtrinsicsRow(number, 0.1 * number, *POSE, 0.1, 0.1, 0.1, 0.01, status, 20, ""))
    write_extrinsics(result / "extrinsics.csv", rows)
    (result / "lanes.json").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    return result, source


def test_what_was_missed_once_is_labelled_and_what_strayed_in_once_is_not(run, tmp_path):
    result, source = run
    out = tmp_path / "out"
    assert write_labels(result, str(source), out, CAMERA, reach=3, stride=1) == FRAMES - 1
    entries = read_entries("tusimple", out, ["labels.json"])
    assert len(entries) == FRAMES - 1  # the run was not sure of the last
    for entry in entries:
        assert {each.boundary for each in entry.lines.lines} == set(OFFSETS)
    missed = {each.boundary: each.points for each in entries[MISSED[0]].lines.lines}[MISSED[1]]
    expected = line(OFFSETS[MISSED[1]])
    there = np.isfinite(missed[:, 0]) & (expected >= 0)
    assert there.sum() > 5
    assert np.abs(missed[there, 0] - expected[there]).max() < 1.0
    sample = labelled_image(entries[0])
    assert sample.painted[2].any()
    assert not sample.painted[5].any()


def test_labels_are_those_of_the_frames_that_the_run_took(run, tmp_path):
    result, source = run
    for number in range(FRAMES, 2 * FRAMES):
        Image.new("RGB", (640, 360)).save(source / f"{number:03d}.png")
    with pytest.raises(ValueError, match=r"expected the 9 frames of .* got 18"):
        write_labels(result, str(source), tmp_path / "out", CAMERA, 3, 1)
    assert {path.name for path in tmp_path.iterdir()} == {"result", "frames"}
    settings = '{"settings": {"--every": "2", "--end": "not given"}}'
    (result / "report.html").write_text(f'<script type="application/json" id="run">{settings}</script>')
    assert write_labels(result, str(source), tmp_path / "out", CAMERA, 3, 1) == FRAMES - 1
    with Image.open(tmp_path / "out" / "images" / "000005.jpg") as image:
        assert image.getpixel((0, 0)) == (0, 0, 0)  # the source's frame 10


def test_a_camera_that_is_not_the_runs_is_refused(run, tmp_path):
    result, source = run
    with pytest.raises(ValueError, match=r"of images 360 px high, with .*; give the camera of the run"):
        write_labels(result, str(source), tmp_path / "out", CAMERA.scaled((720, 1280)), 3, 1)
    CAMERA.to_file(result / "calibration.yaml")
    with pytest.raises(ValueError, match=r"expected the camera of the run, .*calibration.yaml, got"):
        write_labels(result, str(source), tmp_path / "out", CAMERA.cropped(0, 4, 360, 640), 3, 1)
    assert {path.name for path in tmp_path.iterdir()} == {"result", "frames"}
    assert write_labels(result, str(source), tmp_path / "data" / "adapt", CAMERA, 3, 1) == FRAMES - 1


def curves(offset, present):
    zero = torch.zeros_like(offset)
    extent = torch.stack([zero + 3, zero + 40], dim=-1)
    return Boundaries(offset, zero, extent, present, torch.zeros(len(offset), 2))


def test_a_lane_change_is_left_out():
    offset = torch.tensor([-5.4, -1.8, 1.8, 5.4]).repeat(20, 1)
    offset[10:] -= 1.5
    _, steady = smoothed(curves(offset, torch.ones(20, 4, dtype=torch.bool)), 3)
    assert steady[:7].all()
    assert steady[13:].all()
    assert not steady[9:11].any()


def test_frames_beyond_both_ends_do_not_count():
    present = torch.zeros(6, 2, dtype=torch.bool)
    present[:2, 0] = True
    found, _ = smoothed(curves(torch.ones(6, 2), present), 1)
    assert found.present[:, 0].tolist() == [True, True, False, False, False, False]
    assert not found.present[:, 1].any()


@pytest.mark.filterwarnings("ignore")
def test_adapt_config_trains_on_them(run, tmp_path):
    result, source = run
    write_labels(result, str(source), tmp_path / "out", CAMERA, reach=3, stride=2)
    config = Path(__file__).parents[2] / "configs" / "adapt.yaml"
    small = ["network.base_width=4", "network.decoder_width=4", "init_from=null"]
    data = [f"root={tmp_path}/out", "batch_size=2", "sizes=[[48,80]]", "val_size=[48,80]", "workers=0"]
    main(
        ["fit", "--config", str(config), "--trainer.max_steps=1", "--trainer.accelerator=cpu"]
        + [f"--trainer.default_root_dir={tmp_path}", f"--trainer.logger.init_args.save_dir={tmp_path}"]
        + ["--trainer.enable_progress_bar=false"]
        + [f"--model.init_args.{option}" for option in small]
        + [f"--data.init_args.{option}" for option in data]
    )
    assert next(tmp_path.rglob("last.ckpt")).is_file()


@cache
def torchvision_state():
    """torchvision's names: ours, and the classifier's."""
    torch.manual_seed(1)
    state = {name: torch.randn_like(value.float()) for name, value in ResNet18().state_dict().items()}
    return state | {"fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}


def test_a_classifiers_trunk_is_loaded_by_an_argument(tmp_path):
    state = torchvision_state()
    torch.save(state, tmp_path / "resnet18.pth")
    model = Segmentation(network=SegmenterConfig(), backbone=str(tmp_path / "resnet18.pth"))
    torch.testing.assert_close(model.segmenter.trunk.layer4[1].conv2.weight, state["layer4.1.conv2.weight"])
    assert model.settings["backbone"] == str(tmp_path / "resnet18.pth")


@pytest.mark.parametrize("kind", ["module.pth", "module.safetensors", "checkpoint", "half", "no counters"])
def test_a_trunk_under_the_names_of_other_programs(tmp_path, kind):
    state = torchvision_state()
    path = tmp_path / f"{kind}.pth".replace(".safetensors.pth", ".safetensors")
    if kind == "half":
        given = {name: value.half() for name, value in state.items()}
    elif kind == "no counters":  # torchvision's first file
        given = {name: value for name, value in state.items() if "num_batches" not in name}
    else:
        given = {f"module.{name}": value for name, value in state.items()}  # DataParallel's
    if kind.endswith("safetensors"):
        save_file(given, path)
    else:
        torch.save({"epoch": 3, "state_dict": given} if kind == "checkpoint" else given, path)
    trunk = ResNet18()
    load_backbone(trunk, path)
    torch.testing.assert_close(trunk.conv1.weight, state["conv1.weight"], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ResNet18, "got other objects, or a file that is cut; make one by torch.save"),
        (
            lambda: {**torchvision_state(), "bn1.bias": torch.full((64,), torch.nan)},
            "expected finite numbers",
        ),
        (lambda: {"state_dict": {"a": 1}}, "expected a state_dict of tensors, got dict"),
    ],
)
def test_what_is_no_trunk_is_one_line(tmp_path, content, message):
    torch.save(content(), tmp_path / "a.pth")
    with pytest.raises(ValueError, match=message) as error:
        load_backbone(ResNet18(), tmp_path / "a.pth")
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match=r"none\.safetensors: expected a state_dict, got: No such file"):
        load_backbone(ResNet18(), tmp_path / "none.safetensors")


def test_other_names_or_widths_are_refused_in_one_line(tmp_path):
    path = tmp_path / "other.pth"
    state = torchvision_state()
    torch.save({**state, "layer5.weight": torch.zeros(1)}, path)
    with pytest.raises(ValueError, match=r"expected torchvision's ResNet-18, got: .*layer5\.weight"):
        load_backbone(ResNet18(), path)
    torch.save(state, path)
    with pytest.raises(ValueError, match="size mismatch"):
        load_backbone(ResNet18(32), path)
    path.write_bytes(b"no weights")
    with pytest.raises(ValueError, match=r"backbone: .* expected a state_dict"):
        load_backbone(ResNet18(), path)
    with pytest.raises(ValueError, match="expected none beside init_from"):
        Segmentation(backbone="a.pth", init_from="b.ckpt")
