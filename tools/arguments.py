"""Options that several evaluations have."""

import argparse
from pathlib import Path

from train.commands import command_parser

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def evaluation_parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the folder of the evaluation data and the network's weights as options.

    Args:
        description: docstring of the program, shown as it is.
    """
    parser = command_parser(description)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the data (../shared/data)")
    parser.add_argument("--weights", type=Path, help="other weights than the shipped")
    return parser


def add_far_view(parser: argparse.ArgumentParser) -> None:
    """Add the option of a far view to a parser."""
    words = "the network also processes far views about the horizon"
    parser.add_argument("--far-view", action="store_true", help=words)
