"""The comparison of an exported step with PyTorch: known differences, and none of a part with itself."""

import math

import pytest
import torch

from lanebev import BEVGrid, BEVWarp, Camera, LaneBEV, LaneSegmenter, LineExtractor, SegmenterConfig
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.export.parts import make_part
from lanebev.io.results import ExtrinsicsRow
from tools.compare_onnx import compare, difference, row_difference


def test_known_differences():
    one = {
        "extrinsics": torch.tensor([[0.1, 0.0, 0.0, 1.5]], dtype=torch.float64),
        "bev": torch.zeros(1, 3, 2, 2),
        "status": torch.tensor([1]),
    }
    moved = torch.tensor([[0.1, 0.01, 0.0, 1.501]], dtype=torch.float64)
    bright = one["bev"].clone()
    bright[0, 1, 0, 0] = 0.1
    bright[0, 1, 1, 1] = 0.003
    found = difference({"extrinsics": moved, "bev": bright, "status": torch.tensor([2])}, one)
    assert found == pytest.approx((0.572958, 1.0, 0.75, False), abs=1e-6)


def test_known_differences_of_runs():
    """Also of frames without a pose: NaN in both is no difference, NaN in one of them is one."""
    nan = float("nan")
    row = ExtrinsicsRow(0, 0.0, 1.0, 2.0, 3.0, 1.5, 0.1, 0.2, 0.4, 0.02, "TRACKING", 9, "0.png")
    moved = row._replace(yaw_deg=2.25, height_m=1.501, roll_std_deg=0.5, status="COASTING")
    lost = row._replace(pitch_deg=nan, height_m=nan, height_std_m=nan)
    found = row_difference([moved, lost], [row, lost])
    assert found == pytest.approx((0.25, 1.0, 0.25, 1))
    assert row_difference([row, lost], [row, lost]) == (0.0, 0.0, 0.0, 2)
    assert row_difference([row], [lost])[:2] == (math.inf, math.inf)
    with pytest.raises(ValueError, match="argument 2 is longer"):
        row_difference([row], [row, row])


def test_a_step_equals_itself_whatever_state_it_began_with():
    torch.manual_seed(0)
    config = SegmenterConfig(base_width=4, decoder_width=8)
    model = LaneBEV(
        LaneSegmenter(config), LineExtractor.for_network(config), TwoStageCalibrator(num_hypotheses=20),
        BEVWarp(BEVGrid(x=(-6.0, 6.0), z=(6.0, 30.0), resolution=0.5)),
    )  # fmt: skip
    intrinsics = torch.tensor([[80.0, 0.0, 63.5], [0.0, 80.0, 31.5], [0.0, 0.0, 1.0]])
    part = make_part("step", model, Camera(intrinsics, torch.zeros(0), "pinhole", (64, 128)))

    def other(inputs):
        results = part.module(*(inputs[name] for name in part.inputs))
        return dict(zip(part.outputs, results, strict=True))

    with torch.no_grad():
        found = compare(other, part, torch.rand(3, 1, 3, 64, 128))
    assert found == [(0.0, 0.0, 1.0, True)] * 3
