"""Rows that tests of several stages begin with."""

import torch

from lanebev import Status
from lanebev.testing.segments import INTRINSICS as K
from lanebev.testing.segments import lanes, stack_rows


def started(calibrator):
    """A state after two frames, but that of the last row, which is lost."""
    state = calibrator.initial_state(4, dtype=torch.float64)
    for seed in range(2):
        frame = stack_rows(*(lanes(seed=seed + 10 * row) for row in range(4)))
        _, state = calibrator(frame, K.expand(4, 3, 3), state, 1 / 30)
    lost = torch.tensor([Status.TRACKING, Status.TRACKING, Status.TRACKING, Status.LOST])
    return state._replace(status=lost).detach()
