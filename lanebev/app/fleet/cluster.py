"""Run tasks on Ray; the only module that imports it."""

import contextlib
import logging
import os
import signal
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from types import ModuleType

from lanebev.app.drive.build import needs_network
from lanebev.app.fleet.plan import Outcome, Task, is_done, write_mark
from lanebev.app.fleet.worker import run_tasks
from lanebev.signals import handlers_kept

_IN_FLIGHT = 4  # tasks a core that Ray knows of at a time
_STORE = 80 * 2**20  # bytes of shared memory: results are a few numbers


@dataclass(frozen=True)
class Cluster:
    """The processes or machines on which tasks run.

    Attributes:
        address: address of a running Ray cluster; None starts one on this machine for this call.
        workers: tasks at a time on this machine, None for one a core.
        retries: retries of a task that failed or whose worker died.
        cpus: cores of a task.
        gpus: share of a GPU of a task.
        batch: drives per task, whose frames the network processes in one batch.
    """

    address: str | None = None
    workers: int | None = None
    retries: int = 2
    cpus: float = 1.0
    gpus: float = 0.0
    batch: int = 1


def check_ray() -> None:
    """Raise unless Ray is installed."""
    if find_spec("ray") is None:
        raise ValueError(
            "fleet: expected the library ray, got none; install it with pip install 'lanebev[fleet]'"
        )


def groups_of(tasks: Sequence[Task], batch: int) -> list[tuple[Task, ...]]:
    """Return tasks in groups of up to ``batch`` for one network; those that need none, one by one."""
    alike: dict[tuple[object, ...], list[Task]] = {}
    for task in tasks:
        config = task.config
        shares = needs_network(config) and batch > 1
        key = config.network if shares else (task.name,)
        alike.setdefault(key, []).append(task)
    return [
        tuple(own[first : first + batch]) for own in alike.values() for first in range(0, len(own), batch)
    ]


def outcomes(tasks: Sequence[Task], cluster: Cluster) -> Iterator[Outcome]:
    """Run tasks and yield their outcomes, in the order in which they end.

    Ray restarts a group of tasks whose worker died; if it dies repeatedly, its tasks are started one by one.
    A task that fails is started again, alone. After ``retries`` it counts as failed. If the cause is bad
    input, that is noted, and the task is not tried again until its files or settings change.
    """
    ray = _started(cluster)
    try:
        remote = ray.remote(run_tasks).options(
            num_cpus=cluster.cpus, num_gpus=cluster.gpus, max_retries=cluster.retries
        )
        most = max(16, round(_IN_FLIGHT * ray.cluster_resources().get("CPU", 1)))
        queue = _Queue(tasks, cluster)
        pending = dict[object, tuple[Task, ...]]()
        while queue.waiting or pending:
            while queue.waiting and len(pending) < most:
                group = queue.waiting.popleft()
                pending[remote.remote(group)] = group
            ready, _ = ray.wait(list(pending), num_returns=1)
            for each in ready:
                group = pending.pop(each)
                found, is_last = _found(ray, each, group)
                ended = zip(group, found, strict=True)
                yield from filter(None, (queue.end(task, outcome, is_last) for task, outcome in ended))
    finally:
        ray.shutdown()


class _Queue:
    """The groups of tasks that wait, and what follows when a task ends.

    Args:
        tasks: all of them.
        cluster: how many are in a group, and how often a failed one is tried again.

    Attributes:
        waiting: groups of tasks in order.
    """

    def __init__(self, tasks: Sequence[Task], cluster: Cluster) -> None:
        self._schedule, self._retries = Schedule(tasks), cluster.retries
        self.waiting = deque(groups_of(self._schedule.first, cluster.batch))
        self._failures, self._drives = Counter[str](), {task.name: task for task in tasks}

    def end(self, task: Task, outcome: Outcome, is_last: bool) -> Outcome | None:
        """Note what became of a task, and queue it again or the task that follows.

        Returns:
            the outcome of the drive, if it has ended.
        """
        self._failures[task.name] += bool(outcome.failure)
        if outcome.failure and not is_last and self._failures[task.name] <= self._retries:
            self.waiting.append((task,))
            return None
        follows, final = self._schedule.ended(task, outcome)
        if follows is not None:
            self.waiting.append((follows,))
        if final is not None and final.is_final:
            with contextlib.suppress(OSError):  # a full disk: the next call tries it again
                write_mark(self._drives[final.name], final)
        return final


def _found(ray: ModuleType, reference: object, group: Sequence[Task]) -> tuple[Sequence[Outcome], bool]:
    """Return what became of a group, and whether Ray has used all its retries."""
    try:
        found: Sequence[Outcome] = ray.get(reference)
    except ray.exceptions.RayError as error:  # its worker died again and again
        first = str(error).strip().splitlines()[0]
        words = f"its worker died: {type(error).__name__}: {first}"
        return [Outcome(task.name, failure=words) for task in group], len(group) == 1
    return found, False


def _started(cluster: Cluster) -> ModuleType:
    """Start Ray, or join the cluster of an address, and return its module."""
    check_ray()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray

    local: dict[str, object] = {}
    if cluster.address is None:
        local = {
            "num_cpus": None if cluster.workers is None else max(1, round(cluster.workers * cluster.cpus)),
            "include_dashboard": False,
            "object_store_memory": _STORE,
        }
    try:
        with handlers_kept():  # by Ray's own handler SIGTERM aborts with a dump of the stack
            ray.init(
                address=cluster.address or "local",
                logging_level=logging.ERROR,
                log_to_driver=False,
                configure_logging=True,
                **local,
            )
    except SystemExit:  # of Ray's own handler of SIGTERM, before ours is set again
        signal.raise_signal(signal.SIGTERM)
        raise
    except (ConnectionError, ValueError, RuntimeError) as error:
        where = cluster.address or "this machine"
        raise ValueError(
            f"fleet: expected a Ray cluster at {where}, got: {str(error).splitlines()[0]}"
        ) from error
    module: ModuleType = ray
    return module


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
