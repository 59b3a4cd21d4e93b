"""Decode, process and write in parallel: threads ahead that read and process, one behind that writes."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import TypeVar

import torch

T = TypeVar("T")
Result = TypeVar("Result")
_END = object()
_MOST_CALLS = 8  # calls that wait for the background thread, at most


def prefetch(items: Iterable[T], depth: int = 4) -> Iterator[T]:
    """Yield the same items in the same order, up to ``depth`` of them made ahead in a thread.

    An exception of the producer is raised here. Leaving the loop early stops the thread.
    """
    ready: queue.Queue[object] = queue.Queue(depth)
    stop = threading.Event()

    def put(item: object) -> bool:
        while not stop.is_set():
            try:
                ready.put(item, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def produce() -> None:
        try:
            for item in items:
                if not put(item):
                    return
            put(_END)
        except BaseException as error:
            put(_Failure(error))

    thread = threading.Thread(target=produce, name="prefetch", daemon=True)
    thread.start()
    try:
        while (item := ready.get()) is not _END:
            if isinstance(item, _Failure):
                raise item.error
            yield item  # type: ignore[misc]
    finally:
        stop.set()
        thread.join()


def map_ahead(call: Callable[[T], Result], items: Iterable[T], workers: int) -> Generator[tuple[T, Result]]:
    """Yield each item with the result of ``call``, in order, with several calls in parallel threads.

    Meanwhile torch's threads are divided among the calls; its operations in other threads use no more
    threads than one call. Several calls of one thread each are faster than one call after another with
    several threads, which wait for each other at the end of every operation.

    Args:
        call: function that may run in several threads at once.
        items: input, produced ahead in a thread.
        workers: number of parallel calls.
    """
    threads = torch.get_num_threads()
    pool = ThreadPoolExecutor(workers, "map_ahead")
    try:
        torch.set_num_threads(max(1, threads // workers))  # also of threads that begin later
        submitted = ((item, pool.submit(call, item)) for item in items)
        for item, future in prefetch(submitted, depth=workers + 1):
            yield item, future.result()
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads)


class Background:
    """Runs calls one after another in a thread; ``with`` waits for them and raises their exceptions."""

    def __init__(self) -> None:
        self._calls: queue.Queue[Callable[[], object] | None] = queue.Queue(_MOST_CALLS)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="background", daemon=True)

    def __enter__(self) -> Background:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._calls.put(None)
        self._thread.join()
        if error is None and self._error is not None:
            raise self._error

    def submit(self, call: Callable[[], object]) -> None:
        """Queue a call; waits while the queue is full, raises if an earlier call failed."""
        if self._error is not None:
            raise self._error
        self._calls.put(call)

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            if self._error is None:
                try:
                    call()
                except BaseException as error:
                    self._error = error


class _Failure:
    def __init__(self, error: BaseException) -> None:
        self.error = error
