"""The options of tools that evaluate the network."""

import argparse

from jsonargparse.typing import PositiveInt

from lanebev import FarView, LaneBEV
from lanebev.app.config import PRECISIONS
from lanebev.app.drive.build import with_precision
from train.commands import evaluation_parser


def network_parser(description: str | None) -> argparse.ArgumentParser:
    """Return the parser of an evaluation, with the options of :func:`make_model`."""
    parser = evaluation_parser(description)
    parser.add_argument("--width", type=PositiveInt, help="px of the network's input, instead of its own")
    parser.add_argument("--precision", choices=PRECISIONS, default=PRECISIONS[0], help="of the network")
    words = "the network also processes far views about the horizon"
    parser.add_argument("--far-view", action="store_true", help=words)
    return parser


def make_model(options: argparse.Namespace) -> LaneBEV:
    """Make the model that the options of a :func:`network_parser` state, for evaluation."""
    far_view = FarView() if options.far_view else None
    model = LaneBEV.from_pretrained(options.weights, network_width=options.width, far_view=far_view)
    return with_precision(model, options.precision).eval()
