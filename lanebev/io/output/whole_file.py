"""Write a file completely or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacement(path: str | Path) -> Iterator[Path]:
    """Give a path to write to, whose file takes the place of ``path`` if the ``with`` block ends well.

    Raises:
        OSError: the file cannot be written, or a folder, a device or a pipe is there; an older file is as it
            was then.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # such as /dev/null
        raise OSError(0, "a folder" if path.is_dir() else "a device or a pipe")
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.partial-", dir=path.parent) as partial:
        whole = Path(partial) / path.name
        yield whole
        whole.replace(path)


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Give a path to write the result of a command to, see :func:`replacement`.

    Raises:
        ValueError: the file cannot be written; nothing of it is there then.
    """
    target = Path(os.path.realpath(path))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with replacement(target) as whole:
            yield whole
    except OSError as error:
        raise ValueError(
            f"out {path}: expected a file that can be written, got: {error.strerror or error}; "
            "give another with --out"
        ) from error
