"""What a person looks at: measured boundaries and the overlay."""

import math

import numpy as np
import pytest
import torch

from lanebev import BEVGrid, Calibration, Camera, Extrinsics, LaneSegments, Status, image_from_road_points
from lanebev.report.measure import measure_boundaries, spread
from lanebev.report.overlay import BOUNDARY_COLOURS, PANEL_HEIGHT, Panel, draw_panels, joined

CAMERA = Camera.from_parameters(1000, 1000, 639.5, 359.5, 1280, 720)
INTRINSICS = CAMERA.intrinsics[None]
POSE = Extrinsics.from_values(0.03, -0.02, 0.01, 1.4)
OFFSETS = {1: -5.3, 2: -1.7, 3: 2.0, 4: 5.7}  # lanes of 3.6, 3.7 and 3.7 m


def _segments(bend=0.0, noise=0.0, vertical=None):
    """Six vertices, three segments, on each boundary of a road with curvature 2 · bend."""
    z = torch.linspace(6.0, 38.0, 16, dtype=torch.float64)
    ends, boundary = [], []
    for index, offset in OFFSETS.items():
        road = torch.stack([offset + bend * z * z, z], dim=-1)[None]
        pixels = image_from_road_points(road, INTRINSICS, POSE, vertical)[0][0]
        pixels = pixels + noise * torch.randn(16, 2, generator=torch.Generator().manual_seed(index)).double()
        ends.append(torch.stack([pixels[:8], pixels[8:]], dim=1))
        boundary += [index] * 8
    count = len(boundary)
    return LaneSegments(
        torch.cat(ends)[None],
        torch.tensor(boundary)[None],
        torch.ones(1, count).double(),
        torch.ones(1, count).double(),
    )


def _calibration(segments, status=Status.TRACKING):
    cov = torch.diag(torch.tensor([1e-3, 1e-3, 2e-3, 0.01], dtype=torch.float64) ** 2)[None]
    return Calibration(POSE, cov, torch.tensor([int(status)]), torch.ones_like(segments.weight))


@pytest.mark.parametrize("bend", [0.0, 5e-4])
def test_measured_widths_are_those_of_the_road(bend):
    measured = measure_boundaries(_segments(bend), INTRINSICS, POSE)
    np.testing.assert_allclose(measured.widths[1:4], [3.6, 3.7, 3.7], atol=0.01)
    assert np.isnan(measured.widths[[0, 4]]).all()
    assert spread(measured.direction) < 1e-3
    assert abs(spread(measured.widths) - 0.1) < 0.01


def test_measured_widths_over_a_crest_need_its_curvature():
    crest = torch.tensor([4e-4], dtype=torch.float64)
    segments = _segments(vertical=crest)
    measured = measure_boundaries(segments, INTRINSICS, POSE, vertical_curvature=crest)
    np.testing.assert_allclose(measured.widths[1:4], [3.6, 3.7, 3.7], atol=0.01)
    on_plane = measure_boundaries(segments, INTRINSICS, POSE)
    assert (np.abs(on_plane.widths[1:4] - [3.6, 3.7, 3.7]) > 0.03).all()


def test_a_wrong_pitch_fans_the_boundaries_out():
    wrong = POSE._replace(pitch=POSE.pitch - math.radians(1))
    measured = measure_boundaries(_segments(), INTRINSICS, wrong)
    assert spread(measured.direction) > math.radians(5)


def test_a_wrong_height_scales_the_widths():
    higher = POSE._replace(height=POSE.height * 1.1)
    measured = measure_boundaries(_segments(), INTRINSICS, higher, far=60.0)
    np.testing.assert_allclose(measured.widths[1:4], [3.96, 4.07, 4.07], atol=0.01)


def test_measuring_survives_noise_outliers_and_nothing():
    segments = _segments(noise=0.5)
    segments.endpoints[0, 0, 0, 0] += 80.0
    widths = measure_boundaries(segments, INTRINSICS, POSE).widths
    np.testing.assert_allclose(widths[1:4], [3.6, 3.7, 3.7], atol=0.12)
    nothing = measure_boundaries(segments._replace(weight=torch.zeros(1, 32)), INTRINSICS, POSE)
    assert np.isnan(nothing.widths).all()
    assert np.isnan(spread(nothing.direction))
    broken = segments._replace(endpoints=segments.endpoints * math.nan)
    assert np.isnan(measure_boundaries(broken, INTRINSICS, POSE).widths).all()


@pytest.mark.parametrize("status", [Status.TRACKING, Status.LOST])
@pytest.mark.parametrize(("height", "width"), [(720, 1280), (360, 640)])
def test_overlay_draws_what_is_believed(status, height, width):
    camera = CAMERA.scaled((height, width))
    segments = _segments()
    segments = segments._replace(endpoints=(segments.endpoints + 0.5) * height / 720 - 0.5)
    grid = BEVGrid()
    view = Panel("after", np.zeros((*grid.shape, 3), np.uint8), POSE)
    image = np.full((height, width, 3), 90, np.uint8)
    picture = joined(
        draw_panels(image, camera, segments, _calibration(segments, status), "frame 1", (view,), grid)
    )
    assert picture.shape[0] == PANEL_HEIGHT
    assert picture.dtype == np.uint8
    scale = 720 / height
    for index in (2, 3):  # a vertex of each boundary has the boundary's colour
        k = int((segments.boundary[0] == index).nonzero()[0])
        x, y = (segments.endpoints[0, k, 0] * scale).round().int().tolist()
        np.testing.assert_allclose(picture[y, x], BOUNDARY_COLOURS[index], atol=30)
    assert (image == 90).all()  # the input is not drawn on


def test_outliers_are_grey_on_the_input_and_not_in_the_views():
    segments, grid = _segments(), BEVGrid(resolution=0.2)
    view = Panel("fixed pose", np.zeros((*grid.shape, 3), np.uint8), POSE)
    image, calibration = np.full((720, 1280, 3), 90, np.uint8), _calibration(segments)
    outliers = calibration._replace(inliers=torch.zeros_like(calibration.inliers))

    def coloured(picture):
        return (np.ptp(picture[60:].astype(int), axis=-1) > 60).sum()

    pictures = [
        draw_panels(image, CAMERA, segments, each, "f", (view,), grid) for each in (calibration, outliers)
    ]
    (fitting, used), (grey, left) = [[coloured(part) for part in panels] for panels in pictures]
    assert fitting > 1000
    assert used > 1000
    assert grey == left == 0


def test_overlay_tells_the_reasons():
    segments, grid = _segments(), BEVGrid(resolution=0.2)
    view = Panel("after", np.zeros((*grid.shape, 3), np.uint8), POSE)
    image = np.full((720, 1280, 3), 90, np.uint8)
    arguments = (image, CAMERA, segments, _calibration(segments), "frame 1", (view,), grid)
    (without, bev), (told, same) = draw_panels(*arguments), draw_panels(*arguments, reasons="one lane only")
    assert (told[:-34] == without[:-34]).all()
    assert (told[-34:].max(-1) > 200).sum() > (without[-34:].max(-1) > 200).sum() + 100  # letters
    assert (bev == same).all()
    assert joined(draw_panels(*arguments)).shape == (720, told.shape[1] + 8 + bev.shape[1], 3)


def test_overlay_of_an_empty_frame_and_of_a_wide_lens():
    fisheye = Camera.from_parameters(300, 300, 639.5, 359.5, 1280, 720, [0.01, -0.002, 0.0, 0.0], "fisheye")
    segments = _segments()._replace(weight=torch.zeros(1, 32).double())
    grid = BEVGrid(resolution=0.2)
    view = Panel("after", np.zeros((*grid.shape, 3), np.uint8), POSE)
    image = np.zeros((720, 1280, 3), np.uint8)
    for pitch in (0.03, 1.4):  # and with the horizon far outside
        calibration = _calibration(segments)._replace(
            extrinsics=POSE._replace(pitch=torch.tensor([pitch]).double())
        )
        assert (
            joined(draw_panels(image, fisheye, segments, calibration, "f", (view, view), grid)).shape[0]
            == PANEL_HEIGHT
        )


@pytest.mark.parametrize("shape", [(40, 2000), (2000, 40)])
def test_overlay_of_a_strip_is_no_wider_than_video_codecs_take(shape):
    camera = Camera.from_parameters(1000, 1000, shape[1] / 2, shape[0] / 2, shape[1], shape[0])
    view = Panel("after", np.zeros((*BEVGrid().shape, 3), np.uint8), POSE)
    image = np.full((*shape, 3), 90, np.uint8)
    picture = joined(
        draw_panels(image, camera, _segments(), _calibration(_segments()), "f", (view,), BEVGrid())
    )
    assert picture.shape[0] == PANEL_HEIGHT
    assert picture.shape[1] < 4096
