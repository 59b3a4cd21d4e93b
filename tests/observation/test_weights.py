"""The shipped weights: what they say of themselves, and that they see a rendered road."""

import copy
import json
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F

import lanebev
from lanebev.observation.segmenter import LaneSegmenter, SegmenterConfig
from lanebev.render import Drive, boundary_masks
from lanebev.weights import SHIPPED, load_segmenter, read_metadata, save_segmenter, segmenter_config
from train.metrics import point_recall


@pytest.fixture(scope="module")
def segmenter():
    return load_segmenter()


def test_shipped_weights_are_small_and_say_where_they_are_from():
    assert SHIPPED.stat().st_size <= 30_000_000
    record = read_metadata()
    assert {"config", "training", "seed", "commit", "metrics"} <= set(record)
    assert record["metrics"]
    assert record["training"]["optimizer"] in ("sgd", "adamw")
    assert "/" not in json.dumps(record["training"])  # no path of the machine that trained


def test_shipped_network_is_the_papers_resnet_18(segmenter):
    assert segmenter.config.base_width == 64
    assert segmenter.config.num_boundaries == lanebev.types.NUM_BOUNDARIES
    assert not segmenter.training


def test_from_pretrained_runs_at_the_size_it_was_trained_for(segmenter):
    model = lanebev.LaneBEV.from_pretrained()
    assert model.network_width == segmenter.image_size[1]
    assert model.network_size((375, 1242)) == (224, 768)
    assert lanebev.LaneBEV.from_pretrained(network_width=320).network_size((375, 1242)) == (96, 320)
    stride = segmenter.config.output_stride
    logits, segments = model.observe(torch.rand(1, 3, 360, 640), torch.eye(3)[None] * 600)
    assert logits.shape[-1] == segmenter.image_size[1] // stride
    assert all(part.isfinite().all() for part in segments)


@pytest.mark.parametrize("stride", [1, 4])
def test_from_pretrained_reads_lines_as_the_network_draws_them(tmp_path, stride):
    config = SegmenterConfig(
        base_width=8,
        output_stride=stride,
        decoder_width=8,
        image_size=(64, 96),
        sigma_scale=2.0,
        pose_sigma_scale=1.5,
    )
    save_segmenter(LaneSegmenter(config), tmp_path / "w.safetensors")
    model = lanebev.LaneBEV.from_pretrained(tmp_path / "w.safetensors")
    assert (model.extractor.config.stride, model.extractor.config.sigma_scale) == (stride, 2.0)
    assert model.pose_sigma_scale == 1.5


def test_the_former_names_of_sigma_scales_are_read():
    """Weights files and checkpoints that were written before the names changed."""
    config = segmenter_config({"image_size": [64, 96], "noise_factor": 2.25, "pose_factor": 1.6})
    assert (config.sigma_scale, config.pose_sigma_scale, config.image_size) == (2.25, 1.6, (64, 96))


@pytest.mark.slow
def test_sees_the_ego_lane_of_rendered_drives(segmenter):
    """Six clear drives, one frame each: most of both boundaries of the ego lane is found."""
    height, width = segmenter.image_size
    found, there = torch.zeros(6), torch.zeros(6)
    for seed in range(91_000, 91_006):
        frame = Drive(seed, (height, width), num_frames=1, weather="clear").frame(0)
        with torch.inference_mode():
            probabilities = segmenter(frame.image).softmax(1)[:, 1:]
        truth = boundary_masks(frame, (height, width), 2.25)
        target = F.interpolate(truth, probabilities.shape[-2:], mode="area")
        hits, rows = point_recall(probabilities, target, tolerance=3.5)
        found, there = found + hits[0], there + rows[0]
    recall = found[2:4] / there[2:4]
    assert there[2:4].min() > 200
    assert recall.min() > 0.75


def test_a_cut_file_is_one_clear_error(tmp_path):
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(Path(SHIPPED).read_bytes()[:100_000])
    with pytest.raises(ValueError, match="expected a whole safetensors file"):
        load_segmenter(cut)


def test_what_is_no_weights_file_says_what_it_is(tmp_path, segmenter):
    path = tmp_path / "w.safetensors"
    torch.save({"state_dict": {}}, path)  # a checkpoint by another name
    with pytest.raises(ValueError, match="got a checkpoint of training; make one with: python -m"):
        load_segmenter(path)
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    with pytest.raises(ValueError, match="a pointer of Git LFS; fetch the file by git lfs pull"):
        load_segmenter(path)
    broken = copy.deepcopy(segmenter)
    with torch.no_grad():
        broken.head.weight[0, 0] = torch.nan
    save_segmenter(broken, path)
    with pytest.raises(ValueError, match="expected finite numbers, got NaN"):
        load_segmenter(path)
