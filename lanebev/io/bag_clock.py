"""Times of a bag's images, by their own stamps and by when they were recorded."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class BagClock:
    """Gives each image of a bag a time that is later than that of the one before.

    An image without a stamp, or whose stamp is not later than the one before, follows as it was recorded.
    After a clock that was set back the steps between stamps count.

    Attributes:
        interval: s between images that neither stamps nor recording tell apart.
        unstamped: number of images without a stamp.
    """

    interval: float
    unstamped: int = 0
    _time: float | None = None
    _stamp: float | None = None  # the latest
    _logged: float = 0.0
    _offset: float = 0.0  # s, of times against stamps
    _is_behind: bool = False

    def time(self, stamp: float | None, logged: float) -> tuple[float, str]:
        """Return the time of the next image, s of any epoch, and what is wrong with its stamp.

        Args:
            stamp: its own, s; None if it has none.
            logged: time of its recording, s.
        """
        before, recorded = self._time, logged - self._logged
        advance = None if stamp is None or self._stamp is None else stamp - self._stamp
        time = logged if stamp is None else self._offset + stamp
        if before is not None and (stamp is None or time <= before):
            time = before + next(step for step in (advance or 0.0, recorded, self.interval) if step > 0)
            if stamp is not None and (advance is None or advance > 0):
                self._offset = time - stamp
        was_behind, self._is_behind = self._is_behind, advance is not None and advance <= 0
        self._time, self._logged = time, logged
        self._stamp = self._stamp if stamp is None else stamp
        self.unstamped += stamp is None
        if not self._is_behind or was_behind:  # once, as long as it lasts
            return time, ""
        return time, f"expected a stamp later than the frame before, got {advance:.4g} s"
