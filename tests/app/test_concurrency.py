"""What runs side by side: frames and calls made ahead, and calls in the background."""

import threading
import time

import pytest
import torch

from lanebev.app.concurrency import Background, map_ahead, prefetch


def test_map_ahead_keeps_order_and_calls_side_by_side():
    both = threading.Barrier(2, timeout=20)  # passed only by two calls at once

    def square(number: int) -> int:
        both.wait()
        return number * number

    assert list(map_ahead(square, range(6), 2)) == [(k, k * k) for k in range(6)]


def test_map_ahead_shares_out_the_threads_of_torch_and_gives_them_back():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(4)
        inside = [used for _, used in map_ahead(lambda _: torch.get_num_threads(), range(3), 2)]
        assert inside == [2, 2, 2]
        assert torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(before)


def test_map_ahead_raises_what_a_call_raised_in_its_place_and_stops_when_left():
    before = torch.get_num_threads()
    results = map_ahead(lambda number: 6 // number, [3, 2, 0, 1], 2)
    assert [next(results), next(results)] == [(3, 2), (2, 3)]
    with pytest.raises(ZeroDivisionError):
        next(results)
    endless = map_ahead(str, iter(int, 1), 2)
    next(endless)
    endless.close()
    assert not any(thread.name.startswith(("map_ahead", "prefetch")) for thread in threading.enumerate())
    assert torch.get_num_threads() == before


def test_prefetch_keeps_order_and_runs_ahead():
    made = []

    def produce():
        for i in range(6):
            made.append(i)
            yield i

    items = prefetch(produce(), depth=3)
    assert next(items) == 0
    deadline = time.monotonic() + 5
    while len(made) < 4 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert len(made) >= 4
    assert list(items) == [1, 2, 3, 4, 5]


def test_prefetch_raises_what_the_producer_raised_and_stops_when_left():
    def broken():
        yield 1
        raise ValueError("frame 2")

    items = prefetch(broken())
    assert next(items) == 1
    with pytest.raises(ValueError, match="frame 2"):
        next(items)
    endless = prefetch(iter(int, 1))
    next(endless)
    endless.close()
    assert not any(thread.name.startswith("prefetch") for thread in threading.enumerate())


def test_background_runs_in_order_and_raises():
    done = []
    with Background() as background:
        for i in range(20):
            background.submit(lambda i=i: done.append(i))
    assert done == list(range(20))

    def fail():
        raise OSError("disk full")

    def run():
        with Background() as background:
            background.submit(fail)

    with pytest.raises(OSError, match="disk full"):
        run()
