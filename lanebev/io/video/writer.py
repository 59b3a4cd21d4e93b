"""H.264 output for browsers."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

_TICK = Fraction(1, 90_000)  # s, of what is written
_LONGEST = Fraction(3600)  # s; MP4 has 2**31 ticks at most between two frames


class VideoWriter:
    """H.264, yuv420p, the index in front: plays in browsers. Frames are padded to even sides.

    Use as a context manager; the file is whole only after it closes.

    Args:
        path: the file.
        fps: frames per second.
        crf: x264's quality, less is better.
    """

    def __init__(self, path: str | Path, fps: Fraction, crf: int = 21) -> None:
        self._container = av.open(os.path.abspath(path), "w", options={"movflags": "faststart"})
        self._stream = self._container.add_stream("libx264", rate=fps.limit_denominator(65535))
        self._stream.pix_fmt = "yuv420p"
        self._stream.codec_context.time_base = _TICK
        self._interval, self._next, self._left_out = 1 / fps, Fraction(0), Fraction(0)
        self._stream.options = {"crf": str(crf), "preset": "ultrafast", "bf": "0"}  # else a late gap is cut

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if error is None:
            for packet in self._stream.encode():
                self._container.mux(packet)
        self._container.close()

    def write(self, image: NDArray[np.uint8], time: float | None = None) -> None:
        """Write (H, W, 3) uint8 RGB, always of one size, shown at ``time`` s or a frame after the last.

        The part of a pause beyond an hour is left out.
        """
        height, width = image.shape[:2]
        if height % 2 or width % 2:
            image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        if not self._stream.codec_context.is_open:
            self._stream.height, self._stream.width = image.shape[:2]
        frame = av.VideoFrame.from_ndarray(cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420), format="yuv420p")
        wanted = self._next if time is None else Fraction(time) - self._left_out
        shown = min(max(wanted, self._next - self._interval + _TICK), self._next + _LONGEST)
        self._left_out += max(wanted - shown, Fraction(0))
        frame.pts, frame.time_base = round(shown / _TICK), _TICK
        self._next = shown + self._interval
        for packet in self._stream.encode(frame):
            self._container.mux(packet)
