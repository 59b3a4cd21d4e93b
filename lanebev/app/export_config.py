"""Settings of an export and their defaults. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from lanebev.app.config import CALIBRATORS, option

FORMATS = ("onnx", "torch-export")
PARTS = ("segmenter", "extractor", "warp", "joint", "two-stage", "step")


@dataclass(frozen=True)
class ExportConfig:
    """Settings of an export.

    Attributes:
        camera: camera file; the exported parts take images of its size and lens model.
        part: one of PARTS; None exports all parts that a run by ONNX Runtime needs, and the step.
        format: one of FORMATS.
        out: output folder.
        calibrator: calibrator of the step, one of CALIBRATORS.
        weights: weights file of the network; None is the shipped one.
    """

    camera: str = option("", "camera file, whose image size and lens model the export keeps", "FILE")
    part: str | None = option(None, "export this part only (default: all)", choices=PARTS)
    format: str = option("onnx", "format of the files (default {})", choices=FORMATS)
    out: str = option("lanebev-export", "output folder (default {})", "DIR")
    calibrator: str = option(
        "joint",
        "calibrator; two-stage is the paper's method (default {}, which takes minutes to export as ONNX)",
        choices=CALIBRATORS,
    )
    weights: str | None = option(None, "weights of the network instead of the shipped ones", "FILE")

    def __post_init__(self) -> None:
        if not self.camera:
            raise ValueError("camera: expected --camera FILE, got none")

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts to write."""
        return (self.part,) if self.part else ("segmenter", "extractor", self.calibrator, "warp", "step")
