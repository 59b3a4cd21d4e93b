"""Tasks on Ray: the only module that imports it."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from types import ModuleType

from lanebev.app.fleet.plan import Outcome, Task, write_mark
from lanebev.app.fleet.worker import run_task
from lanebev.io.results import OutputFolderError

_IN_FLIGHT = 4  # tasks a core that Ray knows of at a time
_STORE = 80 * 2**20  # bytes of shared memory: results are a few numbers


@dataclass(frozen=True)
class Cluster:
    """Where tasks run.

    Attributes:
        address: of a running Ray cluster, None for one on this machine that ends with the call.
        workers: tasks at a time on this machine, None for one a core.
        retries: of a task that failed or whose worker died.
        cpus: cores of a task.
        gpus: share of a GPU of a task.
    """

    address: str | None = None
    workers: int | None = None
    retries: int = 2
    cpus: float = 1.0
    gpus: float = 0.0


def check_ray() -> None:
    """Raise unless Ray is installed.

    Raises:
        ValueError: it is not.
    """
    if find_spec("ray") is None:
        raise ValueError(
            "fleet: expected the library ray, got none; install it with pip install 'lanebev[fleet]'"
        )


def outcomes(tasks: Sequence[Task], cluster: Cluster) -> Iterator[Outcome]:
    """Run tasks and yield what became of each, in the order in which they end.

    Ray starts a task again whose worker died or which raised. After ``retries`` it counts as failed; where
    it was the input's fault, that is noted, and it is not tried again until its files or settings change.
    """
    ray = _started(cluster)
    try:
        remote = ray.remote(run_task).options(
            num_cpus=cluster.cpus,
            num_gpus=cluster.gpus,
            max_retries=cluster.retries,
            retry_exceptions=True,
        )
        most = max(16, round(_IN_FLIGHT * ray.cluster_resources().get("CPU", 1)))
        waiting, pending = iter(tasks), dict[object, Task]()
        while True:
            while len(pending) < most and (task := next(waiting, None)) is not None:
                pending[remote.remote(task)] = task
            if not pending:
                return
            ready, _ = ray.wait(list(pending), num_returns=1)
            for each in ready:
                yield _outcome(ray, each, pending.pop(each))
    finally:
        ray.shutdown()


def _outcome(ray: ModuleType, reference: object, task: Task) -> Outcome:
    try:
        outcome: Outcome = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        is_input = isinstance(error.cause, (ValueError, OSError))
        words = " ".join(str(error.cause).split()) or type(error.cause).__name__
        words = words if is_input else f"{type(error.cause).__name__}: {words}"
        is_final = isinstance(error.cause, ValueError) and not isinstance(error.cause, OutputFolderError)
        outcome = Outcome(task.name, failure=words, is_final=is_final)
        if outcome.is_final:
            write_mark(task, outcome)
    except ray.exceptions.RayError as error:  # its worker died again and again
        first = str(error).strip().splitlines()[0]
        outcome = Outcome(task.name, failure=f"its worker died: {type(error).__name__}: {first}")
    return outcome


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
        ray.init(
            address=cluster.address or "local",
            logging_level=logging.ERROR,
            log_to_driver=False,
            configure_logging=True,
            **local,
        )
    except (ConnectionError, ValueError, RuntimeError) as error:
        where = cluster.address or "this machine"
        raise ValueError(
            f"fleet: expected a Ray cluster at {where}, got: {str(error).splitlines()[0]}"
        ) from error
    module: ModuleType = ray
    return module
