"""``lanebev export``: write parts of the model as files for other runtimes."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from lanebev.app.config.export import ExportConfig
from lanebev.app.drive.build import make_calibrator
from lanebev.camera.model import Camera
from lanebev.export.parts import make_part
from lanebev.export.quantize import VIEWS, quantize_segmenter, rendered_views
from lanebev.export.write import write_onnx, write_program
from lanebev.observation.far_view import FarView
from lanebev.pipeline import LaneBEV

SUFFIXES = {"onnx": ".onnx", "torch-export": ".pt2"}


def export(config: ExportConfig, begun: Callable[[str], None] = lambda _: None) -> str:
    """Write the parts to the output folder, all of them or nothing.

    Args:
        config: settings.
        begun: called with a line about each part before it is exported, which can take minutes.

    Returns:
        a line for each file.
    """
    camera = Camera.from_file(config.camera)
    model = LaneBEV.from_pretrained(
        config.weights,
        calibrator=make_calibrator(config.calibrator),
        far_view=FarView() if config.far_view else None,
    )
    write, lines = {"onnx": write_onnx, "torch-export": write_program}[config.format], []
    out = Path(config.out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out, prefix=".export") as partial:
            for number, name in enumerate(config.parts, start=1):
                begun(f"{name}, {number} of {len(config.parts)}")
                path = Path(partial, f"{name}{SUFFIXES[config.format]}")
                write(make_part(name, model, camera), path)
                if config.int8 and name == "segmenter":
                    begun(f"{name} in 8 bits, by {VIEWS} rendered views")
                    quantize_segmenter(path, rendered_views(model.network_size(camera.image_size)))
                lines.append(f"{out / path.name}: {path.stat().st_size / 1e6:.1f} MB")
            for path in Path(partial).iterdir():
                os.replace(path, out / path.name)
    except OSError as error:
        raise ValueError(
            f"output folder {out}: expected one that can be written, got: {error.strerror}"
        ) from error
    return "\n".join(lines)
