"""Run several drives in one process, as the command line does, each in its own thread."""

import shutil
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from pathlib import Path

from lanebev.app.config import NetworkSettings, RunConfig
from lanebev.app.continued.part_observation import observe_part
from lanebev.app.continued.recovery import size_and_time
from lanebev.app.drive.build import make_network, needs_network
from lanebev.app.drive.shared_network import SharedNetwork
from lanebev.app.fleet.plan import Outcome, Task, earlier_outcome, write_mark
from lanebev.app.run import run
from lanebev.io.output.folder import OutputFolderError
from lanebev.pipeline import LaneBEV


def run_tasks(tasks: Sequence[Task]) -> list[Outcome]:
    """Run on drives at the same time, and note which are done.

    The network processes their frames in batches, and stays loaded for later calls in this process.
    A drive that fails has an outcome that says why, and disturbs no other.

    Args:
        tasks: all with the same settings of the network. What is done already, by a worker that died
            later on, is not done again.
    """
    try:
        network = _shared_network(tasks[0].config, len(tasks))
    except Exception as error:  # reported as the failure of every drive
        return [_failed(task, error) for task in tasks]
    if len(tasks) == 1:  # in the main thread, which signals reach
        return [_run_task(tasks[0], network)]
    with ThreadPoolExecutor(len(tasks), "drive") as pool:
        return list(pool.map(partial(_run_task, network=network), tasks))


def _run_task(task: Task, network: SharedNetwork | None) -> Outcome:
    earlier = earlier_outcome(task)
    if earlier is not None and not earlier.failure:
        return earlier
    start = time.perf_counter()
    try:
        if task.is_part:
            frames = observe_part(task.config, task.result, network)
        else:
            frames = len(run(task.config, network=network, parts=[part.result for part in task.parts]).rows)
        before = sum(part.seconds for part in map(earlier_outcome, task.parts) if part is not None)
        outcome = Outcome(task.name, frames=frames, seconds=before + time.perf_counter() - start)
        write_mark(task, outcome)
    except Exception as error:  # a failure of any kind must not stop the other drives
        return _failed(task, error)
    for part in task.parts:
        shutil.rmtree(part.config.out, ignore_errors=True)
    return outcome


def _failed(task: Task, error: Exception) -> Outcome:
    """Return the outcome of a drive that raised; it is final where the same input would raise it again."""
    words = " ".join(str(error).split()) or type(error).__name__
    if not isinstance(error, (ValueError, OSError)):
        words = f"{type(error).__name__}: {words}"
    is_final = isinstance(error, ValueError) and not isinstance(error, OutputFolderError)
    return Outcome(task.name, failure=words, is_final=is_final)


def _shared_network(config: RunConfig, batch: int) -> SharedNetwork | None:
    if not needs_network(config):
        return None
    changed = size_and_time(Path(config.weights)) if config.weights else (0, 0)
    return SharedNetwork(_loaded(config.network, changed), batch)


@lru_cache(maxsize=1)
def _loaded(settings: NetworkSettings, changed: tuple[int, int]) -> LaneBEV:
    """Return a network; ``changed`` is the size and time of its weights file, to notice a new one."""
    return make_network(*settings)
