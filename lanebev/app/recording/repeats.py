"""Frames that show the image before them again, as in videos that were converted to a higher frame rate.

Their errors are those of the frame before. The motion stops in them and is twice as large in the next frame.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lanebev.app.recording.storage import StoredNumbers
from lanebev.io.frozen_images import FROZEN, STRIDE, ImageChanges

_NEAR = 2  # frames before and after, among which the largest change is that of the drive
_MOVING = 1.0  # grey levels of 255 on average, of a change that counts
_REPEATED = 0.2  # a frame repeats if it changes by less of the largest change near by; codecs cause 0.1
_MOST_SHARE, _MOST_COUNT = 0.1, 4  # fraction and number of frames; more repeated frames are reported


def repeated(changes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which frames repeat the one before: they change far less than frames near by.

    Args:
        changes: (N,) mean absolute difference from the frame before, grey levels; NaN where there is none.

    Returns:
        (N,).
    """
    padded = np.pad(np.nan_to_num(changes), _NEAR)
    largest = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEAR + 1).max(-1)
    found: NDArray[np.bool_] = (largest > _MOVING) & (changes < _REPEATED * largest)
    return found


class RepeatedFrames:
    """Counts the repeated frames of a drive.

    Args:
        folder: where a number for each frame is kept on disk; None keeps them in memory.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._between, self._changes = ImageChanges(), StoredNumbers(folder=folder)

    def add(self, image: NDArray[np.uint8] | None) -> None:
        """Take the next frame (H, W, 3), None if it was lost."""
        self._changes.append(
            np.array(self._between.add(None if image is None else image[::STRIDE, ::STRIDE]))
        )

    def remark(self) -> str:
        """Return a remark on the drive; empty if few frames are repeated."""
        changes = self._changes.all()
        count = int(repeated(changes).sum()) if len(changes) else 0
        many = max(_MOST_COUNT, _MOST_SHARE * len(changes))
        frozen = int((changes < FROZEN).sum())
        if count <= many < frozen:
            return (
                f"{frozen} of {len(changes)} frames show the image of the one before: is the video frozen?"
                " standard deviations become too small in them, since their errors are the same"
            )
        if count <= many:
            return ""
        return (
            f"{count} of {len(changes)} frames repeat the one before: the motion stops in them and is larger"
            " in the next; leave them out, as by ffmpeg -vf mpdecimate, or --every 2 if they are every second"
        )
