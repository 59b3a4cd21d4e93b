"""What online calibrators have in common: the border at which anything may come."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from lanebev.estimation.checks import as_batch, as_lane_width, check_segments, check_state, padded, usable
from lanebev.geometry.precision import autocast_off, cast_floating, widest_dtype
from lanebev.types import Calibration, LaneSegments


class Calibrator(nn.Module):
    """Per row of a batch, state in and state out; a subclass gives ``initial_state`` and :meth:`step`.

    Attributes:
        config: the numbers, ``num_boundaries`` among them.
        state_type: NamedTuple of the state, its first tensor (B, D).
    """

    config: Any
    state_type: type[Any]

    def forward(
        self,
        segments: LaneSegments,
        intrinsics: Tensor,
        state: Any,
        dt: float | Tensor,
        lane_width: float | Tensor = 3.7,
    ) -> tuple[Calibration, Any]:
        """One frame; the results have the state's dtype.

        All is computed in double precision, autocast off: in single precision a lane seen sharply and alone
        leaves information matrices with a condition number beyond 1e7, which are not positive definite any
        more. Only where a device has no double precision (MPS) is it computed in single.

        Args:
            segments: of this frame, N per row, 0 too; weight 0 is not there, non-finite counts as not there.
            intrinsics: (B, 3, 3) px. A row where they or the widths are not finite and positive sees nothing.
            state: of the frame before, or ``initial_state(B)``.
            dt: s since that frame, float or (B,). A started row skips a frame that is not later (0 or
                negative). Where not finite, an interval is assumed.
            lane_width: m, float, (B,) or (B, L-1) per lane.

        Returns:
            calibration of this frame, in memory of its own, and the state after it.

        Raises:
            ValueError: a shape that doesn't fit, whole numbers, another calibrator's state.
        """
        check_segments(segments, intrinsics)
        count = segments.weight.shape[1]
        given = check_state(state, self.state_type, intrinsics.shape[0])
        like = given.to(widest_dtype(given.device))
        segments, intrinsics, state = (cast_floating(x, like.dtype) for x in (segments, intrinsics, state))
        widths = as_lane_width(lane_width, like, self.config.num_boundaries)
        segments, intrinsics, widths = usable(
            padded(segments), intrinsics, widths, self.config.num_boundaries
        )
        with autocast_off(like.device):
            calibration, state = self.step(segments, intrinsics, state, as_batch(dt, like), widths)
        calibration = calibration._replace(inliers=calibration.inliers[:, :count])
        return _copied(cast_floating(calibration, given.dtype)), cast_floating(state, given.dtype)

    def step(
        self, segments: LaneSegments, intrinsics: Tensor, state: Any, dt: Tensor, lane_width: Tensor
    ) -> tuple[Calibration, Any]:
        """As :meth:`forward`, of what can be used, in one dtype, with dt (B,) and lane_width (B, L-1)."""
        raise NotImplementedError


def _copied(value: Any) -> Any:
    """A tensor, or every one in a NamedTuple, in memory of its own."""
    return value.clone() if isinstance(value, Tensor) else type(value)(*map(_copied, value))
