"""Handlers of the signals that end a program. Imports nothing heavy."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

Handler = Callable[[int, FrameType | None], object] | int

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has not all of them


@contextmanager
def handlers_kept() -> Iterator[dict[int, Handler]]:
    """Set the handlers of SIGINT, SIGTERM and SIGHUP again after a block, which is given them by signal.

    It is given none in a thread other than the main one, since Python lets no other thread set handlers.
    """
    numbers = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    found = {number: signal.getsignal(number) for number in numbers}
    before = {number: handler for number, handler in found.items() if handler is not None}  # None: one of C
    try:
        yield before
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
