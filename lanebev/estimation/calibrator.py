"""The interface of all online calibrators, and the checks and casts that they share."""

from typing import Generic, Protocol, Self, TypeVar

import torch
from torch import Tensor, nn

from lanebev.estimation.checks import (
    FEW_SEGMENTS,
    as_batch,
    as_lane_width,
    check_segments,
    check_state,
    mask_invalid_rows,
    padded,
)
from lanebev.geometry.precision import autocast_off, cast_floating, widest_dtype
from lanebev.observation.segments import LaneSegments
from lanebev.tensors import map_tensors, one_thread_if_small, recorded
from lanebev.torch_internals import is_in_forward_mode
from lanebev.types import Calibration, TensorTuple, check_devices


class CalibratorState(TensorTuple, Protocol):
    """A NamedTuple of tensors, (B, ...) each; the first is floating point."""

    @property
    def reasons(self) -> Tensor:
        """(B,) int64 flags of :class:`lanebev.Reason`, of the last frame."""
        ...

    def detach(self) -> Self:
        """Return the state without the graph that computed it, as truncated backpropagation needs."""
        ...


StateT = TypeVar("StateT", bound=CalibratorState)


class Calibrator(nn.Module, Generic[StateT]):
    """Estimate the pose frame by frame, per row of a batch: state in, state out.

    A subclass sets the attributes and defines :meth:`initial_state`, :meth:`step` and, where it estimates
    the road's curvature, :meth:`curvature` and :meth:`vertical_curvature`; for a far view also
    :meth:`pitch_and_yaw`.

    Attributes:
        state_type: the class of the state.
        num_boundaries: L.
        still_passes: updates that a single image needs, see
            :func:`~lanebev.estimation.still.calibrate_still`: 1 for a calibrator that starts by a search.
        lane_width_std: standard deviation of the lane width, m, whose effect its covariance contains.
    """

    state_type: type[StateT]
    num_boundaries: int
    still_passes: int = 1
    lane_width_std: float = 0.0

    def initial_state(
        self, batch_size: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> StateT:
        """Return the state before the first frame, UNINITIALISED.

        Args:
            batch_size: B.
            dtype: dtype of the state and so of all results, float32 or float64.
            device: device of the state; None is the default device.

        Raises:
            TypeError: a batch size that is no whole number.
            ValueError: a negative batch size, or another dtype.
        """
        raise NotImplementedError

    def forward(
        self,
        segments: LaneSegments,
        intrinsics: Tensor,
        state: StateT,
        dt: float | Tensor,
        lane_width: float | Tensor = 3.7,
    ) -> tuple[Calibration, StateT]:
        """Estimate the pose of one frame; the results have the state's dtype.

        Everything is computed in double precision without autocast: with one precisely seen lane, information
        matrices have a condition number beyond 1e7, so in single precision they are not positive definite.
        Only on a device without double precision (MPS) is single precision used.

        Args:
            segments: N >= 0 segments per row; those of weight 0 or with non-finite numbers are ignored.
            intrinsics: (B, 3, 3) px. If they or the widths are not finite and positive, the row is unused; so
                it is on a GPU if they are transposed, which is an error on the CPU.
            state: state of the frame before, or ``initial_state(B)``.
            dt: s since that frame, float or (B,). A started row skips a frame that is not later (0 or
                negative). If it is not finite, an interval is assumed.
            lane_width: m, float, (B,) or (B, L-1) per lane. It counts as exact, also the default, except for
                the ``lane_width_std`` of the configuration: 0 unless given.

        Returns:
            calibration of this frame, which shares no memory with the inputs, and the state after it.

        Raises:
            ValueError: a shape that doesn't fit, whole numbers, another device, another calibrator's state.
        """
        check_segments(segments, intrinsics)
        given = check_state(state, self.state_type, intrinsics.shape[0])
        if given.ndim != 2:  # as default_collate stacks states
            rows = f"({given.shape[0]}, D)"
            raise ValueError(f"state: expected {rows}, got {tuple(given.shape)}; join states by torch.cat")
        own = {f"segments.{name}": part for name, part in segments._asdict().items()}
        check_devices({"intrinsics": intrinsics, **own, "state": given})
        frame = (segments, intrinsics, state, dt, lane_width, given)
        differentiable = torch.is_grad_enabled() or is_in_forward_mode()
        with one_thread_if_small(segments.weight, FEW_SEGMENTS):
            if recorded() or differentiable or torch.is_inference_mode_enabled():
                calibration, after = self._estimate(*frame)
            else:
                with torch.inference_mode():  # takes a fifth less time than torch.no_grad
                    calibration, after = self._estimate(*frame)
                after = map_tensors(torch.clone, after)  # which a graph may use later
        return map_tensors(torch.clone, calibration), after

    def _estimate(
        self,
        segments: LaneSegments,
        intrinsics: Tensor,
        state: StateT,
        dt: float | Tensor,
        lane_width: float | Tensor,
        given: Tensor,
    ) -> tuple[Calibration, StateT]:
        """Estimate as :meth:`forward`, from checked segments and state; ``given`` has the results' dtype."""
        count, like = segments.weight.shape[1], given.to(widest_dtype(given.device))
        segments, intrinsics = cast_floating(segments, like.dtype), cast_floating(intrinsics, like.dtype)
        widths = as_lane_width(lane_width, like, self.num_boundaries)
        segments, intrinsics, widths = mask_invalid_rows(
            padded(segments), intrinsics, widths, self.num_boundaries
        )
        with autocast_off(like.device, like.dtype):
            calibration, after = self.step(
                segments, intrinsics, cast_floating(state, like.dtype), as_batch(dt, like), widths
            )
        calibration = calibration._replace(inliers=calibration.inliers[:, :count])
        return cast_floating(calibration, given.dtype), cast_floating(after, given.dtype)

    def step(
        self, segments: LaneSegments, intrinsics: Tensor, state: StateT, dt: Tensor, lane_width: Tensor
    ) -> tuple[Calibration, StateT]:
        """Estimate as :meth:`forward`, from usable input of one dtype; dt is (B,), lane_width (B, L-1)."""
        raise NotImplementedError

    def with_speed(self, state: StateT, speed: float | Tensor) -> StateT:
        """Return a state updated by the vehicle's speed, where the calibrator estimates one.

        Call it after a frame, with the state that is given to the next one.

        Args:
            state: state after a frame.
            speed: speed of the vehicle at that frame, m/s, float or (B,). A row whose speed is not finite
                keeps its state; below 0, driving backward, it counts as 0.
        """
        return state

    def weigh_still(
        self,
        calibration: Calibration,
        state: StateT,
        segments: LaneSegments,
        intrinsics: Tensor,
        lane_width: float | Tensor,
    ) -> Calibration:
        """Return the calibration of single images, which no other frame will correct.

        Args:
            calibration: after the passes over them.
            state: after the passes.
            segments: segments of B images.
            intrinsics: (B, 3, 3) px.
            lane_width: m, float, (B,) or (B, L-1).
        """
        return calibration

    def scale_still(self, calibration: Calibration, factor: float) -> Calibration:
        """Scale the standard deviations of single images, whose detector's errors are larger than stated.

        Args:
            calibration: calibration of :meth:`weigh_still`.
            factor: factor on the standard deviations of the image's information on the pose.
        """
        return calibration.with_std_scaled(factor)

    def scale_drive(
        self, calibration: Calibration, state: StateT, factor: float, lane_width: float | Tensor = 3.7
    ) -> Calibration:
        """Scale the standard deviations of a drive's pose for a detector whose errors repeat over frames.

        Args:
            calibration: calibration of a frame.
            state: state after it, before :meth:`with_speed`.
            factor: factor on the standard deviations of what the frames tell of the pose.
            lane_width: m, as of the frame.
        """
        return calibration.with_std_scaled(factor)

    def curvature(self, state: StateT) -> Tensor | None:
        """Return the road's curvature at the camera, (B,) 1/m, positive to the right, or None."""
        return None

    def vertical_curvature(self, state: StateT) -> Tensor | None:
        """Return the road's vertical curvature, (B,) 1/m, positive over a crest, or None for a plane road."""
        return None

    def pitch_and_yaw(self, state: StateT) -> tuple[Tensor, Tensor] | None:
        """Return pitch and yaw of a state, (B, 2) rad, and their variances (B, 2), or None.

        Before the first frame they are those of the prior.
        """
        return None

    def reasons(self, state: StateT) -> Tensor:
        """Return why rows are not (fully) tracked, (B,) int64 flags of :class:`lanebev.Reason`."""
        return state.reasons
