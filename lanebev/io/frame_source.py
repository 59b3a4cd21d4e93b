"""Frames of a video or of images, iterated as often as wanted."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import islice
from typing import ParamSpec

import numpy as np
from numpy.typing import NDArray

from lanebev.io.frames import ALL, Frame, Selection, taken_frames
from lanebev.io.images.pixels import read_image
from lanebev.io.rising_clock import RisingClock
from lanebev.io.speeds import Speeds
from lanebev.io.video.decoding import rgb
from lanebev.io.video.seeking import open_at

P = ParamSpec("P")
DEFAULT_FPS = Fraction(30)


@dataclass(frozen=True)
class FrameSource:
    """A video or a list of images, iterated frame by frame, as often as wanted.

    Attributes:
        source: what the user gave.
        paths: the images in order; empty for a video.
        fps: nominal frame rate.
        count: number of frames; of a damaged video an estimate.
        image_size: (height, width) of the first frame that decodes; of images the most frequent one.
        problem: what is wrong with the whole of it, else empty.
        times: s since the first, of images whose names state them and of a video's frames by its packets;
            else empty.
        has_times: whether a video says when its frames are shown; else they are evenly spaced.
        pixel_aspect: width of a pixel over its height, as a video states it; frames are not resized by it.
        selection: which of the frames are taken. ``fps`` and ``count`` are those of the whole source.
        most: how many frames are yielded at most, so that a file that grows is the same twice; None for all.
        matrix: by which a video's frames are shown, see :func:`lanebev.io.video.decoding.display_matrix`.
        untimed: why a file of times beside images is not used, else empty.
        speeds: speeds of the vehicle, if they are given.
    """

    source: str
    paths: tuple[str, ...]
    fps: Fraction
    count: int
    image_size: tuple[int, int]
    problem: str = ""
    times: tuple[float, ...] = ()
    has_times: bool = True
    pixel_aspect: Fraction = Fraction(1)
    selection: Selection = ALL
    most: int | None = None
    matrix: tuple[int, ...] | None = None
    untimed: str = ""
    speeds: Speeds | None = field(default=None, compare=False)

    @property
    def is_live(self) -> bool:
        """Whether frames arrive in real time and only once, until the source is stopped."""
        return False

    @property
    def taken_numbers(self) -> list[int]:
        """Numbers of the frames that are taken; of a damaged video an estimate."""
        times = self.times or (float(index / self.fps) for index in range(self.count))
        return [number for number, time in enumerate(times) if self.selection.takes(number, time)]

    @property
    def taken_count(self) -> int:
        """Number of frames that are taken; of a damaged video an estimate."""
        return len(self.taken_numbers)

    @property
    def is_video(self) -> bool:
        """Whether the frames come out of one container."""
        return not self.paths

    @property
    def is_single(self) -> bool:
        """Whether it is one image given by its own path."""
        return len(self.paths) == 1 and self.paths[0] == self.source

    def __iter__(self) -> Iterator[Frame]:
        frames = self._video_frames() if self.is_video else self._image_frames()
        if (speeds := self.speeds) is not None:
            frames = (each._replace(speed=speeds.at(each.number, each.time)) for each in frames)
        taken = frames if self.selection == ALL else taken_frames(frames, self.selection)
        return taken if self.most is None else islice(taken, self.most)

    def _image_frames(self) -> Iterator[Frame]:
        for index, path in enumerate(self.paths):
            image, problem = None, ""
            time, dt = float(index / self.fps), float(1 / self.fps)
            if self.times:
                time, dt = self.times[index], self.times[index] - self.times[index - 1] if index else dt
            if self.selection.takes(index, time):
                image, problem = self._decoded(read_image, path)
            yield Frame(index, time, dt, path, image, problem)

    def _video_frames(self) -> Iterator[Frame]:
        damaged, reported = False, False  # since the last key frame
        with open_at(self.source, self.selection.start) as video:
            first, before, tick = video.first, video.before, video.stream.time_base
            clock = RisingClock(1 / self.fps, before)
            for index, (pts, frame) in enumerate(video.frames, start=video.number):
                timed = pts is not None and self.has_times
                time, _ = clock.time(pts * tick if timed else None, index / self.fps)
                first = time if first is None else first
                dt = float(1 / self.fps) if before is None else float(time - before)
                image, problem = None, ""
                if isinstance(frame, str) or frame.key_frame:
                    damaged, reported = isinstance(frame, str), False
                elif damaged and not reported:
                    problem = "up to the next key frame, images may show a lost frame's damage"
                    reported = True
                if self.selection.takes(index, float(time - first)):
                    image, fault = self._decoded(rgb, frame, self.matrix)
                    problem = fault or problem
                yield Frame(index, float(time - first), dt, "", image, problem)
                before = time

    def _decoded(
        self, decode: Callable[P, NDArray[np.uint8]], *args: P.args, **kwargs: P.kwargs
    ) -> tuple[NDArray[np.uint8] | None, str]:
        """Return the decoded image, or None and why there is none of the size of the other frames."""
        try:
            image = decode(*args, **kwargs)
        except ValueError as error:
            return None, str(error)
        (height, width), (rows, columns) = self.image_size, image.shape[:2]
        if (rows, columns) != (height, width):
            return None, f"expected {width} x {height} like the other frames, got {columns} x {rows}"
        return image, ""
