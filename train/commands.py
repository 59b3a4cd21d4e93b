"""Parts of all commands of train and tools: arguments, errors, and the versions they report."""

import argparse
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

import lanebev

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


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


def versions() -> dict[str, object]:
    """Return what figures depend on beside the command: versions, and the number of threads."""
    return {
        "lanebev": lanebev.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "threads": torch.get_num_threads(),
    }


def evaluation_parser(description: str | None) -> argparse.ArgumentParser:
    """Return such a parser with the folder of the evaluation data and the network's weights as options."""
    parser = command_parser(description)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the data (../shared/data)")
    parser.add_argument("--weights", type=Path, help="other weights than the shipped")
    return parser
