"""Continue a run that was killed: the network is not run again on the frames that it had processed."""

import json
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path

from lanebev import __version__
from lanebev.app.config import RunConfig
from lanebev.app.drive.build import input_files
from lanebev.app.drive.observers import NetworkObserver, Observation, Observer
from lanebev.camera.model import Camera
from lanebev.io.frame_source import FrameSource
from lanebev.io.frames import Frame
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.lanes.tusimple import whole_tusimple_lines
from lanebev.io.output.folder import OutputFolder

LANES_FILE = "lanes.json"
_SETTINGS, _SEEN = ".settings.json", ".seen.json"  # in the temporary folder


def frame_name(frame: Frame, source: FrameSource) -> str:
    """Return the name of a frame in lanes.json."""
    return frame.name or f"{Path(source.source).name}/{frame.number:06d}"


class RecoveredObserver:
    """Returns an earlier run's observations of the first frames, and another observer's of the others.

    Args:
        entries: entries of lanes.json, from the first frame on.
        observer: observer of the other frames.
        name_of: gives the name of a frame's entry.
        is_reported: whether the report says so.

    Attributes:
        frames: how many were taken.
        remark, workers: those of the other observer.
    """

    def __init__(
        self,
        entries: Iterator[FrameLines],
        observer: NetworkObserver,
        name_of: Callable[[Frame], str],
        is_reported: bool = True,
    ) -> None:
        self.is_reported = is_reported
        self._entries, self._observer, self._name_of = entries, observer, name_of
        self._ahead: dict[str, FrameLines] = {}  # read before their frames came: threads overtake each other
        self._lock = threading.Lock()
        self.remark, self.workers, self.frames = observer.remark, observer.workers, 0

    def __call__(self, frame: Frame) -> Observation:
        """See :class:`lanebev.app.drive.observers.Observer`."""
        entry = self._entry(self._name_of(frame))
        if entry is None or frame.image is None:
            return self._observer(frame)
        return self._observer.restored(entry)

    def _entry(self, name: str) -> FrameLines | None:
        with self._lock:
            while name not in self._ahead and (entry := next(self._entries, None)) is not None:
                self._ahead[entry.name] = entry
            self.frames += name in self._ahead
            return self._ahead.pop(name, None)


def facts_of(observer: Observer) -> dict[str, str]:
    """Return the number of reused detections, for the report."""
    if not isinstance(observer, RecoveredObserver) or not (observer.is_reported and observer.frames):
        return {}
    return {"reused": f"detections of a run that was killed, in the first {observer.frames} frames"}


def recover_run(
    out: OutputFolder, config: RunConfig, source: FrameSource, camera: Camera, observer: Observer
) -> Observer:
    """Return an observer that reuses the detections of a run that was killed in this folder.

    They are reused only with the same settings and files. Lane files of another detector are read again, and
    a stream starts again.
    """
    settings = fingerprint(config, source, camera)
    known = out / _SETTINGS
    same = known.is_file() and known.read_text(encoding="utf-8") == settings
    left = [path for path in (out.left(LANES_FILE), out / _SEEN) if path.is_file()]
    if left and same:
        max(left, key=lambda path: path.stat().st_size).replace(out / _SEEN)
    else:
        (out / _SEEN).unlink(missing_ok=True)
    known.write_text(settings, encoding="utf-8")
    if source.is_live or not isinstance(observer, NetworkObserver):
        return observer
    entries = whole_tusimple_lines(out / _SEEN) if (out / _SEEN).is_file() else iter(())
    return RecoveredObserver(entries, observer, partial(frame_name, source=source))


def observer_of_second_pass(
    out: OutputFolder, observer: Observer, reusing: Observer, source: FrameSource
) -> Observer:
    """Return an observer for a second pass, which reuses the detections in lanes.json of the first one.

    Args:
        out: output folder with the first pass's lanes.json, which is moved.
        observer: observer of the frames.
        reusing: result of :func:`recover_run` for it.
        source: the frames.
    """
    if not (isinstance(reusing, RecoveredObserver) and isinstance(observer, NetworkObserver)):
        return observer
    (out / LANES_FILE).replace(out / _SEEN)
    entries = whole_tusimple_lines(out / _SEEN)
    return RecoveredObserver(entries, observer, partial(frame_name, source=source))


def fingerprint(config: RunConfig, source: FrameSource, camera: Camera) -> str:
    """Return all that determines a run's detections as text: settings, sizes and times of files, lens."""
    settings = {name: value for name, value in asdict(config).items() if name != "out"}
    files = [[os.fspath(path), *size_and_time(Path(path))] for path in input_files(config, source)]
    found = {"settings": settings, "files": files, "camera": camera.fingerprint(), "lanebev": __version__}
    return json.dumps(found, default=str)


def size_and_time(path: Path) -> tuple[int, int]:
    """Return a file's size and time of change; zeros if it is not a file, such as a stream."""
    try:
        about = path.stat()
    except OSError:
        return 0, 0
    return about.st_size, about.st_mtime_ns
