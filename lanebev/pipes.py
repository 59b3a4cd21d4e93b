"""Pipes that another program writes into, without waiting for it for ever."""

import os
import select
from io import FileIO
from pathlib import Path

_LONGEST_WAIT = 30.0  # s without anything, after which a pipe is no source


def open_pipe(path: str | Path) -> FileIO:
    """Open a named pipe at once, where opening a file waits for a program that writes."""
    return open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb", buffering=0)


def await_bytes(pipe: FileIO) -> None:
    """Wait until something has come through a pipe, or it ends."""
    if hasattr(select, "poll"):  # not on Windows
        waiting = select.poll()
        waiting.register(pipe, select.POLLIN)
        if not waiting.poll(1000 * _LONGEST_WAIT):
            raise ValueError(f"nothing for {_LONGEST_WAIT:g} s")
        os.set_blocking(pipe.fileno(), True)
