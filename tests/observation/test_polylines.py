"""Polylines of a detector, and the vertices of a network, to segments, and through ``lanes.json``."""

import json

import numpy as np
import pytest
import torch

from lanebev import Camera, LaneSegments
from lanebev.io.lanes import read_lanes
from lanebev.io.lanes.tusimple import tusimple_line
from lanebev.observation.boundary_order import boundary_indices
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.polylines import (
    LINE_SIGMA,
    VERTICES_PER_LINE,
    LaneLine,
    image_rows,
    lane_width_ratios,
    rows_from_vertices,
    vertices_from_lines,
)
from lanebev.observation.segments import camera_segments, segments_from_lines

CAMERA = Camera.from_parameters(1000, 1000, 639.5, 359.5, 1280, 720)
DISTORTED = Camera.from_parameters(1000, 1000, 639.5, 359.5, 1280, 720, [-0.25, 0.04, 1e-4, -1e-4, 0])


def _fan(offsets, vanishing=(640.0, 300.0), height=1.5, top=330.0, bottom=719.0):
    """Straight lines at these lateral offsets (m) on a flat road, (P, 2) each, cut at the image's border."""
    rows = np.arange(top, bottom + 1, 10.0)
    lines = []
    for offset in offsets:
        x = vanishing[0] + (rows - vanishing[1]) * offset / height
        lines.append(np.stack([x, rows], axis=-1)[(x >= 0) & (x <= 1279)])
    return lines


@pytest.mark.parametrize(
    ("offsets", "expected", "ratio"),
    [
        ((-1.85, 1.85, 3.35), [2, 3, 4], 3.7 / 1.5),  # a shoulder's line
        ((-3.35, -1.85, 1.85, 3.35), [1, 2, 3, 4], 3.7 / 1.5),
        ((-1.6, 2.1, 3.6), [2, 3, 4], 3.7 / 1.5),
        ((-1.85, 5.55, 9.25), [2, 4, 5], 1.0),  # in a lane whose right boundary is not seen
        ((-5.55, 1.85, 5.55), [2, 4, 5], 1.0),
        ((-1.85, 1.85, 9.25), [2, 3, 5], 1.0),
        ((-3.7, 3.7, 7.4), [2, 4, 5], 1.0),  # above a boundary that is not seen
    ],
)
def test_the_lane_in_whose_middle_the_camera_is_is_one(offsets, expected, ratio):
    lines = _fan(offsets)
    assert boundary_indices(lines) == expected
    assert lane_width_ratios([LaneLine(line) for line in lines], CAMERA) == pytest.approx([ratio])


@pytest.mark.parametrize("roll", [-0.05, 0.02])
def test_lanes_are_equal_for_the_roll_of_the_camera_only(roll):
    """Of lines through one point, at the angles at which a camera with roll sees equal lanes."""
    angles = np.arctan(np.array([-5.55, -1.85, 1.85, 5.55, 9.25]) / 1.5) + roll
    lines = [LaneLine(line, k + 1) for k, line in enumerate(_fan(np.tan(angles), height=1.0, bottom=340.0))]
    found = lane_width_ratios(lines, CAMERA, (0.0, roll, 1.5, -1.5))
    assert found[1] == pytest.approx(1.0)
    assert found[0] > 1.2
    assert np.isnan(found[2:]).all()  # then lines would be above the horizon


def test_a_frame_without_three_boundaries_has_no_ratio_of_widths():
    assert np.isnan(lane_width_ratios([], CAMERA)).all()
    assert np.isnan(lane_width_ratios([LaneLine(line) for line in _fan((-1.85, 1.85))], CAMERA)).all()


def test_boundary_index_counts_outwards_from_the_ego_lane():
    offsets = [9.0, 1.7, -5.4, -1.9, 5.3, -9.2]  # the outermost leave the image sideways
    assert boundary_indices(_fan(offsets)) == [5, 3, 1, 2, 4, 0]


@pytest.mark.parametrize("vanishing_x", [100.0, 640.0, 950.0])
def test_boundary_index_at_any_yaw(vanishing_x):
    lines = _fan([-1.8, 1.8, 5.4], vanishing=(vanishing_x, 300.0))
    assert boundary_indices(lines) == [2, 3, 4]


def test_boundary_index_of_one_line_and_of_one_side():
    assert boundary_indices(_fan([-0.5])) == [2]
    assert boundary_indices(_fan([0.5])) == [3]
    assert boundary_indices(_fan([2.0, 5.6])) == [3, 4]
    assert boundary_indices(_fan([-5.6, -2.0])) == [1, 2]
    assert boundary_indices([]) == []
    assert boundary_indices([np.zeros((0, 2)), np.ones((1, 2))]) == [None, None]


def test_boundary_index_skips_a_missed_line_and_merges_a_double():
    assert boundary_indices(_fan([-1.8, 1.8, 9.0])) == [2, 3, 5]
    doubled = _fan([-1.8, 1.8, 2.0, 5.4])
    doubled[2] = doubled[2][:5]
    assert boundary_indices(doubled) == [2, 3, None, 4]
    assert boundary_indices(_fan([-16, -12.6, -9, -5.4, -1.8, 1.8])) == [None, None, 0, 1, 2, 3]


def test_segments_lie_on_the_lines_of_an_ideal_pinhole():
    offsets = [-5.4, -1.8, 1.8, 5.4]
    lines = [DISTORTED.distort_points(torch.from_numpy(line)).numpy() for line in _fan(offsets)]
    segments = LaneSegments.from_polylines(lines, DISTORTED)
    assert segments.endpoints.shape == (1, 180, 2, 2)
    seen = segments.weight[0] > 0
    for boundary, offset in zip((1, 2, 3, 4), offsets, strict=True):
        points = segments.endpoints[0][seen & (segments.boundary[0] == boundary)].reshape(-1, 2)
        assert len(points) >= 12
        expected = 640 + (points[:, 1] - 300) * offset / 1.5
        assert (points[:, 0] - expected).abs().max() < 0.05  # px: chords of the distorted line
    assert not (seen & ((segments.boundary[0] == 0) | (segments.boundary[0] == 5))).any()


def test_polylines_by_boundary_are_taken_at_their_word():
    left, right = _fan([-1.8, 1.8])
    named = LaneSegments.from_polylines({1: left, 4: right}, CAMERA, sigma=0.7)
    assert set(named.boundary[named.weight > 0].tolist()) == {1, 4}
    assert named.sigma[named.weight > 0].unique().tolist() == pytest.approx([0.7])
    tensors = LaneSegments.from_polylines([torch.from_numpy(left).float(), torch.from_numpy(right)], CAMERA)
    assert set(tensors.boundary[tensors.weight > 0].tolist()) == {2, 3}
    assert LaneSegments.from_polylines([], CAMERA).weight.sum() == 0
    empty = LaneSegments.from_polylines([[], left, right, []], CAMERA)
    assert set(empty.boundary[empty.weight > 0].tolist()) == {2, 3}


def test_a_dense_polyline_says_no_more_than_one_on_rows():
    """Points a pixel apart err alike; the pose would be ten times too sure of itself."""
    dense = np.stack([np.linspace(640, 300, 1000), np.linspace(330, 710, 1000)], axis=-1)
    sparse = dense[[0, 400, -1]]
    one, other = (LaneSegments.from_polylines({2: line}, CAMERA) for line in (dense, sparse))
    torch.testing.assert_close(one.endpoints, other.endpoints)
    assert (one.weight > 0).sum() == 19  # of 39 rows from 330 to 710 the middle one is left out


@pytest.mark.parametrize("missing", [(0, 0), (-1, -1), (-2, -2), (np.nan, np.nan), (np.inf, 5), (np.nan, 0)])
def test_arrays_of_one_shape_are_padded_by_points_that_are_not_there(missing):
    line = np.stack([np.linspace(640, 300, 20), np.linspace(330, 710, 20)], axis=-1)
    expected = LaneSegments.from_polylines({2: line}, CAMERA)
    for way in (line, line[::-1]):
        for before, after in ((0, 3), (3, 0), (2, 2)):
            padded = np.concatenate([np.tile(missing, (before, 1)), way, np.tile(missing, (after, 1))])
            found = LaneSegments.from_polylines({2: padded}, CAMERA)
            torch.testing.assert_close(found.endpoints, expected.endpoints)
            torch.testing.assert_close(found.weight, expected.weight)


def test_a_line_is_not_joined_across_points_without_coordinates():
    line = np.stack([np.linspace(640, 300, 39), np.arange(330, 711, 10)], axis=-1)
    gap, nowhere = line.copy(), line.copy()
    gap[10:20, 0], nowhere[10:20] = np.nan, np.nan
    masked = np.ma.masked_array(line, np.isnan(nowhere))
    for each in (gap, nowhere, masked):
        found = LaneSegments.from_polylines({2: each}, CAMERA)
        assert (found.weight > 0).sum() == 14  # of 29 rows
        torch.testing.assert_close(found.endpoints, LaneSegments.from_polylines({2: gap}, CAMERA).endpoints)


@pytest.mark.parametrize(
    ("polylines", "message"),
    [
        ([np.zeros((4, 3))], r"polylines\[0\]: expected \(P, 2\) px, got shape \(4, 3\)"),
        (
            [torch.zeros(4, 2).bfloat16()],
            r"polylines\[0\]: expected float32 or float64, .* which rounds them",
        ),
        ([np.zeros((4, 2)), [["a", 3]]], r"polylines\[1\]: expected"),
        ({6: np.zeros((4, 2))}, "polylines: expected boundaries 0 to 5, got 6"),
        ({"2": np.zeros((4, 2))}, "polylines: expected boundaries 0 to 5, got '2'"),
    ],
)
def test_polylines_are_checked(polylines, message):
    with pytest.raises(ValueError, match=message):
        LaneSegments.from_polylines(polylines, CAMERA)
    with pytest.raises(TypeError, match=r"camera: expected a lanebev.Camera, got str"):
        LaneSegments.from_polylines([], "camera.yaml")


@pytest.mark.parametrize("every", [2, 3])
def test_points_that_are_missing_between_all_others_are_no_gaps(every):
    """As a detector writes them that looks at every second row of those in the file."""
    whole = np.column_stack([np.linspace(300, 100, 31), np.arange(4, 252, 8)]).astype(float)
    sparse = whole.copy()
    sparse[np.arange(31) % every > 0, 0] = np.nan
    expected, found = (vertices_from_lines([LaneLine(points, 2)], CAMERA) for points in (whole, sparse))
    torch.testing.assert_close(found, expected)
    sparse[12, 0] = np.nan  # a gap
    with_gap = vertices_from_lines([LaneLine(sparse, 2)], CAMERA)
    rows = with_gap.points[0, 2, with_gap.weight[0, 2] > 0, 1]
    assert len(rows) > 15
    assert not ((rows > 100 - 8 * (every - 1)) & (rows < 100 + 8 * (every - 1))).any()


def test_gaps_stay_gaps():
    rows = image_rows(720)
    x = np.where((rows > 400) & (rows < 500), np.nan, 600.0 - 0.5 * rows)
    vertices = vertices_from_lines([LaneLine(np.stack([x, rows], axis=-1), 2)], CAMERA)
    seen = vertices.points[0, 2, vertices.weight[0, 2] > 0]
    expected = np.isfinite(x) & (x >= 0)
    np.testing.assert_array_equal(
        seen[:, 1], rows[expected][np.linspace(0, expected.sum() - 1, 60).round().astype(int)]
    )
    again = rows_from_vertices(vertices, CAMERA.image_size)
    assert not np.isfinite(again.x[2, (rows > 405) & (rows < 495)]).any()


def test_a_hidden_stretch_stays_hidden():
    line = _fan([-1.8])[0]
    line = line[(line[:, 1] < 420) | (line[:, 1] > 560)]
    ones = np.ones(len(line))
    vertices = vertices_from_lines([LaneLine(line, 2, ones, ones)], CAMERA)
    found = rows_from_vertices(vertices, CAMERA.image_size)
    seen = found.rows[np.isfinite(found.x[2])]
    assert not ((seen > 430) & (seen < 550)).any()
    assert len(seen) > 15


def test_a_long_polyline_keeps_its_ends():
    line = np.stack([np.full(720, 600.0), np.arange(720.0)], axis=-1)
    vertices = vertices_from_lines([LaneLine(line, 2)], CAMERA)
    points = vertices.points[0, 2]
    assert len(points.unique(dim=0)) == VERTICES_PER_LINE
    assert points[[0, -1], 1].tolist() == [0.0, 710.0]


def test_a_sigma_of_one_line_leaves_the_others_their_own():
    first, second = _fan([-1.8, 1.8])
    lines = [LaneLine(first, 2, np.full(len(first), 0.2)), LaneLine(second, 3)]
    vertices = vertices_from_lines(lines, CAMERA)
    for boundary, sigma in ((2, 0.2), (3, LINE_SIGMA)):
        own = vertices.sigma[0, boundary, vertices.weight[0, boundary] > 0]
        torch.testing.assert_close(own, torch.full_like(own, sigma))


@pytest.mark.parametrize("seed", range(2))
def test_a_detectors_lines_go_through_lanes_json_bit_for_bit(tmp_path, seed):
    noise = np.random.default_rng(seed)
    fan = _fan([-5.4, -1.8, 1.8, 5.5, 9.1])
    lines = [LaneLine(line + noise.normal(0, [1, 0], line.shape)) for line in fan]
    vertices = vertices_from_lines(lines, DISTORTED)
    _goes_through(tmp_path / "lanes.json", vertices)
    assert int((vertices.weight > 0).sum()) > 100


def test_a_networks_vertices_go_through_lanes_json_bit_for_bit(tmp_path, dtype):
    draw = torch.Generator().manual_seed(0)
    fan = [torch.from_numpy(line) for line in _fan([-9.0, -5.4, -1.8, 1.8, 5.5, 9.1])]
    points = torch.stack([line[torch.linspace(0, len(line) - 1, 32).round().long()] for line in fan])[None]
    points = points + 0.3 * torch.randn(points.shape, generator=draw).double()
    weight = (torch.rand(1, 6, 32, generator=draw).double() - 0.2).clamp(min=0)  # with some not seen
    weight[:, 5] = 0.0
    sigma = 0.3 + torch.rand(1, 6, 32, generator=draw).double()
    parts = (part.to(dtype) for part in (points, weight, sigma))
    _goes_through(tmp_path / "lanes.json", BoundaryVertices(*parts, torch.arange(6)[None]))
    fields = json.loads((tmp_path / "lanes.json").read_text())
    assert fields["seen"]["boundary"] == [0, 1, 2, 3, 4]
    assert fields["boundary"] == [2]  # what others read


def _goes_through(path, vertices):
    """Written and read, they give the same segments, in the same order, padding aside."""
    rows = image_rows(720)
    x = np.full((6, 72), np.nan)
    x[2] = 600.0
    path.write_text(tusimple_line("1.jpg", rows, x, vertices, 1.7) + "\n")
    (frame,) = read_lanes(path)
    assert frame.pose_sigma_scale == 1.7
    told = camera_segments(vertices_from_lines(frame.lines, DISTORTED), DISTORTED)
    given = camera_segments(vertices, DISTORTED)
    for a, b in zip(given, told, strict=True):
        assert torch.equal(a[given.weight > 0], b[told.weight > 0])


def test_empty_frame_writes_a_line_and_reads_back(tmp_path):
    empty = vertices_from_lines([], CAMERA)
    path = tmp_path / "lanes.json"
    path.write_text(tusimple_line("1.jpg", *rows_from_vertices(empty, CAMERA.image_size), empty))
    assert read_lanes(path)[0].lines == []
    assert camera_segments(empty, CAMERA).weight.sum() == 0


def _seen(**changes):
    lines = {"boundary": [2], "points": [[[1.0, 2.0], [3, 4.5]]], "sigma": [[0.5, 1]], "weight": [[1, 0.5]]}
    return json.dumps({"raw_file": "a", "lanes": [], "h_samples": [], "seen": {**lines, **changes}})


def test_seen_vertices_are_read(tmp_path):
    (tmp_path / "lanes.json").write_text(_seen())
    (line,) = read_lanes(tmp_path / "lanes.json")[0].lines
    assert line.boundary == 2
    np.testing.assert_array_equal(line.points, [[1, 2], [3, 4.5]])
    np.testing.assert_array_equal(line.sigma, [0.5, 1])
    np.testing.assert_array_equal(line.weight, [1, 0.5])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": 3}, "points: expected a list"),
        ({"points": []}, "seen: expected points, sigma and weight of as many lines"),
        ({"points": [[[1.0, 2.0], [3.0]]]}, r"seen.points\[0\]: expected 2 numbers, got 1"),
        ({"points": [[[1.0, 2.0], 3.0]]}, r"seen.points\[0\]: expected a list, got 3.0"),
        ({"points": [[[1.0, float("nan")], [3, 4]]]}, r"seen.points\[0\]: expected finite numbers"),
        ({"sigma": [[0.5]]}, r"seen.sigma\[0\]: expected 2 numbers, got 1"),
        ({"sigma": [[0.5, 0]]}, r"seen.sigma\[0\]: expected px above 0"),
        ({"weight": [[0.5, 1.5]]}, r"seen.weight\[0\]: expected 0 to 1"),
        ({"boundary": [6]}, "boundary: expected one different index"),
    ],
)
def test_bad_seen_vertices_name_file_and_line(tmp_path, changes, message):
    path = tmp_path / "lanes.json"
    path.write_text(_seen(**changes))
    with pytest.raises(ValueError, match=f"line 1: {message}"):
        read_lanes(path)


def test_rows_of_a_batch_are_those_alone():
    frames = [[LaneLine(line) for line in _fan(offsets)] for offsets in ([-1.8, 1.8], [-2.0], [])]
    together = segments_from_lines(frames, CAMERA)
    for row, frame in enumerate(frames):
        alone = segments_from_lines([frame], CAMERA)
        for a, b in zip(alone, together, strict=True):
            assert torch.equal(a[0], b[row])
