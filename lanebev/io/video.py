"""Frames in from a video, a folder, a glob or one image; H.264 that browsers play out."""

from __future__ import annotations

import bisect
import glob
import os
import re
import struct
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import av
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm")
DEFAULT_FPS = Fraction(30)


class Frame(NamedTuple):
    """One frame of a source.

    Attributes:
        number: 0, 1, ...
        time: s since the first frame.
        dt: s since the frame before; of the first, the source's nominal interval.
        name: the image's path as found, empty for a video.
        image: (H, W, 3) uint8 RGB, or None if it did not decode.
        problem: why not, else empty.
    """

    number: int
    time: float
    dt: float
    name: str
    image: NDArray[np.uint8] | None
    problem: str = ""


@dataclass(frozen=True)
class FrameSource:
    """A video or a list of images, iterated frame by frame, as often as wanted.

    Attributes:
        source: what the user gave.
        paths: the images in order; empty for a video.
        fps: nominal frame rate.
        count: number of frames; of a damaged video an estimate.
        image_size: (height, width) of the first frame that decodes.
        problem: what is wrong with the whole of it, else empty.
    """

    source: str
    paths: tuple[str, ...]
    fps: Fraction
    count: int
    image_size: tuple[int, int]
    problem: str = ""

    @property
    def is_video(self) -> bool:
        """Whether the frames come out of one container."""
        return not self.paths

    @property
    def is_single(self) -> bool:
        """Whether it is one image given by its own path."""
        return len(self.paths) == 1 and self.paths[0] == self.source

    def __iter__(self) -> Iterator[Frame]:
        return self._video_frames() if self.is_video else self._image_frames()

    def _image_frames(self) -> Iterator[Frame]:
        for index, path in enumerate(self.paths):
            image, problem = None, ""
            try:
                image = self._right_size(read_image(path))
            except ValueError as error:
                problem = str(error)
            yield Frame(index, float(index / self.fps), float(1 / self.fps), path, image, problem)

    def _video_frames(self) -> Iterator[Frame]:
        first, before = None, None
        with _open_video(self.source) as container:
            stream = container.streams.video[0]
            for index, (pts, decoded) in enumerate(_decoded(container, stream)):
                time = (first or 0) + index / self.fps if pts is None else pts * stream.time_base
                if before is not None and time <= before:  # AVI has no times of display
                    time = before + 1 / self.fps
                first = time if first is None else first
                dt = float(1 / self.fps) if before is None else float(time - before)
                image, problem = None, ""
                try:
                    image = self._right_size(_rgb(decoded))
                except ValueError as error:
                    problem = str(error)
                yield Frame(index, float(time - first), dt, "", image, problem)
                before = time

    def _right_size(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if image.shape[:2] != self.image_size:
            height, width = self.image_size
            got = f"{image.shape[1]} x {image.shape[0]}"
            raise ValueError(f"expected {width} x {height} like the first frame, got {got}")
        return image


def open_source(source: str, fps: Fraction = DEFAULT_FPS) -> FrameSource:
    """Look at what the user gave and check that a frame of it decodes.

    Args:
        source: a video, a folder of images, a glob (recursive with ``**``) or one image.
        fps: frame rate of a folder or glob; a video knows its own.

    Raises:
        ValueError: nothing there, no images in it, or the only (or every) image does not decode.
    """
    path = Path(source)
    if path.is_dir():
        there = (p for p in path.iterdir() if _is_image(p) and p.name[0] != ".")  # macOS leaves ._ files
        paths = sorted(map(str, there), key=natural_order)
        if not paths:
            raise ValueError(
                f"{source}: expected images in the folder, got none; for those in folders below it give "
                f"a quoted glob such as '{path}/**/*.jpg'"
            )
        return _image_source(source, paths, fps)
    if path.is_file():
        return _image_source(source, [source], fps) if _is_image(path) else _video_source(source)
    if glob.has_magic(source):
        paths = sorted(filter(_is_image, glob.glob(source, recursive=True)), key=natural_order)
        if not paths:
            raise ValueError(f"{source}: expected images that match, got none; quote the pattern")
        return _image_source(source, paths, fps)
    raise ValueError(f"{source}: expected a video, an image, a folder or a glob of images, got nothing there")


def read_image(path: str | Path) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB, upright by its EXIF orientation, as viewers and OpenCV show it.

    A file that is cut is an error, not an image with a grey half.

    Raises:
        ValueError: the file is missing, cut or no image.
    """
    try:
        with warnings.catch_warnings(), Image.open(path) as image:
            warnings.simplefilter("ignore")  # of odd EXIF; errors are errors
            return np.asarray(_eight_bit(_upright(image)).convert("RGB"))
    except (OSError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        if isinstance(error, UnidentifiedImageError):
            reason = "no image or one whose header is cut"
        else:
            reason = (getattr(error, "strerror", None) or str(error)).splitlines()[0].lower()
        raise ValueError(f"image {path}: expected a whole image, got: {reason}") from error


def image_size(path: str | Path) -> tuple[int, int] | None:
    """(height, width) of an image, None if it does not decode."""
    try:
        height, width = read_image(path).shape[:2]
    except ValueError:
        return None
    return height, width


def write_png(path: str | Path, image: NDArray[np.uint8]) -> None:
    """(H, W, 3) uint8 RGB to a PNG."""
    Image.fromarray(image).save(path)


def natural_order(path: str) -> list[tuple[int, int, str]]:
    """Sort key with numbers by value: 2.jpg before 10.jpg."""
    return [(0, int(part), part) if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", path)]


_HIDING = ("vp8", "libvpx")  # codecs with frames that are decoded and not shown, in packets of their own


_TICK = Fraction(1, 90_000)  # s, of what is written


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
        self._interval, self._next = 1 / fps, Fraction(0)
        self._stream.options = {"crf": str(crf), "preset": "veryfast", "bf": "0"}  # else a late gap is cut

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            for packet in self._stream.encode():
                self._container.mux(packet)
        self._container.close()

    def write(self, image: NDArray[np.uint8], time: float | None = None) -> None:
        """(H, W, 3) uint8 RGB, the same size every time; shown at ``time`` s, or a frame after the last."""
        height, width = image.shape[:2]
        if height % 2 or width % 2:
            image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        if not self._stream.codec_context.is_open:
            self._stream.height, self._stream.width = image.shape[:2]
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        shown = self._next if time is None else max(Fraction(time), self._next - self._interval + _TICK)
        frame.pts, frame.time_base = round(shown / _TICK), _TICK
        self._next = shown + self._interval
        for packet in self._stream.encode(frame):
            self._container.mux(packet)


def _is_image(path: str | Path) -> bool:
    return Path(path).suffix.lower() in IMAGE_SUFFIXES and Path(path).is_file()


def _upright(image: Image.Image) -> Image.Image:
    try:
        turned = image.getexif().get(ExifTags.Base.Orientation, 1) != 1
    except (SyntaxError, struct.error, ValueError, KeyError, TypeError):  # of odd EXIF
        turned = False
    return ImageOps.exif_transpose(image) if turned else image


def _eight_bit(image: Image.Image) -> Image.Image:
    """16-bit grey at its own scale; ``convert`` would cut it off at 255.

    Raises:
        OSError: of floating point, whose scale nobody says.
    """
    if image.mode == "F":
        raise OSError("floating point, expected 8 or 16 bits")
    if not image.mode.startswith("I"):
        return image
    return Image.fromarray((np.asarray(image).clip(0, 65535) / 257).round().astype(np.uint8))


def _image_source(source: str, paths: Sequence[str], fps: Fraction) -> FrameSource:
    problem = ""
    for path in paths:
        try:
            return FrameSource(source, tuple(paths), fps, len(paths), read_image(path).shape[:2])
        except ValueError as error:
            problem = problem or str(error)
    raise ValueError(problem)


def _video_source(source: str) -> FrameSource:
    with _open_video(source) as container:
        stream = container.streams.video[0]
        fps = Fraction(stream.average_rate or stream.guessed_rate or DEFAULT_FPS)
        frames = (frame for _, frame in _decoded(container, stream) if not isinstance(frame, str))
        try:
            frame = next(frames)
        except (av.error.FFmpegError, StopIteration) as error:
            raise ValueError(f"video {source}: expected at least one whole frame, got none") from error
        size = _rgb(frame).shape[:2]
    with _open_video(source) as container:  # the header's count includes frames that an edit list cuts
        stream = container.streams.video[0]
        begin, tick = stream.start_time or 0, stream.time_base or 1 / fps
        count, end = 0, Fraction(0)
        telling = stream.codec_context.name not in _HIDING
        for packet in container.demux(stream):
            telling = telling and (packet.pts is not None or not packet.size)
            if packet.pts is not None:
                count += not packet.is_discard
                end = max(end, packet.pts - begin + max(packet.duration or 0, 1 / fps / tick))
        declared, got = _declared_duration(stream, begin * tick), float(end * tick)
    if not telling:
        with _open_video(source) as container:
            count = sum(1 for _ in _decoded(container, container.streams.video[0]))
    cut = declared - got > 0.5 / fps
    problem = f"video {source}: expected {declared:.2f} s as it declares, got {got:.2f} s; is it cut?"
    return FrameSource(source, (), fps, count, size, problem if cut else "")


def _declared_duration(stream: av.VideoStream, begin: Fraction) -> float:
    """How long the header says that the stream is, s; 0 if it does not. Matroska has its end, in a tag."""
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    match = re.fullmatch(r"(\d+):(\d\d):(\d\d(?:\.\d+)?)", stream.metadata.get("DURATION", ""))
    if match is None:
        return 0.0
    hours, minutes, seconds = map(float, match.groups())
    return 3600 * hours + 60 * minutes + seconds - float(begin)


def _decoded(
    container: av.container.InputContainer, stream: av.VideoStream
) -> Iterator[tuple[int | None, av.VideoFrame | str]]:
    """Frames as they are shown, with the times that the file gives; of a lost one, what was got instead.

    A packet whose frame does not come is lost if the file is damaged up to there; in a sound one it shows
    nothing. No frame threads: they drop what follows the last error.
    """
    due: list[int] = []  # times of packets whose frames have not come
    damage = ""
    for packet in container.demux(stream):
        if packet.pts is not None and not packet.is_discard:
            bisect.insort(due, packet.pts)
        if packet.is_corrupt:
            damage = damage or "a damaged one"
        frames: Sequence[av.VideoFrame] = ()
        try:
            frames = packet.decode()
        except av.error.FFmpegError as error:  # one frame lost, the next may be whole
            damage = error.strerror
            if packet.pts is None and packet.size:
                yield None, damage
        for frame in frames:
            while due and frame.pts is not None and due[0] <= frame.pts:
                if (pts := due.pop(0)) < frame.pts and damage:
                    yield pts, damage
            yield frame.pts, frame
    if damage:
        yield from ((pts, damage) for pts in due)


def _rgb(decoded: av.VideoFrame | str) -> NDArray[np.uint8]:
    """Upright, by the container's display matrix, as players and OpenCV show it."""
    if isinstance(decoded, str):
        raise ValueError(f"expected a whole frame, got: {decoded}")
    image: NDArray[np.uint8] = decoded.to_ndarray(format="rgb24")
    return np.ascontiguousarray(np.rot90(image, round(decoded.rotation / 90)))


def _open_video(source: str) -> av.container.InputContainer:
    try:
        container = av.open(os.path.abspath(source))  # else what precedes a colon is taken for a protocol
    except (av.error.FFmpegError, OSError) as error:
        reason = error.strerror or "unknown format"
        raise ValueError(f"video {source}: expected a video that opens, got: {reason}; is it cut?") from error
    if not container.streams.video:
        container.close()
        raise ValueError(f"video {source}: expected a video stream, got none")
    return container
