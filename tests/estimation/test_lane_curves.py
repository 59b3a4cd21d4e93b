"""The boundaries of a frame as curves on the calibrated road."""

import numpy as np
import pytest
import torch

from lanebev import Calibration, Camera, Extrinsics, LaneSegments, Status, image_from_road_points
from lanebev.observation.polylines import image_rows
from lanebev.report.lane_curves import lane_curves
from tests.drawn_road import boundary

DISTORTION = (-0.2, 0.05, 0.0, 0.0, 0.0)
CAMERA = Camera.from_parameters(1000, 1000, 639.5, 359.5, 1280, 720, distortion=DISTORTION)
POSE = Extrinsics.from_values(0.05, -0.02, 0.03, 1.6)
PLACES = (-9.35, -5.65, -1.95, 1.75, 5.45, 9.15)
CURVATURE = 1 / 800


def _boundary(place, z):
    return boundary(CAMERA, place, z, POSE, CURVATURE)


def _calibration(segments, status=Status.TRACKING):
    return Calibration(POSE, torch.zeros(1, 4, 4), torch.tensor([int(status)]), segments.weight)


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
    segments = LaneSegments(ends, boundary, ones, 0.3 * ones)
    found = lane_curves(segments, _calibration(segments), CAMERA)
    np.testing.assert_array_equal(found.rows, rows)
    x = found.x
    assert x.shape == (6, 72)
    assert np.isnan(x[[0, 5]]).all()
    z = torch.linspace(6.0, 50.0, 2000, dtype=torch.float64)  # nearer, no boundary was seen
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
    assert np.isnan(lane_curves(segments, _calibration(segments), CAMERA).x).all()


@pytest.mark.parametrize(("status", "there"), [("COASTING", True), ("UNINITIALISED", False), ("LOST", False)])
def test_without_a_pose_there_are_no_curves(status, there):
    points = _pieces(3, torch.Generator().manual_seed(2))[None]
    ones = torch.ones(1, 12, dtype=torch.float64)
    segments = LaneSegments(points, torch.full((1, 12), 3), ones, ones)
    found = lane_curves(segments, _calibration(segments, Status[status]), CAMERA)
    assert np.isfinite(found.x[3]).any() == there


def test_curves_follow_a_crest():
    """They end where they were drawn, and on a plane road they would not."""
    crest = torch.tensor([5e-4], dtype=torch.float64)
    z = torch.linspace(1 / 6, 1 / 50, 24, dtype=torch.float64) ** -1
    drawn = [
        image_from_road_points(
            torch.stack([PLACES[index] + 0.5 * CURVATURE * z**2, z], dim=-1)[None],
            CAMERA.intrinsics[None],
            POSE,
            crest,
        )[0][0]
        for index in (1, 2, 3, 4)
    ]
    ends = torch.cat([torch.stack([points[:-1], points[1:]], dim=1) for points in drawn])[None]
    boundary = torch.arange(1, 5).repeat_interleave(23)[None]
    ones = torch.ones(1, 92, dtype=torch.float64)
    segments = LaneSegments(ends, boundary, ones, 0.3 * ones)

    def largest_error(vertical):
        found, errors = lane_curves(segments, _calibration(segments), CAMERA, vertical), []
        for index, points in zip((1, 2, 3, 4), drawn, strict=True):
            true = CAMERA.distort_points(points).numpy()
            order = np.argsort(true[:, 1])
            at = np.interp(found.rows, true[order, 1], true[order, 0], np.nan, np.nan)
            errors.append(np.nanmax(np.abs(found.x[index] - at)))
        return max(errors)

    assert largest_error(crest) < 1.0
    assert largest_error(None) > 3.0
