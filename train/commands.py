"""Error handling that the commands of train and tools share."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Report bad input, and files that cannot be read or written, in one line and exit with status 2.

    As a decorator too: ``@one_line_errors()``.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
