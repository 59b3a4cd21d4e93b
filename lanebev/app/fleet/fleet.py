"""``lanebev fleet``: run on all drives of a manifest and collect their results."""

import json
import logging
import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lanebev.app.continued.resume import STATE_FILE
from lanebev.app.fleet.cluster import Cluster, check_ray, outcomes
from lanebev.app.fleet.collect import FRAMES, collect_frames
from lanebev.app.fleet.manifest import Drive, read_manifest
from lanebev.app.fleet.mounts import Stretch, days, drive_mounts, stretches
from lanebev.app.fleet.page import CameraMounts, fleet_page
from lanebev.app.fleet.plan import DRIVES, Outcome, Task, drive_folder, earlier_outcome, tasks_of
from lanebev.app.progress import Progress, no_progress
from lanebev.estimation.mount import MountEstimator, MountState
from lanebev.io.formats.names import check_installed
from lanebev.io.output.lock import FolderLock
from lanebev.io.output.whole_file import whole_file
from lanebev.io.results import read_extrinsics
from lanebev.io.state import load_state
from lanebev.report.verdict import Verdict, verdict
from lanebev.types import AXES

logger = logging.getLogger(__name__)
PAGE = "index.html"
_MOST_FAILURES = 10  # failures that are printed


class FleetResult(NamedTuple):
    """Result of a fleet.

    Attributes:
        outcomes: by name of the drive, in the manifest's order.
        text: what to print.
    """

    outcomes: dict[str, Outcome]
    text: str


def fleet(
    manifest: str,
    out: str,
    cluster: Cluster | None = None,
    root: str | None = None,
    again: bool = False,
    part_minutes: float | None = None,
    progress: Progress = no_progress,
) -> FleetResult:
    """Run on the drives of a manifest that are not finished, and collect the results of all.

    Args:
        manifest: see :func:`lanebev.app.fleet.manifest.read_manifest`.
        out: folder; each drive's outputs go to ``drives/NAME`` in it.
        cluster: cluster to run on.
        root: folder that paths must not leave; None is the manifest's.
        again: try once more what failed in an earlier call.
        part_minutes: length of the parts of longer videos that the network processes in parallel; None cuts
            nothing.
        progress: wraps the drives that end, given the number that are to be run.

    Raises:
        ValueError: bad manifest, a library that is not installed, another call at work in this folder, or an
            index page in it that no fleet wrote.
    """
    check_ray()
    check_installed(["parquet"])
    drives = read_manifest(manifest, root)
    tasks = tasks_of(drives, out, None if part_minutes is None else 60 * part_minutes)
    folder = Path(out)
    if (folder / PAGE).exists() and not (folder / DRIVES).is_dir():
        raise ValueError(
            f"output folder {out}: expected a new one or an earlier fleet's, got one with a file {PAGE} and "
            f"no folder {DRIVES}; give another with --out"
        )
    with _locked(out):
        found, ran = _run(list(tasks.values()), cluster or Cluster(), again, progress)
        done = [drive for drive in drives if not found[drive.name].failure]
        collect_frames(done, out)
        cameras = camera_mounts(done, out)
        write_mounts(folder / "mounts.json", cameras)
        verdicts = {drive.name: _verdict(drive, out) for drive in done}
        with whole_file(folder / PAGE) as path:
            page = fleet_page(folder.resolve().name, drives, found, verdicts, cameras)
            path.write_text(page, encoding="utf-8", errors="replace")
    return FleetResult(found, _summary(found, ran, out))


def _verdict(drive: Drive, out: str) -> Verdict:
    return verdict(read_extrinsics(drive_folder(out, drive.name) / "extrinsics.csv"), drive.config.stills)


@contextmanager
def _locked(out: str) -> Iterator[None]:
    """Make a fleet's folder, and lock it against other fleets for the ``with`` block."""
    try:
        Path(out).mkdir(parents=True, exist_ok=True)
        lock = FolderLock(Path(out) / ".fleet")
        is_free = lock.acquire()
    except OSError as error:
        raise ValueError(
            f"output folder {out}: expected one that can be written, got: {error.strerror}; "
            "give another with --out"
        ) from error
    if not is_free:
        raise ValueError(
            f"output folder {out}: expected one that is free, got: another fleet writes into it now"
        )
    try:
        yield
    finally:
        shutil.rmtree(lock.folder, ignore_errors=True)
        lock.release()


def in_order(drives: Sequence[Drive]) -> list[Drive]:
    """Return the drives of each camera together, in order of time; those of an unknown time come first."""
    return sorted(drives, key=lambda drive: (drive.camera_id, days(drive.time) if drive.time else -math.inf))


def camera_mounts(drives: Sequence[Drive], out: str | Path) -> list[CameraMounts]:
    """Return the mount of each camera over its finished drives, in order of time."""
    like = {"mount": MountEstimator().initial_state(1, dtype=torch.float64)}
    found = []
    for camera_id, own in groupby(in_order(drives), key=lambda drive: drive.camera_id):
        states: list[tuple[str, str, MountState]] = []
        for drive in own:
            loaded = load_state(drive_folder(out, drive.name) / STATE_FILE, like)
            if loaded.problem is None:  # images on their own have none
                states.append((drive.name, drive.time, loaded.states["mount"]))
        mounts = drive_mounts(states)
        found.append(CameraMounts(camera_id, mounts, stretches(mounts)))
    return found


def write_mounts(path: Path, cameras: Sequence[CameraMounts]) -> None:
    """Write ``mounts.json``: of each camera its stretches, and what each drive says; degrees and metres."""
    content = [
        {
            "camera": camera.camera_id,
            "stretches": [_stretch_fields(each) for each in camera.stretches],
            "drives": [
                {"drive": each.name, "time": each.time or None,
                 **_axes("", each.pose), **_axes("_std", each.std),
                 "moved": [axis for axis, moved in zip(AXES, each.moved, strict=True) if moved]}
                for each in camera.mounts
            ],
        }
        for camera in cameras
    ]  # fmt: skip
    with whole_file(path) as whole:
        whole.write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")


def _run(
    tasks: Sequence[Task], cluster: Cluster, again: bool, progress: Progress
) -> tuple[dict[str, Outcome], int]:
    """Run what is not finished; outcomes by name in the order of the tasks, and how many were run."""
    earlier = {task.name: earlier_outcome(task) for task in tasks}
    found = {name: outcome for name, outcome in earlier.items() if outcome is not None}
    to_do = [task for task in tasks if task.name not in found or (again and found[task.name].failure)]
    logger.info("%d drives, %d of them to run", len(tasks), len(to_do))
    if to_do:
        ended: Iterator[Outcome] = outcomes(to_do, cluster)
        for outcome in progress(ended, len(to_do)):
            logger.info("%s: %s", outcome.name, outcome.failure or f"{outcome.frames} frames")
            found[outcome.name] = outcome
    return {task.name: _kept(found[task.name], task) for task in tasks}, len(to_do)


def _kept(outcome: Outcome, task: Task) -> Outcome:
    """Return a task's outcome, a failure if its outputs are no longer there."""
    if outcome.failure or task.result.is_file():
        return outcome
    return replace(outcome, failure="its outputs were deleted meanwhile; the same command runs it again")


def _stretch_fields(stretch: Stretch) -> dict[str, object]:
    fields = asdict(stretch)
    parts = {"": "pose", "_std": "std", "_drift_per_day": "drift", "_drift_std_per_day": "drift_std"}
    axes = {key: value for end, name in parts.items() for key, value in _axes(end, fields.pop(name)).items()}
    return {**fields, **axes}


def _axes(end: str, values: NDArray[np.float64]) -> dict[str, float | None]:
    """Return the axes of a pose by name, deg and m; None where one is not known."""
    known: dict[str, float | None] = {}
    for axis, value in zip(AXES, values.tolist(), strict=True):
        shown = value if axis == "height" else math.degrees(value)
        known[f"{axis}{end}_{'m' if axis == 'height' else 'deg'}"] = shown if math.isfinite(shown) else None
    return known


def _summary(found: dict[str, Outcome], ran: int, out: str) -> str:
    failed = [outcome for outcome in found.values() if outcome.failure]
    lines = [f"{len(found)} drives: {len(found) - len(failed)} finished, {len(failed)} failed; {ran} run now"]
    lines += [f"failed: {outcome.name}: {outcome.failure}" for outcome in failed[:_MOST_FAILURES]]
    if len(failed) > _MOST_FAILURES:
        lines.append(f"and {len(failed) - _MOST_FAILURES} more, see the page")
    return "\n".join([*lines, f"{out}: {PAGE}, mounts.json, {FRAMES}/, {DRIVES}/"])
