import csv
import warnings
from pathlib import Path

import pytest
import torch

from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from lanebev.weights import load_segmenter, read_metadata, save_segmenter
from train.__main__ import main
from train.export import export

pytestmark = pytest.mark.filterwarnings("ignore")  # of Lightning about itself

CONFIGS = Path(__file__).parents[1] / "configs"
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


@pytest.mark.parametrize("config", ["default.yaml", "paper.yaml", "end_to_end.yaml"])
def test_every_config_trains_a_step(config, tmp_path):
    run("fit", config, tmp_path, *TINY, *VIEWS)
    with next(tmp_path.rglob("metrics.csv")).open() as file:
        rows = list(csv.DictReader(file))
    assert any(row["val/recall"] for row in rows)


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
    """Here, and tusimple.yaml, which needs data, beside its data module."""
    names = {"default.yaml", "paper.yaml", "end_to_end.yaml", "fast.yaml", "refine.yaml", "tusimple.yaml"}
    assert {path.name for path in CONFIGS.glob("*.yaml")} == names


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
    exported = export(
        newest, tmp_path / "w.safetensors", {"noise_factor": 2.5}, seed=1, commit="0" * 7, metrics={}
    )
    loaded = load_segmenter(tmp_path / "w.safetensors")
    torch.testing.assert_close(loaded.head.bias, exported.head.bias)
    assert read_metadata(tmp_path / "w.safetensors")["training"]["optimizer"] == "adamw"
    again = tmp_path / "again.safetensors"
    export(tmp_path / "w.safetensors", again, {"pose_factor": 2.0}, seed=1, commit="0" * 7, metrics={"a": 1})
    facts = read_metadata(again)
    assert (facts["config"]["noise_factor"], facts["config"]["pose_factor"]) == (2.5, 2.0)
    assert (facts["training"]["optimizer"], facts["metrics"]) == ("adamw", {"a": 1})
    torch.testing.assert_close(load_segmenter(again).head.bias, exported.head.bias)


def test_typos_are_errors(tmp_path):
    with pytest.raises(SystemExit) as stop:
        run("fit", "fast.yaml", tmp_path, "--model.init_args.lerning_rate=1")
    assert stop.value.code == 2
