"""Measure what a segmenter of 8 bits costs: time and accuracy beside the same file in float.

    python -m tools.bench_int8 [--views 64] [--drives 4] [--data ../shared/data]

Both files compute by ONNX Runtime; the processor time is that of all its threads together. Recall, error
and false boundaries are those of ``train.evaluate_roads``. The pose is that of the joint calibrator: its
errors and its NEES per degree of freedom, with the weights' ``pose_sigma_scale``, are the medians over drives
of ``train.noise``. Both are on held-out rendered roads; with ``--data`` also the figures on TuSimple's images
of ``tools.real_figures``.
"""

import argparse
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jsonargparse.typing import PositiveInt
from torch import Tensor, nn

from lanebev.camera.model import Camera
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.export.parts import make_part
from lanebev.export.quantize import quantize_segmenter, rendered_views
from lanebev.export.runtime import OnnxPart
from lanebev.export.write import write_onnx
from lanebev.observation.lines import LineExtractor
from lanebev.observation.segmenter import LaneSegmenter
from lanebev.pipeline import LaneBEV
from lanebev.weights import load_segmenter
from tools.real_figures import tusimple_pixels
from train.commands import command_parser, one_line_errors
from train.drives import observe_drive
from train.evaluate_poses import AXES
from train.evaluate_roads import evaluate
from train.noise import summaries

KINDS = ("highway", "varied")


class SegmenterFile(nn.Module):
    """A network whose logits an ONNX file computes."""

    def __init__(self, segmenter: LaneSegmenter, part: OnnxPart) -> None:
        super().__init__()
        self.segmenter, self.part, self.config = segmenter, part, segmenter.config
        self.image_size = tuple(part.facts["network_size"])

    def forward(self, image: Tensor) -> Tensor:
        """Compute the logits of images (B, 3, h, w) of the file's size, one after the other."""
        return torch.cat([self.part({"image": one})["logits"] for one in image.split(1)])


def write_files(folder: Path) -> tuple[Path, Path]:
    """Write the shipped segmenter for images of 16:9 in float and in 8 bits."""
    paths = folder / "float.onnx", folder / "int8.onnx"
    model, camera = LaneBEV.from_pretrained(), Camera.from_fov(60.0, 1280, 720)
    write_onnx(make_part("segmenter", model, camera), paths[0])
    shutil.copy(paths[0], paths[1])
    quantize_segmenter(paths[1], rendered_views(model.network_size(camera.image_size)))
    return paths


def times(networks: Sequence[SegmenterFile], repeats: int = 20) -> list[float]:
    """Measure the least processor time (ms) of each, in turns."""
    image = torch.rand(1, 3, *networks[0].image_size)
    least = [float("inf")] * len(networks)
    for _ in range(repeats):
        for number, network in enumerate(networks):
            begin = time.process_time()
            network(image)
            least[number] = min(least[number], 1e3 * (time.process_time() - begin))
    return least


def accuracy(network: Any, options: argparse.Namespace) -> dict[str, float]:
    """Return the accuracy of one network by name."""
    views = -(-options.views // len(KINDS))
    found: dict[str, float] = {}
    roads = evaluate(network, views, list(KINDS), seed=91_000, batch=8)
    for kind in KINDS:
        part = roads["kind", kind].figures()
        found |= {f"{kind}: {name}": part[name] for name in ("recall", "error_px", "false")}
    seeds = range(81_000, 81_000 + options.drives)
    drives = [observe_drive([network], seed, options.frames, 20.0)[0] for seed in seeds]
    factor = network.config.sigma_scale
    summary = summaries(drives, (factor,))[factor]
    found |= {f"drives: {axis}": value for axis, value in zip(AXES, summary.rmse.tolist(), strict=True)}
    found["drives: NEES"] = float(summary.nees) / network.config.pose_sigma_scale**2
    if options.data is not None:
        extractor = LineExtractor.for_network(network.config)
        model = LaneBEV(network, extractor, JointCalibrator(), network_width=network.config.image_size[1])
        for figure in tusimple_pixels(options.data, model, {"joint": JointCalibrator()}):
            found[f"tusimple: {figure.name}"] = figure.value
    return found


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("--views", type=PositiveInt, default=64, help="number of views")
    parser.add_argument("--drives", type=PositiveInt, default=4, help="number of drives")
    parser.add_argument("--frames", type=PositiveInt, default=60, help="frames per drive")
    parser.add_argument("--data", type=Path, help="folder that has TuSimple's images as tusimple/")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        paths = write_files(Path(folder))
        networks = [SegmenterFile(load_segmenter(), OnnxPart(path)).eval() for path in paths]
        rows = {
            "file, MB": [path.stat().st_size / 1e6 for path in paths],
            "processor time, ms": times(networks),
        }
        with torch.inference_mode():
            columns = [accuracy(network, options) for network in networks]
    rows |= {name: [column[name] for column in columns] for name in columns[0]}
    print("| | float | int8 |\n|---|---|---|")
    for name, (one, other) in rows.items():
        print(f"| {name} | {one:.4g} | {other:.4g} |")


if __name__ == "__main__":
    main()
