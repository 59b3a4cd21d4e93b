"""Computing on one thread, from several Python threads."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import torch

from lanebev.tensors import one_thread


def test_overlapping_blocks_leave_the_number_of_threads_as_it_was_before_the_first() -> None:
    entered, leave = Event(), Event()

    def other() -> int:
        with one_thread():
            entered.set()
            leave.wait(10)
        return torch.get_num_threads()

    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with ThreadPoolExecutor(1) as pool:
            with one_thread():
                begun = pool.submit(other)
                assert entered.wait(10)
            assert torch.get_num_threads() == 2
            leave.set()
            assert begun.result() == 2  # it began with 1
        with ThreadPoolExecutor(1) as pool:
            assert pool.submit(torch.get_num_threads).result() == 2  # of threads that begin later
    finally:
        torch.set_num_threads(threads)


def test_a_block_inside_another_one_leaves_one_thread_until_the_outer_one_ends() -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with one_thread():
            with one_thread():
                assert torch.get_num_threads() == 1
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
