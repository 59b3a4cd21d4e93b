"""The network in a number format of fewer digits."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lanebev.app.config import RunConfig
from lanebev.app.drive.build import make_network

FRAME = Path(__file__).parents[2] / "golden" / "frame.png"


def sees(precision):
    """Logits and boundary vertices of a rendered frame."""
    image = cv2.cvtColor(cv2.imread(str(FRAME)), cv2.COLOR_BGR2RGB)
    model = make_network(None, "cpu", precision).eval()
    with torch.inference_mode():
        return model.boundary_vertices(torch.from_numpy(np.moveaxis(image, -1, 0).copy())[None] / 255)


def test_half_precision_finds_the_same_boundaries():
    (_, exact), (logits, found) = sees("float32"), sees("bfloat16")
    assert logits.dtype == torch.bfloat16
    assert found.points.dtype == torch.float32
    sure = (exact.weight > 0.5) & (found.weight > 0.5)
    assert sure.sum() > 0.9 * (exact.weight > 0.5).sum() > 50
    apart = (found.points - exact.points).abs()[sure]
    assert apart.median() < 0.05  # px
    assert apart.max() < 1.0


def test_a_precision_that_does_not_exist_or_fit_is_refused():
    with pytest.raises(ValueError, match="precision: expected one of float32, bfloat16, float16, got 'int8'"):
        RunConfig("drive.mp4", "camera.yaml", precision="int8")
    with pytest.raises(ValueError, match="precision: expected --backend torch, got onnxruntime"):
        RunConfig("drive.mp4", "camera.yaml", backend="onnxruntime", precision="bfloat16")
