"""What runs side by side: calls ahead of the frames."""

from __future__ import annotations

import threading

import pytest
import torch

from lanebev.app.concurrency import map_ahead


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
