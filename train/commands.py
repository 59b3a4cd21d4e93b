"""What the commands of train and tools have in common."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Bad input, and files that can't be read or written, leave as one line and exit status 2.

    As a decorator too: ``@one_line_errors()``.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
