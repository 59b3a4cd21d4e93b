"""Measure the memory that a run needs per frame and for its report: python -m tools.bench_memory."""

import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from lanebev.app.recording.storage import StoredNumbers, StoredRows
from lanebev.io.results import ExtrinsicsRow, write_extrinsics
from lanebev.report.page import Report, write_report
from lanebev.types import NUM_BOUNDARIES
from train.commands import command_parser

FPS, MEGA = 30, 2**20


def main() -> None:
    parser = command_parser(__doc__)
    parser.add_argument("--frames", type=int, default=200_000)
    frames = parser.parse_args().frames
    before, random = resident(), np.random.default_rng(0)
    folder = tempfile.gettempdir()
    rows, widths = StoredRows(), StoredNumbers(2, NUM_BOUNDARIES - 1, folder=folder)
    covariances = StoredNumbers(4, 4, folder=folder)
    for frame in range(frames):
        pose, reason = random.normal(size=3).tolist(), "" if frame % 700 else "ROLL_UNSEEN"
        numbers = [frame / FPS, *pose, 1.4, 0.1, 0.1, 0.1, 0.01]
        rows.append(ExtrinsicsRow._make([frame, *numbers, "TRACKING", 30, "", reason, 1e-5]))
        widths.append(np.full((2, NUM_BOUNDARIES - 1), 3.7))
        covariances.append(np.eye(4))
    kept, start = resident(), time.perf_counter()
    print(f"{frames} frames: {(kept - before) / frames:.0f} bytes a frame")
    with tempfile.TemporaryDirectory() as outputs:
        write_extrinsics(Path(outputs) / "extrinsics.csv", rows)
        first, second = widths.all().transpose(1, 0, 2)
        report = Report(title="drive", rows=rows, before=first, after=second, lane_width=3.7, facts={})
        write_report(Path(outputs) / "report.html", report)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    seconds = time.perf_counter() - start
    print(f"extrinsics.csv and report.html: {(most - kept) / MEGA:.0f} MB more, {seconds:.0f} s")


def resident() -> int:
    """Return this process' resident memory in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


if __name__ == "__main__":
    main()
