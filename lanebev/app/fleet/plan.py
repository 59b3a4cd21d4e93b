"""Plan the tasks, one for each drive or for parts of long ones, and find which are finished."""

from __future__ import annotations

import glob
import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import av

from lanebev import __version__
from lanebev.app.config import RunConfig
from lanebev.app.continued.recovery import size_and_time
from lanebev.app.fleet.manifest import PATHS, Drive
from lanebev.camera.choice import camera_file
from lanebev.io.images.files import glob_pattern
from lanebev.io.output.whole_file import replacement

DRIVES, MARK, SEEN = "drives", "fleet.json", "seen.json"
_TIME_BASE = 1_000_000  # ticks a second of a container's duration


class Part(NamedTuple):
    """A part of a drive; times in s of the source.

    Attributes:
        start: time of its first frame.
        end: before which its last frame is; None is the end of the source.
    """

    start: float
    end: float | None


def parts_of(start: float, end: float, length: float) -> list[Part]:
    """Return parts of about ``length`` s from ``start`` to ``end``; each ends where the next one begins.

    A rest of less than half a part belongs to the last one.
    """
    count = max(1, math.floor((end - start) / length + 0.5)) if math.isfinite(end) else 1
    cuts = [start + length * number for number in range(1, count)]
    return [Part(*each) for each in zip([start, *cuts], [*cuts, None], strict=True)]


def duration(path: str | Path) -> float:
    """Return how long a video is by its header, s; infinite where it does not say, or is none."""
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            return math.inf if container.duration is None else container.duration / _TIME_BASE
    except (av.error.FFmpegError, OSError):
        return math.inf


@dataclass(frozen=True)
class Task:
    """A run on a drive, or the network alone on a part of it.

    Attributes:
        name: name of the drive; for a part of it, followed by its number.
        config: settings, with the output folder.
        fingerprint: fingerprint of settings and files, which tells whether it is done.
        parts: tasks of the drive's parts, which run before it, if it is cut.
        is_part: whether it is such a part.
    """

    name: str
    config: RunConfig
    fingerprint: str
    parts: tuple[Task, ...] = ()
    is_part: bool = False

    @property
    def result(self) -> Path:
        """A file that is there when it is done."""
        return Path(self.config.out) / (SEEN if self.is_part else "extrinsics.csv")


@dataclass(frozen=True)
class Outcome:
    """Result of a task.

    Attributes:
        name: name of the drive.
        failure: why it failed, in a line; empty if it did not.
        frames: number of frames of the drive.
        seconds: duration of the run.
        is_final: a failure that the same files and settings would have again.
    """

    name: str
    failure: str = ""
    frames: int = 0
    seconds: float = 0.0
    is_final: bool = False


def drive_folder(out: str | Path, name: str) -> Path:
    """Return the folder of a drive's outputs."""
    return Path(out) / DRIVES / name


def tasks_of(drives: Sequence[Drive], out: str | Path, length: float | None = None) -> dict[str, Task]:
    """Return the task of each drive by its name, with parts where a video is cut.

    Args:
        drives: drives of the manifest.
        out: folder of the fleet.
        length: s of a part, None to cut nothing. Drives with lanes of their own need no network, and those
            with far views the estimate of the frame before; they are not cut.
    """
    tasks: dict[str, Task] = {}
    for drive in drives:
        folder = drive_folder(out, drive.name)
        config = replace(drive.config, out=str(folder))
        parts: tuple[Task, ...] = ()
        if length is not None and _is_to_be_cut(config):
            end = min(math.inf if config.end is None else config.end, duration(config.source))
            parts = tuple(
                _part_task(drive.name, config, folder, number, part)
                for number, part in enumerate(parts_of(config.start, end, length))
            )
        parts = parts if len(parts) > 1 else ()
        tasks[drive.name] = Task(drive.name, config, settings_fingerprint(config), parts)
    return tasks


def _is_to_be_cut(config: RunConfig) -> bool:
    whole = config.lanes is not None or config.stills or config.far_view
    return not whole and Path(config.source).is_file()


def _part_task(name: str, config: RunConfig, folder: Path, number: int, part: Part) -> Task:
    hidden = folder.parent / f".{name}.part-{number:03d}"
    last = config.end if part.end is None else part.end
    own = replace(config, out=str(hidden), start=part.start, end=last)
    return Task(f"{name}, part {number}", own, settings_fingerprint(own), is_part=True)


def settings_fingerprint(config: RunConfig) -> str:
    """Return all that decides a run's outputs, as text: settings, and sizes and times of the files named."""
    settings = {name: value for name, value in asdict(config).items() if name != "out"}
    read = [name for name in PATHS if name != "exported" or config.backend == "onnxruntime"]
    paths = settings | {"camera": config.camera and camera_file(config.camera)}
    files = {name: _sizes_and_times(str(paths[name])) for name in read if paths.get(name)}
    return json.dumps({"settings": settings, "files": files, "lanebev": __version__}, default=str)


def _sizes_and_times(path: str) -> list[object]:
    """Return a file's size and time; of a folder or a glob also a digest of those of all its files."""
    own: list[object] = list(size_and_time(Path(path)))
    if Path(path).is_file():
        return own
    pattern = f"{glob.escape(path)}/**" if Path(path).is_dir() else glob_pattern(path)
    files = [(each, *size_and_time(Path(each))) for each in sorted(glob.glob(pattern, recursive=True))]
    return [*own, hashlib.sha256(json.dumps(files).encode()).hexdigest()]


def earlier_outcome(task: Task) -> Outcome | None:
    """Return the outcome of a task in an earlier call; None if there is none, or its input has changed."""
    failed = _read_mark(failure_path(task), task)
    if failed is not None:
        return failed
    done = _read_mark(Path(task.config.out) / MARK, task)
    return done if done is not None and task.result.is_file() else None


def is_done(task: Task) -> bool:
    """Return whether a task finished without failure, in an earlier call or in a worker that died later."""
    earlier = earlier_outcome(task)
    return earlier is not None and not earlier.failure


def write_mark(task: Task, outcome: Outcome) -> None:
    """Write the outcome of a task to a file, for the next call.

    Raises:
        OSError: the disk is full.
    """
    path = failure_path(task) if outcome.failure else Path(task.config.out) / MARK
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacement(path) as whole:
        whole.write_text(json.dumps({"fingerprint": task.fingerprint, **asdict(outcome)}), encoding="utf-8")
    if not outcome.failure:
        failure_path(task).unlink(missing_ok=True)


def failure_path(task: Task) -> Path:
    """Return the file that says why a task failed, beside the folders of drives."""
    folder = Path(task.config.out)
    return folder.parent / f".{folder.name}.failed.json"


def _read_mark(path: Path, task: Task) -> Outcome | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["fingerprint"] != task.fingerprint:
            return None
        return Outcome(**{name: found[name] for name in Outcome.__dataclass_fields__})
    except (OSError, ValueError, KeyError, TypeError):
        return None
