"""What can be exported: modules of tensors only, with the names and an example of what goes in and out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from lanebev.batch import select_rows
from lanebev.camera.model import Camera
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.observation.polylines import VERTICES_PER_LINE
from lanebev.observation.segments import LaneSegments, segments_from_vertices
from lanebev.pipeline import LaneBEV
from lanebev.types import Calibration, Extrinsics

PARTS = ("segmenter", "extractor", "warp", "joint", "two-stage", "step")
_ROWS = 2  # of the example: a batch of one would be taken for a constant

Inputs = dict[str, Tensor]


@dataclass(frozen=True)
class Part:
    """A module that can be exported.

    Attributes:
        module: takes the tensors of ``inputs`` in their order and returns a tuple of those of ``outputs``.
        inputs: an example by name; the first dimension of each is the batch.
        outputs: names.
        facts: what its caller has to know, as JSON can hold it.
    """

    module: nn.Module
    inputs: Inputs
    outputs: tuple[str, ...]
    facts: Mapping[str, Any] = field(default_factory=dict)


def make_part(name: str, model: LaneBEV, camera: Camera) -> Part:
    """Make a part of a model, for the images of a camera.

    Args:
        name: one of PARTS; "step" has the calibrator of the model.
        model: model to take parts of.
        camera: camera whose image size and lens model are fixed; its numbers stay inputs.

    Raises:
        ValueError: another name.
    """
    if name not in PARTS:
        raise ValueError(f"part: expected one of {', '.join(PARTS)}, got {name!r}")
    model = model.eval()
    if name == "segmenter":
        part = _segmenter_part(model, camera)
    elif name == "extractor":
        part = _extractor_part(model, camera)
    elif name == "warp":
        part = _warp_part(model, camera)
    elif name == "step":
        part = _step_part(model, camera)
    else:
        kind: type[Calibrator[Any]] = JointCalibrator if name == "joint" else TwoStageCalibrator
        own = model.calibrator
        part = calibrator_part(own if isinstance(own, kind) else kind(), _segment_count(model, camera))
    return Part(part.module, part.inputs, part.outputs, {"part": name, **_facts(model, camera), **part.facts})


def _facts(model: LaneBEV, camera: Camera) -> dict[str, Any]:
    """Return sizes and conventions that the shapes of tensors do not tell."""
    grid = model.warp.grid
    return {
        "image_size": list(camera.image_size),
        "network_size": list(model.network_size(camera.image_size)),
        "intrinsics": camera.intrinsics.tolist(),
        "distortion": camera.distortion.tolist(),
        "lens": camera.model if camera.distortion.numel() else None,
        "pose_sigma_scale": model.pose_sigma_scale,
        "num_boundaries": _calibrator(model).num_boundaries,
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
    image = torch.rand(_ROWS, 3, *model.network_size(camera.image_size))
    return Part(_Segmenter(model), {"image": image}, ("logits",))


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
        logits = model.segmenter(torch.rand(_ROWS, 3, *model.network_size(camera.image_size)))
    inputs = {"logits": logits.float(), **_lens_inputs(camera)}
    names = ("vertex_points", "vertex_weight", "vertex_sigma", "vertex_boundary", *LaneSegments._fields)
    return Part(_Extractor(model, camera), inputs, names)


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
    pose = torch.tensor([[0.02, 0.0, 0.0, 1.5]], dtype=torch.float64).repeat(_ROWS, 1)
    image = torch.rand(_ROWS, 3, *camera.image_size)
    inputs = {"image": image, "extrinsics": pose, **_lens_inputs(camera)}
    return Part(_Warp(model, camera), inputs, ("bev", "valid"))


class _WithState(nn.Module):
    """A module with a state, which is reset in the rows of ``reset``.

    Args:
        calibrator: calibrator whose state it is.
    """

    def __init__(self, calibrator: Calibrator[Any]) -> None:
        super().__init__()
        self.calibrator, self.state_type = calibrator, calibrator.state_type
        for name, value in calibrator.initial_state(1, dtype=torch.float64)._asdict().items():
            self.register_buffer(f"initial_{name}", value)

    def begin(self, reset: Tensor, state: Sequence[Tensor]) -> Any:
        """Return the state of all rows before this frame."""
        given = self.state_type(*state)
        fresh = (getattr(self, f"initial_{name}").expand_as(value) for name, value in given._asdict().items())
        return select_rows(reset, self.state_type(*fresh), given)


class _Calibrator(_WithState):
    """Segments and state to pose and state."""

    def forward(
        self,
        endpoints: Tensor,
        boundary: Tensor,
        weight: Tensor,
        sigma: Tensor,
        intrinsics: Tensor,
        dt: Tensor,
        lane_width: Tensor,
        reset: Tensor,
        *state: Tensor,
    ) -> Sequence[Tensor]:
        segments = LaneSegments(endpoints, boundary, weight, sigma)
        begun = self.begin(reset, state)
        calibration, after = self.calibrator(segments, intrinsics, begun, dt, lane_width)
        return *_results(calibration), *after


def calibrator_part(calibrator: Calibrator[Any], segments: int) -> Part:
    """Make the part of a calibrator.

    Args:
        calibrator: any.
        segments: N, of every frame; fewer are padded by segments of weight zero.
    """
    double = torch.float64
    inputs = {
        "endpoints": torch.rand(_ROWS, segments, 2, 2, dtype=double),
        "boundary": torch.arange(calibrator.num_boundaries).repeat(_ROWS, segments)[:, :segments],
        "weight": torch.ones(_ROWS, segments, dtype=double),
        "sigma": torch.ones(_ROWS, segments, dtype=double),
        "intrinsics": torch.eye(3, dtype=double).repeat(_ROWS, 1, 1),
        **_state_inputs(calibrator),
    }
    outputs = ("extrinsics", "covariance", "status", "inliers", *_next_names(calibrator))
    return Part(_Calibrator(calibrator).eval(), inputs, outputs, {"segments": segments})


class _Step(_WithState):
    """Image and state to view, pose and state."""

    def __init__(self, model: LaneBEV, camera: Camera) -> None:
        super().__init__(_calibrator(model))
        self.model, self.lens = model, camera.model
        self.coefficients = camera.distortion.numel()

    def forward(
        self,
        image: Tensor,
        dt: Tensor,
        lane_width: Tensor,
        reset: Tensor,
        intrinsics: Tensor,
        *distortion_and_state: Tensor,
    ) -> Sequence[Tensor]:
        lens = 1 if self.coefficients else 0
        distortion = distortion_and_state[0] if lens else None
        begun = self.begin(reset, distortion_and_state[lens:])
        out, after = self.model(image, intrinsics, begun, dt, lane_width, distortion, self.lens)
        return (
            out.bev, out.valid, *_results(out.calibration), out.bev_from_image, *out.segments, *after
        )  # fmt: skip


def _step_part(model: LaneBEV, camera: Camera) -> Part:
    state = _state_inputs(_calibrator(model))
    inputs = {
        "image": torch.rand(_ROWS, 3, *camera.image_size),
        **{name: state.pop(name) for name in ("dt", "lane_width", "reset")},
        **_lens_inputs(camera),
        **state,
    }
    outputs = (
        "bev", "valid", "extrinsics", "covariance", "status", "inliers", "bev_from_image",
        *LaneSegments._fields, *_next_names(_calibrator(model)),
    )  # fmt: skip
    return Part(_Step(model, camera).eval(), inputs, outputs)


def _results(calibration: Calibration) -> tuple[Tensor, ...]:
    """Return the pose as (B, 4), covariance, status and inliers."""
    extrinsics, covariance, status, inliers = calibration
    return extrinsics.stack(), covariance, status, inliers


def _lens_inputs(camera: Camera) -> Inputs:
    """Return intrinsics and, behind a lens, distortion."""
    inputs = {"intrinsics": camera.intrinsics.double().repeat(_ROWS, 1, 1)}
    if camera.distortion.numel():
        inputs["distortion"] = camera.distortion.double().repeat(_ROWS, 1)
    return inputs


def _next_names(calibrator: Calibrator[Any]) -> tuple[str, ...]:
    """Return the outputs that are the inputs ``state_...`` of the next frame."""
    fields: Sequence[str] = calibrator.state_type._fields
    return tuple(f"next_state_{name}" for name in fields)


def _state_inputs(calibrator: Calibrator[Any]) -> Inputs:
    """Return what every calibrator takes beside the segments."""
    state = calibrator.initial_state(_ROWS, dtype=torch.float64)
    return {
        "dt": torch.full((_ROWS,), 1 / 30, dtype=torch.float64),
        "lane_width": torch.full((_ROWS, calibrator.num_boundaries - 1), 3.7, dtype=torch.float64),
        "reset": torch.zeros(_ROWS, dtype=torch.bool),
        **{f"state_{name}": value for name, value in state._asdict().items()},
    }


def _segment_count(model: LaneBEV, camera: Camera) -> int:
    """Return N, room for the segments of an image and for those of a lane file."""
    part = _extractor_part(model, camera)
    with torch.no_grad():
        found = int(part.module(*part.inputs.values())[-1].shape[1])
    return max(found, _calibrator(model).num_boundaries * (VERTICES_PER_LINE // 2))


def _calibrator(model: LaneBEV) -> Calibrator[Any]:
    """Return the model's calibrator, which is one of the package's.

    Raises:
        TypeError: it is somebody else's module.
    """
    if not isinstance(model.calibrator, Calibrator):
        got = type(model.calibrator).__qualname__
        raise TypeError(f"calibrator: expected a lanebev calibrator to export, got {got}")
    return model.calibrator
