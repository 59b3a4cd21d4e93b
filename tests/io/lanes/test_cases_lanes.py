"""Lane files as other detectors write them: gaps, nulls, other image sizes, 3D points without pixels."""

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from lanebev import Camera
from lanebev.app.config import RunConfig
from lanebev.app.drive.observers import LaneFileObserver
from lanebev.app.run import run
from lanebev.io.lanes import read_lanes
from lanebev.io.lanes.culane import read_culane
from lanebev.io.lanes.openlane import camera_from_ground_points
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.lanes.remarks import check_boundary_order, left_out_remark
from lanebev.io.lanes.size import lanes_of_whole_images, meeting_point, resized_lanes, size_remark
from lanebev.io.lanes.tusimple import tusimple_line
from lanebev.io.opening import open_source
from lanebev.numbers import parse_crop, parse_size
from lanebev.observation.polylines import LaneLine, vertices_from_lines

CAMERA = Camera.from_parameters(1000, 1000, 639.5, 359.5, 1280, 720)
OFFSETS = (-5.4, -1.8, 1.8, 5.4)  # m to the right of the camera
HEIGHT, HORIZON = 1.5, 300.0


def _lines(rows=None):
    """Boundaries of a flat straight road, each (P, 2) px."""
    rows = np.arange(700.0, 340.0, -10.0) if rows is None else rows
    return [np.stack([640 + (rows - HORIZON) * x / HEIGHT, rows], axis=-1) for x in OFFSETS]


def _culane(path, lines):
    path.write_text("\n".join(" ".join(f"{x:.2f} {y:g}" for x, y in line) for line in lines) + "\n")
    return path


@pytest.mark.parametrize("kept", [slice(0, None), [0, 1, 2, 3, 9, 10], [0, 5, 6, 7, 8], [0, 1, 2, 3, 30]])
@pytest.mark.parametrize("upwards", [True, False])
def test_rows_may_be_left_out_anywhere(tmp_path, kept, upwards):
    line = _lines()[1][kept][:: 1 if upwards else -1]
    (read,) = read_culane(_culane(tmp_path / "0.lines.txt", [line])).lines
    there = np.isfinite(read.points[:, 0])
    np.testing.assert_allclose(read.points[there], line, atol=0.01)
    gaps = np.flatnonzero(np.abs(np.diff(line[:, 1])) > 25)
    assert (~there).sum() == len(gaps)  # what was left out is not seen
    vertices = vertices_from_lines([LaneLine(read.points, 2)], CAMERA)
    seen = vertices.points[0, 2, vertices.weight[0, 2] > 0, 1].numpy()
    for gap in gaps:
        low, high = sorted(line[gap : gap + 2, 1])
        assert not ((seen > low) & (seen < high)).any()
    assert len(seen) == len(line)


def test_a_number_cut_at_the_end_of_the_file_is_no_gap(tmp_path):
    path = tmp_path / "0.lines.txt"
    path.write_text("600 590 610 580 620 570 630 56")  # of 560
    with pytest.raises(ValueError, match="line 1: expected evenly spaced rows, got 570 then 56; is the file"):
        read_culane(path)
    path.write_text("600 590 610 580 620 570 630 56\n600 590 610 580\n")
    assert len(read_culane(path).lines) == 2  # a dot at row 56: the file goes on


@pytest.mark.parametrize("missing", [None, float("nan"), -2, -2.0])
def test_what_is_not_there_is_null_nan_or_negative(tmp_path, missing):
    fields = {"raw_file": "1.jpg", "h_samples": [500, 510, 520], "lanes": [[missing, 5, 6], [missing] * 3]}
    path = tmp_path / "lanes.json"
    path.write_text(json.dumps(fields))
    ((line,),) = [frame.lines for frame in read_lanes(path)]  # a lane that is nowhere is none
    np.testing.assert_array_equal(line.points, [[np.nan, 500], [5, 510], [6, 520]])


def test_nan_in_culane_and_null_in_openlane_are_gaps(tmp_path):
    path = tmp_path / "0.lines.txt"
    path.write_text("5 590 nan 580 7 570\nnan 590 nan 580\nnan nan 8 580\n")
    first, third = read_culane(path).lines
    np.testing.assert_array_equal(first.points, [[5, 590], [np.nan, 580], [7, 570]])
    np.testing.assert_array_equal(third.points, [[8, 580]])
    fields = {"file_path": "1.jpg", "lane_lines": [{"uv": [[1, None, 3], [590, 580, float("nan")]]}]}
    (tmp_path / "1.json").write_text(json.dumps(fields))
    (line,) = read_lanes(tmp_path / "1.json")[0].lines
    np.testing.assert_array_equal(line.points, [[1, 590], [np.nan, 580], [3, np.nan]])
    assert vertices_from_lines([line], CAMERA).weight.sum() == 0


@pytest.mark.parametrize(
    "text", ['{"raw_file": "1", "h_samples": [1, 2], "lanes": [[1, Infinity]]}', "1e9 590 2 580", "inf 590"]
)
def test_numbers_that_are_no_pixels_are_refused(tmp_path, text):
    path = tmp_path / ("1.json" if text.startswith("{") else "1.lines.txt")
    path.write_text(text)
    with pytest.raises(ValueError, match=r"expected (pixels|finite numbers, or null)"):
        read_lanes(path)


def test_rows_may_fall(tmp_path):
    """As from the bottom of the image upwards."""
    fields = {"raw_file": "1.jpg", "h_samples": [520, 510, 500], "lanes": [[6, 5, -2]]}
    (tmp_path / "lanes.json").write_text(json.dumps(fields))
    (line,) = read_lanes(tmp_path / "lanes.json")[0].lines
    np.testing.assert_array_equal(line.points, [[6, 520], [5, 510], [np.nan, 500]])
    lines = [LaneLine(line, i + 1) for i, line in enumerate(_lines())]
    falling = [line._replace(points=line.points[::-1]) for line in lines]
    for a, b in zip(vertices_from_lines(lines, CAMERA), vertices_from_lines(falling, CAMERA), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks(tmp_path, encoding):
    path = tmp_path / "1.lines.txt"
    path.write_text("5 590 6 580\n", encoding=encoding)
    np.testing.assert_array_equal(read_lanes(path)[0].lines[0].points, [[5, 590], [6, 580]])


def test_a_line_separator_within_a_name_ends_no_line(tmp_path):
    path = tmp_path / "l.json"
    fields = {"raw_file": "a\u2028b.jpg", "h_samples": [1, 2], "lanes": [[5, 6]]}
    path.write_text(json.dumps(fields, ensure_ascii=False) + "\r\n", encoding="utf-8")
    assert read_lanes(path)[0].name == "a\u2028b.jpg"


# OpenLane's 3D points

INTRINSICS = [[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]]
ROAD = np.array([[1.8, 1.5, 10.0], [1.8, 1.5, 20.0], [1.8, 1.5, 40.0], [1.7, 1.4, 80.0]])  # right, down, on
PIXELS = np.array([[820, 510], [730, 435], [685, 397.5], [661.25, 377.5]])
LABEL = ROAD[:, [2, 0, 1]] * [1, -1, -1]  # forward, left, up


def _openlane(path, lane, **fields):
    path.write_text(json.dumps({"file_path": "1.jpg", "lane_lines": [lane], **fields}))
    return path


@pytest.mark.parametrize("layout", ["3 lists", "P lists"])
def test_3d_points_alone_are_projected_by_the_intrinsics(tmp_path, layout):
    xyz = LABEL.T.tolist() if layout == "3 lists" else LABEL.tolist()
    (line,) = read_lanes(_openlane(tmp_path / "1.json", {"xyz": xyz}, intrinsic=INTRINSICS))[0].lines
    np.testing.assert_allclose(line.points, PIXELS, atol=1e-9)
    path = _openlane(tmp_path / "2.json", {"xyz": xyz, "uv": None})
    (line,) = read_lanes(path, np.array(INTRINSICS))[0].lines  # of the camera file
    np.testing.assert_allclose(line.points, PIXELS, atol=1e-9)
    with pytest.raises(ValueError, match=r"intrinsic: expected the camera matrix of lane_lines\[0\]"):
        read_lanes(path)


def test_uv_may_be_a_list_of_points(tmp_path):
    (line,) = read_lanes(_openlane(tmp_path / "1.json", {"uv": PIXELS.tolist()}))[0].lines
    np.testing.assert_array_equal(line.points, PIXELS)
    two = read_lanes(_openlane(tmp_path / "1.json", {"uv": [[1, 2], [590, 580]]}))[0].lines[0]
    np.testing.assert_array_equal(two.points, [[1, 590], [2, 580]])  # two lists, as OpenLane has them


def test_three_3d_points_are_laid_out_as_those_of_the_other_lines(tmp_path):
    path = tmp_path / "1.json"
    three, four = {"xyz": LABEL[:3].tolist()}, {"xyz": LABEL.tolist()}
    path.write_text(json.dumps({"file_path": "1", "lane_lines": [three, four], "intrinsic": INTRINSICS}))
    for line, points in zip(read_lanes(path)[0].lines, (PIXELS[:3], PIXELS), strict=True):
        np.testing.assert_allclose(line.points, points, atol=1e-9)
    by_axis = [{"xyz": LABEL[:3].T.tolist()}, {"xyz": LABEL.T.tolist()}]
    path.write_text(json.dumps({"file_path": "1", "lane_lines": by_axis, "intrinsic": INTRINSICS}))
    np.testing.assert_allclose(read_lanes(path)[0].lines[0].points, PIXELS[:3], atol=1e-9)


def test_3d_points_near_the_camera_may_lie_outside_of_the_images(tmp_path):
    forward = [3.0, 5.0, 10.0, 20.0, 40.0, 80.0]  # the first two below the images, or beside them
    lines = [{"xyz": [forward, [left] * 6, [-1.5] * 6]} for left in (5.4, 1.8, -1.8, -5.4)]
    path = tmp_path / "1.json"
    path.write_text(json.dumps({"file_path": "1", "lane_lines": lines, "intrinsic": INTRINSICS}))
    frames = read_lanes(path)
    assert frames[0].principal_point == (640.0, 360.0)
    assert size_remark(frames, (720, 1280)) == ""
    with pytest.raises(ValueError, match=r"principal point is 640, 360; of images of another size\? state"):
        size_remark(frames, (480, 854))
    half = lanes_of_whole_images(frames, (720, 1280), None, (360, 640))
    assert half[0].principal_point == (319.75, 179.75)
    assert half[0].focal_length == 0.5 * INTRINSICS[0][0]
    assert size_remark(half, (360, 640)) == ""


def test_3d_points_are_seen_through_the_lens_of_the_run(tmp_path):
    lens = Camera.from_parameters(1000, 1000, 640, 360, 1280, 720, [-0.3, 0.02, 0.001, -0.002])
    near = np.concatenate([[[1.8, 1.5, 0.5]], ROAD])  # the first is beyond what the lens images
    xyz = (near[:, [2, 0, 1]] * [1, -1, -1]).T.tolist()
    entries = read_lanes(_openlane(tmp_path / "1.json", {"xyz": xyz}), lens.intrinsics.numpy())
    Image.new("RGB", (1280, 720)).save(tmp_path / "1.jpg")
    observer = LaneFileObserver(entries, open_source(str(tmp_path / "1.jpg")), lens)
    found = observer.entries[0].lines[0].points
    expected, seen = lens.project(torch.from_numpy(near))
    assert seen.tolist() == [False, True, True, True, True]
    np.testing.assert_allclose(found[1:], expected[1:], atol=1e-9)
    assert np.isnan(found[0]).all()
    assert np.abs(found[1] - PIXELS[0]).max() > 2.0  # px


def test_predictions_for_openlanes_benchmark_are_in_the_ground_frame(tmp_path):
    pitch, height = 0.05, 2.1  # camera nose down
    c, s = math.cos(pitch), math.sin(pitch)
    extrinsic = np.array([[c, 0, s, 1.5], [0, 1, 0, 0.1], [-s, 0, c, height], [0, 0, 0, 1]])
    vehicle = LABEL @ extrinsic[:3, :3].T + [0, 0, height]  # forward, left, up, below the camera
    ground = vehicle[:, [1, 0, 2]] * [-1, 1, 1]  # right, forward, up
    np.testing.assert_allclose(camera_from_ground_points(ground, extrinsic), ROAD, atol=1e-12)
    lane = {"xyz": ground.tolist(), "category": 1}
    path = _openlane(tmp_path / "1.json", lane, intrinsic=INTRINSICS, extrinsic=extrinsic.tolist())
    np.testing.assert_allclose(read_lanes(path)[0].lines[0].points, PIXELS, atol=1e-9)


def test_3d_points_that_are_not_seen_or_behind_have_no_pixels(tmp_path):
    xyz = np.concatenate([LABEL, [[-5.0, 1.8, -1.5], [np.nan, 1.8, -1.5]]]).T.tolist()
    path = _openlane(tmp_path / "1.json", {"xyz": xyz}, intrinsic=INTRINSICS)
    np.testing.assert_allclose(read_lanes(path)[0].lines[0].points, PIXELS, atol=1e-9)
    lane = {"xyz": xyz, "visibility": [1, 0, 1, 0, 1, 1]}
    path = _openlane(tmp_path / "1.json", lane, intrinsic=INTRINSICS)
    np.testing.assert_allclose(read_lanes(path)[0].lines[0].points, PIXELS[::2], atol=1e-9)
    path = _openlane(tmp_path / "1.json", {"xyz": (-LABEL).T.tolist()}, intrinsic=INTRINSICS)
    with pytest.raises(ValueError, match="expected points before the camera"):
        read_lanes(path)


@pytest.mark.parametrize(
    ("lane", "fields", "message"),
    [
        ({"xyz": [[1], [2]]}, {}, r"lane_lines\[0\].xyz: expected three lists of one length"),
        ({"xyz": [[1], [2], [3, 4]]}, {}, r"lane_lines\[0\].xyz: expected three lists of one length"),
        ({"xyz": [1, 2, 3]}, {}, r"lane_lines\[0\].xyz: expected three lists of one length"),
        ({"xyz": [[1], [2], [3]]}, {"intrinsic": [1]}, "intrinsic: expected 3 x 3 numbers"),
        ({"xyz": [[1], [2], [3]], "visibility": [1, 1]}, {}, "visibility: expected 1 numbers, got 2"),
        (5, {}, r"lane_lines\[0\]: expected an object, got 5"),
        ({"xyz": [[1, 2, 3]] * 4}, {"extrinsic": [[1]]}, "extrinsic: expected 4 x 4 numbers"),
    ],
)
def test_malformed_3d_lanes_are_one_clear_line(tmp_path, lane, fields, message):
    with pytest.raises(ValueError, match=message) as error:
        read_lanes(_openlane(tmp_path / "1.json", lane, **fields))
    assert "\n" not in str(error.value)


# lanes of another image size


def _entries(scale=1.0):
    inside = [line[(line[:, 0] >= 0) & (line[:, 0] < 1280)] for line in _lines()]
    return [FrameLines("0.png", [LaneLine((line + 0.5) * scale - 0.5) for line in inside])]


@pytest.mark.parametrize("scale", [1.5, 2.0, 3.0])
def test_lanes_of_larger_images_lie_outside(scale):
    with pytest.raises(ValueError, match=r"1280 x 720 px, got \d+% outside .* of another size\?"):
        size_remark(_entries(scale), (720, 1280))


@pytest.mark.parametrize("begin", [6.0, 12.0])  # m, as lanes in 3D or behind a bonnet
@pytest.mark.parametrize("yaw", [-5.0, 0.0, 5.0])
def test_lanes_that_begin_far_ahead_are_not_of_smaller_images(begin, yaw):
    focal = 500.0  # px: 104 degrees of view
    z = np.array([begin, 20.0, 40.0, 80.0])
    x = [639.5 + focal * (math.tan(math.radians(yaw)) + offset / z) for offset in OFFSETS]
    lines = [LaneLine(np.stack([line, 359.5 + focal * HEIGHT / z], axis=-1)) for line in x]
    assert size_remark([FrameLines("0.png", lines)], (720, 1280)) == ""


@pytest.mark.parametrize("scale", [0.25, 0.5, 2 / 3, 0.75, 0.78])
def test_lanes_of_smaller_images_are_noticed(scale):
    remark = size_remark(_entries(scale), (720, 1280))
    assert "of smaller images? state their size with --lanes-size" in remark


def test_lanes_of_wider_and_flatter_images_are_noticed():
    """CULane's 1640 x 590, of which no point is below 1280 x 720."""
    (frame,) = _entries()
    lines = [line._replace(points=line.points * [1640 / 1280, 590 / 720]) for line in frame.lines]
    remark = size_remark([frame._replace(lines=lines)], (720, 1280))
    assert "beyond the right edge, up to column" in remark
    assert "and none beyond the left; of wider images? state their size" in remark
    drawn_on = [LaneLine(line) for line in _lines()]  # over both edges
    assert size_remark([FrameLines("0.png", drawn_on)], (720, 1280)) == ""
    leftmost = [line for line in drawn_on if (line.points[:, 0] >= 0).all()]  # over the right edge alone
    assert max(line.points[:, 0].max() for line in leftmost) > 1280
    assert size_remark([FrameLines("0.png", leftmost)], (720, 1280)) == ""


def test_lanes_of_their_images_get_no_remark():
    assert size_remark(_entries(), (720, 1280)) == ""
    assert size_remark([FrameLines("0.png", [])], (720, 1280)) == ""
    bonnet = [FrameLines("0.png", [LaneLine(line[line[:, 1] < 480]) for line in _lines()])]
    assert size_remark(bonnet, (720, 1280)) == ""


@pytest.mark.parametrize(("top", "share"), [(0.0, "42%"), (250.0, "")])
def test_lines_that_go_on_above_the_horizon_are_noticed(top, share):
    lines = [LaneLine(line) for line in _lines(np.arange(705.0, top, -10.0))]
    remark = size_remark([FrameLines("0.png", lines)], (720, 1280))
    assert remark.startswith(f"lanes: {share} of the points lie above row 300, where they" if share else "")
    assert bool(remark) == bool(share)


@pytest.mark.parametrize("padding", [0.0, 1280.0])
def test_padding_is_not_drawn_beyond_the_road(padding):
    rows = np.arange(705.0, 0.0, -10.0)
    lines = [np.where((rows > 320)[:, None], line, np.stack([np.full(len(rows), padding), rows], -1))
             for line in _lines(rows)]  # fmt: skip
    assert size_remark([FrameLines("0.png", [LaneLine(line) for line in lines])], (720, 1280)) == ""


def _moved(entries, right, down):
    shift = np.array([right, down])
    return [
        entry._replace(lines=[line._replace(points=line.points + shift) for line in entry.lines])
        for entry in entries
    ]


def numbered(*numbers):
    lines = [line._replace(boundary=n) for n, line in zip(numbers, _entries()[0].lines, strict=True)]
    return FrameLines("0.png", lines)


def test_a_boundary_number_that_no_frame_has_is_noticed():
    skipping = [numbered(1, 2, 4, 5)] * 10
    assert left_out_remark([*skipping, FrameLines("1.png", [])]) == (
        "lanes: no frame has boundary 3, so that 2 and 4 are taken to have 2 lanes between them; if it is "
        "one, number its boundaries one after the other"
    )
    unnumbered = [numbered(None, None, None, None)] * 10
    for frames in ([], unnumbered, [*skipping, numbered(1, 2, 3, 4)]):
        assert left_out_remark(frames) == ""


def test_a_boundary_may_be_hidden_in_a_few_images():
    assert left_out_remark([numbered(1, 2, 4, 5)] * 9 + [FrameLines("1.png", [])] * 9) == ""


def test_boundary_numbers_that_fall_from_left_to_right_are_refused():
    check_boundary_order([numbered(1, 2, 3, 4), numbered(0, 1, 2, 3), numbered(None, None, None, None)])
    check_boundary_order([numbered(1, 2, 3, 4), numbered(4, 3, 2, 1)])  # one frame's mistake
    check_boundary_order([])
    with pytest.raises(ValueError, match=r"got falling ones in 3 of 3 pairs of neighbours; number them"):
        check_boundary_order([numbered(4, 3, 2, 1), FrameLines("1.png", [])])


def test_lines_meet_at_the_horizon():
    assert meeting_point(_entries()) == pytest.approx((640.0, HORIZON), abs=1e-6)
    assert meeting_point([*_entries(), FrameLines("1.png", [])])[1] == pytest.approx(HORIZON, abs=1e-6)
    parallel = [LaneLine(np.array([[x, 500.0], [x, 600.0]])) for x in (100.0, 700.0)]
    found = meeting_point([FrameLines("0.png", parallel), FrameLines("1.png", parallel[:1])])
    assert all(map(math.isnan, found))


def test_rows_counted_from_below_are_noticed():
    (frame,) = _entries()
    flipped = [line._replace(points=line.points * [1, -1] + [0, 719]) for line in frame.lines]
    assert f"they meet at row {719 - HORIZON:.0f}, below all of their points; are rows" in size_remark(
        [frame._replace(lines=flipped)], (720, 1280)
    )


@pytest.mark.parametrize("top", [110, 180, 240, 280])
def test_lanes_of_images_whose_top_was_cut_off_are_noticed(top):
    remark = size_remark(_moved(_entries(), 0, -top), (720, 1280))
    assert f"they meet at row {HORIZON - top:.0f}; of images whose top was cut off?" in remark
    assert f"such as 1280x{720 - 20 - top}+0+{top + 20}" in remark  # the lowest row of the lanes is 700
    assert size_remark(_moved(_entries(), 0, -top), (720 - top, 1280)) == ""  # so were the images


@pytest.mark.parametrize("size", [None, (320, 800)])
def test_lanes_of_a_stated_part_are_moved_to_their_place(size):
    crop = (240, 100, 480, 1180)  # top, left, height, width
    drawn = _moved(_entries(), -100, -240)
    drawn = drawn if size is None else resized_lanes(drawn, crop[2:], size)
    (whole,) = lanes_of_whole_images(drawn, size, crop, (720, 1280))
    for line, expected in zip(whole.lines, _entries()[0].lines, strict=True):
        np.testing.assert_allclose(line.points, expected.points, atol=1e-9)
    with pytest.raises(
        ValueError, match="lanes crop: expected a part of the 1280 x 600 px, got 1180 x 480 at"
    ):
        lanes_of_whole_images(drawn, size, crop, (600, 1280))
    for other in ((-5, 0, 480, 1180), (0, -5, 480, 1180), (0, 0, 0, 1180)):
        with pytest.raises(ValueError, match="lanes crop: expected a part of the 1280 x 720 px, got 1180 x "):
            lanes_of_whole_images(drawn, size, other, (720, 1280))


def test_lanes_of_images_that_were_not_turned_are_refused():  # labelme#1873
    """A stretch to the other proportions would bring them into the images, to wrong places."""
    stated = [entry._replace(image_size=(1280, 720)) for entry in _entries()]
    words = "got 720 x 1280.*; if images are turned by their EXIF orientation, draw lanes on the turned ones"
    with pytest.raises(ValueError, match=f"lanes: expected lanes of images of 1280 x 720 px, {words}"):
        size_remark(stated, (720, 1280))
    for size in ((1280, 720), (640, 360)):
        with pytest.raises(
            ValueError, match="lanes size: expected WIDTHxHEIGHT of images like those of 1280 x"
        ):
            lanes_of_whole_images(_entries(), size, None, (720, 1280))
    lanes_of_whole_images(_entries(), (512, 512), None, (720, 1280))


@pytest.mark.parametrize("text", ["1280x480", "1280x480+0", "1280+0+240", "1280x480+0-240", "0x480+0+0", ""])
def test_crops_that_are_none_are_one_clear_line(text):
    with pytest.raises(ValueError, match=r"lanes crop: expected WIDTHxHEIGHT\+LEFT\+TOP"):
        parse_crop(text)
    assert parse_crop("1280x480+10+240") == (240, 10, 480, 1280)


@given(st.floats(0.1, 8), st.integers(2, 3000), st.integers(2, 3000))
def test_resized_lanes_come_back(scale, width, height):
    size = (max(1, round(height * scale)), max(1, round(width * scale)))
    first = [FrameLines("0", [LaneLine(_lines()[0], 2, np.ones(36))], 1.5)]
    there = resized_lanes(first, size, (height, width))
    (back,) = resized_lanes(there, (height, width), size)
    np.testing.assert_allclose(back.lines[0].points, first[0].lines[0].points, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(back.lines[0].sigma, 1.0)
    assert (back.pose_sigma_scale, back.lines[0].boundary) == (1.5, 2)
    corner = resized_lanes([FrameLines("0", [LaneLine(np.array([[-0.5, -0.5]]))])], size, (height, width))
    np.testing.assert_allclose(corner[0].lines[0].points, -0.5)  # the image's corner stays it


@pytest.mark.parametrize("text", ["1280", "1280x", "0x720", "-1x5", "1280x720x3", "1e3x5", "", "１２x５"])
def test_sizes_that_are_none_are_one_clear_line(text):
    with pytest.raises(ValueError, match="lanes size: expected WIDTHxHEIGHT"):
        parse_size(text)
    assert parse_size("1280x720") == (720, 1280)


def test_a_run_takes_lanes_of_a_stated_size_and_remarks_others(tmp_path):
    Image.fromarray(np.zeros((720, 1280, 3), np.uint8)).save(tmp_path / "0.png")
    CAMERA.to_file(tmp_path / "camera.yaml")
    rows = np.arange(170.0, 351.0, 5.0)
    x = np.full((6, len(rows)), np.nan)
    x[1:5] = [(line[:, 0] + 0.5) / 2 - 0.5 for line in _lines(2 * rows + 0.5)]
    x[(x < 0) | (x > 639)] = np.nan
    (tmp_path / "lanes.json").write_text(tusimple_line("0.png", rows, x))
    given = dict(source=str(tmp_path / "0.png"), camera=str(tmp_path / "camera.yaml"), stills=True)
    config = RunConfig(**given, out=str(tmp_path / "a"), lanes=str(tmp_path / "lanes.json"))
    assert any("of smaller images?" in problem for problem in run(config).problems)
    config = RunConfig(
        **given, out=str(tmp_path / "b"), lanes=str(tmp_path / "lanes.json"), lanes_size=(360, 640)
    )
    report = run(config)
    assert report.problems == []
    assert report.rows[0].pitch_deg == pytest.approx(math.degrees(math.atan(59.5 / 1000)), abs=0.1)
    assert report.rows[0].height_m == pytest.approx(1.5, abs=0.1)
    assert report.facts["--lanes-size"] == "640x360"


def test_huge_numbers_of_culane_are_one_clear_line(tmp_path):
    path = tmp_path / "0.lines.txt"
    path.write_text("10 1e-308 12.5 580 15 1e308 17 560\n")
    with (
        np.errstate(over="raise"),
        pytest.raises(ValueError, match=r"line 1: points: expected pixels, got 1e\+308"),
    ):
        read_culane(path)
