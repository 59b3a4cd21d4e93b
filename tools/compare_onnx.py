"""Compare exported files with PyTorch on a video: ``python -m tools.compare_onnx VIDEO --camera FILE``.

With ``--what step`` the step: poses and views, each with its own state. With ``--what run`` the rows of
``extrinsics.csv`` by ``lanebev run --backend onnxruntime`` and by PyTorch. Files that are missing in DIR are
exported, which takes minutes for a joint calibrator.
"""

import argparse
import math
import tempfile
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.app.config import BACKENDS, CALIBRATORS, RunConfig
from lanebev.app.config.export import ExportConfig
from lanebev.app.drive.build import make_calibrator
from lanebev.app.export import export
from lanebev.app.run import run
from lanebev.camera.model import Camera
from lanebev.export.part import Part
from lanebev.export.parts import make_part
from lanebev.export.runtime import OnnxPart
from lanebev.io.opening import open_source
from lanebev.io.results import ExtrinsicsRow, read_extrinsics
from lanebev.observation.frames import check_frame, network_image
from lanebev.pipeline import LaneBEV
from train.commands import command_parser

LEVEL = 1 / 255


class Difference(NamedTuple):
    """Differences of one frame: degrees, mm, share of view pixels within a level of 8 bits, equal status."""

    angle: float
    height: float
    within: float
    same_status: bool


def difference(found: dict[str, Tensor], expected: dict[str, Tensor]) -> Difference:
    """Compare outputs of the same frame."""
    apart = (found["extrinsics"] - expected["extrinsics"]).abs()[0]
    pixels = (found["bev"] - expected["bev"]).abs().amax(1)  # (1, U, V)
    return Difference(
        float(apart[:3].max().rad2deg()),
        1e3 * float(apart[3]),
        float((pixels <= LEVEL).double().mean()),
        bool(torch.equal(found["status"], expected["status"])),
    )


def compare(other: OnnxPart, part: Part, images: Iterable[Tensor]) -> list[Difference]:
    """Run both over images (1, 3, H, W) of a drive, each handing on its own state."""
    states = [name for name in part.inputs if name.startswith("state_")]
    first = {name: torch.zeros_like(part.inputs[name][:1]) for name in states}
    held, differences = [first, first], []
    fixed = {name: value[:1] for name, value in part.inputs.items() if name not in states}
    for number, image in enumerate(images):
        given = {**fixed, "image": image, "reset": torch.tensor([number == 0])}
        found = other({**given, **held[0]})
        inputs = {**given, **held[1]}
        results = part.module(*(inputs[name] for name in part.inputs))
        expected = dict(zip(part.outputs, results, strict=True))
        held = [{name: out[f"next_{name}"] for name in states} for out in (found, expected)]
        differences.append(difference(found, expected))
    return differences


class RunDifference(NamedTuple):
    """Largest differences of two runs' rows: degrees, mm, relative one of sigmas; rows of equal status."""

    angle: float
    height: float
    sigma: float
    same_status: int


def row_difference(found: Sequence[ExtrinsicsRow], expected: Sequence[ExtrinsicsRow]) -> RunDifference:
    """Compare rows of the same frames; NaN in both is no difference, NaN in one of them is infinite."""
    angle = height = sigma = 0.0
    for one, other in zip(found, expected, strict=True):
        pairs = list(zip(one[2:10], other[2:10], strict=True))
        apart = [_apart(a, b) for a, b in pairs]
        angle, height = max(angle, *apart[:3]), max(height, 1e3 * apart[3])
        scaled = (gap / b if gap else 0.0 for gap, (_, b) in zip(apart[4:], pairs[4:], strict=True))
        sigma = max(sigma, *scaled)
    same = sum(one.status == other.status for one, other in zip(found, expected, strict=True))
    return RunDifference(angle, height, sigma, same)


def _apart(one: float, other: float) -> float:
    if math.isnan(one) or math.isnan(other):
        return 0.0 if math.isnan(one) and math.isnan(other) else math.inf
    return abs(one - other)


def compare_runs(options: argparse.Namespace) -> str:
    """Run on the video by both backends and compare the rows."""
    seconds = options.frames / open_source(options.video, None).fps
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for backend in BACKENDS:
            config = RunConfig(
                options.video,
                options.camera,
                str(Path(folder, backend)),
                calibrator=options.calibrator,
                backend=backend,
                exported=str(options.exported),
                end=seconds,
                no_video=True,
            )
            run(config)
            rows.append(read_extrinsics(Path(config.out, "extrinsics.csv")))
    expected, found = rows
    angle, height, sigma, same = row_difference(found, expected)
    tracked = sum(row.status == "TRACKING" for row in expected)
    return (
        f"{len(found)} frames of {Path(options.video).name}, {tracked} tracked, by {options.calibrator}\n"
        f"largest difference: {angle:.2g} degrees, {height:.2g} mm, {sigma:.2%} of a sigma\n"
        f"status equal in {same} frames"
    )


def export_missing(options: argparse.Namespace) -> None:
    """Export the files that the comparison needs and that are not there."""
    needed = ("segmenter", "extractor", options.calibrator) if options.what == "run" else ("step",)
    for part in needed:
        if not (options.exported / f"{part}.onnx").is_file():
            words = {"camera": options.camera, "out": str(options.exported), "calibrator": options.calibrator}
            print(export(ExportConfig(part=part, **words)), flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command_parser(__doc__)
    parser.add_argument("video")
    parser.add_argument("--camera", required=True)
    parser.add_argument("--exported", type=Path, default=Path("lanebev-export"), metavar="DIR")
    parser.add_argument("--what", choices=("step", "run"), default="step")
    parser.add_argument("--calibrator", choices=CALIBRATORS, default="joint")
    parser.add_argument("--frames", type=int, default=200)
    options = parser.parse_args(arguments)
    export_missing(options)
    print(compare_runs(options) if options.what == "run" else compare_steps(options))


def compare_steps(options: argparse.Namespace) -> str:
    """Compare the exported step with PyTorch's on the frames of the video."""
    source = open_source(options.video, None)
    camera = Camera.from_file(options.camera, source.image_size)
    model = LaneBEV.from_pretrained(calibrator=make_calibrator(options.calibrator))
    part, other = make_part("step", model, camera), OnnxPart(options.exported / "step.onnx")
    frames = (frame.image for frame in islice(source, options.frames))
    images = (
        network_image(check_frame(image, camera.image_size), torch.device("cpu"))
        for image in frames
        if image is not None
    )
    with torch.inference_mode():
        found = compare(other, part, images)
    angle, height, within, same = zip(*found, strict=True)
    return (
        f"{len(found)} frames of {Path(options.video).name}, calibrator {options.calibrator}\n"
        f"largest difference: {max(angle):.2g} degrees, {max(height):.2g} mm\n"
        f"view within 1/255: {min(within):.4%} of the pixels of the worst frame\n"
        f"status equal in {sum(same)} frames"
    )


if __name__ == "__main__":
    main()
