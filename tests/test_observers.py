"""What a run makes of the network's boundaries."""

import numpy as np
import pytest
import torch

from lanebev import Camera, LaneSegments, image_from_road_points
from lanebev.app.observers import fitted_rows
from lanebev.observation.lines import NETWORK_CORRELATION, LineExtractor
from lanebev.observation.polylines import image_rows, rows_from_segments, segments_from_rows
from lanebev.observation.vertices import LineConfig
from lanebev.report.measure import pose

DISTORTION = (-0.2, 0.05, 0.0, 0.0, 0.0)
CAMERA = Camera.from_parameters(1000, 1000, 639.5, 359.5, 1280, 720, distortion=DISTORTION)
POSE = pose(0.05, -0.02, 0.03, 1.6, CAMERA.intrinsics)
PLACES = (-9.35, -5.65, -1.95, 1.75, 5.45, 9.15)
CURVATURE = 1 / 800


def _boundary(place, z):
    road = torch.stack([place + 0.5 * CURVATURE * z**2, z], dim=-1)[None]
    return image_from_road_points(road, CAMERA.intrinsics[None], POSE)[0][0]


def _pieces(index, generator):
    """Half of the second boundary, the far half of the third, all of the fourth and fifth; no others."""
    first, last = {1: (6.0, 18.0), 2: (18.0, 50.0), 3: (6.0, 50.0), 4: (6.0, 50.0)}[index]
    points = _boundary(PLACES[index], torch.linspace(1 / first, 1 / last, 24, dtype=torch.float64) ** -1)
    points = points + 0.3 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    return torch.stack([points[:12], points[12:]], dim=1)


def test_boundaries_seen_in_pieces_are_whole():
    generator = torch.Generator().manual_seed(0)
    ends = torch.cat([_pieces(index, generator) for index in (1, 2, 3, 4)])[None]
    boundary = torch.arange(1, 5).repeat_interleave(12)[None]
    ones = torch.ones(1, 48, dtype=torch.float64)
    rows = image_rows(720)
    x = fitted_rows(LaneSegments(ends, boundary, ones, 0.3 * ones), rows, CAMERA, 3.7)
    assert x.shape == (6, 72)
    assert np.isnan(x[[0, 5]]).all()
    z = torch.linspace(3.0, 50.0, 2000, dtype=torch.float64)
    for index in (1, 2, 3, 4):
        true = CAMERA.distort_points(_boundary(PLACES[index], z)).numpy()
        order = np.argsort(true[:, 1])
        expected = np.interp(rows, true[order, 1], true[order, 0], np.nan, np.nan)
        both = np.isfinite(expected) & (expected >= 0) & (expected < 1279)
        assert np.isfinite(x[index][both]).all()
        tangent = np.abs(np.gradient(expected[both], 10.0))
        np.testing.assert_array_less(np.abs(x[index] - expected)[both], 2.0 * np.hypot(1, tangent))


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_what_is_no_road_gives_no_lanes(weight):
    generator = torch.Generator().manual_seed(1)
    ends = torch.rand(1, 12, 2, 2, generator=generator, dtype=torch.float64) * 300  # in the sky
    zero = torch.zeros(1, 12, dtype=torch.float64)
    segments = LaneSegments(ends, torch.arange(12)[None] % 6, zero + weight, zero + 1)
    assert np.isnan(fitted_rows(segments, image_rows(720), CAMERA, 3.7)).all()


def test_a_run_and_lanebev_are_told_as_much_by_a_line():
    """The sum of weights by variances of a boundary's segments, by rows and without."""
    camera = Camera.from_parameters(600.0, 600.0, 640.0, 360.0, 1280, 720)
    y, x = torch.meshgrid(torch.arange(96.0), torch.arange(160.0), indexing="ij")
    lines = ((80, 0.1), (60, -0.6), (90, 2.0), (100, 4.0))
    maps = [8 * ((x - at - s * (y - 40)).abs() < 1.1 * (1 + s * s) ** 0.5) - 4 for at, s in lines]
    logits = torch.stack([torch.zeros_like(x), *maps])[None].double()
    logits[:, 1:, :40] = logits[:, 1:, 60:] = -9.0
    direct = LineExtractor(LineConfig(stride=2, correlation=NETWORK_CORRELATION))(logits, (720, 1280))
    by_rows = segments_from_rows([rows_from_segments(direct, camera)], camera)
    for k in range(4):
        one, other = (
            float((torch.where(part.boundary == k, part.weight, 0.0) / part.sigma.square()).sum())
            for part in (direct, by_rows)
        )
        assert 0.75 < other / one < 1.25
