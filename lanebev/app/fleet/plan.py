"""What is to be done: a task a drive, and which are finished."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from lanebev import __version__
from lanebev.app.config import RunConfig
from lanebev.app.fleet.joining import Part, duration, parts_of
from lanebev.app.fleet.manifest import PATHS, Drive
from lanebev.app.take_up import size_and_time

DRIVES, MARK = "drives", "fleet.json"


@dataclass(frozen=True)
class Task:
    """One run.

    Attributes:
        name: of the drive; of a part of it, with its number.
        config: what to run, and the folder to write.
        fingerprint: of settings and files, to know whether it is done.
        parts: of the drive, if it is cut.
        number: of the part.
    """

    name: str
    config: RunConfig
    fingerprint: str
    parts: tuple[Part, ...] = ()
    number: int = 0


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Attributes:
        name: of the drive.
        failure: why it failed, in a line; empty if it did not.
        frames: of the drive.
        seconds: that the run took.
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


def tasks_of(
    drives: Sequence[Drive], out: str | Path, length: float | None = None, overlap: float = 0.0
) -> dict[str, list[Task]]:
    """Return the tasks of each drive by its name: one, or several where a video is cut.

    Args:
        drives: of the manifest.
        out: folder of the fleet.
        length: s of a part, None to cut nothing.
        overlap: s that a part begins before the first frame that is kept of it.
    """
    tasks: dict[str, list[Task]] = {}
    for drive in drives:
        config, folder = drive.config, drive_folder(out, drive.name)
        end = config.end if config.end is not None else math.inf
        if length is not None and not config.stills and Path(config.source).is_file():
            parts = tuple(parts_of(config.start, min(end, duration(config.source)), length, overlap))
        else:
            parts = ()
        if len(parts) < 2:
            whole = replace(config, out=str(folder))
            tasks[drive.name] = [Task(drive.name, whole, settings_fingerprint(whole))]
            continue
        tasks[drive.name] = []
        for number, part in enumerate(parts):
            last = config.end if part.end is None else part.end
            own = replace(config, out=str(folder / f"part-{number:03d}"), start=part.start, end=last)
            name = f"{drive.name}, part {number}"
            tasks[drive.name].append(Task(name, own, settings_fingerprint(own), parts, number))
    return tasks


def drive_outcome(name: str, tasks: Sequence[Task], outcomes: Sequence[Outcome]) -> Outcome:
    """Return what became of a drive from what became of its tasks."""
    failed = [(task, outcome) for task, outcome in zip(tasks, outcomes, strict=True) if outcome.failure]
    if len(tasks) == 1:
        return outcomes[0]
    seconds = sum(outcome.seconds for outcome in outcomes)
    if failed:
        task, outcome = failed[0]
        return Outcome(
            name, f"part {task.number}: {outcome.failure}", seconds=seconds, is_final=outcome.is_final
        )
    return Outcome(name, frames=sum(outcome.frames for outcome in outcomes), seconds=seconds)


def settings_fingerprint(config: RunConfig) -> str:
    """Return all that decides a run's outputs, as text: settings, and sizes and times of the files named."""
    settings = {name: value for name, value in asdict(config).items() if name != "out"}
    files = {name: size_and_time(Path(settings[name])) for name in PATHS if settings.get(name)}
    return json.dumps({"settings": settings, "files": files, "lanebev": __version__}, default=str)


def earlier_outcome(task: Task) -> Outcome | None:
    """Return what became of a task in an earlier call; None if it is to be done, or done again."""
    failed = _read_mark(failure_path(task), task)
    if failed is not None:
        return failed
    done = _read_mark(Path(task.config.out) / MARK, task)
    return done if done is not None and (Path(task.config.out) / "extrinsics.csv").is_file() else None


def write_mark(task: Task, outcome: Outcome) -> None:
    """Note what became of a task, for the next call."""
    path = failure_path(task) if outcome.failure else Path(task.config.out) / MARK
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"fingerprint": task.fingerprint, **asdict(outcome)})
    half = path.with_name(f".{path.name}.part")
    half.write_text(text, encoding="utf-8")
    half.replace(path)
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
