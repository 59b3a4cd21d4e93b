"""The roads of simulated drives."""

import pytest
import torch

from lanebev.testing.moments import Moment, on_flat_road, road_curves
from tools.replay.kinds import changing_crossfall


def test_a_road_that_falls_to_the_right_looks_like_nearer_points_there():
    # 3 m to the right and 20 m ahead the road is 0.05 · 3 m = 15 cm lower, so the ray meets the plane earlier
    point = torch.tensor([3.0, 20.0], dtype=torch.float64)
    seen = on_flat_road(point, 1.5, 0.0, lambda z: torch.full_like(z, 0.05))
    assert torch.allclose(seen, point * 1.5 / 1.65)
    with_crest = on_flat_road(point, 1.5, 1e-4, lambda z: torch.full_like(z, 0.05))
    assert torch.allclose(with_crest, point * 1.5 / (1.65 + 0.02))


@pytest.mark.parametrize(
    ("start", "at_40_m"),
    [(50.0, 0.0), (20.0, 0.04), (-10.0, 0.02), (-60.0, 0.0)],
    ids=["before it", "in view", "on it", "behind it"],
)
def test_crossfall_is_relative_to_that_at_the_camera(start, at_40_m):
    crossfall = changing_crossfall(0.04, start, 20.0)
    assert float(crossfall(torch.zeros(()))) == 0.0
    assert float(crossfall(torch.tensor(40.0))) == pytest.approx(at_40_m)


def test_points_of_a_plane_road_stay_where_they_are():
    road = road_curves(Moment((0.0, 0.0, 0.0, 1.5)))
    assert torch.equal(on_flat_road(road, 1.5, 0.0), road)
