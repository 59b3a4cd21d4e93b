"""The mean of several networks' weights: ``python -m train.average OUT A B``.

Source: Wortsman et al. 2022, "Robust fine-tuning of zero-shot models": between a network and what it was
fine-tuned to lie networks that are better than both. The same holds for two that were fine-tuned from one.
The training settings in its file are those of the last network.
"""

from pathlib import Path

import torch

from lanebev.observation.segmenter import LaneSegmenter
from lanebev.weights import save_segmenter
from train.commands import command_parser, one_line_errors
from train.export import trained_segmenter


def average(segmenters: list[LaneSegmenter]) -> LaneSegmenter:
    """Return a network with the mean of the weights; counters are those of the first."""
    first, *others = segmenters
    for other in others:
        if other.config != first.config:
            raise ValueError(f"expected networks of one configuration, got {first.config} and {other.config}")
    states = [segmenter.state_dict() for segmenter in segmenters]
    result = LaneSegmenter(first.config)
    result.load_state_dict(
        {
            name: torch.stack([state[name] for state in states]).mean(0)
            if value.is_floating_point()
            else value
            for name, value in states[0].items()
        }
    )
    return result.eval()


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("weights", type=Path, nargs="+", help="weights files or checkpoints")
    args = parser.parse_args()
    if args.out.exists():
        parser.error(f"out: expected a new file, which comes first, got {args.out}, which is there")
    segmenters, training = zip(*map(trained_segmenter, args.weights), strict=True)
    names = [path.name for path in args.weights]
    save_segmenter(average(list(segmenters)), args.out, training={**training[-1], "average_of": names})


if __name__ == "__main__":
    main()
