"""A lock on a folder that ends with the process that holds it, however that ends."""

import errno
import importlib
import importlib.util
import os
from pathlib import Path
from typing import Any

fcntl: Any = importlib.import_module("fcntl") if importlib.util.find_spec("fcntl") else None  # Windows: none

LOCK_NAME = ".lock"
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)  # file systems that have none


class FolderLock:
    """Holds ``.lock`` in a folder that is made if it is not there.

    The operating system releases the lock with the process, so one that was killed leaves none. Where the
    file system or the operating system has no such locks, nothing is locked.

    Args:
        folder: to make and to lock; its parent exists.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._file: int | None = None

    def acquire(self) -> bool:
        """Make and lock the folder; whether no other process holds it.

        Raises:
            OSError: the folder cannot be made or written.
        """
        while True:
            self.folder.mkdir(mode=0o700, exist_ok=True)
            try:
                file = os.open(self.folder / LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o600)
            except FileNotFoundError:  # its holder has just removed the folder
                continue
            try:
                _lock(file)
            except BlockingIOError:
                os.close(file)
                return False
            if os.fstat(file).st_nlink or fcntl is None:
                self._file = file
                return True
            os.close(file)  # the holder has just removed the file

    def release(self) -> None:
        """Let others have it; twice is no error."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _lock(file: int) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
