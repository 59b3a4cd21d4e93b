"""Evaluate line extraction alone on exact masks: ``python -m train.extraction``.

Prints how far the vertices are from the true boundaries, in pixels of the mask, and how that compares with
the standard deviations they come with.
"""

import json
from typing import NamedTuple

import torch
from jsonargparse.typing import PositiveInt
from torch import Tensor

from lanebev.observation.lines import extract_segments
from lanebev.observation.vertices import LineConfig
from lanebev.render import RenderedFrame, boundary_masks, render_views
from train.commands import command_parser, one_line_errors
from train.maps import boundaries_as_taken


class ExtractionError(NamedTuple):
    """Errors of the end points of all segments on all images.

    Attributes:
        distance: (K,) px of the mask, from the true boundary, across it.
        sigma: (K,) px of the mask, as reported.
        missed: share of boundaries with at least 20 px of stripe of which nothing was extracted.
    """

    distance: Tensor
    sigma: Tensor
    missed: float

    def normalised(self) -> float:
        """Compute the root mean square of the errors in sigmas; 1 if the sigmas are right."""
        return float((self.distance / self.sigma).square().mean().sqrt())


def extraction_error(frame: RenderedFrame, size: tuple[int, int], config: LineConfig) -> ExtractionError:
    """Draw each boundary's mask, extract, and compare with the boundary."""
    masks = boundary_masks(frame, size, config.half_width).double()
    segments = extract_segments(masks, size, config, size)._asdict()
    batch, boundaries = frame.boundaries.shape[:2]
    points = boundaries_as_taken(frame).double()
    scale = points.new_tensor([size[1] / frame.image.shape[3], size[0] / frame.image.shape[2]])
    truth = (points + 0.5) * scale - 0.5
    # the masks are taken for the image: one network pixel per cell, so stride is 1
    ends = segments["endpoints"].view(batch, boundaries, -1, 2)
    seen = segments["weight"].view(batch, boundaries, -1, 1).expand(-1, -1, -1, 2).flatten(2) > 0
    sigma = segments["sigma"].view(batch, boundaries, -1, 1).expand(-1, -1, -1, 2).flatten(2)
    distance = distance_to_polyline(ends, truth)
    there = masks.sum((2, 3)) > 20 * 2 * config.half_width
    missed = (there & ~seen.any(-1)).sum() / there.sum().clamp(min=1)
    return ExtractionError(distance[seen], sigma[seen], float(missed))


def distance_to_polyline(points: Tensor, line: Tensor) -> Tensor:
    """Compute the distance of points (..., N, 2) to the nearest piece of a polyline (..., P, 2), (..., N)."""
    start, along = line[..., None, :-1, :], line.diff(dim=-2).unsqueeze(-3)  # (..., 1, P - 1, 2)
    away = points.unsqueeze(-2) - start
    part = (away * along).sum(-1) / along.square().sum(-1).clamp(min=1e-12)
    distance: Tensor = (away - part.clamp(0, 1).unsqueeze(-1) * along).norm(dim=-1)
    return distance.amin(-1)


def join(errors: list[ExtractionError]) -> ExtractionError:
    """Join errors of several batches of equally many images."""
    distance, sigma, missed = zip(*errors, strict=True)
    return ExtractionError(torch.cat(distance), torch.cat(sigma), sum(missed) / len(missed))


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("--frames", type=PositiveInt, default=64)
    parser.add_argument("--size", type=int, nargs=2, default=(144, 256), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if args.frames % 8:
        parser.error(f"--frames: expected a multiple of 8, got {args.frames}")
    generator, size = torch.Generator().manual_seed(args.seed), tuple(args.size)
    image_size = (size[0] // 2, size[1] // 2)  # only the truth is used
    batches = [render_views(8, image_size, generator) for _ in range(args.frames // 8)]
    error = join([extraction_error(batch, size, LineConfig(stride=1)) for batch in batches])
    report = {
        "vertices": len(error.distance),
        "rms_px": float(error.distance.square().mean().sqrt()),
        "within_0.1_px": float((error.distance < 0.1).double().mean()),
        "p99_px": float(error.distance.quantile(0.99)),
        "max_px": float(error.distance.max()),
        "normalised_error": error.normalised(),
        "missed": error.missed,
    }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
