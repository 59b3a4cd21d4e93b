"""What the commands of train and tools share: their arguments and their errors."""

import argparse
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


def command_parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser whose ``--help`` shows a docstring as it is written."""
    formatter = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(description=description, formatter_class=formatter)
