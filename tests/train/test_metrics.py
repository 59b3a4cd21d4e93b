import numpy as np
import pytest
import torch

from lanebev.io.lanes.parsing import FrameLines
from lanebev.observation.polylines import LaneLine
from train.metrics import CULaneCounts, culane_counts, point_recall, tusimple_lane_score, tusimple_score

ROWS = list(range(0, 100, 10))  # ten rows
STRAIGHT = [100.0] * 10


def shifted(pixels, rows=10):
    """The first ``rows`` points moved."""
    return [100.0 + pixels] * rows + [100.0] * (10 - rows)


def test_tusimple_counts_points_within_20_px():
    assert tusimple_lane_score([shifted(19.9)], [STRAIGHT], ROWS) == (1.0, 0.0, 0.0)
    assert tusimple_lane_score([shifted(20)], [STRAIGHT], ROWS) == (0.0, 1.0, 1.0)
    assert tusimple_lane_score([shifted(20, rows=1)], [STRAIGHT], ROWS) == (0.9, 0.0, 0.0)  # 9 of 10 >= 0.85
    assert tusimple_lane_score([shifted(20, rows=2)], [STRAIGHT], ROWS) == (0.8, 1.0, 1.0)


def test_tusimple_tolerance_grows_with_the_slope():
    slanted = [4 / 3 * y for y in ROWS]  # atan(4/3): 20 px / cos = 33.3 px
    assert tusimple_lane_score([[x + 33 for x in slanted]], [slanted], ROWS).accuracy == 1.0
    assert tusimple_lane_score([[x + 34 for x in slanted]], [slanted], ROWS).accuracy == 0.0


def test_tusimple_rows_without_a_lane_count_as_agreed():
    half = [-2.0] * 5 + [100.0] * 5
    assert tusimple_lane_score([half], [half], ROWS).accuracy == 1.0
    assert tusimple_lane_score([STRAIGHT], [half], ROWS) == (0.5, 1.0, 1.0)


def test_tusimple_extra_and_missing_lanes():
    lanes = [[50.0 * k + 50] * 10 for k in range(4)]
    assert tusimple_lane_score([*lanes, [600.0] * 10], lanes, ROWS) == (1.0, 0.2, 0.0)
    assert tusimple_lane_score(lanes[:3], lanes, ROWS) == (0.75, 0.0, 0.25)
    assert tusimple_lane_score([], lanes, ROWS) == (0.0, 0.0, 1.0)
    assert tusimple_lane_score(lanes, lanes[:1], ROWS) == (0.0, 0.0, 1.0)  # three too many


def test_tusimple_forgives_the_worst_of_five():
    lanes = [[50.0 * k + 50] * 10 for k in range(5)]
    assert tusimple_lane_score(lanes[:4], lanes, ROWS) == (1.0, 0.0, 0.0)


def test_tusimple_wants_one_x_per_row():
    with pytest.raises(ValueError, match="predicted: expected 10 x per lane"):
        tusimple_lane_score([[1.0]], [STRAIGHT], ROWS)


def test_tusimple_score_of_boundaries_on_other_rows():
    """Rows every 10 px from 0; the label file's begin at 20, and its line at 40."""
    label_rows = np.arange(20.0, 100, 10)
    label = LaneLine(np.stack([np.where(label_rows < 40, np.nan, 2 * label_rows), label_rows], axis=-1))
    rows = np.arange(0.0, 120, 10)
    x = np.full((6, 12), np.nan)
    x[2, 5:] = 2 * rows[5:] + 3  # row 40 is missed: 7 of 8 agree
    assert tusimple_score(x, rows, FrameLines("a", [label])) == (0.875, 0.0, 0.0)
    x[0] = x[5] = 0.0  # beyond the lanes beside the current one: not asked for
    assert tusimple_score(x, rows, FrameLines("a", [label])) == (0.875, 0.0, 0.0)
    x[4] = 0.0
    assert tusimple_score(x, rows, FrameLines("a", [label])) == (0.875, 0.5, 0.0)
    assert tusimple_score(x, rows, FrameLines("a", [])) == (0.0, 1.0, 0.0)


def vertical(x, top=100, bottom=500):
    return np.stack([np.full(5, float(x)), np.linspace(top, bottom, 5)], axis=-1)


def test_culane_overlap_of_vertical_lanes():
    """Stripes 31 px wide and d apart overlap by (31 - d) / (31 + d): half at d = 10.3."""
    assert culane_counts([vertical(300)], [vertical(300)]) == (1, 0, 0)
    assert culane_counts([vertical(310)], [vertical(300)]) == (1, 0, 0)
    assert culane_counts([vertical(311)], [vertical(300)]) == (0, 1, 1)


def test_culane_matches_for_the_largest_sum():
    """Greedy would give 305 to 300 and leave 309 with 296 (0.41); one to one both are found."""
    assert culane_counts([vertical(305), vertical(309)], [vertical(300), vertical(306)]) == (2, 0, 0)
    assert culane_counts([vertical(305), vertical(301)], [vertical(300)]) == (1, 1, 0)


def test_culane_empty_sides_and_f1():
    assert culane_counts([], [vertical(300)]) == (0, 0, 1)
    assert culane_counts([vertical(300)], []) == (0, 1, 0)
    assert culane_counts([vertical(300)[:1]], [vertical(300)]) == (0, 1, 1)  # a point overlaps nothing
    assert culane_counts([vertical(300)[:0]], []) == (0, 0, 0)
    assert CULaneCounts(3, 1, 2).f1() == pytest.approx(2 * 0.75 * 0.6 / (0.75 + 0.6))
    assert CULaneCounts(0, 0, 0).f1() == 0


def test_culane_bends_between_points():
    """Three points on a half circle: the spline is longer than the chords."""
    arc = np.array([[300.0, 100], [400, 200], [300, 300]])
    straight = np.concatenate([np.linspace(arc[0], arc[1], 9), np.linspace(arc[1], arc[2], 9)[1:]])
    assert culane_counts([arc], [arc], width=4) == (1, 0, 0)
    assert culane_counts([arc], [straight], width=4) == (0, 1, 1)


def test_point_recall_of_three_rows():
    target, probabilities = torch.zeros(1, 1, 4, 20), torch.zeros(1, 1, 4, 20)
    target[..., :3, 9:12] = 1  # rows 0..2 have the boundary, row 3 has not
    probabilities[0, 0, 0, 9:12] = 0.6  # found
    probabilities[0, 0, 1, 9:12] = 0.4  # too faint
    probabilities[0, 0, 2, 14:17] = 1.0  # elsewhere
    found, there = point_recall(probabilities, target)
    assert (found.item(), there.item()) == (1, 3)
