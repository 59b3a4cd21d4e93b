"""Compact weights files, and what is told about a checkpoint in their place."""

import pytest
import torch

from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from lanebev.weights import load_segmenter, quantised, read_metadata, save_segmenter
from train.export import checkout_commit, checkpoint_weights, export, main, trained_segmenter


def test_rounding_to_8_bits_is_within_half_a_scale_of_each_channel():
    torch.manual_seed(0)
    weight = torch.randn(5, 4, 3, 3) * torch.tensor([1e-3, 1.0, 30.0, 1.0, 0.0]).view(5, 1, 1, 1)
    rounded, scale = quantised(weight)
    assert rounded.dtype == torch.int8
    assert scale.shape == (5, 1, 1, 1)
    assert ((rounded * scale - weight).abs() <= 0.5001 * scale).all()
    torch.testing.assert_close(scale.flatten(), weight.flatten(1).abs().amax(1) / 127, atol=1e-30, rtol=1e-6)


@pytest.fixture(scope="module")
def wide():
    torch.manual_seed(0)
    return LaneSegmenter(SegmenterConfig(base_width=64)).eval()


def test_a_compact_file_is_smaller_than_15_megabytes_and_gives_single_precision(wide, tmp_path):
    path = tmp_path / "w.safetensors"
    save_segmenter(wide, path, compact=True, seed=3)
    assert path.stat().st_size < 15e6
    loaded = load_segmenter(path)
    assert {value.dtype for value in loaded.parameters()} == {torch.float32}
    assert read_metadata(path)["seed"] == 3
    image = torch.rand(1, 3, 64, 96)
    with torch.inference_mode():
        before, after = wide(image), loaded(image)
    assert (before - after).abs().max() < 0.02 * before.std() + 1e-3


def test_export_makes_a_weights_file_compact(wide, tmp_path):
    save_segmenter(wide, tmp_path / "half.safetensors")
    out = tmp_path / "new" / "out.safetensors"
    export(tmp_path / "half.safetensors", out, {}, seed=1)
    again = load_segmenter(out)
    torch.testing.assert_close(again.head.bias, wide.head.bias)
    assert out.stat().st_size < 0.7 * (tmp_path / "half.safetensors").stat().st_size


def test_a_checkpoint_in_place_of_weights_is_told_how_to_export(tmp_path):
    path = tmp_path / "last.ckpt"
    path.write_bytes(b"anything")
    with pytest.raises(ValueError, match=r"python -m train\.export .*last\.ckpt last\.safetensors"):
        load_segmenter(path)


def test_checkpoints_are_told_from_weights_files_by_what_is_in_them(wide, tmp_path):
    torch.save({"state_dict": {}}, tmp_path / "last.pt")
    with pytest.raises(
        ValueError, match="expected a checkpoint of python -m train, got: none with 'settings'"
    ):
        trained_segmenter(tmp_path / "last.pt")
    save_segmenter(wide, tmp_path / "weights.safetensors")
    for name, data in (("weights.safetensors", None), ("cut.safetensors", bytes(30)), ("notes.txt", b"none")):
        if data is not None:
            (tmp_path / name).write_bytes(data)
        with pytest.raises(
            ValueError, match=f"{name}: .* got another file; .*by --model.init_args.init_from"
        ):
            checkpoint_weights(tmp_path / name)


def test_metrics_that_are_no_json_are_named(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["export", "last.ckpt", "out", "--seed", "1", "--metrics", "{recall: 1}"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "metrics: expected JSON, got '{recall: 1}'" in capsys.readouterr().err


def test_commit_is_the_environments_where_one_is_given(monkeypatch):
    monkeypatch.setenv("LANEBEV_COMMIT", "abc1234")
    assert checkout_commit() == "abc1234"


class _Touches:
    """What a hostile file holds: it writes a file where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_a_checkpoint_is_never_unpickled(tmp_path):
    torch.save({"state_dict": {}, "settings": _Touches(tmp_path / "there")}, tmp_path / "bad.ckpt")
    with pytest.raises(ValueError, match="expected a checkpoint of python -m train, got"):
        checkpoint_weights(tmp_path / "bad.ckpt")
    assert not (tmp_path / "there").exists()
