"""A frame of a source, and which of its frames are taken."""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Frame(NamedTuple):
    """One frame of a source.

    Attributes:
        number: 0, 1, ...
        time: s since the first frame.
        dt: s since the frame before; of the first, the source's nominal interval.
        name: the image's path as found, empty for a video.
        image: (H, W, 3) uint8 RGB, or None if it did not decode.
        problem: why not, or another remark on the frame; else empty.
        source_number: its number in the whole source, where only some of its frames are taken; else None.
        speed: speed of the vehicle, m/s; None if it is not known.
    """

    number: int
    time: float
    dt: float
    name: str
    image: NDArray[np.uint8] | None
    problem: str = ""
    source_number: int | None = None
    speed: float | None = None


class Selection(NamedTuple):
    """The frames of a source that are taken.

    Attributes:
        start: s since the source's first frame, of the first that is taken.
        end: s, before which the last one is.
        every: take only frames whose number in the source is a multiple of it.
    """

    start: float = 0.0
    end: float = math.inf
    every: int = 1

    def takes(self, number: int, time: float) -> bool:
        """Return whether a frame is taken, by its number and its time (s) in the source."""
        return self.start <= time < self.end and number % self.every == 0


ALL = Selection()


def taken_frames(frames: Iterable[Frame], selection: Selection) -> Iterator[Frame]:
    """Return the frames that are taken, with numbers from zero and times from the first."""
    number, first, before = 0, 0.0, 0.0
    for frame in frames:
        if frame.time >= selection.end:
            return
        if selection.takes(frame.number, frame.time):
            first = frame.time if number == 0 else first
            dt = frame.time - before if number else frame.dt * selection.every
            yield frame._replace(number=number, time=frame.time - first, dt=dt, source_number=frame.number)
            number, before = number + 1, frame.time
