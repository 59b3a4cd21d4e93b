"""Means of networks' weights."""

import sys

import pytest
import torch

from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from lanebev.weights import load_segmenter, read_metadata, save_segmenter
from train import average

SMALL = SegmenterConfig(base_width=4, decoder_width=4)


def test_mean_of_two_networks(tmp_path, monkeypatch):
    torch.manual_seed(0)
    paths = [tmp_path / "a.safetensors", tmp_path / "b.safetensors"]
    for path in paths:
        save_segmenter(LaneSegmenter(SMALL), path)
    out = tmp_path / "mean.safetensors"
    monkeypatch.setattr(sys, "argv", ["average", str(out), *map(str, paths)])
    average.main()
    a, b, mean = (load_segmenter(path).state_dict() for path in (*paths, out))
    assert read_metadata(out)["training"] == {"average_of": ["a.safetensors", "b.safetensors"]}
    for name, value in mean.items():
        expected = (a[name] + b[name]) / 2 if value.is_floating_point() else a[name]
        torch.testing.assert_close(value, expected, rtol=1e-3, atol=1e-4)  # stored in half precision


def test_networks_of_other_shapes_are_refused(tmp_path, monkeypatch, capsys):
    save_segmenter(LaneSegmenter(SMALL), tmp_path / "a.safetensors")
    wide = SegmenterConfig(base_width=8, decoder_width=4)
    save_segmenter(LaneSegmenter(wide), tmp_path / "b.safetensors")
    out = tmp_path / "mean.safetensors"
    files = [str(tmp_path / "a.safetensors"), str(tmp_path / "b.safetensors")]
    monkeypatch.setattr(sys, "argv", ["average", str(out), *files])
    with pytest.raises(SystemExit, match="2"):
        average.main()
    assert "expected networks of one configuration" in capsys.readouterr().err
    assert not out.exists()
