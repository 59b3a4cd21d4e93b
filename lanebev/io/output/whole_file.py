"""Write a file completely or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Give a path to write to, whose file takes the place of ``path`` at the end of the ``with`` block.

    Raises:
        ValueError: the file cannot be written; nothing of it is there then.
    """
    target = Path(os.path.realpath(path))
    try:
        if target.is_dir():
            raise IsADirectoryError(0, "a folder")
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.partial-", dir=target.parent) as partial:
            whole = Path(partial) / target.name
            yield whole
            whole.replace(target)
    except OSError as error:
        raise ValueError(
            f"out {path}: expected a file that can be written, got: {error.strerror or error}; "
            "give another with --out"
        ) from error
