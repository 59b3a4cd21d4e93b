"""The extractor, and one frame of each calibrator."""

from functools import partial
from typing import Any

import torch

from lanebev import JointCalibrator, LaneSegments, LineExtractor, TwoStageCalibrator
from lanebev.tensors import map_tensors
from lanebev.testing.segments import INTRINSICS, lanes
from tools.bench_speed import scene
from tools.bench_speed.measuring import Calls


def extractors() -> Calls:
    """Make calls on seven maps with six stripes, as the shipped network makes them of 576 × 320 px."""
    rows, columns = torch.arange(160.0).unsqueeze(-1), torch.arange(288.0)
    slopes = torch.tensor([-1.6, -1.0, -0.4, 0.3, 0.9, 1.5])
    middle = 144 + slopes[:, None, None] * (rows - 30)
    stripes = 8.0 * ((columns - middle).abs() < 1.2) * (rows > 40)
    logits = torch.cat([torch.full((1, 160, 288), 4.0), stripes])[None]
    logits = logits + 0.3 * torch.randn(logits.shape, generator=torch.Generator().manual_seed(0))
    extractor = LineExtractor()
    return {
        "softmax": lambda: logits.softmax(1),
        "LineExtractor": lambda: extractor(logits, scene.SIZE, (320, 576)),
    }


def calibrators(rows: int, per_boundary: int) -> dict[str, partial[Any]]:
    """Make calls of one frame of each calibrator, sure of its start: see ``JointState.doubt``."""
    one = lanes(per=per_boundary, noise=0.5)
    seen = LaneSegments(*(part.expand(rows, *part.shape[1:]) for part in one))
    intrinsics = INTRINSICS.expand(rows, 3, 3)
    calls = {}
    for name, calibrator in (("joint", JointCalibrator()), ("two-stage", TwoStageCalibrator())):
        state: Any = calibrator.initial_state(1, dtype=torch.float64)
        for _ in range(20):  # of one row, which the others equal
            _, state = calibrator(one, INTRINSICS.expand(1, 3, 3), state, 1 / 30)
        state = map_tensors(lambda part: part.expand(rows, *part.shape[1:]).clone(), state)
        calls[name] = partial(calibrator, seen, intrinsics, state, 1 / 30)
    return calls


def compiled() -> Calls:
    """Make calls of one frame of the joint calibrator, as it is and compiled by inductor, of 408 segments."""
    frame = calibrators(1, 68)["joint"]
    step = torch.compile(frame.func, fullgraph=True)
    return {"JointCalibrator": frame, "torch.compile": partial(step, *frame.args)}
