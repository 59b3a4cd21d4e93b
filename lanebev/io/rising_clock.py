"""Times of a source's frames that rise, whatever their stamps do."""

from fractions import Fraction
from typing import Generic, TypeVar

Seconds = TypeVar("Seconds", float, Fraction)

REORDERED = 16  # frames in which stamps may be out of order; if it takes longer, the clock was set back


class RisingClock(Generic[Seconds]):
    """Gives each frame a time that is later than that of the one before.

    A frame without a stamp, or whose stamp is too early, follows as it was recorded. After a clock that was
    set back the steps between stamps count again.

    Args:
        interval: s between frames that neither stamps nor recording tell apart.
        before: time and stamp of the frame before the first, s; None if there is none.

    Attributes:
        unstamped: number of frames without a stamp.
    """

    def __init__(self, interval: Seconds, before: Seconds | None = None) -> None:
        self.unstamped = 0
        self._interval: Seconds = interval
        self._time: Seconds | None = before
        self._stamp: Seconds | None = before
        self._recorded: Seconds | None = None
        self._offset: Seconds = interval - interval  # s, of times against stamps
        self._early = 0  # frames one after another whose stamps are too early
        self._rises = True

    def time(self, stamp: Seconds | None, recorded: Seconds) -> tuple[Seconds, str]:
        """Return the time of the next frame, s, and what is wrong with its stamp.

        Args:
            stamp: its own, s of any epoch; None if it has none.
            recorded: time of its recording, s of any epoch.
        """
        self.unstamped += stamp is None
        step = self._interval if self._recorded is None else recorded - self._recorded
        advance = None if stamp is None or self._stamp is None else stamp - self._stamp
        time = recorded if stamp is None else self._offset + stamp
        if self._time is None or (stamp is not None and time > self._time):
            self._early = 0
        else:
            self._early += stamp is not None
            is_set_back = self._early > REORDERED and advance is not None and advance > 0
            step = advance if is_set_back and advance else step
            time = self._time + (step if step > 0 else self._interval)
            self._offset = time - stamp if is_set_back and stamp is not None else self._offset
        did_rise, self._rises = self._rises, advance is None or advance > 0
        self._time, self._recorded = time, recorded
        self._stamp = self._stamp if stamp is None else stamp
        if self._rises or not did_rise or advance is None:  # it is said once, as long as it lasts
            return time, ""
        return time, f"expected a stamp later than the frame before, got {float(advance):.4g} s"
