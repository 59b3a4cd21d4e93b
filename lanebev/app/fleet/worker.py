"""One drive: the run of the command line, in whatever process."""

from __future__ import annotations

import time

from lanebev.app.fleet.plan import Outcome, Task, write_mark
from lanebev.app.run import run


def run_task(task: Task) -> Outcome:
    """Run on a drive, and note that it is done.

    Raises:
        ValueError, OSError: as :func:`lanebev.app.run.run`.
    """
    start = time.perf_counter()
    report = run(task.config)
    outcome = Outcome(task.name, frames=len(report.rows), seconds=time.perf_counter() - start)
    write_mark(task, outcome)
    return outcome
