"""The paper's extraction rule by hand, and beside the differentiable one."""

import torch

from lanebev.observation.paper_vertices import paper_vertices
from lanebev.observation.scans import scan_vertices
from lanebev.observation.vertices import LineConfig


def test_mean_of_on_pixels_by_hand():
    maps = torch.zeros(1, 2, 4, 8)
    maps[0, 0, 1, 2:5] = 0.9  # columns 2, 3, 4
    maps[0, 0, 2, 5] = 0.6
    maps[0, 0, 2, 7] = 0.5  # not larger than 0.5
    maps[0, 0, 3, [1, 4]] = 1.0
    points, there = paper_vertices(maps, 5)
    assert there.tolist() == [[[True, True, True, False, False], [False] * 5]]
    assert points[0, 0, :3].tolist() == [[3.0, 1.0], [5.0, 2.0], [2.5, 3.0]]


def test_vertices_are_sampled_evenly_from_end_to_end():
    maps = torch.zeros(1, 1, 100, 10)
    maps[0, 0, 20:81, 4] = 1.0
    points, there = paper_vertices(maps, 5)
    assert there.all()
    assert points[0, 0, :, 1].tolist() == [20.0, 35.0, 50.0, 65.0, 80.0]
    assert (paper_vertices(maps, 1)[0] == torch.tensor([4.0, 20.0])).all()


def test_it_agrees_with_the_differentiable_rule_on_a_clean_stripe():
    """A vertical band of three columns and a fraction: the paper's mean is off by the fraction at most."""
    maps = torch.zeros(1, 1, 64, 40, dtype=torch.float64)
    maps[..., 18:20], maps[..., 20] = 1.0, 0.25
    points, _ = paper_vertices(maps, 64)
    found = scan_vertices(maps, LineConfig())
    sure = found.weight[0, 0, :64] > 0.5
    assert sure.sum() > 40
    assert (found.points[0, 0, :64, 0] - points[0, 0, :, 0])[sure].abs().max() < 0.25
