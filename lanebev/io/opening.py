"""Open a video, a folder, a glob or one image as a source of frames."""

import contextlib
import glob
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from statistics import median
from typing import NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from lanebev.io.frame_source import DEFAULT_FPS, FrameSource
from lanebev.io.images.files import (
    HEIC,
    endings_remedy,
    folder_remedy,
    glob_pattern,
    images_of,
    left_out_remark,
)
from lanebev.io.images.names import in_natural_order, times_from_names
from lanebev.io.images.pixels import dark_remark, is_image, read_image, stated_size
from lanebev.io.images.time_files import times_from_file
from lanebev.io.side_by_side import halves_remark
from lanebev.io.source_names import SCHEMES
from lanebev.io.video.decoding import (
    declared_duration,
    decoded,
    display_matrix,
    has_times,
    open_video,
    packets,
    pixel_aspect,
    rgb,
    video_stream,
)
from lanebev.io.video.remarks import (
    LONGEST_STEP,
    appended_remark,
    gap_remark,
    missing_remark,
    restart_remark,
    stream_remarks,
)

_LOOKED_AT = 20  # images, for the most frequent size and one that has it
_SAME_RATE = 0.05  # relative, by which two frame rates may differ and be the same
_SAME_VIDEO = 2  # factor, by which a video's frames may come faster or slower than its mean rate
_HIDING = ("vp8", "libvpx")  # codecs with frames that are decoded and not shown, in packets of their own


def open_source(source: str, fps: Fraction | None = None) -> FrameSource:
    """Open what the user gave as a source of frames, and check that a frame of it decodes.

    Args:
        source: a video, a folder of images, a glob (recursive with ``**``) or one image.
        fps: frame rate of a folder, a glob or a raw stream. None is that of images whose names state their
            times, of a raw stream what it says or ffmpeg guesses, else 30. A video states its own.

    Raises:
        ValueError: nothing there, no images in it, or the only (or every) image does not decode.
    """
    path = Path(source)
    if path.is_dir():
        paths = in_natural_order(images_of(source))
        if not paths:
            raise ValueError(f"{source}: expected images in the folder, got none; {folder_remedy(path)}")
        return _image_source(source, paths, fps, left_out_remark(path))
    if path.suffix.lower() in HEIC:
        raise ValueError(f"{source}: expected a video or an image, got HEIC; convert it to JPEG")
    if path.is_file():
        return _image_source(source, [source], fps) if is_image(path) else _video_source(source, fps)
    if glob.has_magic(source):
        paths = in_natural_order(images_of(source))
        if not paths:
            matches = glob.glob(glob_pattern(source), recursive=True)
            remedy = endings_remedy(map(Path, matches)) or "quote the pattern"
            raise ValueError(f"{source}: expected images that match, got none; {remedy}")
        return _image_source(source, paths, fps)
    raise ValueError(
        f"{source}: expected a video, an image, a folder or a glob of images, got nothing there"
        f"{_address_remedy(source)}"
    )


def _address_remedy(source: str) -> str:
    if re.search(r"%\d*d", source):
        return "; give the folder, or a quoted glob with * for the number"
    if source.startswith("file:"):
        return "; give the path without file://"
    if re.fullmatch(r"\d", source):
        return f"; a camera is given as /dev/video{source}"
    return f"; streams are {', '.join(SCHEMES)}; download other addresses first" if "://" in source else ""


def _image_source(source: str, paths: Sequence[str], fps: Fraction | None, left_out: str = "") -> FrameSource:
    image = _typical_image(paths)
    size, times, stated, unused = image.shape[:2], times_from_names(paths), "its names state", ""
    if not times:
        (times, unused), stated = times_from_file(paths), "a file of times beside it states"
    remarks = [left_out, dark_remark(image), halves_remark(image)]
    rate = fps or DEFAULT_FPS
    if times:
        own = 1 / Fraction(median(np.diff(times).tolist())).limit_denominator(1_000_000)
        times, rate = (times, own) if fps is None else ((), fps)
        if abs(own / rate - 1) > _SAME_RATE:
            remarks.append(f"{stated} {float(own):.4g} frames per second, --fps {float(rate):g} was given")
    said = "; ".join(filter(None, remarks))
    problem = f"{source}: {said}" if said else ""
    untimed = "" if fps else unused
    return FrameSource(source, tuple(paths), rate, len(paths), size, problem, times, untimed=untimed)


def _typical_image(paths: Sequence[str]) -> NDArray[np.uint8]:
    """Return the first whole image whose size is the most frequent one of the first images.

    Where none of these is whole, it is the first whole image of any size.
    """
    sizes = Counter(filter(None, map(stated_size, paths[:_LOOKED_AT])))
    usual = sizes.most_common(1)[0][0] if sizes else None
    found, problem = None, ""
    for number, path in enumerate(paths):
        if found is not None and number >= _LOOKED_AT:
            break
        try:
            image = read_image(path)
        except ValueError as error:
            problem = problem or str(error)
            continue
        if usual in (None, image.shape[:2]):
            return image
        found = image if found is None else found
    if found is None:
        raise ValueError(problem)
    return found


class _Survey(NamedTuple):
    """What the packets of a video say.

    Attributes:
        shown: times, ticks, of the frames that are shown, in the order of their packets.
        tick: s, unit of the times.
        end: s since the video's begin, at which its last frame ends.
        declared: s, as the header says it.
        is_edited: whether an edit list leaves out frames.
        is_complete: whether the packets tell which frames are shown.
        problems: remarks on them.
    """

    shown: list[int]
    tick: Fraction
    end: float
    declared: float
    is_edited: bool
    is_complete: bool
    problems: list[str]


def _video_source(source: str, stated: Fraction | None) -> FrameSource:
    """Open a video as a source: a first frame says what it shows, its packets how many there are and when."""
    with open_video(source) as container:
        stream = video_stream(container)
        timed = has_times(container)
        own = Fraction((timed and stream.average_rate) or stream.guessed_rate or DEFAULT_FPS)
        states_rate = container.format.name != "mpegts"  # of whose times ffmpeg guesses it
        fps = own if timed else stated or own
        lost, first, frame = _first_whole(source, decoded(container, stream))
        matrix = display_matrix(frame)
        image = rgb(frame, matrix)
        size = image.shape[:2]
        aspect = pixel_aspect(stream, frame, size)
        problems = [*filter(None, stream_remarks(container, frame, image))]
    found = _survey(source, lost, first, fps)
    count = len(found.shown)
    if not found.is_complete:
        with open_video(source) as container:
            count = sum(1 for _ in decoded(container, video_stream(container)))
    problems += found.problems
    if timed and (rate := _rate_of_times(found.shown, found.tick, own)) != own:
        words = f"it states {float(own):.4g} frames per second, they come at {float(rate):.4g}"
        problems += [words] if states_rate else []
        fps = own = rate
    problems += filter(None, [_length_remark(found, fps) if timed else "", _rate_remark(timed, own, stated)])
    problem = f"video {source}: {'; '.join(problems)}" if problems else ""
    times = _times_since_first(found.shown, found.tick, fps) if timed and found.is_complete else ()
    return FrameSource(source, (), fps, count, size, problem, times, timed, aspect, matrix=matrix)


def _survey(source: str, lost: Sequence[int], first: int | None, fps: Fraction) -> _Survey:
    """Read the packets of a video; the header's count includes frames that an edit list cuts.

    Args:
        source: path of the video.
        lost: times, ticks, of frames before the first whole one.
        first: time, ticks, of the first whole frame; what precedes it is not shown: it lacks a key frame.
        fps: frame rate, for the last frame's duration where no packet states one.
    """
    with open_video(source) as container:
        stream = video_stream(container)
        begin, tick = stream.start_time or 0, stream.time_base or 1 / fps
        end, is_edited, read = Fraction(0), False, 0
        shown = [pts for pts in lost if first is not None and pts < first]
        is_complete = stream.codec_context.name not in _HIDING
        keys: list[tuple[int, float]] = []
        latest, early, most_early = -math.inf, 0, 0
        for packet in packets(container, stream):
            is_complete = is_complete and (packet.pts is not None or not packet.size)
            read = max(read, (packet.pos or 0) + packet.size)
            if packet.pts is not None:
                keys += [(packet.pts, latest)] if packet.is_keyframe else []
                early = early + 1 if packet.pts < latest else 0
                latest, most_early = max(latest, packet.pts), max(most_early, early)
                is_edited = is_edited or packet.is_discard
                if not packet.is_discard and (first is None or packet.pts >= first):
                    shown.append(packet.pts)
                end = max(end, packet.pts - begin + max(packet.duration or 0, 1 / fps / tick))
        declared, appended = declared_duration(stream), appended_remark(container, read)
    restart = restart_remark(keys, most_early)
    gaps = gap_remark(shown, tick) or missing_remark(container.format.name, shown)
    problems = [*filter(None, (appended, restart, gaps))]
    return _Survey(shown, tick, float(end * tick), declared, is_edited, is_complete and not restart, problems)


def _length_remark(found: _Survey, fps: Fraction) -> str:
    """Return a remark on a video that is shorter than it declares; else nothing."""
    spare = (1.5 if found.is_edited else 0.5) / fps  # an edit list may begin within a frame
    if found.declared - found.end <= spare:
        return ""
    return f"expected {found.declared:.2f} s as it declares, got {found.end:.2f} s; is it cut?"


def _rate_remark(timed: bool, own: Fraction, stated: Fraction | None) -> str:
    """Return a remark on a frame rate that is assumed, or given and not used; else nothing.

    Args:
        timed: whether the video says when its frames are shown.
        own: its frame rate.
        stated: the frame rate that the user gave.
    """
    if not timed:
        return (
            ""
            if stated
            else f"it has no times, and is taken for {float(own):g} frames per second; state --fps"
        )
    if stated is None or abs(own / stated - 1) <= _SAME_RATE:
        return ""
    return f"its own {float(own):.4g} frames per second are used, not --fps {float(stated):g}"


def _first_whole(
    source: str, frames: Iterable[tuple[int | None, av.VideoFrame | str]]
) -> tuple[list[int], int | None, av.VideoFrame]:
    """Return the times (ticks) of the frames lost before the first whole one, its own, and that frame."""
    lost: list[int] = []
    with contextlib.suppress(av.error.FFmpegError):
        for pts, frame in frames:
            if isinstance(frame, av.VideoFrame):
                return lost, pts, frame
            lost += [] if pts is None else [pts]
    raise ValueError(f"video {source}: expected at least one whole frame, got none")


def _times_since_first(shown: Sequence[int], tick: Fraction, fps: Fraction) -> tuple[float, ...]:
    """Return the times of frames, s since the first, by those of their packets (ticks) in any order.

    A frame that is not later than the one before is taken for the next by the frame rate.
    """
    times: list[Fraction] = []
    for pts in sorted(shown):
        time = pts * tick
        times.append(time if not times or time > times[-1] else times[-1] + 1 / fps)
    return tuple(float(time - times[0]) for time in times)


def _rate_of_times(times: Sequence[int], tick: Fraction, stated: Fraction) -> Fraction:
    """Return the stated frame rate, or that of the times (ticks) where it is near neither mean nor median.

    Steps longer than ``LONGEST_STEP``, which are pauses of the recording, do not count.
    """
    steps = np.diff(np.unique(times))
    steps = steps[steps * float(tick) <= LONGEST_STEP]
    if not len(steps):
        return stated
    median_rate, mean_rate = (1 / Fraction(float(of(steps))) / tick for of in (np.median, np.mean))
    near = any(1 / _SAME_VIDEO < rate / stated < _SAME_VIDEO for rate in (median_rate, mean_rate))
    return stated if near else median_rate.limit_denominator(1000)
