"""The parts of a model that can be exported, by name."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor, nn

from lanebev.camera.model import Camera
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.export.names import PARTS
from lanebev.export.part import ROWS, Part, lens_inputs
from lanebev.export.state_parts import calibrator_part, exported_calibrator, speed_part, step_part
from lanebev.observation.polylines import VERTICES_PER_LINE
from lanebev.observation.segments import LaneSegments, segments_from_vertices
from lanebev.pipeline import LaneBEV
from lanebev.types import Extrinsics


def make_part(name: str, model: LaneBEV, camera: Camera) -> Part:
    """Make a part of a model, for the images of a camera.

    Args:
        name: one of PARTS; "step" has the calibrator of the model.
        model: model to take parts of.
        camera: camera whose image size and lens model are fixed; its numbers stay inputs.

    Raises:
        ValueError: another name, or the extractor alone of a model with a far view.
    """
    if name not in PARTS:
        raise ValueError(f"part: expected one of {', '.join(PARTS)}, got {name!r}")
    if model.far_view is not None and name == "extractor":
        raise ValueError(
            "far view: expected another part than the extractor, which takes images of one size; export the "
            "step, or a model without far view"
        )
    model = model.eval()
    if name == "segmenter":
        part = _segmenter_part(model, camera)
    elif name == "extractor":
        part = _extractor_part(model, camera)
    elif name == "warp":
        part = _warp_part(model, camera)
    elif name == "step":
        part = step_part(model, camera)
    elif name == "speed":
        own = model.calibrator
        part = speed_part(own if isinstance(own, JointCalibrator) else JointCalibrator())
    else:
        kind: type[Calibrator[Any]] = JointCalibrator if name == "joint" else TwoStageCalibrator
        own = model.calibrator
        part = calibrator_part(own if isinstance(own, kind) else kind(), _segment_count(model, camera))
    return replace(part, facts={"part": name, **_facts(model, camera), **part.facts})


def _facts(model: LaneBEV, camera: Camera) -> dict[str, Any]:
    """Return sizes and conventions that cannot be read off the shapes of tensors."""
    grid = model.warp.grid
    return {
        "image_size": list(camera.image_size),
        "network_size": list(model.network_size(camera.image_size)),
        "intrinsics": camera.intrinsics.tolist(),
        "distortion": camera.distortion.tolist(),
        "lens": camera.model if camera.distortion.numel() else None,
        "pose_sigma_scale": model.pose_sigma_scale,
        "num_boundaries": exported_calibrator(model).num_boundaries,
        "grid": {"x": list(grid.x), "z": list(grid.z), "resolution": grid.resolution},
        "units": "image RGB in [0, 1]; px, rad, m, s; extrinsics are pitch, yaw, roll, height",
    }


class _Segmenter(nn.Module):
    """Image to logits."""

    def __init__(self, model: LaneBEV) -> None:
        super().__init__()
        self.segmenter = model.segmenter

    def forward(self, image: Tensor) -> tuple[Tensor]:
        return (self.segmenter(image),)


def _segmenter_part(model: LaneBEV, camera: Camera) -> Part:
    """Make the segmenter: with a far view for inputs of any size, whose lines PyTorch extracts."""
    image = torch.rand(ROWS, 3, *model.network_size(camera.image_size))
    part = Part(_Segmenter(model), {"image": image}, ("logits",))
    if model.far_view is None:
        return part
    return replace(part, facts={"lines": asdict(model.extractor.config)}, free={2: 32, 3: 32})


class _Extractor(nn.Module):
    """Logits and lens to vertices, in pixels as taken, and segments, in undistorted ones."""

    def __init__(self, model: LaneBEV, camera: Camera) -> None:
        super().__init__()
        self.extractor, self.model = model.extractor, camera.model
        self.sizes = (camera.image_size, model.network_size(camera.image_size))

    def forward(
        self, logits: Tensor, intrinsics: Tensor, distortion: Tensor | None = None
    ) -> Sequence[Tensor]:
        vertices = self.extractor.vertices(logits, *self.sizes)
        segments = segments_from_vertices(vertices, intrinsics, distortion, self.model)
        return *vertices, *segments


def _extractor_part(model: LaneBEV, camera: Camera) -> Part:
    with torch.no_grad():
        logits = model.segmenter(torch.rand(ROWS, 3, *model.network_size(camera.image_size)))
    inputs = {"logits": logits.float(), **lens_inputs(camera)}
    names = ("vertex_points", "vertex_weight", "vertex_sigma", "vertex_boundary", *LaneSegments._fields)
    return Part(
        _Extractor(model, camera), inputs, names, {"boundary_segments": model.extractor.config.segments}
    )


class _Warp(nn.Module):
    """Image and pose to the bird's-eye view."""

    def __init__(self, model: LaneBEV, camera: Camera) -> None:
        super().__init__()
        self.warp, self.model = model.warp, camera.model

    def forward(
        self, image: Tensor, extrinsics: Tensor, intrinsics: Tensor, distortion: Tensor | None = None
    ) -> Sequence[Tensor]:
        pose = Extrinsics.unstack(extrinsics)
        bev, valid = self.warp(image, intrinsics, pose, distortion, self.model)
        return bev, valid


def _warp_part(model: LaneBEV, camera: Camera) -> Part:
    pose = torch.tensor([[0.02, 0.0, 0.0, 1.5]], dtype=torch.float64).repeat(ROWS, 1)
    image = torch.rand(ROWS, 3, *camera.image_size)
    inputs = {"image": image, "extrinsics": pose, **lens_inputs(camera)}
    return Part(_Warp(model, camera), inputs, ("bev", "valid"))


def _segment_count(model: LaneBEV, camera: Camera) -> int:
    """Return N, room for the segments of an image and for those of a lane file."""
    part = _extractor_part(model, camera)
    with torch.no_grad():
        found = int(part.module(*part.inputs.values())[-1].shape[1])
    return max(found, exported_calibrator(model).num_boundaries * (VERTICES_PER_LINE // 2))
