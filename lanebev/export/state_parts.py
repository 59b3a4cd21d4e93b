"""Parts with a state: a calibrator, and the step, all of a frame in one."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lanebev.batch import select_rows
from lanebev.camera.model import Camera
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.export.part import ROWS, Inputs, Part, lens_inputs
from lanebev.observation.segments import LaneSegments
from lanebev.pipeline import LaneBEV
from lanebev.types import Calibration


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
        "endpoints": torch.rand(ROWS, segments, 2, 2, dtype=double),
        "boundary": torch.arange(calibrator.num_boundaries).repeat(ROWS, segments)[:, :segments],
        "weight": torch.ones(ROWS, segments, dtype=double),
        "sigma": torch.ones(ROWS, segments, dtype=double),
        "intrinsics": torch.eye(3, dtype=double).repeat(ROWS, 1, 1),
        **_state_inputs(calibrator),
    }
    outputs = ("extrinsics", "covariance", "status", "inliers", *_next_names(calibrator))
    return Part(_Calibrator(calibrator).eval(), inputs, outputs, {"segments": segments})


class _Step(_WithState):
    """Image and state to view, pose and state."""

    def __init__(self, model: LaneBEV, camera: Camera) -> None:
        super().__init__(exported_calibrator(model))
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


def step_part(model: LaneBEV, camera: Camera) -> Part:
    """Make the part that processes a frame from the image to the view, with the calibrator of the model."""
    state = _state_inputs(exported_calibrator(model))
    inputs = {
        "image": torch.rand(ROWS, 3, *camera.image_size),
        **{name: state.pop(name) for name in ("dt", "lane_width", "reset")},
        **lens_inputs(camera),
        **state,
    }
    outputs = (
        "bev", "valid", "extrinsics", "covariance", "status", "inliers", "bev_from_image",
        *LaneSegments._fields, *_next_names(exported_calibrator(model)),
    )  # fmt: skip
    return Part(_Step(model, camera).eval(), inputs, outputs)


class _Speed(nn.Module):
    """State after a frame and the vehicle's speed to the state for the next one."""

    FIELDS = ("mean", "cov", "heading_sensitivity")

    def __init__(self, calibrator: JointCalibrator) -> None:
        super().__init__()
        self.calibrator = calibrator

    def forward(
        self, mean: Tensor, cov: Tensor, heading_sensitivity: Tensor, speed: Tensor
    ) -> Sequence[Tensor]:
        others = self.calibrator.initial_state(1, mean.dtype)
        state = others._replace(mean=mean, cov=cov, heading_sensitivity=heading_sensitivity)
        after = self.calibrator.with_speed(state, speed)
        return [getattr(after, name) for name in self.FIELDS]


def speed_part(calibrator: JointCalibrator) -> Part:
    """Make the part that updates the joint calibrator's state by the vehicle's speed."""
    state = calibrator.initial_state(ROWS, dtype=torch.float64)
    inputs = {f"state_{name}": getattr(state, name) for name in _Speed.FIELDS}
    inputs["speed"] = torch.full((ROWS,), 10.0, dtype=torch.float64)
    return Part(_Speed(calibrator).eval(), inputs, tuple(f"next_state_{name}" for name in _Speed.FIELDS))


def _results(calibration: Calibration) -> tuple[Tensor, ...]:
    """Return the pose as (B, 4), covariance, status and inliers."""
    extrinsics, covariance, status, inliers = calibration
    return extrinsics.stack(), covariance, status, inliers


def _next_names(calibrator: Calibrator[Any]) -> tuple[str, ...]:
    """Return the outputs that are the inputs ``state_...`` of the next frame."""
    fields: Sequence[str] = calibrator.state_type._fields
    return tuple(f"next_state_{name}" for name in fields)


def _state_inputs(calibrator: Calibrator[Any]) -> Inputs:
    """Return what every calibrator takes beside the segments."""
    state = calibrator.initial_state(ROWS, dtype=torch.float64)
    return {
        "dt": torch.full((ROWS,), 1 / 30, dtype=torch.float64),
        "lane_width": torch.full((ROWS, calibrator.num_boundaries - 1), 3.7, dtype=torch.float64),
        "reset": torch.zeros(ROWS, dtype=torch.bool),
        **{f"state_{name}": value for name, value in state._asdict().items()},
    }


def exported_calibrator(model: LaneBEV) -> Calibrator[Any]:
    """Return the model's calibrator, which is one of the package's."""
    if not isinstance(model.calibrator, Calibrator):
        got = type(model.calibrator).__qualname__
        raise TypeError(f"calibrator: expected a lanebev calibrator to export, got {got}")
    return model.calibrator
