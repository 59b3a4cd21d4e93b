"""What to export: settings with their defaults. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from lanebev.app.config import CALIBRATORS, option

FORMATS = ("onnx", "torch-export")
PARTS = ("segmenter", "extractor", "warp", "joint", "two-stage", "step")


@dataclass(frozen=True)
class ExportConfig:
    """What to export.

    Attributes:
        camera: camera file; images of its size and behind its kind of lens can be given to what is exported.
        part: one of PARTS, or None for all that a run by ONNX Runtime needs, and the step.
        format: one of FORMATS.
        out: output folder.
        calibrator: of the step, one of CALIBRATORS.
        weights: of the network, None for the shipped ones.
    """

    camera: str = option("", "whose image size and kind of lens are fixed", "FILE")
    part: str | None = option(None, "one part only, instead of what a run needs and the step", choices=PARTS)
    format: str = option("onnx", "of the files (default {})", choices=FORMATS)
    out: str = option("lanebev-export", "output folder (default {})", "DIR")
    calibrator: str = option(
        "joint", "two-stage is the paper's (default {}, which takes minutes as ONNX)", choices=CALIBRATORS
    )
    weights: str | None = option(None, "weights of the network instead of the shipped ones", "FILE")

    def __post_init__(self) -> None:
        if not self.camera:
            raise ValueError("camera: expected --camera FILE, got none")

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts to write."""
        return (self.part,) if self.part else ("segmenter", "extractor", self.calibrator, "warp", "step")
