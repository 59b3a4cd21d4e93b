"""Lane files as more detectors write them: lists, empty lanes, lines drawn twice, across the road or back."""

import gzip
import json

import numpy as np
import pytest
from PIL import Image

from lanebev import Camera
from lanebev.app.config import RunConfig
from lanebev.app.drive.sources import make_source
from lanebev.io.lanes import match_frames, read_lanes
from lanebev.io.lanes.parsing import FrameLines
from lanebev.observation.boundary_order import boundary_indices
from lanebev.observation.polylines import LaneLine, vertices_from_lines

CAMERA = Camera.from_parameters(1000, 1000, 639.5, 359.5, 1280, 720)


def _entry(name="1.jpg", **changes):
    return {"raw_file": name, "h_samples": [500, 510, 520], "lanes": [[5, 6, 7], [900, 910, 920]], **changes}


@pytest.mark.parametrize(
    "text",
    [
        json.dumps([_entry(), _entry("2.jpg")]),
        json.dumps([_entry(), _entry("2.jpg")], indent=2),
        json.dumps(_entry(), indent=2) + "\n" + json.dumps(_entry("2.jpg"), indent=2),
        json.dumps(_entry()) + ",\n" + json.dumps(_entry("2.jpg")) + ",\n",
        json.dumps(_entry()) + json.dumps(_entry("2.jpg")),
        json.dumps(_entry()) + "\r\n\r\n" + json.dumps(_entry("2.jpg")) + "\r\n",
    ],
)
def test_tusimples_objects_in_any_arrangement(tmp_path, text):
    (tmp_path / "lanes.json").write_text(text)
    frames = read_lanes(tmp_path / "lanes.json")
    assert [frame.name for frame in frames] == ["1.jpg", "2.jpg"]
    np.testing.assert_array_equal(frames[1].lines[0].points, [[5, 500], [6, 510], [7, 520]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            json.dumps(_entry()) + "\n\n" + json.dumps(_entry("2"))[:-9],
            "line 3: expected JSON, got a line that",
        ),
        (json.dumps([_entry(), _entry("2")], indent=2)[:-9], "line 1: expected JSON"),
        (json.dumps(_entry(), indent=2) + "\n5\n", r"line \d\d: expected a JSON object, got int"),
        ("[1, 2]", "line 1: expected a JSON object, got list"),
        ("[" * 10_000, "line 1: expected JSON"),
    ],
)
def test_what_breaks_off_names_its_line(tmp_path, text, message):
    (tmp_path / "lanes.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_lanes(tmp_path / "lanes.json")


def test_an_empty_lane_is_none(tmp_path):
    (tmp_path / "lanes.json").write_text(
        json.dumps(_entry(lanes=[[], [900, 910, 920]], sigma=[None, [1, 1, 1]]))
    )
    (line,) = read_lanes(tmp_path / "lanes.json")[0].lines
    np.testing.assert_array_equal(line.points[:, 0], [900, 910, 920])


@pytest.mark.parametrize(("left", "right"), [(0.0, 1279.0), (-1.0, 1280.0), (1.5, 1277.5)])
def test_points_that_were_moved_to_the_edge_are_missing(left, right):
    outer = _fan(-5.4, 5.4)  # leave the image above its bottom
    rows = np.array([600.0, 650.0, 700.0])
    moved = [
        np.concatenate([line, np.column_stack([np.full(3, edge), rows])])
        for line, edge in zip(outer, (left, right), strict=True)
    ]
    lines = [moved[0], LEFT, RIGHT, moved[1]]
    found, expected = (
        vertices_from_lines([LaneLine(line) for line in each], CAMERA)
        for each in (lines, [outer[0], LEFT, RIGHT, outer[1]])
    )
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.weight, expected.weight)


@pytest.mark.parametrize("shift", [0.0, 0.25])
@pytest.mark.parametrize("order", [1, -1])
def test_points_that_repeat_the_x_of_a_lines_end_are_missing(shift, order):
    part = slice(4, -6) if shift == 0.0 else slice(1, -1)
    rows = LEFT[:, 1]
    lines = [line + np.array([shift, 0.0]) for line in (LEFT, RIGHT)]
    repeating = [
        np.stack([np.interp(rows, line[part, 1], line[part, 0]), rows], axis=-1)[::order] for line in lines
    ]
    found, expected = (
        vertices_from_lines([LaneLine(line) for line in each], CAMERA)
        for each in (repeating, [line[part][1:-1] for line in lines])
    )
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.weight, expected.weight)


@pytest.mark.parametrize(
    "x",
    [
        [500, 500, 500, 500, 500, 500],
        [500, 500, 500, 501, 501, 501],
        [500, 500, 502, 506, 512, 520],
        [500, 500, 503, 506, 509, 512],
        [500, 500, 504, 512, 524, 540],
        [500.5, 500.5, 502.4, 506.1, 511.9, 519.8],
        [500.5, 500.5, 500.6, 500.8, 501.0, 501.2],
        [500.5, 500.5, 508.5, 508.5, 516.5, 516.5],  # of a grid
    ],
)
def test_lines_that_are_vertical_or_become_so_are_whole(x):
    line = np.stack([x, np.arange(400.0, 460.0, 10.0)], axis=-1)
    assert vertices_from_lines([LaneLine(line, 2)], CAMERA).weight.sum() == 6
    drawn = np.array([[640.0, 400.0], [640.0, 500.0], [600.0, 550.0], [560.0, 600.0]])  # by hand
    assert vertices_from_lines([LaneLine(drawn, 2)], CAMERA).weight.sum() == 21


@pytest.mark.parametrize("order", [1, -1])
def test_a_whole_number_that_is_repeated_once_is_missing_where_the_line_moves_fast(order):
    rows = np.arange(400.0, 470.0, 10.0)
    x = np.array([500, 500, 505, 510, 516, 521, 527])
    (found,) = vertices_from_lines([LaneLine(np.stack([x, rows], -1)[::order], 2)], CAMERA).weight[0, 2:3]
    assert found.sum() == 5


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("slope", [-1.3, -0.7, -0.4, 0.4, 1.0])  # px a row
def test_whole_numbers_that_a_slow_line_repeats_at_its_end_are_missing(slope, order):
    """As by the columns of a mask on every row."""
    rows = np.arange(300.0, 700.0)
    x = np.round(640 + slope * (np.maximum(rows, 360) - 300))
    found, expected = (
        vertices_from_lines([LaneLine(np.stack([x, rows], -1)[part][::order], 2)], CAMERA)
        for part in (slice(None), slice(65, None))
    )
    np.testing.assert_array_equal(found.points[0, 2, :33], expected.points[0, 2, :33])
    np.testing.assert_array_equal(found.weight, expected.weight)


@pytest.mark.parametrize("begin", [0.0, 10.0, 25.0, 60.0])  # rows from the end to where the curve is vertical
@pytest.mark.parametrize("power", [2, 3, 4])
@pytest.mark.parametrize("bend", [3.0, 30.0, 300.0])  # px at the other end
def test_whole_numbers_of_a_curve_that_becomes_vertical_are_whole(bend, power, begin):
    rows = np.arange(300.0, 700.0)
    x = np.round(640 + bend * ((rows - 300 - begin) / 400) ** power)
    assert vertices_from_lines([LaneLine(np.stack([x, rows], -1), 2)], CAMERA).weight.sum() == 40


@pytest.mark.parametrize("order", [1, -1])
def test_a_point_in_the_corner_is_padding(order):
    padded = [np.concatenate([line[::order], [[0.0, 0.0]]]) for line in (LEFT, RIGHT)]
    found, expected = (
        vertices_from_lines([LaneLine(line) for line in each], CAMERA) for each in (padded, [LEFT, RIGHT])
    )
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.weight, expected.weight)


def test_zeros_where_a_detector_sees_no_line_are_missing():
    with_zeros = LEFT.copy()
    with_zeros[5:9, 0] = 0.0
    with_gap = np.where(with_zeros == 0.0, np.nan, with_zeros)
    found, expected = (
        vertices_from_lines([LaneLine(line), LaneLine(RIGHT)], CAMERA) for line in (with_zeros, with_gap)
    )
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.weight, expected.weight)


def test_letters_that_macos_takes_apart_are_the_same():
    assert match_frames(["caf\u00e9/1.jpg"], [FrameLines("cafe\u0301/1.jpg", [])]) == [0]
    assert match_frames(["cafe\u0301.jpg"], [FrameLines("caf\u00e9.jpg", [])]) == [0]


def test_json_by_the_name_of_a_text_file(tmp_path):
    (tmp_path / "pred.txt").write_text("\n" + json.dumps([_entry(), _entry("2.jpg")]))
    assert [frame.name for frame in read_lanes(tmp_path / "pred.txt")] == ["1.jpg", "2.jpg"]


def test_openlanes_files_of_several_images_and_packed_files_are_one_clear_line(tmp_path):
    path = tmp_path / "1.json"
    path.write_text(2 * (json.dumps({"file_path": "1.jpg", "lane_lines": []}) + "\n"))
    with pytest.raises(ValueError, match="expected one JSON object, got more; write a file per image"):
        read_lanes(path)
    path.write_bytes(gzip.compress(json.dumps(_entry()).encode()))
    with pytest.raises(ValueError, match="a readable file, got: compressed by gzip; unpack it"):
        read_lanes(path)


def test_hidden_files_are_no_lanes(tmp_path):
    (tmp_path / "1.lines.txt").write_text("5 590 6 580\n")
    (tmp_path / "._1.lines.txt").write_bytes(b"\x00\x05\x16\x07\x00")  # macOS
    (tmp_path / ".ipynb_checkpoints").mkdir()
    (tmp_path / ".ipynb_checkpoints" / "1.lines.txt").write_text("7 590 8 580\n")
    (frame,) = read_lanes(tmp_path)
    np.testing.assert_array_equal(frame.lines[0].points, [[5, 590], [6, 580]])


@pytest.mark.parametrize("missing", ["-2", "-1", "nan"])
def test_culane_points_that_are_not_there_draw_no_line(tmp_path, missing):
    path = tmp_path / "1.lines.txt"
    path.write_text(f"{missing} 695 {missing} 685 {missing} 675 300 665 310 655 320 645 330 635\n")
    (line,) = read_lanes(path)[0].lines
    vertices = vertices_from_lines([line._replace(boundary=2)], CAMERA)
    seen = vertices.points[0, 2, vertices.weight[0, 2] > 0].numpy()
    np.testing.assert_allclose(seen, [[325, 640], [315, 650], [305, 660]])  # and not 150 at 670


def test_a_class_and_a_score_before_culane_points_are_refused(tmp_path):
    path = tmp_path / "1.lines.txt"
    path.write_text("1 0.98 600 590 610 580 620 570 630 560\n")
    with pytest.raises(ValueError, match=r"line 1: expected x y pairs in px, got 1 0.98 before them; leave"):
        read_lanes(path)
    path.write_text("600 590 610 580 620 570 0.98\n")
    with pytest.raises(ValueError, match="got 7 numbers; is the file cut, or a class beside them"):
        read_lanes(path)
    path.write_text("5 0 6 10 7 20 8 30\n0 1 600 590\n")  # rows from the first one, and two points
    assert len(read_lanes(path)[0].lines) == 2
    path.write_text("0 0 300 400 310 390 320 380\n")  # padding, or the image's corner
    assert len(read_lanes(path)[0].lines) == 1


def test_a_folder_of_other_files_says_which_it_reads(tmp_path):
    message = r"expected .lines.txt or .json files, got {}; give an .xml file by its name, and lines instead"
    with pytest.raises(ValueError, match=message.format("none")):
        read_lanes(tmp_path)
    (tmp_path / "annotations.xml").write_text("<annotations></annotations>")
    (tmp_path / "1.png").write_bytes(b"")
    with pytest.raises(ValueError, match=message.format(".png .xml")):
        read_lanes(tmp_path)


def test_culane_rows_may_repeat_and_turn(tmp_path):
    path = tmp_path / "1.lines.txt"
    path.write_text("5 590 7 580 9 580 11 570\n5 590 7 580 9 570 12 575 15 580 18 585\n")
    first, second = read_lanes(path)[0].lines
    assert np.isfinite(first.points).all()
    rows = vertices_from_lines([second._replace(boundary=2)], CAMERA)
    seen = rows.points[0, 2, rows.weight[0, 2] > 0].numpy()
    np.testing.assert_array_equal(seen, [[9, 570], [7, 580], [5, 590]])  # the longer way


def _fan(*offsets, top=330.0, height=1.5):
    """Boundaries of a flat straight road at these lateral offsets (m), each (P, 2) px."""
    rows = np.arange(top, 720.0, 10.0)
    lines = [np.stack([640 + (rows - 300) * offset / height, rows], axis=-1) for offset in offsets]
    return [line[(line[:, 0] >= 0) & (line[:, 0] <= 1279)] for line in lines]


LEFT, RIGHT = _fan(-1.8, 1.8)


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ([LEFT, LEFT], [2, None]),
        ([LEFT, LEFT, RIGHT], [2, None, 3]),
        ([LEFT, RIGHT, LEFT, RIGHT], [2, 3, None, None]),
        (_fan(-1.9, -1.7), [2, None]),  # both edges of one marking
        (_fan(1.7, 1.9), [3, None]),
        (_fan(-1.9, -1.7, 1.7, 1.9), [2, None, 3, None]),
        ([LEFT[:12], LEFT[20:], RIGHT], [None, 2, 3]),  # in two pieces
        (_fan(-5.4, -1.8, 1.8, 5.4, height=6.0), [1, 2, 3, 4]),  # narrow in the image: seen from above
    ],
)
def test_a_line_that_is_drawn_twice_counts_once(lines, expected):
    assert boundary_indices(lines) == expected


@pytest.mark.parametrize("rise", [4.0, -4.0, 25.0, -25.0, 0.0])
def test_a_line_across_the_road_counts_for_none(rise):
    across = np.array([[100.0, 600.0], [400.0, 600.0 + rise / 2], [700.0, 600.0 + rise]])
    assert boundary_indices([across, LEFT, RIGHT]) == [None, 2, 3]
    assert boundary_indices([across]) == [None]


@pytest.mark.parametrize("reverse", [False, True])
def test_the_end_of_a_line_that_comes_down_again_is_left_out(reverse):
    up = np.stack([np.linspace(300, 600, 31), np.linspace(700, 400, 31)], axis=-1)
    down = np.stack([np.linspace(610, 900, 8), np.linspace(405, 440, 8)], axis=-1)
    whole = np.concatenate([up, down])[:: -1 if reverse else 1]
    found, expected = (vertices_from_lines([LaneLine(line, 2)], CAMERA) for line in (whole, up))
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.weight, expected.weight)


def test_points_in_no_order_are_a_line_all_the_same():
    shuffled = np.random.default_rng(0).permutation(LEFT)
    found, expected = (vertices_from_lines([LaneLine(line, 2)], CAMERA) for line in (shuffled, LEFT))
    np.testing.assert_array_equal(found.points, expected.points)


def test_curvelanes(tmp_path):  # CLRerNet#60
    (tmp_path / "labels").mkdir()
    path = tmp_path / "labels" / "a.lines.json"
    drawn = [
        [{"y": "590.0", "x": "5.25"}, {"y": 580, "x": 7}, {"x": None, "y": 570}],
        [],
        [{"x": "nan", "y": 1}],
    ]
    path.write_text(json.dumps({"Lines": drawn}))
    (frame,) = read_lanes(path.parent)
    assert match_frames([str(tmp_path / "images" / "a.jpg")], [frame]) == [0]
    (line,) = frame.lines
    np.testing.assert_array_equal(line.points, [[5.25, 590], [7, 580], [np.nan, 570]])


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (5, "Lines: expected a list, got int"),
        ([5], r"Lines\[0\]: expected a list, got 5"),
        ([[[1, 2]]], r"Lines\[0\]: expected points with x and y, got list"),
        ([[{"x": "a", "y": 1}]], r"Lines\[0\]: expected finite numbers"),
        ([[{"x": 1e9, "y": 1}]], r"Lines\[0\]: expected pixels, got 1e\+09"),
    ],
)
def test_what_is_no_curvelanes_is_one_clear_line(tmp_path, lines, message):
    (tmp_path / "a.lines.json").write_text(json.dumps({"Lines": lines}))
    with pytest.raises(ValueError, match=message):
        read_lanes(tmp_path / "a.lines.json")


def test_a_folder_whose_names_state_no_times_says_which_rate_is_assumed(tmp_path):
    for number in range(3):
        Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / f"{number}.png")
    assumed = make_source(RunConfig(str(tmp_path), "c")).problem
    assert assumed.endswith(
        "no times are read from their names, 30 frames per second are assumed; state --fps"
    )
    for settings in ({"fps": 10.0}, {"stills": True}):
        assert make_source(RunConfig(str(tmp_path), "c", **settings)).problem == ""
    assert make_source(RunConfig(str(tmp_path / "0.png"), "c")).problem == ""


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (  # SDLane
            "1.json",
            json.dumps({"geometry": [], "idx": [1], "shape": {"a": 1}}),
            "expected keys of a known format, got 'geometry, idx, shape'; formats: TuSimple, .*, VIA$",
        ),
        ("1.json", json.dumps({"0.jpg": {"l0": [1]}}), "a known format, got '0.jpg'; formats"),
        (
            "1.json",
            str({"raw_file": "0.jpg", "lanes": []}),
            "line 1: expected JSON, got single quotes: .*; write it by json.dumps$",
        ),
        (
            "1.lines.txt",
            "".join(f"{500 - y / 2} {y}\n" for y in range(700, 600, -10)),
            "expected a line of text for each lane, got one for each point$",
        ),
    ],
)
def test_what_others_write_is_refused_in_words(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        read_lanes(tmp_path / name)
