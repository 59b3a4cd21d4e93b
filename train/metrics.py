"""Metrics of lane detection: held-out recall, and the scores of TuSimple and CULane."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from lanebev.io.lanes.parsing import FrameLines

Points = npt.NDArray[np.float64]

_LEAST_MASS = 0.5  # label px, below which a row has no boundary


def row_recall(probabilities: Tensor, target: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """Return the rows in which each boundary is found.

    A row where a boundary's stripe has its mass is found if at least half of that mass of probability lies
    within the tolerance of the stripe's centre.

    Args:
        probabilities: (B, L, h, w).
        target: (B, L, h, w) in [0, 1].
        tolerance: label px.

    Returns:
        found, there: (B, L, h) bool.
    """
    columns = torch.arange(target.shape[-1], dtype=target.dtype, device=target.device)
    mass = target.sum(-1)
    centre = (target * columns).sum(-1) / mass.clamp(min=1e-6)
    near = (columns - centre.unsqueeze(-1)).abs() <= tolerance
    there = mass > _LEAST_MASS
    return there & ((probabilities * near).sum(-1) >= 0.5 * (target * near).sum(-1)), there


def point_recall(probabilities: Tensor, target: Tensor, tolerance: float = 2.5) -> tuple[Tensor, Tensor]:
    """Count the rows of :func:`row_recall`: found, there, (B, L) each."""
    found, there = row_recall(probabilities, target, tolerance)
    return found.sum(-1).to(target.dtype), there.sum(-1).to(target.dtype)


class TuSimpleScore(NamedTuple):
    """TuSimple's score of one image; a data set's score is the mean over images."""

    accuracy: float
    false_positives: float
    false_negatives: float


def tusimple_score(x: Points, rows: Points, labelled: FrameLines) -> TuSimpleScore:
    """Compute TuSimple's score of boundaries on image rows against one entry of its label file.

    Source: the benchmark's README asks for at most four markings, of the current lane and the lanes left and
    right of it, so only the middle four boundaries are handed in.

    Args:
        x: (L, R) px, NaN where a boundary was not seen.
        rows: (R,) px, rising.
        labelled: lines on the rows of the label file, NaN where a line is not.
    """
    label_rows = labelled.lines[0].points[:, 1] if labelled.lines else rows
    label_x = [np.nan_to_num(line.points[:, 0], nan=-2.0) for line in labelled.lines]
    first = max(0, len(x) // 2 - 2)
    asked = [lane for lane in x[first : first + 4] if np.isfinite(lane).any()]
    sampled = [np.interp(label_rows, rows, lane, -2.0, -2.0) for lane in asked]
    return tusimple_lane_score([np.nan_to_num(lane, nan=-2.0) for lane in sampled], label_x, label_rows)


def tusimple_lane_score(
    predicted: Sequence[Sequence[float] | Points],
    labelled: Sequence[Sequence[float] | Points],
    rows: Sequence[float] | Points,
) -> TuSimpleScore:
    """Compute TuSimple's accuracy, FP and FN of one image.

    Source: TuSimple lane detection benchmark, evaluation rules: a point is right within 20 px / cos(angle of
    the label), a row that neither has counts as right, a lane is found at 85 % of rows; of five or more
    labels the worst one is forgiven; more than two lanes too many is a failure.

    Args:
        predicted: x of each lane on each row, negative where there is none.
        labelled: the same.
        rows: y.
    """
    for name, lanes in (("predicted", predicted), ("labelled", labelled)):
        if any(len(lane) != len(rows) for lane in lanes):
            raise ValueError(f"{name}: expected {len(rows)} x per lane, one a row")
    if len(predicted) > len(labelled) + 2:
        return TuSimpleScore(0.0, 0.0, 1.0)
    best = [max((_row_accuracy(p, g, rows) for p in predicted), default=0.0) for g in labelled]
    missed = sum(accuracy < 0.85 for accuracy in best)
    wrong = len(predicted) - (len(best) - missed)
    total = sum(best)
    if len(labelled) > 4:
        total -= min(best)
        missed = max(0, missed - 1)
    count = max(min(len(labelled), 4), 1)
    return TuSimpleScore(total / count, wrong / len(predicted) if predicted else 0.0, missed / count)


def _row_accuracy(
    predicted: Sequence[float] | Points, labelled: Sequence[float] | Points, rows: Sequence[float] | Points
) -> float:
    """Compute the share of rows on which the two agree."""
    p, g, y = (np.asarray(values, float) for values in (predicted, labelled, rows))
    there = g >= 0
    slope = np.polyfit(y[there], g[there], 1)[0] if there.sum() > 1 else 0.0
    tolerance = 20 * np.hypot(1, slope)  # 20 / cos(atan(slope))
    return float(np.mean(np.abs(np.where(p >= 0, p, -100) - np.where(there, g, -100)) < tolerance))


class CULaneCounts(NamedTuple):
    """Counts of lanes found, false and missed; they are summed over images before F1 is computed."""

    true_positives: int
    false_positives: int
    false_negatives: int

    def f1(self) -> float:
        """Return the harmonic mean of precision and recall; 0 where nothing was found."""
        errors = self.false_positives + self.false_negatives
        return 2 * self.true_positives / max(1, 2 * self.true_positives + errors)


def culane_counts(
    predicted: Sequence[Points],
    labelled: Sequence[Points],
    image_size: tuple[int, int] = (590, 1640),
    width: int = 30,
    threshold: float = 0.5,
) -> CULaneCounts:
    """Count CULane's matches of one image.

    Source: Pan et al. 2018 and the CULane evaluation: lanes are splines drawn 30 px wide, matched one to one
    for the largest sum of intersection over union, and found above 0.5. OpenLane's evaluation of lanes in the
    image is the same with other numbers.

    Args:
        predicted: (P, 2) px points of each lane, in order along it; one of a single point matches none.
        labelled: the same.
        image_size: (height, width).
        width: width of the drawn lanes, px.
        threshold: threshold of the intersection over union.
    """
    p, g = ([lane for lane in lanes if len(lane)] for lanes in (predicted, labelled))
    masks_p, masks_g = ([_lane_mask(lane, image_size, width) for lane in lanes] for lanes in (p, g))
    overlap = np.array([[_iou(a, b) for b in masks_g] for a in masks_p]).reshape(len(p), len(g))
    found = int((overlap[linear_sum_assignment(-overlap)] > threshold).sum())
    return CULaneCounts(found, len(p) - found, len(g) - found)


def _lane_mask(points: Points, image_size: tuple[int, int], width: int) -> npt.NDArray[np.bool_]:
    """Draw the lane's natural cubic spline over chord length."""
    points = np.asarray(points, float)
    if len(points) > 2:
        chord = np.concatenate([[0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
        keep = np.concatenate([[True], np.diff(chord) > 0])
        spline = CubicSpline(chord[keep], points[keep], bc_type="natural")
        fine = np.interp(np.arange(50 * (keep.sum() - 1) + 1) / 50, np.arange(keep.sum()), chord[keep])
        points = spline(fine)
    mask = np.zeros(image_size, np.uint8)
    if len(points) < 2:
        return mask > 0
    cv2.polylines(mask, [np.rint(points).astype(np.int32)], False, 1, width)
    return mask > 0


def _iou(a: npt.NDArray[np.bool_], b: npt.NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))
