"""Check lanebev fleet with killed workers and a corrupt file: python -m tools.fleet_check.

Checks that every drive but the corrupt one has the outputs of a single run, to the last digit, that the
corrupt one is reported, and that a second call does nothing. Then times one worker and several on the same
drives: the speed-up, and what a drive costs besides its run. Prints a line of JSON; its status is 0 if all
is as it should be.
"""

import argparse
import csv
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from lanebev.app.demo import write_drive
from lanebev.app.fleet.manifest import read_manifest
from lanebev.app.run import run
from lanebev.render import Drive
from train.commands import command_parser

IMAGE_SIZE, FPS = (96, 160), 20
COMPARED = ("extrinsics.csv", "covariance.csv", "lanes.json", "calibration.yaml")
CORRUPT = 1  # number of that drive
PATIENCE = 600.0  # s


def main(arguments: Sequence[str] | None = None) -> int:
    parser = command_parser(__doc__)
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--frames", type=int, default=20, help="frames per drive (%(default)s)")
    parser.add_argument(
        "--network", type=int, default=4, help="drives on which the network runs (%(default)s)"
    )
    parser.add_argument("--kills", type=int, default=2, help="workers to kill (%(default)s)")
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--batch", type=int, default=1, help="drives a worker takes at a time (%(default)s)")
    words = "cut drives, for the network, into parts of so many seconds"
    parser.add_argument("--part-seconds", type=float, help=words)
    parser.add_argument("--no-timing", action="store_true", help="do not time one worker and --workers")
    parser.add_argument("--folder", type=Path, help="folder in which all files are kept")
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        found = check(args, args.folder or Path(temporary))
    print(json.dumps(found))
    good = found["equal"] == found["finished"] == args.drives - 1 and found["failed"] == 1
    return 0 if good and found["killed"] == args.kills and found["second_call_changed"] == 0 else 1


def check(args: argparse.Namespace, folder: Path) -> dict[str, object]:
    """Return the figures."""
    manifest = write_drives(folder, args.drives, args.frames, args.network)
    torch.set_num_threads(1)  # as Ray gives its workers: sums of several threads have another order
    out = folder / "fleet"
    cut = [] if args.part_seconds is None else ["--part-minutes", f"{args.part_seconds / 60:.5f}"]
    options = ["--batch", str(args.batch), *cut]
    said, seconds, killed = call(manifest, out, args.workers, options, args.kills, args.drives)
    counts = [int(number) for number in re.findall(r"(\d+) finished, (\d+) failed", said)[0]]
    before = times_of(out / "drives")
    again, second, _ = call(manifest, out, args.workers, options)
    changed = sum(before.get(path) != time for path, time in times_of(out / "drives").items())
    equal, single = equal_to_single_runs(manifest, out, folder / "single")
    found: dict[str, object] = {
        "drives": args.drives,
        "finished": counts[0],
        "failed": counts[1],
        "killed": killed,
        "equal": equal,
        "second_call": again.splitlines()[0],
        "second_call_changed": changed,
        "seconds": round(seconds, 1),
        "second_call_seconds": round(second, 1),
        "median_single_seconds": round(sorted(single)[len(single) // 2], 2),
    }
    return found | ({} if args.no_timing else timing(manifest, folder, args.workers, options))


def write_drives(folder: Path, drives: int, frames: int, network: int) -> Path:
    """Render drives with the lanes of the truth, one of them corrupt; the manifest's path."""
    rows = []
    for number in range(drives):
        name = f"drive-{number:02d}"
        (folder / name).mkdir(parents=True)
        drive = Drive(number, IMAGE_SIZE, frames, float(FPS))
        write_drive(drive, (folder / name).__truediv__)
        if number == CORRUPT:
            (folder / name / "drive.mp4").write_bytes(os.urandom(5000))
        lanes = "" if number < network else f"{name}/lanes.json"
        day = f"2026-03-{1 + number % 3:02d}"
        rows.append((f"{name}/drive.mp4", f"{name}/camera.yaml", lanes, f"camera-{number}", day))
    with open(folder / "manifest.csv", "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("video", "camera", "lanes", "camera_id", "day"), *rows])
    return folder / "manifest.csv"


def call(
    manifest: Path, out: Path, workers: int, options: Sequence[str] = (), kills: int = 0, drives: int = 0
) -> tuple[str, float, int]:
    """Run ``lanebev fleet`` and kill workers as drives end; what it says, seconds, how many were killed."""
    command = [sys.executable, "-m", "lanebev", "fleet", str(manifest), "--out", str(out)]
    command += ["--workers", str(workers), *options]
    start, killed = time.perf_counter(), 0
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    while process.poll() is None and time.perf_counter() - start < PATIENCE:
        done = len(list((out / "drives").glob("*/fleet.json"))) if kills else 0
        if killed < kills and done >= killed * drives // (kills + 1):  # the first is looked for at once
            for worker in list(busy_workers(process.pid))[:1]:
                os.kill(worker, signal.SIGKILL)
                killed += 1
        time.sleep(0.05)
    said, _ = process.communicate(timeout=10)
    return said, time.perf_counter() - start, killed


def busy_workers(ancestor: int) -> Iterator[int]:
    """Yield the workers that run a task now, of the processes that came from this one."""
    parents, names = {}, {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            after = status.read_text().rpartition(")")[2].split()
            names[int(status.parent.name)] = (status.parent / "cmdline").read_bytes()
        except (OSError, ValueError):
            continue
        parents[int(status.parent.name)] = int(after[1])
    for process, name in names.items():
        above = process
        while above in parents and above != ancestor:
            above = parents[above]
        if above == ancestor and name.startswith(b"ray::run_task"):
            yield process


def equal_to_single_runs(manifest: Path, out: Path, singles: Path) -> tuple[int, list[float]]:
    """Run on each drive by itself; how many have exactly the fleet's outputs, and the seconds of each run."""
    equal, seconds = 0, []
    for drive in read_manifest(manifest):
        start = time.perf_counter()
        try:
            run(replace(drive.config, out=str(singles / drive.name)))
        except ValueError:
            continue
        seconds.append(time.perf_counter() - start)
        folders = singles / drive.name, out / "drives" / drive.name
        equal += all(
            (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes() for name in COMPARED
        )
    return equal, seconds


def timing(manifest: Path, folder: Path, several: int, options: Sequence[str]) -> dict[str, object]:
    """Time one worker and several on the same drives, without kills.

    ``seconds_N`` is a whole call, ``working_N`` of it from when the first run begins to when the last ends:
    Ray and Python with torch start before, results are collected after. ``overhead_a_drive_N`` is what of
    the workers' time in between is no run, over the drives.
    """
    found: dict[str, object] = {"cores": os.cpu_count()}
    working = []
    for workers in (1, several):
        out = folder / f"workers-{workers}"
        begin = time.time()
        _, seconds, _ = call(manifest, out, workers, options)
        runs = [
            (path.stat().st_mtime, json.loads(path.read_text())["seconds"])
            for path in out.glob("drives/*/fleet.json")
        ]
        first = min(end - took for end, took in runs)
        span, total = max(end for end, _ in runs) - first, sum(took for _, took in runs)
        working.append(span)
        found[f"seconds_{workers}"] = round(seconds, 1)
        found[f"starting_{workers}"] = round(first - begin, 1)
        found[f"working_{workers}"] = round(span, 1)
        found[f"overhead_a_drive_{workers}"] = round((span * workers - total) / len(runs), 2)
    return found | {"speed_up": round(working[0] / working[1], 2)}


def times_of(folder: Path) -> dict[Path, int]:
    """Return when each file was changed."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


if __name__ == "__main__":
    sys.exit(main())
