"""Decide which tasks can start: parts of a cut drive first, then the run on the whole drive."""

from collections.abc import Sequence

from lanebev.app.fleet.plan import Outcome, Task, is_done


class Schedule:
    """The drives that are to be run.

    Args:
        tasks: tasks of the drives. Unfinished parts of drives start first.
    """

    def __init__(self, tasks: Sequence[Task]) -> None:
        self._drive_of: dict[str, Task] = {}
        self._left: dict[str, int] = {}
        self._failed: dict[str, Outcome] = {}
        self.first: list[Task] = []
        for task in tasks:
            parts = [part for part in task.parts if not is_done(part)]
            self._drive_of |= {part.name: task for part in parts}
            self._left[task.name] = len(parts)
            self.first += parts or [task]

    def ended(self, task: Task, outcome: Outcome) -> tuple[Task | None, Outcome | None]:
        """Note what became of a task.

        Returns:
            the task that can begin now, and what became of a drive; None where there is none.
        """
        if not task.is_part:
            return None, outcome
        drive = self._drive_of[task.name]
        self._left[drive.name] -= 1
        if outcome.failure:
            self._failed.setdefault(drive.name, outcome)
        if self._left[drive.name]:
            return None, None
        failed = self._failed.get(drive.name)
        if failed is None:
            return drive, None
        return None, Outcome(drive.name, f"{failed.name}: {failed.failure}", is_final=failed.is_final)
