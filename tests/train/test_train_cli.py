import csv
import importlib.util
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from lanebev.weights import load_segmenter, read_metadata, save_segmenter
from train.__main__ import main
from train.data import Batch
from train.export import export
from train.module import Segmentation

pytestmark = pytest.mark.filterwarnings("ignore")  # of Lightning about itself

CONFIGS = Path(__file__).parents[2] / "configs"
TINY = [
    "--trainer.max_steps=1",
    "--trainer.limit_val_batches=1",
    "--trainer.val_check_interval=1",
    "--trainer.num_sanity_val_steps=0",
    "--trainer.enable_progress_bar=false",
    "--trainer.accelerator=cpu",
    "--model.init_args.network.base_width=4",
    "--model.init_args.network.decoder_width=4",
    "--model.init_args.init_from=null",
    "--data.init_args.batch_size=2",
    "--data.init_args.workers=0",
    "--data.init_args.render_size=[72,128]",
]
VIEWS = [
    "--data.init_args.sizes=[[64,96]]",
    "--data.init_args.val_size=[64,96]",
    "--data.init_args.val_batches=1",
]


def run(subcommand, config, tmp_path, *extra):
    here = [f"--trainer.default_root_dir={tmp_path}", f"--trainer.logger.init_args.save_dir={tmp_path}"]
    main([subcommand, "--config", str(CONFIGS / config), *here, *extra])


@pytest.mark.slow
@pytest.mark.parametrize("config", ["default.yaml", "paper.yaml", "end_to_end.yaml"])
def test_every_config_trains_a_step(config, tmp_path):
    run("fit", config, tmp_path, *TINY, *VIEWS)
    with next(tmp_path.rglob("metrics.csv")).open() as file:
        rows = list(csv.DictReader(file))
    assert any(row["val/recall"] for row in rows)


@pytest.mark.parametrize("more", [["--trainer.max_epochs=1"], []])
def test_epochs_of_random_views_have_no_end(tmp_path, capsys, more):
    with pytest.raises(SystemExit) as stopped:
        run("fit", "fast.yaml", tmp_path, "--trainer.max_steps=-1", *more)
    assert stopped.value.code == 2
    said = "error: max_steps: expected a number of steps, since an epoch of random views never ends, got -1"
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("limit", ["limit_train_batches", "overfit_batches"])
def test_epochs_of_some_batches_end(tmp_path, limit):
    run(
        "fit",
        "fast.yaml",
        tmp_path,
        "--trainer.max_steps=-1",
        "--trainer.max_epochs=1",
        f"--trainer.{limit}=1",
    )


@pytest.mark.slow
def test_training_goes_on_from_a_weights_file_and_exports_it_unchanged(tmp_path):
    torch.manual_seed(0)
    before = LaneSegmenter(SegmenterConfig(base_width=4, decoder_width=4))
    save_segmenter(before, tmp_path / "before.safetensors", half=False)
    frozen = [
        "--model.init_args.learning_rate=0",
        f"--model.init_args.init_from={tmp_path}/before.safetensors",
    ]
    run("fit", "refine.yaml", tmp_path, *TINY, *VIEWS, *frozen)
    export(next(tmp_path.rglob("*.ckpt")), tmp_path / "after.safetensors", {}, seed=1, commit="", metrics={})
    after = load_segmenter(tmp_path / "after.safetensors")
    torch.testing.assert_close(after.head.bias, before.head.bias)  # class weights done and undone
    torch.testing.assert_close(after.trunk.conv1.weight, before.trunk.conv1.weight, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("native", [True, False])
def test_emulated_bfloat16_is_pointed_out(native, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: native)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run("fit", "refine.yaml", tmp_path, *TINY, *VIEWS)
    said = [str(each.message) for each in caught if "32-true" in str(each.message)]
    assert len(said) == (not native)


def test_every_config_is_tested():
    """Here, and the others beside what makes their data."""
    here = {"default.yaml", "paper.yaml", "end_to_end.yaml", "fast.yaml", "refine.yaml"}
    assert {path.name for path in CONFIGS.glob("*.yaml")} == here | {
        "tusimple.yaml",
        "gpu.yaml",
        "refine_live.yaml",
        "adapt.yaml",
        "detector.yaml",
    }


@pytest.mark.slow
def test_fit_resume_test_predict_export(tmp_path):
    run("fit", "fast.yaml", tmp_path)
    last = next(tmp_path.rglob("last.ckpt"))
    assert torch.load(last, weights_only=False)["global_step"] == 2
    run("fit", "fast.yaml", tmp_path, f"--ckpt_path={last}", "--trainer.max_steps=3")
    newest = max(tmp_path.rglob("*.ckpt"), key=lambda p: torch.load(p, weights_only=False)["global_step"])
    assert torch.load(newest, weights_only=False)["global_step"] == 3
    run("test", "fast.yaml", tmp_path, f"--ckpt_path={newest}")
    assert any("test/iou_2" in path.read_text() for path in tmp_path.rglob("metrics.csv"))
    run("predict", "fast.yaml", tmp_path, f"--ckpt_path={newest}")
    predictions = sorted(tmp_path.rglob("predictions/*.png"))
    assert [path.name for path in predictions] == ["000000.png", "000001.png"]
    with Image.open(predictions[0]) as image:
        assert (image.mode, image.size) == ("P", (48, 32))
        assert int(np.asarray(image).max()) < 7
    exported = export(
        newest, tmp_path / "w.safetensors", {"sigma_scale": 2.5}, seed=1, commit="0" * 7, metrics={}
    )
    loaded = load_segmenter(tmp_path / "w.safetensors")
    torch.testing.assert_close(loaded.head.bias, exported.head.bias)
    assert read_metadata(tmp_path / "w.safetensors")["training"]["optimizer"] == "adamw"
    again = tmp_path / "again.safetensors"
    export(
        tmp_path / "w.safetensors", again, {"pose_sigma_scale": 2.0}, seed=1, commit="0" * 7, metrics={"a": 1}
    )
    facts = read_metadata(again)
    assert (facts["config"]["sigma_scale"], facts["config"]["pose_sigma_scale"]) == (2.5, 2.0)
    assert (facts["training"]["optimizer"], facts["metrics"]) == ("adamw", {"a": 1})
    torch.testing.assert_close(load_segmenter(again).head.bias, exported.head.bias)


@pytest.mark.slow
def test_an_interrupted_run_ends_as_one_in_a_piece(tmp_path, monkeypatch):
    """Bit for bit: views, augmentation, optimiser, rate and averaged weights, from the last checkpoint."""
    averaged = "--trainer.callbacks+=lightning.pytorch.callbacks.EMAWeightAveraging"
    options = ["--trainer.max_steps=4", "--model.init_args.augment=1.0", averaged]
    run("fit", "fast.yaml", tmp_path / "whole", *options)
    step = Segmentation.training_step

    def until_the_third(self, batch, batch_idx):
        if batch_idx == 2:
            raise RuntimeError("power cut")
        return step(self, batch, batch_idx)

    monkeypatch.setattr(Segmentation, "training_step", until_the_third)
    with pytest.raises(RuntimeError, match="power cut"):
        run("fit", "fast.yaml", tmp_path / "parts", *options)
    monkeypatch.undo()
    run("fit", "fast.yaml", tmp_path / "parts", *options, "--ckpt_path=last")
    whole, parts = (
        torch.load(
            max((tmp_path / name).rglob("last.ckpt"), key=lambda path: path.stat().st_mtime),
            weights_only=False,
        )
        for name in ("whole", "parts")
    )
    assert whole["global_step"] == parts["global_step"] == 4
    assert whole["state_dict"].keys() == parts["state_dict"].keys()
    assert all(torch.equal(value, parts["state_dict"][name]) for name, value in whole["state_dict"].items())


@pytest.mark.slow
def test_a_finished_run_goes_on_at_its_own_rate(tmp_path, monkeypatch):
    """Its checkpoint was written when the rate had come to its end, 0; another rate may be given."""
    rates, decays = [], []
    step = Segmentation.training_step

    def noted(self, batch, batch_idx):
        first, second = self.trainer.optimizers[0].param_groups
        assert second["weight_decay"] == 0
        rates.append(first["lr"])
        decays.append(first["weight_decay"])
        return step(self, batch, batch_idx)

    monkeypatch.setattr(Segmentation, "training_step", noted)
    run("fit", "fast.yaml", tmp_path)
    run("fit", "fast.yaml", tmp_path, "--trainer.max_steps=4", "--ckpt_path=last")
    others = ["--model.init_args.learning_rate=5e-4", "--model.init_args.weight_decay=0.1"]
    run("fit", "fast.yaml", tmp_path, "--trainer.max_steps=6", "--ckpt_path=last", *others)
    assert rates == [2e-3] * 4 + [5e-4] * 2
    assert decays == [0.02] * 4 + [0.1] * 2


@pytest.mark.slow
@pytest.mark.parametrize("strength", [0.0, 1.0])
def test_a_run_goes_on_with_other_augmentation(strength, tmp_path, monkeypatch):
    """Also with averaged weights, beside which a checkpoint has the others."""
    ranges = []
    step = Segmentation.training_step

    def noted(self, batch, batch_idx):
        buffers = dict(self.named_buffers())
        ranges.append([part.tolist() for name, part in buffers.items() if "brightness" in name])
        return step(self, batch, batch_idx)

    monkeypatch.setattr(Segmentation, "training_step", noted)
    averaged = "--trainer.callbacks+=lightning.pytorch.callbacks.EMAWeightAveraging"
    run("fit", "fast.yaml", tmp_path, "--trainer.max_steps=1", averaged)
    options = ["--trainer.max_steps=2", averaged, f"--model.init_args.augment={strength}", "--ckpt_path=last"]
    run("fit", "fast.yaml", tmp_path, *options)
    assert ranges == [[pytest.approx([0.825, 1.175])], [pytest.approx([0.65, 1.35])] if strength else []]


def test_last_of_nothing_is_an_error(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        run("fit", "fast.yaml", tmp_path, "--ckpt_path=last")
    assert stop.value.code == 2
    assert "expected a last.ckpt" in capsys.readouterr().err


def refused(capsys, *arguments):
    """The last line that a run which ends with status 2 says."""
    with pytest.raises(SystemExit) as stop:
        run(*arguments)
    assert stop.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_checkpoints_of_another_kind_are_one_line(tmp_path, capsys):
    notes = tmp_path / "notes.md"
    notes.write_text("no checkpoint")
    assert "expected a checkpoint" in refused(capsys, "test", "fast.yaml", tmp_path, f"--ckpt_path={notes}")
    run("fit", "fast.yaml", tmp_path, "--trainer.max_steps=1")
    path, wider = next(tmp_path.rglob("last.ckpt")), "--model.init_args.network.base_width=16"
    said = refused(capsys, "test", "fast.yaml", tmp_path, f"--ckpt_path={path}", wider)
    assert said == "error: ckpt_path: expected a network of base_width 16, got 4"
    by_sgd = ("--trainer.max_steps=2", "--model.init_args.optimizer=sgd", "--ckpt_path=last")
    said = refused(capsys, "fit", "fast.yaml", tmp_path, *by_sgd)
    assert said.startswith(
        "error: ckpt_path: expected a run by sgd, got adamw; to begin anew from its weights"
    )
    said = refused(capsys, "fit", "fast.yaml", tmp_path, f"--model.init_args.init_from={path}", wider)
    assert "weights do not fit the network" in said
    with pytest.raises(ValueError, match="expected a file that can be written"):
        export(path, notes / "w.safetensors", {})
    with pytest.raises(ValueError, match=r"image_size: expected \(height, width\) above 0, got \(0, -5\)"):
        export(path, tmp_path / "w.safetensors", {"image_size": (0, -5)})


def test_a_device_that_is_not_there_is_one_line(tmp_path, capsys):
    said = refused(capsys, "fit", "fast.yaml", tmp_path, "--trainer.accelerator=cpu", "--trainer.devices=0")
    assert said.startswith("error: `Trainer(devices=")


@pytest.mark.skipif(importlib.util.find_spec("torch_xla") is not None, reason="torch_xla is installed")
def test_a_library_of_lightning_that_is_not_installed_is_one_line(tmp_path, capsys):
    said = refused(capsys, "fit", "fast.yaml", tmp_path, "--trainer.accelerator=tpu")
    assert said.startswith("error: Requirement 'torch_xla")


@pytest.mark.parametrize("option", ["batch_size=0", "sizes=[[0,0]]", "val_size=[64,0]"])
def test_numbers_that_make_no_batch_are_refused(option, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        run("fit", "fast.yaml", tmp_path, f"--data.init_args.{option}")
    assert stop.value.code == 2
    assert option.split("=")[0] in capsys.readouterr().err


@pytest.mark.parametrize("content", [None, b"no checkpoint", b""])
def test_what_cannot_be_begun_from_is_one_line(content, tmp_path, capsys):
    path = tmp_path / "begin.ckpt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SystemExit) as stop:
        run("fit", "fast.yaml", tmp_path, f"--model.init_args.init_from={path}")
    assert stop.value.code == 2
    assert f"{path}: expected a checkpoint" in capsys.readouterr().err.splitlines()[-1]


def test_iou_pools_images_and_leaves_out_what_is_not_labelled():
    """One pixel wrong on a nearly empty image is one pixel; an absent class has none."""
    model = Segmentation(network=SegmenterConfig(base_width=4, decoder_width=4), augment=0)
    logged = {}
    model.log = lambda name, value, **_: logged.update({name: value})
    model.log_dict = logged.update
    target = torch.zeros(2, 6, 4, 10, dtype=torch.uint8)
    target[0, 2, :2] = 255  # 20 px, found
    target[1, 2, 0, 0] = 255  # one, not found
    target[1, 3, 3] = 255  # occluded
    weight = torch.ones(2, 4, 10, dtype=torch.uint8)
    weight[1, 3] = 0
    seen = torch.zeros(2, 7, 4, 10)
    seen[:, 0] = 1.0
    seen[0, 3, :2] = 2.0
    model.forward = lambda image: seen
    model.on_test_start()
    model.test_step(Batch(torch.zeros(2, 3, 8, 20, dtype=torch.uint8), target, weight), 0)
    model.on_test_epoch_end()
    assert float(logged["test/iou_2"]) == pytest.approx(20 / 21)
    assert logged["test/iou_3"].isnan()
    assert float(logged["test/iou"]) == pytest.approx(20 / 21)


def test_typos_are_errors(tmp_path):
    with pytest.raises(SystemExit) as stop:
        run("fit", "fast.yaml", tmp_path, "--model.init_args.lerning_rate=1")
    assert stop.value.code == 2
