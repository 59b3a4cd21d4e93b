"""Computing on one thread, from several Python threads."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest
import torch

from lanebev import JointCalibrator
from lanebev.estimation.joint.frame import single_frame
from lanebev.estimation.still import calibrate_still
from lanebev.tensors import one_thread
from lanebev.testing.moments import CAMERA, WIDTH, moments, observe


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


class Counting(JointCalibrator):
    """Notes the number of threads of every step."""

    def step(self, *frame):
        self.threads = torch.get_num_threads()
        return super().step(*frame)


@pytest.mark.parametrize(("rows", "expected"), [(1, 1), (8, 1), (200, 2)])
def test_one_thread_computes_a_frame_of_few_segments(rows, expected, monkeypatch):
    """Operations on small matrices take longer with two threads, on busy cores many times longer."""
    threads, used = torch.get_num_threads(), []
    fit = single_frame.fit_observations
    monkeypatch.setattr(
        single_frame,
        "fit_observations",
        lambda *given: (used.append(torch.get_num_threads()), fit(*given))[1],
    )
    ((_, segments),) = observe(moments(1 / 30), rows, 1.0, 4, 0, torch.float32)
    cameras, calibrator = CAMERA.expand(rows, 3, 3).float(), Counting()
    torch.set_num_threads(2)
    try:
        single_frame.fit_single_frame(segments, cameras, WIDTH)
        assert used == [expected]
        calibrate_still(calibrator, segments, cameras, WIDTH)
        assert calibrator.threads == expected
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
