"""The joint filter when the shape of the road is known: what remains to be estimated is the pose."""

from collections.abc import Sequence

import torch
from torch import Tensor

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import MotionConfig
from lanebev.estimation.joint.layout import SHAPE
from lanebev.estimation.joint.measurement.road_curve import KNOT_SPACING, NUM_STEPS
from lanebev.estimation.joint.state import JointState
from lanebev.observation.segments import LaneSegments
from lanebev.testing.moments import Moment
from lanebev.types import Calibration

_KNOWN = 1e-9  # 1/m, standard deviation of the shape


class KnownRoad(JointCalibrator):
    """The joint filter whose state is given the true shape of the road before every frame.

    It counts the frames since ``initial_state``, so the rows of a batch must drive over the same road at the
    same speed.

    Args:
        drive: moments, each with a curvature.
        speed: m/s.
    """

    def __init__(self, drive: Sequence[Moment], speed: float) -> None:
        super().__init__(motion=MotionConfig(speed=speed, speed_std=0.5))
        self.drive, self.frame = drive, 0

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> JointState:
        """See :class:`~lanebev.JointCalibrator`; the next frame is the first of the drive again."""
        self.frame = 0
        return super().initial_state(batch_size, dtype, device)

    def step(
        self, segments: LaneSegments, intrinsics: Tensor, state: JointState, dt: Tensor, lane_width: Tensor
    ) -> tuple[Calibration, JointState]:
        """Process one frame, the road of the frame before being known."""
        if self.frame:
            shape = shape_of(self.drive[self.frame - 1], state.phase)
            mean, cov = state.mean.clone(), state.cov.clone()
            mean[:, SHAPE] = shape
            cov[:, SHAPE], cov[:, :, SHAPE] = 0.0, 0.0
            cov.diagonal(dim1=1, dim2=2)[:, SHAPE] = _KNOWN**2
            state = state._replace(mean=mean, cov=cov)
        self.frame += 1
        return super().step(segments, intrinsics, state, dt, lane_width)


def shape_of(moment: Moment, phase: Tensor) -> Tensor:
    """Compute the curvature of the road at the first knot, and its steps (B, 1 + NUM_STEPS), 1/m.

    Args:
        moment: with a curvature by the distance along the road.
        phase: (B,) m, how far the first knot lies behind the camera.
    """
    assert moment.curvature is not None
    knots = KNOT_SPACING * torch.arange(1 + NUM_STEPS, dtype=phase.dtype) - phase.unsqueeze(-1)
    at_knots = moment.curvature(knots)
    return torch.cat([at_knots[:, :1], at_knots.diff(dim=-1)], dim=-1)
