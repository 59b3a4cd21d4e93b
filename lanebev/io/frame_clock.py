"""Time steps between the frames of a live source, by their stamps."""

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from lanebev.numbers import check_number

logger = logging.getLogger(__name__)

FIRST_DT = 1 / 30  # s before a first frame: it has no frame before
_SHORT_DT, _LONG_DT = (
    1e-3 / 1.5,
    5.0,
)  # s; if all steps are shorter or longer, the stamps are probably not seconds
_LOOKED_AT = 5  # number of steps that are checked for that


@dataclass
class FrameClock:
    """Time steps by stamps.

    Attributes:
        stamp: of the last frame, s of any epoch; None before the first one.
        steps: s, the latest time steps.
        is_doubted: whether a warning of missing stamps was logged.
    """

    stamp: float | None = None
    steps: list[float] = field(default_factory=list)
    is_doubted: bool = False

    def values(self) -> dict[str, Any]:
        """Return the attributes by name, for a file."""
        return asdict(self)

    def step(self, stamp: float | None) -> tuple[float, list[str]]:
        """Return the time since the frame before (s), and what is doubtful about it.

        Args:
            stamp: of this frame, s; None assumes the time step of the frame before.
        """
        if stamp is None:
            if self.stamp is None and not self.is_doubted:
                logger.warning("no time stamps are given: frames are assumed to be 1/30 s apart")
                self.is_doubted = True
            return (self.steps[-1] if self.steps else FIRST_DT), []
        check_number("stamp", stamp, "seconds as a number")
        if not math.isfinite(stamp):
            raise ValueError(f"stamp: expected finite seconds, got {stamp}")
        before, self.stamp = self.stamp, float(stamp)
        if before is None:
            return FIRST_DT, []
        dt = self.stamp - before
        if dt <= 0:
            return dt, [f"the time stamp does not advance: {dt:g} s after the frame before"]
        was_odd, self.steps = _are_odd(self.steps), [*self.steps[-_LOOKED_AT + 1 :], dt]
        if not _are_odd(self.steps):
            return dt, []
        units = "minutes or days" if dt < 1 else "milli- or nanoseconds"
        remark = f"time stamps advance by {dt:g} a frame: expected seconds, got {units}?"
        if not was_odd:  # once, as long as it lasts
            logger.warning(remark)
        return dt, [remark]


def _are_odd(steps: Sequence[float]) -> bool:
    """Return whether all of some time steps (s) are shorter, or all longer, than those of a camera."""
    return len(steps) == _LOOKED_AT and (max(steps) < _SHORT_DT or min(steps) > _LONG_DT)
