"""Scores of TuSimple and CULane from logits, over a data set."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from lanebev.geometry.camera import Camera
from lanebev.io.lane_rows import BoundaryRows, rows_from_segments
from lanebev.observation.lines import LineExtractor
from lanebev.observation.vertices import LineConfig
from train.datasets import ScoredBatch
from train.metrics import CULaneCounts, culane_counts, tusimple_score

_CULANE_HEIGHT, _CULANE_LINE = 590, 30  # px: the benchmark's images, and how wide it draws lanes on them


class BenchmarkScores:
    """Collects images, then gives the benchmark's figures: TuSimple's accuracy, FP and FN, or CULane's F1."""

    def __init__(self) -> None:
        self.tusimple: list[tuple[float, float, float]] = []
        self.culane = CULaneCounts(0, 0, 0)

    def update(self, logits: Tensor, network_size: tuple[int, int], batch: ScoredBatch) -> None:
        """Add images: logits (B, 1+L, h, w) of the images resized to the network's (height, width)."""
        for i, (lines, size) in enumerate(zip(batch.lines, batch.image_sizes, strict=True)):
            rows = boundary_rows(logits[i : i + 1], network_size, size)
            if batch.benchmark == "tusimple":
                self.tusimple.append(tusimple_score(rows.x, rows.rows, lines))
                continue
            found = [np.stack([x, rows.rows], axis=-1)[np.isfinite(x)] for x in rows.x]
            labelled = [line.points[np.isfinite(line.points).all(-1)] for line in lines.lines]
            width = round(_CULANE_LINE * size[0] / _CULANE_HEIGHT)
            counts = culane_counts(found, labelled, size, width)
            self.culane = CULaneCounts(*(a + b for a, b in zip(self.culane, counts, strict=True)))

    def compute(self) -> dict[str, float]:
        """Named figures; none where there was nothing to score."""
        figures = {}
        if self.tusimple:
            names = ("accuracy", "false_positives", "false_negatives")
            figures |= dict(zip(names, np.mean(self.tusimple, axis=0).tolist(), strict=True))
        if any(self.culane):
            figures["f1"] = self.culane.f1()
        return figures


def boundary_rows(logits: Tensor, network_size: tuple[int, int], image_size: tuple[int, int]) -> BoundaryRows:
    """One image's boundaries on rows of the image as it came."""
    stride = -(-network_size[0] // logits.shape[-2])
    extractor = LineExtractor(LineConfig(stride=stride))
    segments = extractor(logits.detach().cpu(), image_size, network_size)
    height, width = image_size
    camera = Camera.from_parameters(width, width, width / 2, height / 2, width, height)  # its size is used
    return rows_from_segments(segments, camera)
