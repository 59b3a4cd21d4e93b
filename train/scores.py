"""Scores of TuSimple, CULane and OpenLane from logits, over a data set."""

from typing import NamedTuple

import numpy as np
from torch import Tensor

from lanebev.io.lanes.parsing import FrameLines
from lanebev.observation.lines import LineExtractor
from lanebev.observation.polylines import BoundaryRows, rows_from_vertices
from lanebev.observation.vertices import LineConfig
from train.datasets import ScoredBatch
from train.metrics import CULaneCounts, culane_counts, tusimple_score


class DrawnLanes(NamedTuple):
    """Settings of a benchmark that compares drawn lanes.

    Attributes:
        height: px, of its images.
        line: px, width of a lane drawn on them.
        overlap: intersection over union above which a lane is found.
        middle: boundaries about the ego lane that it labels, at most.
    """

    height: int
    line: int
    overlap: float
    middle: int


DRAWN = {
    "culane": DrawnLanes(590, 30, 0.5, 4),  # Pan et al. 2018
    "openlane": DrawnLanes(1280, 30, 0.3, 6),  # Chen et al. 2022, its LANE_evaluation
}


class BenchmarkScores:
    """Collects images and computes the benchmark's scores: TuSimple's accuracy, FP and FN, or F1."""

    def __init__(self) -> None:
        self.tusimple: list[tuple[float, float, float]] = []
        self.drawn = CULaneCounts(0, 0, 0)

    def update(self, logits: Tensor, network_size: tuple[int, int], batch: ScoredBatch) -> None:
        """Add images: logits (B, 1+L, h, w) of the images resized to the network's (height, width)."""
        for i, (lines, size) in enumerate(zip(batch.lines, batch.image_sizes, strict=True)):
            rows = boundary_rows(logits[i : i + 1], network_size, size)
            if batch.benchmark == "tusimple":
                self.tusimple.append(tusimple_score(rows.x, rows.rows, lines))
                continue
            counts = drawn_counts(rows, lines, size, batch.benchmark)
            self.drawn = CULaneCounts(*(a + b for a, b in zip(self.drawn, counts, strict=True)))

    def compute(self) -> dict[str, float]:
        """Return the named figures; none if there was nothing to score."""
        figures: dict[str, float] = {}
        if self.tusimple:
            names = ("accuracy", "false_positives", "false_negatives")
            figures |= dict(zip(names, np.mean(self.tusimple, axis=0).tolist(), strict=True))
        if any(self.drawn):
            figures["f1"] = self.drawn.f1()
        return figures


def drawn_counts(
    rows: BoundaryRows, label: FrameLines, image_size: tuple[int, int], benchmark: str
) -> CULaneCounts:
    """Count one image's matches by the rules of a benchmark that draws lanes."""
    rules = DRAWN[benchmark]
    beside = max(0, len(rows.x) - rules.middle) // 2
    found = [np.stack([x, rows.rows], -1)[np.isfinite(x)] for x in rows.x[beside : len(rows.x) - beside]]
    labelled = [line.points[np.isfinite(line.points).all(-1)] for line in label.lines]
    width = round(rules.line * image_size[0] / rules.height)
    return culane_counts(found, labelled, image_size, width, rules.overlap)


def boundary_rows(logits: Tensor, network_size: tuple[int, int], image_size: tuple[int, int]) -> BoundaryRows:
    """Return one image's boundaries on rows of the image as taken."""
    stride = -(-network_size[0] // logits.shape[-2])
    extractor = LineExtractor(LineConfig(stride=stride))
    vertices = extractor.vertices(logits.detach().cpu(), image_size, network_size)
    return rows_from_vertices(vertices, image_size)
