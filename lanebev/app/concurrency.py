"""Decode, process and write in parallel: threads ahead that read and process, one behind that writes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar, cast

import torch

T = TypeVar("T")
Result = TypeVar("Result")
_END = object()
_MOST_CALLS = 8  # calls that wait for the background thread, at most


def prefetch(items: Iterable[T], depth: int = 4) -> Iterator[T]:
    """Yield the same items in the same order, up to ``depth`` of them made ahead in a thread.

    An exception of the producer is raised here. Leaving the loop early stops the thread.
    """
    iterator = iter(items)
    pool = ThreadPoolExecutor(1, "prefetch")
    try:
        ahead = deque(pool.submit(next, iterator, _END) for _ in range(depth))
        while (item := ahead.popleft().result()) is not _END:
            ahead.append(pool.submit(next, iterator, _END))
            yield cast(T, item)
    finally:
        pool.shutdown(cancel_futures=True)


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
        self._pool = ThreadPoolExecutor(1, "background")
        self._calls: deque[Future[object]] = deque()

    def __enter__(self) -> Background:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        try:
            while self._calls and error is None:
                self._calls.popleft().result()
        finally:
            self._pool.shutdown(cancel_futures=True)

    def submit(self, call: Callable[[], object]) -> None:
        """Queue a call; waits while the queue is full, raises if an earlier call failed."""
        while self._calls and (self._calls[0].done() or len(self._calls) >= _MOST_CALLS):
            self._calls.popleft().result()
        self._calls.append(self._pool.submit(call))
