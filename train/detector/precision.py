"""Average precision of boxes by the distance of their centres, as nuScenes defines it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
LEAST_RECALL = LEAST_PRECISION = 0.1


class Centres(NamedTuple):
    """Centres of boxes in the frames of a data set, N of them.

    Attributes:
        frame: (N,) int64, the frame's number.
        xz: (N, 2) m on the road.
        score: (N,); of truth, anything.
    """

    frame: NDArray[np.int64]
    xz: Floats
    score: Floats


def match_centres(found: Centres, truth: Centres, distance: float) -> NDArray[np.int64]:
    """Match found centres with true ones, best score first, each with the nearest that is left.

    Source: Caesar et al. 2020, "nuScenes", Sec. 4.1, and nuscenes-devkit ``eval/detection/algo.py``.

    Args:
        found: N centres.
        truth: M centres.
        distance: m, a match is nearer than this.

    Returns:
        (N,) index into ``truth``, -1 where there is no match.
    """
    matched = np.full(len(found.frame), -1, np.int64)
    for frame in np.unique(found.frame):
        rows = np.flatnonzero(found.frame == frame)
        free = list(np.flatnonzero(truth.frame == frame))
        for row in rows[np.argsort(-found.score[rows], kind="stable")]:
            away = np.linalg.norm(truth.xz[free] - found.xz[row], axis=1)
            if free and away.min() < distance:
                matched[row] = free.pop(int(away.argmin()))
    return matched


def average_precision(correct: NDArray[np.bool_], score: Floats, positives: int) -> float:
    """Compute the area under precision over recall, above a tenth of both, as a share of the largest.

    Source: as of :func:`match_centres`; precision is interpolated at 101 recalls.

    Args:
        correct: (N,) whether each box found was matched.
        score: (N,) of each.
        positives: number of true boxes.

    Returns:
        0 to 1; NaN without true boxes.
    """
    if positives == 0:
        return float("nan")
    if not len(score):
        return 0.0
    hits = correct[np.argsort(-score, kind="stable")].cumsum()
    precision, recall = hits / np.arange(1, len(hits) + 1), hits / positives
    at = np.linspace(0, 1, 101)
    curve = np.interp(at, recall, precision, right=0.0)[round(100 * LEAST_RECALL) + 1 :]
    return float(np.maximum(curve - LEAST_PRECISION, 0).mean() / (1 - LEAST_PRECISION))


class RangeScores(NamedTuple):
    """Scores of the boxes between two distances ahead.

    Attributes:
        positives: number of true boxes.
        precision: AP by the largest distance of a match in m.
        error: m, mean distance of matches within ``ERROR_WITHIN``.
    """

    positives: int
    precision: dict[str, float]
    error: float


DISTANCES = (0.5, 1.0, 2.0)
ERROR_WITHIN = 2.0


def score_range(found: Centres, truth: Centres, near: float, far: float) -> RangeScores:
    """Score the boxes whose Z is in [near, far) m.

    A match is where its truth is, a box without a match where it was found: one that was found across the
    border counts on its truth's side.
    """
    inside = (truth.xz[:, 1] >= near) & (truth.xz[:, 1] < far)
    own = (found.xz[:, 1] >= near) & (found.xz[:, 1] < far)
    precision, error = {}, float("nan")
    for distance in DISTANCES:
        matched = match_centres(found, truth, distance)
        correct = matched >= 0
        counted = own.copy()
        counted[correct] = inside[matched[correct]]
        precision[f"{distance:g}"] = average_precision(
            correct[counted], found.score[counted], int(inside.sum())
        )
        if distance == ERROR_WITHIN and (correct & counted).any():
            pairs = correct & counted
            error = float(np.linalg.norm(found.xz[pairs] - truth.xz[matched[pairs]], axis=1).mean())
    return RangeScores(int(inside.sum()), precision, error)
