"""Compare an exported step with PyTorch on a video: poses and views, each with its own state.

``lanebev export --part step --camera CAMERA --out DIR`` writes DIR/step.onnx.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.app.build import make_calibrator
from lanebev.camera.model import Camera
from lanebev.export.parts import Part, make_part
from lanebev.export.runtime import OnnxPart
from lanebev.io.video import open_source
from lanebev.observation.frames import check_frame, network_image
from lanebev.pipeline import LaneBEV

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


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("video")
    parser.add_argument("--camera", required=True)
    parser.add_argument("--exported", type=Path, default=Path("lanebev-export"), metavar="DIR")
    parser.add_argument("--calibrator", default="joint", help="calibrator of the step")
    parser.add_argument("--frames", type=int, default=200)
    options = parser.parse_args(arguments)
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
    print(f"{len(found)} frames of {Path(options.video).name}, calibrator {options.calibrator}")
    print(f"largest difference: {max(angle):.2g} degrees, {max(height):.2g} mm")
    print(f"view within 1/255: {min(within):.4%} of the pixels of the worst frame")
    print(f"status equal in {sum(same)} frames")


if __name__ == "__main__":
    main()
