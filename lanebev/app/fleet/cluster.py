"""Run tasks on Ray; the only module that imports it."""

import logging
import os
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from types import ModuleType

from lanebev.app.fleet.plan import Outcome, Task
from lanebev.app.fleet.queue import TaskQueue
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
        queue = TaskQueue(tasks, cluster.batch, cluster.retries)
        pending = dict[object, tuple[Task, ...]]()
        while queue.waiting or pending:
            while queue.waiting and len(pending) < most:
                group = queue.waiting.popleft()
                pending[remote.remote(group)] = group
            ready, _ = ray.wait(list(pending), num_returns=1)
            for each in ready:
                group = pending.pop(each)
                found, may_retry = _found(ray, each, group)
                ended = zip(group, found, strict=True)
                yield from filter(None, (queue.end(task, outcome, may_retry) for task, outcome in ended))
    finally:
        ray.shutdown()


def _found(ray: ModuleType, reference: object, group: Sequence[Task]) -> tuple[Sequence[Outcome], bool]:
    """Return the outcomes of a group, and whether its tasks may run again: Ray ran one alone often enough."""
    try:
        found: Sequence[Outcome] = ray.get(reference)
    except ray.exceptions.RayError as error:  # its worker died again and again
        first = str(error).strip().splitlines()[0]
        words = f"its worker died: {type(error).__name__}: {first}"
        return [Outcome(task.name, failure=words) for task in group], len(group) > 1
    return found, True


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
