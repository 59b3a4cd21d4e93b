"""Settings of an export and their defaults. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from lanebev.app.config.options import check_types, option
from lanebev.app.config.run import CALIBRATORS
from lanebev.export.names import PARTS

EXPORT_FORMATS = ("onnx", "torch-export")


@dataclass(frozen=True)
class ExportConfig:
    """Settings of an export. Every field is an option of ``lanebev export``, with its help text.

    Raises:
        TypeError: a value of another type.
        ValueError: settings that exclude each other.
    """

    camera: str = option("", "camera file, whose image size and lens model the export keeps", "FILE")
    part: str | None = option(
        None,
        "export this part only (default: the step, and all that a run by ONNX Runtime needs)",
        choices=PARTS,
    )
    format: str = option("onnx", "format of the files (default {})", choices=EXPORT_FORMATS)
    out: str = option("lanebev-export", "output folder (default {})", "DIR")
    calibrator: str = option(
        "joint",
        "calibrator; two-stage is the paper's method (default {}, which takes minutes to export as ONNX)",
        choices=CALIBRATORS,
    )
    weights: str | None = option(None, "weights of the network instead of the shipped ones", "FILE")
    int8: bool = option(False, "quantise the segmenter's convolutions to 8 bits, by rendered views")
    far_view: bool = option(
        False, "for runs with a far view, see lanebev run --help: no extractor and no warp are written"
    )

    def __post_init__(self) -> None:
        check_types(self)
        if not self.camera:
            raise ValueError("camera: expected --camera FILE, got none")
        if self.int8 and (self.format != "onnx" or "segmenter" not in self.parts):
            got = f"--format {self.format} and {self.part or 'all parts'}"
            raise ValueError(f"int8: expected --format onnx and the part segmenter, got {got}")
        if self.far_view and self.part in ("extractor", "warp"):
            raise ValueError(
                f"part: expected segmenter, {', '.join(CALIBRATORS)} or step with --far-view, "
                f"got {self.part}, which a run with a far view does not read from a file"
            )
        if self.far_view and self.int8:
            raise ValueError("int8: expected --int8 or --far-view, got both; leave one of them out")

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts to write."""
        if self.far_view:
            return (self.part,) if self.part else ("segmenter", self.calibrator, "step")
        return (self.part,) if self.part else ("segmenter", "extractor", self.calibrator, "warp", "step")
