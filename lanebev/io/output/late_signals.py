"""Signals that come when the work is done."""

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def late_signals_ignored() -> Iterator[None]:
    """Ignore SIGINT, SIGTERM and SIGHUP meanwhile, as for the moment in which outputs are moved into place.

    Threads other than the main one cannot, and are not interrupted by them.
    """
    names = ("SIGINT", "SIGTERM", "SIGHUP")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    before = {number: signal.signal(number, signal.SIG_IGN) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
