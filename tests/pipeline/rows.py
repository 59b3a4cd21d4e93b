"""Rows that tests of several stages begin with, and derivatives of functions of them."""

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


def slopes(along, size):
    """Derivatives at 0 of a function of one number, by autograd and by central differences of this size."""
    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    values = along(step)
    analytic = [torch.autograd.grad(each, step, retain_graph=True)[0] for each in values.flatten()]
    with torch.no_grad():
        ahead, behind = (along(torch.tensor(sign * size, dtype=torch.float64)) for sign in (1, -1))
    return torch.stack(analytic).view_as(values), (ahead - behind) / (2 * size)
