"""Evaluate where a network finds boundaries: ``python -m train.evaluate_roads WEIGHTS``.

On held-out rendered views, by boundary, distance ahead, kind of road
(:data:`lanebev.render.scene.kinds.KINDS`) and brightness of the image, over label rows:

    recall    share of the rows with a visible boundary in which it is found at its place
    error_px  root mean square error of its position in those rows, px of the network's input
    false     rows in which a boundary is reported where there is none, as a share of the rows with one
"""

import itertools
import json
import math
import time
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import torch
from jsonargparse.typing import PositiveInt
from rich.console import Console
from rich.table import Table
from torch import Tensor

from lanebev.geometry.lens import undistort_points
from lanebev.geometry.road import road_from_image_points
from lanebev.observation.segmenter import LaneSegmenter
from lanebev.render import RenderedFrame, render_views
from lanebev.render.scene.kinds import KINDS
from train.commands import command_parser, one_line_errors
from train.export import trained_segmenter
from train.labels import ViewConfig
from train.maps import boundaries_as_taken, label_maps
from train.metrics import row_recall
from train.rendering import combined_seed

TOLERANCE = 2.5  # label px
DISTANCES = (0.0, 10.0, 20.0, 40.0, 80.0, float("inf"))  # m
OWN_KINDS = tuple(kind for kind in KINDS if kind not in ("any", "varied"))  # those that are no mixture
HELD_OUT_SEED = 91_000
_BEYOND = 1e9  # m, of a row above the horizon of a flat road
BRIGHTNESS = (0.0, 0.1, 0.25, 1.01)  # mean of the image


class Rows(NamedTuple):
    """Truth and detection of each label row, (B, L, h).

    Attributes:
        there: a visible boundary.
        found: and the network finds it.
        off: px of the network's input, between the two centres.
        false: the network claims a boundary where there is none, hidden ones aside.
        distance: m ahead on a flat road; NaN where there is no boundary.
        brightness: brightness of the image.
    """

    there: Tensor
    found: Tensor
    off: Tensor
    false: Tensor
    distance: Tensor
    brightness: Tensor


def judge_rows(logits: Tensor, frame: RenderedFrame, view: ViewConfig) -> Rows:
    """Compare the network's logits (B, 1+L, h, w) with a rendered batch."""
    size = (frame.image.shape[-2], frame.image.shape[-1])
    points = boundaries_as_taken(frame)
    target, weight = label_maps(points, frame.painted > 0.5, frame.visible > 0.5, size, view)
    probability = logits.float().softmax(1)[:, 1:]
    found, there = row_recall(probability, target, TOLERANCE)
    columns = torch.arange(target.shape[-1], dtype=target.dtype, device=target.device)
    label, seen = ((each * columns).sum(-1) / each.sum(-1).clamp(min=1e-6) for each in (target, probability))
    labelled = target.sum(-1) > 0
    claimed = (probability * weight.unsqueeze(1)).sum(-1) > view.half_width  # half of a stripe's mass
    rows = torch.arange(target.shape[-2], dtype=target.dtype, device=target.device)
    taken = torch.stack([label, rows.expand_as(label)], dim=-1) * view.output_stride
    flat = undistort_points(taken.flatten(1, 2), frame.intrinsics, frame.distortion)
    road, ahead = road_from_image_points(flat, frame.intrinsics, frame.extrinsics)
    distance = torch.where(ahead, road[..., 1], _BEYOND).reshape(label.shape)
    return Rows(
        there=there,
        found=found,
        off=view.output_stride * (seen - label),
        false=claimed & ~labelled,
        distance=torch.where(there, distance, float("nan")),
        brightness=frame.image.mean((1, 2, 3))[:, None, None].expand_as(label),
    )


class Sums(NamedTuple):
    """Counts of rows, and the sum of squared distances."""

    there: float = 0.0
    found: float = 0.0
    squares: float = 0.0
    false: float = 0.0

    def figures(self) -> dict[str, float]:
        """Return recall, error and false claims; NaN where there is nothing to tell."""
        there, found = self.there or float("nan"), self.found or float("nan")
        return {
            "rows": self.there,
            "recall": round(self.found / there, 4),
            "error_px": round((self.squares / found) ** 0.5, 3),
            "false": round(self.false / there, 4),
        }


def add_up(rows: Rows, where: Tensor) -> Sums:
    """Sum over the rows of a mask that broadcasts to (B, L, h)."""
    found = rows.found & where
    values = (rows.there & where, found, torch.where(found, rows.off, 0.0).square(), rows.false & where)
    return Sums(*torch.stack([value.double().sum() for value in values]).tolist())


def groups(rows: Rows, kind: str) -> dict[tuple[str, str], Tensor]:
    """Return the masks of all groups that a batch of one kind of road has a part in."""
    everywhere = torch.ones_like(rows.there)
    index = torch.arange(rows.there.shape[1], device=rows.there.device)[:, None]
    found = {("kind", kind): everywhere}
    found |= {("boundary", str(k)): (index == k) & everywhere for k in range(rows.there.shape[1])}
    for low, high in itertools.pairwise(DISTANCES):
        found["distance_m", f"{low:g} to {high:g}"] = (rows.distance >= low) & (rows.distance < high)
    for low, high in itertools.pairwise(BRIGHTNESS):
        found["brightness", f"{low:g} to {min(high, 1):g}"] = (rows.brightness >= low) & (
            rows.brightness < high
        )
    return found


@torch.inference_mode()
def evaluate(
    segmenter: LaneSegmenter,
    views: int,
    kinds: list[str],
    seed: int,
    batch: int,
    deadline: float = math.inf,
) -> dict[tuple[str, str], Sums]:
    """Evaluate a network, on its device, on rendered views of its own size.

    Args:
        segmenter: the network.
        views: number of views of each kind of road.
        kinds: kinds of road, which take turns, so that each has its share if time runs out.
        seed: seed of the views.
        batch: views rendered together.
        deadline: time of :func:`time.monotonic` at which no further batch begins that would not end before
            it, if it takes as long as the longest so far.
    """
    device = next(segmenter.parameters()).device
    view = ViewConfig(output_stride=segmenter.config.output_stride)
    total: dict[tuple[str, str], Sums] = defaultdict(Sums)
    longest, begin = 0.0, time.monotonic()
    for start, (number, kind) in itertools.product(range(0, views, batch), enumerate(kinds)):
        if begin + longest > deadline:
            break
        count = min(batch, views - start)
        generator = torch.Generator().manual_seed(combined_seed((seed, number, start)))
        frame = render_views(count, segmenter.image_size, generator, device=device, kind=kind)
        rows = judge_rows(segmenter(frame.image), frame, view)
        for name, mask in groups(rows, kind).items():
            sums = zip(total[name], add_up(rows, mask), strict=True)
            total[name] = Sums(*(a + b for a, b in sums))
        now = time.monotonic()
        longest, begin = max(longest, now - begin), now
    return dict(sorted(total.items(), key=lambda item: item[0][0]))


def records(total: dict[tuple[str, str], Sums]) -> list[dict[str, str | float]]:
    """Return the figures of all groups."""
    return [{"by": by, "name": name, **sums.figures()} for (by, name), sums in total.items()]


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("weights", type=Path)
    parser.add_argument(
        "--views", type=PositiveInt, default=64, help="number of views, all kinds together (about)"
    )
    parser.add_argument("--kinds", nargs="+", default=list(OWN_KINDS))
    parser.add_argument("--seed", type=int, default=HELD_OUT_SEED)
    parser.add_argument("--batch", type=PositiveInt, default=32, help="views rendered together")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object per line instead of the table"
    )
    args = parser.parse_args()
    segmenter = trained_segmenter(args.weights)[0].to(args.device)
    views = -(-args.views // len(args.kinds))
    total = evaluate(segmenter, views, args.kinds, args.seed, args.batch)
    table = Table("by", "", "rows", "recall", "error_px", "false")
    for record in records(total):
        table.add_row(*(f"{value:g}" if isinstance(value, float) else value for value in record.values()))
        if args.json:
            print(json.dumps(record))
    if not args.json:
        Console().print(table)


if __name__ == "__main__":
    main()
