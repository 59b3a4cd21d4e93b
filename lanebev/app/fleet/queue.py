"""The order in which the tasks of a fleet run: parts of drives, drives, and again those that failed."""

import contextlib
from collections import Counter, deque
from collections.abc import Sequence

from lanebev.app.drive.build import needs_network
from lanebev.app.fleet.plan import Outcome, Task, is_done, write_mark


class TaskQueue:
    """The tasks of drives that wait to be run. A drive that is cut waits until all of its parts are done.

    Args:
        tasks: a task for each drive.
        batch: drives or parts in a group, at most; see :func:`groups_of`.
        retries: how often a task that failed is run again.

    Attributes:
        waiting: groups of tasks in order.
    """

    def __init__(self, tasks: Sequence[Task], batch: int, retries: int) -> None:
        self._retries, self._failures = retries, Counter[str]()
        self._drive_of: dict[str, Task] = {}  # by name of the part
        self._parts_left: dict[str, int] = {}  # by name of the drive, as the next
        self._failed_part: dict[str, Outcome] = {}
        first: list[Task] = []
        for task in tasks:
            parts = [part for part in task.parts if not is_done(part)]
            self._drive_of |= {part.name: task for part in parts}
            self._parts_left[task.name] = len(parts)
            first += parts or [task]
        self.waiting = deque(groups_of(first, batch))

    def end(self, task: Task, outcome: Outcome, may_retry: bool = True) -> Outcome | None:
        """Note the outcome of a task. Queue it again if it failed, or its drive if it was the last part.

        Returns:
            the outcome of the drive, if it has ended.
        """
        self._failures[task.name] += bool(outcome.failure)
        if outcome.failure and may_retry and self._failures[task.name] <= self._retries:
            self.waiting.append((task,))
            return None
        drive = self._drive_of[task.name] if task.is_part else task
        ended = self._end_part(drive, outcome) if task.is_part else outcome
        if ended is not None and ended.is_final:
            with contextlib.suppress(OSError):  # a full disk: the next call tries it again
                write_mark(drive, ended)
        return ended

    def _end_part(self, drive: Task, outcome: Outcome) -> Outcome | None:
        """Note the outcome of a part. After the last one queue the drive, or return its failure."""
        self._parts_left[drive.name] -= 1
        if outcome.failure:
            self._failed_part.setdefault(drive.name, outcome)
        if self._parts_left[drive.name]:
            return None
        failed = self._failed_part.get(drive.name)
        if failed is None:
            self.waiting.append((drive,))
            return None
        return Outcome(drive.name, f"{failed.name}: {failed.failure}", is_final=failed.is_final)


def groups_of(tasks: Sequence[Task], batch: int) -> list[tuple[Task, ...]]:
    """Return tasks in groups of up to ``batch`` for one network; those that need none, one by one."""
    alike: dict[tuple[object, ...], list[Task]] = {}
    for task in tasks:
        shares = needs_network(task.config) and batch > 1
        key = task.config.network if shares else (task.name,)
        alike.setdefault(key, []).append(task)
    return [
        tuple(own[first : first + batch]) for own in alike.values() for first in range(0, len(own), batch)
    ]
