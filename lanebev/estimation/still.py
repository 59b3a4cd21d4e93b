"""Single images: a calibrator from its initial state, without a drive before or after."""

import math

from torch import Tensor

from lanebev.estimation.calibrator import Calibrator, StateT
from lanebev.observation.segments import LaneSegments
from lanebev.types import Calibration

_INSTANT = 1e-3  # s between the passes over one image


def calibrate_still(
    calibrator: Calibrator[StateT], segments: LaneSegments, intrinsics: Tensor, lane_width: float | Tensor
) -> Calibration:
    """Calibrate on images of their own, each from the initial state.

    A calibrator that starts with a search needs one pass. One that starts with a guess takes several
    (:attr:`Calibrator.still_passes`), each with its share of the information. Source: with the end points'
    variance times the number of passes, all passes together say as much as the image does once (progressive
    update), so the covariance stays that of the image while the point of linearisation converges.

    Args:
        calibrator: any.
        segments: B images.
        intrinsics: (B, 3, 3) px.
        lane_width: m, float, (B,) or (B, L-1); exact, except for the calibrator's ``lane_width_std``.

    Returns:
        the calibration of each image.
    """
    return calibrate_still_with_state(calibrator, segments, intrinsics, lane_width)[0]


def calibrate_still_with_state(
    calibrator: Calibrator[StateT], segments: LaneSegments, intrinsics: Tensor, lane_width: float | Tensor
) -> tuple[Calibration, StateT]:
    """Calibrate as :func:`calibrate_still`, and return the state after it too, for its reasons."""
    passes = calibrator.still_passes
    shared = segments._replace(sigma=segments.sigma * math.sqrt(passes))
    state = calibrator.initial_state(segments.sigma.shape[0], segments.sigma.dtype, segments.sigma.device)
    for _ in range(passes):
        calibration, state = calibrator(shared, intrinsics, state, _INSTANT, lane_width)
    return calibrator.weigh_still(calibration, state, segments, intrinsics, lane_width), state
