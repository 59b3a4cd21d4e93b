"""Lane files: what each format says, which frame it belongs to, and the way to segments and back."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from lanebev import Camera
from lanebev.io.lanes import match_frames, read_lanes
from lanebev.io.lanes.culane import read_culane
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.lanes.tusimple import read_tusimple
from lanebev.observation.polylines import vertices_from_lines

CAMERA = Camera.from_parameters(1000, 1000, 639.5, 359.5, 1280, 720)
DATA = Path(__file__).parents[4] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is not on this machine")


def _tusimple(name="a/20.jpg", **extra):
    return {"raw_file": name, "h_samples": [100, 110, 120], "lanes": [[-2, 5, 6], [7, -2, 9]], **extra}


def _write(path, text):
    path.write_text(text)
    return path


def test_tusimple_lines(tmp_path):
    path = _write(tmp_path / "l.json", json.dumps(_tusimple(boundary=[2, 3])) + "\n\n")
    (frame,) = read_lanes(path)
    assert frame.name == "a/20.jpg"
    assert [line.boundary for line in frame.lines] == [2, 3]
    np.testing.assert_array_equal(frame.lines[1].points, [[7, 100], [np.nan, 110], [9, 120]])


@pytest.mark.parametrize("key", ["objects", "items", "annotations", "calibration", "labels", "laneLines"])
def test_tusimple_lines_may_have_keys_of_other_formats(tmp_path, key):
    path = _write(tmp_path / "l.json", json.dumps(_tusimple(**{key: []})))
    assert [len(frame.lines) for frame in read_lanes(path)] == [2]


def test_lanes_may_be_lists_of_points(tmp_path):
    lanes = [[[5, 110], [6.5, 120], [-2, 130]], [{"x": "7", "y": 100}, {"x": 9, "y": 120}], []]
    entry = {"raw_file": "a.jpg", "lanes": lanes, "boundary": [2, 3, 4], "sigma": [[1, 2, 1], [1, 1], []]}
    for more in ({}, {"h_samples": [100, 110]}):
        (frame,) = read_lanes(_write(tmp_path / "l.json", json.dumps({**entry, **more})))
        np.testing.assert_array_equal(frame.lines[0].points, [[5, 110], [6.5, 120], [np.nan, 130]])
        np.testing.assert_array_equal(frame.lines[1].points, [[7, 100], [9, 120]])
        assert [line.boundary for line in frame.lines] == [2, 3]
        np.testing.assert_array_equal(frame.lines[0].sigma, [1, 2, np.nan])
    for lane, message in (
        ([[5, 110, 1]], r"lanes\[0\]: expected 2 numbers, got 3"),
        ([[5, 110], 6], r"lanes\[0\]: expected a list, got 6"),
        ([{"u": 5, "v": 110}], r"lanes\[0\]: expected finite numbers, got None, None"),
    ):
        with pytest.raises(ValueError, match=f"line 1: {message}"):
            read_lanes(_write(tmp_path / "l.json", json.dumps({"raw_file": "a.jpg", "lanes": [lane]})))


def test_a_point_that_is_not_there_has_no_standard_deviation(tmp_path):
    text = json.dumps(_tusimple(sigma=[[-2, 1, 2], [3, 0, 4]]))
    (frame,) = read_lanes(_write(tmp_path / "l.json", text))
    np.testing.assert_array_equal(frame.lines[0].sigma, [np.nan, 1, 2])
    np.testing.assert_array_equal(frame.lines[1].sigma, [3, np.nan, 4])


def test_points_and_numbers_at_rows_together(tmp_path):
    entry = {"raw_file": "a.jpg", "lanes": [[608, 560], [[608, 300], [560, 330]]]}
    (frame,) = read_lanes(_write(tmp_path / "l.json", json.dumps({**entry, "h_samples": [300, 330]})))
    for line in frame.lines:
        np.testing.assert_array_equal(line.points, [[608, 300], [560, 330]])
    with pytest.raises(ValueError, match="give all lanes as points, or all with h_samples"):
        read_lanes(_write(tmp_path / "l.json", json.dumps(entry)))


def test_lanes_that_are_all_empty_need_no_rows(tmp_path):
    for lanes in ([[], []], []):
        text = json.dumps({"raw_file": "a.jpg", "lanes": lanes})
        assert read_lanes(_write(tmp_path / "l.json", text))[0].lines == []


@pytest.mark.parametrize(("count", "first"), [(56, 160), (48, 240)])
def test_predictions_for_tusimples_benchmark_leave_the_rows_out(tmp_path, count, first):
    lines = [{"raw_file": "a", "lanes": [[], [5.0] * count], "run_time": 10}, {"raw_file": "b", "lanes": []}]
    frames = read_tusimple(_write(tmp_path / "pred.json", "\n".join(map(json.dumps, lines))))
    np.testing.assert_array_equal(frames[0].lines[0].points[:, 1], np.arange(first, 711, 10))
    assert frames[1].lines == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1"),
        ('{"raw_file": "a', "line 2: expected JSON, got a line that breaks off"),
        ("[1, 2]", "line 2: expected a JSON object, got list"),
        (
            "image,lane,x,y\n1.jpg,0,5,3",
            "line 2: expected JSON, got 'image,lane,x,y'; formats: Tu",
        ),
        (json.dumps({"raw_file": "b", "lanes": [[1, 2]]}), "line 2: h_samples: expected a list, got none"),
        (  # TuSimple's 56 rows were taken (resa#23)
            json.dumps({"raw_file": "b", "lanes": [[9] * 56], "y_samples": [*range(200, 480, 5)]}),
            "line 2: h_samples: expected this key, got 'y_samples' with as many numbers; rename it",
        ),
        (json.dumps({**_tusimple("b"), "h_samples": 3}), "line 2: h_samples: expected a list, got int"),
        (json.dumps({"raw_file": "b", "lanes": 5}), "line 2: lanes: expected a list, got int"),
        (
            json.dumps({**_tusimple("b"), "raw_file": 3}),
            "line 2: raw_file: expected the image's path .*, got 3",
        ),
        (
            json.dumps({**_tusimple("b"), "lanes": [[1, 2]]}),
            r"line 2: lanes\[0\]: expected 3 numbers",
        ),
        (
            json.dumps({**_tusimple("b"), "h_samples": [1, 3, 2]}),
            "line 2: h_samples: expected rows that only rise",
        ),
        (
            json.dumps({**_tusimple("b"), "lanes": [[1, "x", 3]]}),
            r"line 2: lanes\[0\]: expected finite",
        ),
        (json.dumps({**_tusimple("b"), "boundary": [2, 6]}), r"line 2: boundary: .* 0\.\.5"),
        (json.dumps({**_tusimple("b"), "boundary": [2, 2]}), "line 2: boundary"),
        (json.dumps({**_tusimple("b"), "boundary": [2]}), "line 2: boundary"),
        (json.dumps({**_tusimple("b"), "sigma": [[1, 1, 1]]}), "line 2: sigma: expected a list per lane"),
        (json.dumps({**_tusimple("b"), "boundary": [[2], [3]]}), "line 2: boundary"),
        (
            json.dumps({**_tusimple("b"), "sigma": [[-2, 1, 1], [1, -2, 0]]}),
            r"line 2: sigma\[1\]: expected px above 0 where the lane is, got \[1, -2, 0\]",
        ),
        (
            json.dumps({**_tusimple("b"), "sigma": [[1, -2, 1], [1, 1, 1]]}),
            r"line 2: sigma\[0\]: expected px",
        ),
        (
            json.dumps({**_tusimple("b"), "lanes": [[1, 10**400, 3]]}),
            r"line 2: lanes\[0\]: expected finite",
        ),
        (
            json.dumps({**_tusimple("b"), "pose_sigma_scale": 10**400}),
            "line 2: pose_sigma_scale: expected a finite",
        ),
        ("[" * 100_000, "line 2: expected JSON"),
        (json.dumps({**_tusimple("b"), "sigma": [[1], [1]]}), r"line 2: sigma\[0\]: expected 3 numbers"),
        (
            json.dumps({**_tusimple("b"), "pose_sigma_scale": 0}),
            "line 2: pose_sigma_scale: expected a finite number above 0",
        ),
        (json.dumps({**_tusimple("b"), "pose_sigma_scale": "2"}), "line 2: pose_sigma_scale: .* got '2'"),
        (json.dumps(_tusimple()), "each raw_file once, got 'a/20.jpg' again"),
    ],
)
def test_bad_tusimple_lines_name_file_and_line(tmp_path, text, message):
    first = json.dumps(_tusimple()) + "\n" if text else "{"
    path = _write(tmp_path / "l.json", first + text)
    with pytest.raises(ValueError, match=message) as error:
        read_lanes(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


def test_culane_lines(tmp_path):
    path = _write(tmp_path / "7.lines.txt", "-12 590 10 580 30 570\n\n500 590 510 580\n")
    frame = read_lanes(path)[0]
    assert frame.name == str(tmp_path / "7")
    assert len(frame.lines) == 2
    np.testing.assert_array_equal(frame.lines[1].points, [[500, 590], [510, 580]])
    assert read_culane(_write(tmp_path / "8.lines.txt", "")).lines == []


def test_a_culane_point_given_twice_counts_once(tmp_path):
    path = _write(tmp_path / "7.lines.txt", "10 590 12 580 12 580 12 580 14 570\n500 590 500 590\n")
    first, second = read_culane(path).lines
    np.testing.assert_array_equal(first.points, [[10, 590], [12, 580], [14, 570]])
    np.testing.assert_array_equal(second.points, [[500, 590]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 590 2 580\n3 590 4", "line 2: expected x y pairs, got 3"),
        ("1 590 2 580 3 570 4 56", "line 1: expected evenly spaced rows, got 570 then 56; is the file cut"),
        ("1 590 2 600 3 570", "line 1: expected rows that only rise or only"),
        ("1 590 2 580 3 580 4 570", "line 1: expected rows that only rise or only"),
        ("1 590 2 580 1 590 3 570", "line 1: expected rows that only rise or only"),
        ("1 590 2 x", "line 1: points: expected finite numbers"),
        (
            "/a/b.MP4/00000.jpg 1 1 1 1",
            "line 1: expected x y pairs, got a path; give the folder of the .lines",
        ),
        (
            "1,590 2,580",
            "line 1: expected spaces between numbers, got commas or semicolons; replace them",
        ),
    ],
)
def test_bad_culane_lines_name_file_and_line(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        read_lanes(_write(tmp_path / "7.lines.txt", text))


def test_openlane_leaves_kerbs_out(tmp_path):
    lanes = [{"uv": [[1, 2], [30, 40]], "category": 1}, {"uv": [[5, 6], [30, 40]], "category": 21}]
    path = _write(tmp_path / "1.json", json.dumps({"file_path": "seg/1.jpg", "lane_lines": lanes}, indent=1))
    (frame,) = read_lanes(path)
    assert frame.name == "seg/1.jpg"
    (line,) = frame.lines
    np.testing.assert_array_equal(line.points, [[1, 30], [2, 40]])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"file_path": "1.jpg", "lane_lines": [{"uv": [[1], [2, 3]]}]},
            r"lane_lines\[0\].uv: expected two",
        ),
        ({"file_path": "1.jpg", "lane_lines": [{}]}, "uv: expected a list, got none"),
        *[
            ({"file_path": "1.jpg", "lane_lines": [{"uv": uv}]}, r"lane_lines\[0\].uv: expected two lists")
            for uv in ([[1, 2], None], [5, [1]], [], [[1]])
        ],
        ({"file_path": "1.jpg", "lane_lines": [{"uv": [[1], [10**400]]}]}, "uv: expected finite numbers"),
        (5, "expected a JSON object, got int"),
        ({"lane_lines": []}, "file_path: expected a str, got none"),
    ],
)
def test_bad_openlane_file(tmp_path, fields, message):
    with pytest.raises(ValueError, match=message):
        read_lanes(_write(tmp_path / "1.json", json.dumps(fields)))


def test_cut_openlane_file(tmp_path):
    text = json.dumps({"file_path": "seg/1.jpg", "lane_lines": [{"uv": [[1, 2], [3, 4]]}]})
    with pytest.raises(ValueError, match="is the file cut"):
        read_lanes(_write(tmp_path / "1.json", text[:60]))


def test_missing_and_empty(tmp_path):
    with pytest.raises(ValueError, match="No such file"):
        read_lanes(tmp_path / "none.json")
    with pytest.raises(ValueError, match="got an empty file"):
        read_tusimple(_write(tmp_path / "e.json", "\n"))
    (tmp_path / "d").mkdir()
    with pytest.raises(ValueError, match=r"expected \.lines\.txt or \.json files"):
        read_lanes(tmp_path / "d")


def _frames(*names):
    return [FrameLines(name, []) for name in names]


def test_match_by_longest_common_tail():
    frames = _frames("clips/1/20.jpg", "clips/2/20.jpg", "other/1/20.jpg")
    images = ["/d/clips/2/20.png", "/d/clips/1/20.jpg", "/d/clips/3/21.jpg"]
    assert match_frames(images, frames) == [1, 0, None]


def test_match_gives_an_entry_to_the_image_that_shares_most():
    assert match_frames(["/d/3/20.jpg", "/d/1/20.jpg"], _frames("clips/1/20.jpg")) == [None, 0]


def test_a_folder_is_read_as_its_images_are(tmp_path):
    for name in ("10", "9", "2"):
        (tmp_path / f"{name}.lines.txt").write_text(f"{name} 590 11 580\n")
    assert [frame.lines[0].points[0, 0] for frame in read_lanes(tmp_path)] == [2, 9, 10]


def test_match_of_names_that_differ_in_their_suffix_alone():
    """A run's own lanes.json names its images as they are."""
    names = ["a/0000.jpg", "a/0000.png"]
    assert match_frames(names, [FrameLines(name, []) for name in reversed(names)]) == [1, 0]


def test_match_of_names_with_dots(tmp_path):
    for name in ("1494452385.593783", "1494452385.627116"):
        _write(tmp_path / f"{name}.lines.txt", "10 590 12 580\n")
    images = ["/d/1494452385.627116.JPG", "/d/1494452385.593783.jpg", "/d/1494452385.jpg"]
    assert match_frames(images, read_lanes(tmp_path)) == [1, 0, None]
    assert match_frames(["/d/1.25.png"], _frames("d/1.5.jpg", "d/1.25.jpeg")) == [1]


def test_match_refuses_a_tie_and_strangers():
    with pytest.raises(ValueError, match="fit equally well"):
        match_frames(["20.jpg"], _frames("1/20.jpg", "2/20.jpg"))
    with pytest.raises(ValueError, match="fit equally well"):
        match_frames(["1/20.jpg", "2/20.jpg"], _frames("20.jpg"))
    with pytest.raises(ValueError, match=r"at least one image, got none that ends like 3\.jpg"):
        match_frames(["3.jpg"], _frames("20.jpg"))
    with pytest.raises(ValueError, match=r"at least one image, .* 3\.jpg; the file has none"):
        match_frames(["3.jpg"], [])


@needs_data
def test_real_tusimple_labels_match_their_images():
    frames = read_lanes(DATA / "tusimple" / "label_data.json")
    images = sorted(str(path) for path in (DATA / "tusimple").rglob("*.jpg"))
    matched = match_frames(images, frames)
    assert sorted(matched) == list(range(88))
    for frame in frames:
        seen = vertices_from_lines(frame.lines, CAMERA).weight[0].any(-1)
        assert seen[2]
        assert seen[3]


@needs_data
def test_real_culane_and_openlane_folders(tmp_path):
    assert len(read_lanes(DATA / "culane")) == 10
    assert [len(frame.lines) for frame in read_lanes(DATA / "openlane" / "lane2d")] == [3, 3]
    assert [len(frame.lines) for frame in read_lanes(DATA / "openlane" / "lane3d")] == [3, 3]
    source = next((DATA / "culane").rglob("*.lines.txt"))
    shutil.copy(source, tmp_path)
    cut = tmp_path / source.name
    cut.write_text(cut.read_text()[:-7])
    with pytest.raises(ValueError, match="is the file cut"):
        read_lanes(cut)


def test_a_file_that_the_system_does_not_open_is_named(tmp_path):
    path = tmp_path / ("l" * 300)  # as a folder without permission, but for the superuser too
    with pytest.raises(ValueError, match=r"lane file .*: expected a readable .*: File name too long$"):
        read_tusimple(path)
