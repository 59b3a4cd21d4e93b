"""Boxes, their maps and their average precision: known answers."""

import math

import numpy as np
import pytest
import torch

from lanebev.view.grid import BEVGrid
from train.detector.boxes import box_corners, in_grid, visible_share
from train.detector.precision import Centres, average_precision, match_centres, score_range
from train.detector.targets import centre_heatmap, decode_boxes, detection_loss, focal_loss

GRID = BEVGrid(x=(-8.0, 8.0), z=(4.0, 36.0), resolution=1.0)
VIEW = torch.tensor([[-0.5, 0.5]])


def box(x, z, length=4.0, width=2.0, heading=0.0):
    return [x, z, length, width, heading]


def test_corners_of_a_box_that_heads_right():
    corners = box_corners(torch.tensor(box(1.0, 10.0, heading=math.pi / 2)))
    assert corners.amax(0).tolist() == pytest.approx([3.0, 11.0])
    assert corners.amin(0).tolist() == pytest.approx([-1.0, 9.0])


def test_a_nearer_box_hides_the_one_behind_it_and_not_the_other_way():
    boxes = torch.tensor([[box(0, 10), box(0, 30), box(5, 30), box(0, -5), box(60, 20)]])
    share = visible_share(boxes, torch.ones(1, 5).bool(), VIEW)[0]
    assert share.tolist() == [1.0, 0.0, 1.0, 0.0, 0.0]
    alone = visible_share(boxes, torch.tensor([[False, True, True, True, True]]), VIEW)[0]
    assert alone.tolist() == [0.0, 1.0, 1.0, 0.0, 0.0]


def test_half_a_box_is_seen_where_the_image_ends():
    view = torch.tensor([[-0.5, math.atan2(11.0, 20.0)]])  # to the middle of a flat box
    share = visible_share(torch.tensor([[box(11, 20, length=0.01)]]), torch.ones(1, 1).bool(), view)
    assert float(share) == pytest.approx(0.5, abs=0.05)


def test_the_grid_ends_half_a_cell_outside_its_first_and_last_cell():
    cells = torch.tensor([box(-8.4, 36.4), box(-8.6, 10), box(7.4, 5), box(7.6, 5)])
    assert in_grid(cells, GRID).tolist() == [True, False, True, False]


def perfect_maps(boxes, seen):
    """Maps whose decoding is the boxes."""
    maps = torch.zeros(len(boxes), 7, *GRID.shape)
    maps[:, 0] = torch.logit(centre_heatmap(boxes, seen, GRID).clamp(1e-4, 1 - 1e-4))
    point = GRID.bev_from_road_points(boxes[..., :2])
    for row in range(len(boxes)):
        for each, (column, line) in zip(boxes[row], point[row].round().long().tolist(), strict=True):
            off = GRID.bev_from_road_points(each[:2]) - torch.tensor([column, line])
            heading = each[4:]
            values = torch.cat([off, each[2:4].log(), heading.sin(), heading.cos()])
            maps[row, 1:, line, column] = values
    return maps


def test_boxes_come_back_from_their_maps():
    boxes = torch.tensor([[box(-3.3, 10.2, 4.5, 1.8, 0.1), box(2.4, 25.7, 9.0, 2.5, -0.2)]])
    seen = torch.ones(1, 2).bool()
    found, score = decode_boxes(perfect_maps(boxes, seen), GRID, count=3)
    order = found[0, :2, 1].argsort()
    torch.testing.assert_close(found[0, :2][order], boxes[0], atol=1e-4, rtol=1e-4)
    assert score[0, 1] > 0.99
    assert score[0, 2] < 0.01


def test_the_loss_is_least_at_the_truth_and_blind_to_boxes_not_seen():
    boxes = torch.tensor([[box(-3.3, 10.2), box(2.4, 25.7)]])
    seen = torch.tensor([[True, True]])
    maps = perfect_maps(boxes, seen)
    least = detection_loss(maps, boxes, seen, GRID)
    assert float(detection_loss(maps.roll(1, -1), boxes, seen, GRID)) > 10 * float(least)
    moved = boxes.clone()
    moved[0, 1, :2] = 0.0
    one = torch.tensor([[True, False]])
    torch.testing.assert_close(detection_loss(maps, boxes, one, GRID), detection_loss(maps, moved, one, GRID))


def test_gradients_of_the_loss_are_those_of_finite_differences():
    boxes = torch.tensor([[box(-3.3, 10.2), box(2.4, 25.7)]]).double()
    grid = BEVGrid(x=(-4.0, 4.0), z=(8.0, 28.0), resolution=4.0)
    generator = torch.Generator().manual_seed(1)
    maps = torch.randn(1, 7, *grid.shape, generator=generator, dtype=torch.float64, requires_grad=True)
    seen = torch.ones(1, 2).bool()
    assert torch.autograd.gradcheck(lambda m: detection_loss(m, boxes, seen, grid), maps)
    empty = focal_loss(maps[:, 0], torch.zeros(1, *grid.shape).double())
    assert empty.isfinite()


def centres(rows):
    frame, x, z, score = zip(*rows, strict=True)
    return Centres(np.array(frame), np.array([x, z], float).T, np.array(score, float))


def test_the_best_score_takes_the_nearest_truth_and_each_truth_is_taken_once():
    truth = centres([(0, 0, 10, 1), (0, 0, 12, 1), (1, 0, 10, 1)])
    found = centres([(0, 0, 10.4, 0.5), (0, 0, 10.2, 0.9), (0, 0, 11.9, 0.1), (2, 0, 10, 1.0)])
    assert match_centres(found, truth, 1.0).tolist() == [-1, 0, 1, -1]
    assert match_centres(found, truth, 2.0).tolist() == [1, 0, -1, -1]


def test_average_precision_of_known_curves():
    right, wrong = np.ones(10, bool), np.zeros(10, bool)
    falling = np.linspace(1, 0.1, 10)
    assert average_precision(right, falling, 10) == pytest.approx(1.0)
    assert average_precision(wrong, falling, 10) == 0.0
    assert average_precision(right[:0], falling[:0], 10) == 0.0
    assert math.isnan(average_precision(right, falling, 0))
    # Half of the truth found at precision 1: recalls .11 to .50 of .11 to 1.
    assert average_precision(right, falling, 20) == pytest.approx(40 / 90)
    # Precision 1/2 at every recall: (0.5 - 0.1) / 0.9.
    alternate = np.tile([False, True], 200)
    assert average_precision(alternate, np.linspace(1, 0, 400), 200) == pytest.approx(4 / 9, abs=0.01)


def test_a_match_across_the_border_counts_on_its_truths_side():
    truth = centres([(0, 0, 19.9, 1)])
    found = centres([(0, 0, 20.2, 0.9)])
    near, far = score_range(found, truth, 5, 20), score_range(found, truth, 20, 35)
    assert near.positives == 1
    assert near.precision == pytest.approx({"0.5": 1.0, "1": 1.0, "2": 1.0})
    assert near.error == pytest.approx(0.3)
    assert far.positives == 0
    assert math.isnan(far.precision["1"])
