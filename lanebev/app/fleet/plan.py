"""What is to be done: a task a drive, and which are finished."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from lanebev import __version__
from lanebev.app.config import RunConfig
from lanebev.app.fleet.manifest import PATHS, Drive
from lanebev.app.take_up import size_and_time

DRIVES, MARK = "drives", "fleet.json"


@dataclass(frozen=True)
class Task:
    """One run.

    Attributes:
        name: of the drive.
        config: what to run, and the folder to write.
        fingerprint: of settings and files, to know whether it is done.
    """

    name: str
    config: RunConfig
    fingerprint: str


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


def tasks_of(drives: Sequence[Drive], out: str | Path) -> list[Task]:
    """Return a task for each drive."""
    tasks = []
    for drive in drives:
        config = replace(drive.config, out=str(drive_folder(out, drive.name)))
        tasks.append(Task(drive.name, config, settings_fingerprint(config)))
    return tasks


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
        found: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if found["fingerprint"] != task.fingerprint:
            return None
        return Outcome(**{name: found[name] for name in Outcome.__dataclass_fields__})
    except (OSError, ValueError, KeyError, TypeError):
        return None
