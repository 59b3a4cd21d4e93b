"""Lane changes: all boundary indices change by one when the camera crosses a line."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.estimation.joint.layout import NUM_COMMON
from lanebev.estimation.joint.measurement.observations import Observations
from lanebev.estimation.joint.measurement.residuals import OFFSET, Sight, every_segment, sampson_distances
from lanebev.estimation.joint.measurement.robust import (
    log_likelihood,
    scaled_variance,
    squared_distance,
    start_scale,
)
from lanebev.tensors import constant

_SEGMENTS = 96  # segments that decide, at least


def best_shift(
    mean: Tensor,
    positions: Tensor,
    seen: Observations,
    sight: Sight,
    lane_width: Tensor,
) -> tuple[Tensor, Tensor]:
    """Choose by how many lanes the boundary indices changed since the prediction: -1, 0 or 1.

    Source: (J13).

    A shift is chosen if it explains the frame far better than none: the camera crossed a line, or the
    detector changed its numbering.

    Args:
        mean: (B, D) predicted.
        positions: (B, L) m, of the boundaries from the ego lane's middle.
        seen: what was observed.
        sight: with the predicted state.
        lane_width: (B,) m, of the ego lane.

    Returns:
        shift (B,) in the dtype of ``mean``, and (B,) noise scale of the frame's residuals after it.
    """
    own = mean[:, NUM_COMMON : NUM_COMMON + positions.shape[-1]]
    places = (positions + own).gather(1, seen.boundary)
    stride = max(1, places.shape[-1] // _SEGMENTS)
    sight = every_segment(sight, stride)
    places, weight, sigma = (part[:, ::stride] for part in (places, seen.weight, seen.sigma))
    shifts = constant((0.0, -1.0, 1.0), like=mean)
    moved = places + (shifts[:, None] * lane_width)[:, :, None]  # (3, B, N)
    distance = sampson_distances(mean[:, :NUM_COMMON], moved, sight)
    scales = start_scale(distance, sigma, weight * sight.valid)  # (3, B)
    squared, variance = squared_distance(distance), scaled_variance(sigma, scales.amin(0))
    scores = log_likelihood(squared, sight.valid, weight, variance, seen.focal)  # (3, B)
    clear = scores[1:].amax(0) > 2.0 * scores[0] + 10.0
    best = torch.where(clear, 1 + scores[1:].argmax(0), 0)  # (B,)
    return shifts.gather(0, best), scales.gather(0, best.unsqueeze(0)).squeeze(0)


def renumber(mean: Tensor, shift: Tensor, lane_width: Tensor, num_boundaries: int) -> Tensor:
    """Shift offset and deviations of a state by a lane: after a change to the right, boundary k was k + 1.

    Args:
        mean: (B, D).
        shift: (B,) lanes, -1, 0 or 1.
        lane_width: (B,) m, of the ego lane.
        num_boundaries: L.

    Returns:
        (B, D).
    """
    last = NUM_COMMON + num_boundaries
    own = shifted(mean[:, NUM_COMMON:last], shift)
    offset = mean[:, OFFSET : OFFSET + 1] + (shift * lane_width).unsqueeze(-1)
    return torch.cat(
        [mean[:, :OFFSET], offset, mean[:, OFFSET + 1 : NUM_COMMON], own, mean[:, last:]], dim=-1
    )


def shifted(values: Tensor, shift: Tensor) -> Tensor:
    """Shift values (B, ..., L) of each boundary by (B,) lanes, -1, 0 or 1; 0 comes in at the end."""
    number = constant(tuple(range(1, values.shape[-1] + 1)), like=values, dtype=torch.int64)  # padded
    source = (number + shift.long().unsqueeze(-1)).view(-1, *[1] * (values.ndim - 2), values.shape[-1])
    return pad(values, (1, 1)).gather(-1, source.expand_as(values))
