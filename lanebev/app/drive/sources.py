"""Open the source of a run from its settings, and end a stream."""

import contextlib
import math
import re
import signal
from collections.abc import Generator, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import FrameType

import numpy as np
from numpy.typing import NDArray

from lanebev.app.concurrency import map_ahead, prefetch
from lanebev.app.config import RunConfig, rate_as_fraction
from lanebev.app.drive.build import make_camera
from lanebev.app.drive.observers import Observation, Observer
from lanebev.camera.model import Camera
from lanebev.io.bags import BagSource, bag_speeds, open_bag_source
from lanebev.io.frame_source import FrameSource
from lanebev.io.frames import ALL, Frame, Selection
from lanebev.io.images.names import drives_remark, jump_remark, untimed_remark
from lanebev.io.live import LiveSource, open_live
from lanebev.io.opening import open_source
from lanebev.io.source_names import is_bag, is_live, without_login
from lanebev.io.speeds import Speeds, fast_remark, read_speeds
from lanebev.report.run_folder import RunFolder
from lanebev.signals import handlers_kept

_RECTIFIED = re.compile(r"(?:^|[/_])rect(?:ified)?(?:[/_]|$)")  # in topics of ROS's image_proc, which P is of
_MOST_WITHOUT = 0.5  # fraction of the frames, that may be without speed
_SHORT_STEP, _LONG_STEP = Fraction(1, 1500), 5  # s between frames of a drive


def make_source(config: RunConfig, may_take_none: bool = False) -> FrameSource:
    """Open the source, with the frames that the settings take.

    Args:
        config: the settings.
        may_take_none: whether they may take no frame, as a part of a drive that lies in a gap.

    Raises:
        ValueError: nothing there, nothing that decodes, no frame that is taken, or a setting that a stream
            cannot have.
    """
    selection = Selection(config.start, math.inf if config.end is None else config.end, config.every)
    if is_live(config.source):
        return _stream(config, selection)
    found = _opened(config.source, config.topic, config.frame_rate)
    remarks = [] if config.stills else [each for each in _remarks_on_drive(config, found) if each]
    speeds = _speeds(config, found)
    said = [found.problem, *(f"{config.source}: {each}" for each in remarks), _speeds_remark(speeds, found)]
    source = replace(found, selection=selection, problem="; ".join(filter(None, said)), speeds=speeds)
    if selection != ALL and not may_take_none and not source.taken_count:
        last = source.times[-1] if source.times else float(source.count / source.fps)
        raise ValueError(
            f"start, end, every: expected some of the {source.count} frames to be taken, got none; "
            f"{config.source} is {last:.2f} s long"
        )
    return source


def _stream(config: RunConfig, selection: Selection) -> FrameSource:
    for name in ("lanes", "stills", "smooth", "topic", "speed", "speed_topic"):
        if getattr(config, name):
            shown = without_login(config.source)
            option = name.replace("_", "-")
            raise ValueError(f"source {shown}: expected no --{option} with a stream, got it; leave it out")
    return open_live(config.source, config.frame_rate, config.keep_all, selection)


def _remarks_on_drive(config: RunConfig, found: FrameSource) -> Iterator[str]:
    """Yield remarks, some of them empty, on the times of frames and on images of several drives."""
    step = config.every / found.fps
    if found.count > 1 and not _SHORT_STEP <= step <= _LONG_STEP:
        remedy = "give --fps" if found.paths else "give its frames as images, and --fps"
        remedy = "correct --fps" if found.fps == config.frame_rate else remedy
        remedy = "if so, use --stills" if step > 1 else f"if not, {remedy}"
        yield f"its frames are {float(step):.3g} s apart; is the frame rate right? {remedy}"
    if not found.paths:
        return
    yield found.untimed
    yield drives_remark(found.paths) or ("" if found.times else jump_remark(found.paths))
    if found.count > 1 and not (found.times or config.frame_rate):
        why, remedy = untimed_remark(found.paths)
        yield f"{why}, {float(found.fps):g} frames per second are assumed; {remedy}"


def _opened(source: str, topic: str | None, fps: Fraction | None) -> FrameSource:
    if is_bag(source):
        return open_bag_source(source, topic, fps)
    found = open_source(source, fps)
    if topic:
        raise ValueError(f"topic: expected a bag as the source, got {source}; leave --topic out")
    return found


def _speeds(config: RunConfig, source: FrameSource) -> Speeds | None:
    """Return the speeds of the vehicle that the settings give."""
    if config.speed_topic is not None:
        if not isinstance(source, BagSource):
            raise ValueError(
                f"speed topic: expected a bag as the source, got {config.source}; leave --speed-topic out"
            )
        return bag_speeds(Path(config.source), source.topic, config.speed_topic)
    if config.speed is None:
        return None
    speeds = read_speeds(config.speed)
    if speeds.times is None and len(speeds.speeds) != source.count:
        got = f"{len(speeds.speeds)}; or add a column of times"
        raise ValueError(
            f"speed {config.speed}: expected a speed for each of {source.count} frames, got {got}"
        )
    last = source.times[-1] if source.times else float(source.count / source.fps)
    if speeds.times is not None and not (speeds.times[0] <= last and speeds.times[-1] >= 0):
        raise ValueError(
            f"speed {config.speed}: expected times since the first frame, 0 to {last:.2f} s, got "
            f"{speeds.times[0]:.12g} to {speeds.times[-1]:.12g}; subtract the first frame's time"
        )
    are_numbers = speeds.times is not None and np.array_equal(
        np.diff(speeds.times), np.ones(source.count - 1)
    )
    if are_numbers and source.count > 2 and last < 0.5 * source.count:
        raise ValueError(
            f"speed {config.speed}: expected times in seconds, got numbers of the {source.count} frames; "
            "write titles, as frame,speed"
        )
    return speeds


def _speeds_remark(speeds: Speeds | None, source: FrameSource) -> str:
    """Return a remark if most frames have no speed near them in time, or it may be in km/h; else nothing."""
    if speeds is None:
        return ""
    fastest = np.nanmax(np.abs(speeds.speeds), initial=0.0)
    if remark := fast_remark(float(fastest), "title it speed_kmh"):
        return remark
    times = np.array(source.times or [float(number / source.fps) for number in range(source.count)])
    without = speeds.without(times)
    if without <= _MOST_WITHOUT * len(times):
        return ""
    return f"speed: {without} of {len(times)} frames have none within a second; are its times in seconds?"


def source_of_run(source: str, run: RunFolder) -> FrameSource:
    """Open the source of a finished run again, with its frame rate, topic and the frames that it took."""
    found = _opened(source, run.topic, rate_as_fraction(run.fps))
    return replace(found, selection=run.selection())


def camera_of(config: RunConfig, source: FrameSource) -> Camera:
    """Make the camera of the settings, or else of the bag that the frames are from."""
    if config.camera or config.fov is not None or not isinstance(source, BagSource):
        return make_camera(config, source.image_size, source.pixel_aspect)
    if source.lens is None:
        raise ValueError(
            f"camera: expected --camera FILE, got none, and bag {source.source} has no calibrated CameraInfo "
            f"beside {source.topic}"
        )
    try:
        rectified = config.rectified or bool(_RECTIFIED.search(source.topic))
        camera = Camera.from_fields(source.lens, rectified)
        return replace(camera, remark="; ".join(filter(None, (camera.remark, source.lens_remark))))
    except ValueError as error:
        raise ValueError(f"camera of bag {source.source}: {error}; give --camera FILE") from error


def first_image(source: FrameSource) -> NDArray[np.uint8] | None:
    """Return the first frame's image, (H, W, 3); None of a stream, or if there is none that decodes."""
    frame = None if source.is_live else next(iter(source), None)
    return None if frame is None else frame.image


def observed_frames(source: FrameSource, observer: Observer) -> Generator[tuple[Frame, Observation]]:
    """Yield each frame with what is seen in it; of a stream one after another, else several at a time."""
    if source.is_live:
        return ((frame, observer(frame)) for frame in source)
    if observer.workers == 0:
        return ((frame, observer(frame)) for frame in prefetch(source))
    return map_ahead(observer, source, observer.workers)


@contextlib.contextmanager
def ended_by_signals(source: FrameSource) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP end a stream, and so the run normally; a second one interrupts.

    Other sources, and threads other than the main one, are left as they are.
    """
    with handlers_kept() as before:

        def stop(number: int, frame: FrameType | None) -> None:
            source.stop()  # type: ignore[attr-defined]  # no signal is taken of another
            for each, handler in before.items():
                signal.signal(each, handler)

        for number, handler in before.items():
            if isinstance(source, LiveSource) and handler is not signal.SIG_IGN:  # nohup's
                signal.signal(number, stop)
        yield
