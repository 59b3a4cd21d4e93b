"""ONNX files at work: parts of :class:`lanebev.LaneBEV` that compute by ONNX Runtime."""

import json
from collections.abc import Mapping
from copy import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Generic

import torch
from torch import Tensor, nn

from lanebev.camera.model import Camera
from lanebev.estimation.calibrator import Calibrator, StateT
from lanebev.estimation.checks import padded
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.export.write import METADATA, MISSING
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.lines import LineExtractor
from lanebev.observation.segments import LaneSegments
from lanebev.observation.vertices import LineConfig
from lanebev.pipeline import LaneBEV
from lanebev.types import Calibration, Extrinsics

_TYPES = {"tensor(float)": torch.float32, "tensor(double)": torch.float64}


class OnnxPart:
    """A part in an ONNX file.

    Args:
        path: path of a file that ``lanebev export`` wrote.

    Raises:
        ValueError: ONNX Runtime is not there, or the file is missing or of something else.
    """

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise ValueError(f"onnxruntime: {MISSING} ({error})") from error
        if not path.is_file():
            raise ValueError(f"{path}: expected a file that lanebev export writes, found none")
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3  # errors
        try:
            self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its classes have no common base
            reason = str(error).splitlines()[0]
            raise ValueError(f"{path}: expected an ONNX file of lanebev export, got: {reason}") from error
        metadata = self.session.get_modelmeta().custom_metadata_map
        if METADATA not in metadata:
            raise ValueError(f"{path}: expected an ONNX file of lanebev export, got another one")
        self.facts: dict[str, Any] = json.loads(metadata[METADATA])
        self.inputs = {each.name: _TYPES.get(each.type) for each in self.session.get_inputs()}
        self.outputs = [each.name for each in self.session.get_outputs()]

    def __call__(self, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Compute the outputs by name from the inputs by name; numbers are cast as the file wants them."""
        feeds = {
            name: values[name].detach().cpu().to(dtype or values[name].dtype).numpy()
            for name, dtype in self.inputs.items()
        }
        found = self.session.run(self.outputs, feeds)
        return {name: torch.from_numpy(value) for name, value in zip(self.outputs, found, strict=True)}


class OnnxSegmenter(nn.Module):
    """Stands in for :class:`lanebev.LaneSegmenter`."""

    def __init__(self, part: OnnxPart) -> None:
        super().__init__()
        self.part = part
        self.config = SimpleNamespace(
            num_boundaries=part.facts["num_boundaries"], pose_sigma_scale=part.facts["pose_sigma_scale"]
        )

    def forward(self, image: Tensor) -> Tensor:
        """Convert an image (B, 3, h, w) to logits."""
        return self.part({"image": image})["logits"]


class OnnxExtractor(nn.Module):
    """Stands in for :class:`lanebev.LineExtractor`, for the images of one camera."""

    def __init__(self, part: OnnxPart, camera: Camera) -> None:
        super().__init__()
        self.part, self.camera = part, camera
        self.config = SimpleNamespace(segments=part.facts.get("boundary_segments", LineConfig().segments))

    def vertices(
        self, logits: Tensor, image_size: tuple[int, int], network_size: tuple[int, int]
    ) -> BoundaryVertices:
        """Convert logits (B, 1 + L, h, w) to vertices in pixels of the image as taken."""
        rows = logits.shape[0]
        found = self.part(
            {
                "logits": logits,
                "intrinsics": self.camera.intrinsics.expand(rows, 3, 3),
                "distortion": self.camera.distortion.expand(rows, -1),
            }
        )
        return BoundaryVertices._make(found[f"vertex_{name}"] for name in BoundaryVertices._fields)


class OnnxStep(Generic[StateT]):
    """Stands in for :meth:`~lanebev.estimation.calibrator.Calibrator.step`."""

    def __init__(self, part: OnnxPart) -> None:
        self.part = part

    def __call__(
        self, segments: LaneSegments, intrinsics: Tensor, state: StateT, dt: Tensor, lane_width: Tensor
    ) -> tuple[Calibration, StateT]:
        """Estimate the pose of one frame."""
        (rows, count), most = segments.weight.shape, self.part.facts["segments"]
        if count > most:
            raise ValueError(
                f"segments: expected {most} at most, as the calibrator was exported for, got {count}"
            )
        states = {f"state_{name}": value for name, value in state._asdict().items()}
        found = self.part(
            {
                **padded(segments, most)._asdict(),
                "intrinsics": intrinsics,
                "dt": dt,
                "lane_width": lane_width,
                "reset": torch.zeros(rows, dtype=torch.bool),
                **states,
            }
        )
        calibration = Calibration(
            Extrinsics.unstack(found["extrinsics"]),
            found["covariance"],
            found["status"],
            found["inliers"][:, :count],
        )
        return calibration, type(state)(*(found[f"next_{name}"] for name in states))


def with_exported_step(calibrator: Calibrator[StateT], part: OnnxPart) -> Calibrator[StateT]:
    """Return a calibrator whose step is that of a part; its initial state and all else are its own."""
    stepped = copy(calibrator)
    stepped.step = OnnxStep[StateT](part)  # type: ignore[method-assign]
    return stepped


def onnx_model(folder: Path, camera: Camera, far_view: bool = False) -> LaneBEV:
    """Make a model of the segmenter and the extractor in a folder; its calibrator is PyTorch's.

    So is its extractor for a far view, since there are inputs of three sizes.

    Raises:
        ValueError: files that are missing, or for images or a lens of another kind than the camera's.
    """
    segmenter = _part(folder, "segmenter")
    lines = segmenter.facts.get("lines", {})
    if far_view and not lines:
        raise ValueError(
            f"{folder / 'segmenter.onnx'}: expected a segmenter for far views, got one for whole images; "
            "export it again with --far-view"
        )
    extractor = segmenter if far_view else _part(folder, "extractor")
    expected = (list(camera.image_size), camera.model if camera.distortion.numel() else None)
    found = (extractor.facts["image_size"], extractor.facts["lens"])
    if found != expected:
        raise ValueError(
            f"{folder}: expected files for this camera, {_words(*expected)}, got some for "
            f"{_words(*found)}; export them again with this camera file"
        )
    # LaneBEV asks it for vertices only
    finder: Any = LineExtractor(LineConfig(**lines)) if far_view else OnnxExtractor(extractor, camera)
    return LaneBEV(
        OnnxSegmenter(segmenter),
        finder,
        JointCalibrator(num_boundaries=segmenter.facts["num_boundaries"]),
        network_width=extractor.facts["network_size"][1],
    )


def onnx_calibrator(folder: Path, name: str, calibrator: Calibrator[StateT]) -> Calibrator[StateT]:
    """Make the calibrator of this name in a folder, the export of ``calibrator``.

    Raises:
        ValueError: a file that is missing, or of another calibrator.
    """
    part, state = _part(folder, name), calibrator.initial_state(1)._asdict()
    if not {f"state_{each}" for each in state} <= set(part.inputs):
        raise ValueError(
            f"{folder / name}.onnx: expected one of this version of lanebev, got another's; export it again"
        )
    return with_exported_step(calibrator, part)


def _part(folder: Path, name: str) -> OnnxPart:
    """Return the part of this name in a folder."""
    part = OnnxPart(folder / f"{name}.onnx")
    if part.facts["part"] != name:
        raise ValueError(f"{folder / name}.onnx: expected the {name}, got the {part.facts['part']}")
    return part


def _words(size: list[int], lens: str | None) -> str:
    return f"{size[1]} x {size[0]} px {lens or 'without lens'}"
