"""Lane files: what each format says, which frame it belongs to, and the way to segments and back."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from lanebev import Camera, LaneSegments
from lanebev.io.lanes import (
    FrameLines,
    LaneLine,
    match_frames,
    read_culane,
    read_lanes,
    read_tusimple,
    tusimple_line,
)
from lanebev.observation.boundary_order import boundary_indices
from lanebev.observation.polylines import (
    BoundaryRows,
    image_rows,
    paired,
    rows_from_lines,
    rows_from_segments,
    segments_from_rows,
)

CAMERA = Camera.from_parameters(1000, 1000, 639.5, 359.5, 1280, 720)
DATA = Path(__file__).parents[2] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is not on this machine")


def _fan(offsets, vanishing=(640.0, 300.0), height=1.5, top=330.0, bottom=719.0):
    """Straight lines at these lateral offsets (m) on a flat road, (P, 2) each, cut at the image's border."""
    rows = np.arange(top, bottom + 1, 10.0)
    lines = []
    for offset in offsets:
        x = vanishing[0] + (rows - vanishing[1]) * offset / height
        lines.append(np.stack([x, rows], axis=-1)[(x >= 0) & (x <= 1279)])
    return lines


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


@pytest.mark.parametrize(("count", "first"), [(56, 160), (48, 240)])
def test_predictions_for_tusimples_benchmark_leave_the_rows_out(tmp_path, count, first):
    lines = [{"raw_file": "a", "lanes": [[5.0] * count], "run_time": 10}, {"raw_file": "b", "lanes": []}]
    frames = read_tusimple(_write(tmp_path / "pred.json", "\n".join(map(json.dumps, lines))))
    np.testing.assert_array_equal(frames[0].lines[0].points[:, 1], np.arange(first, 711, 10))
    assert frames[1].lines == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1"),
        ('{"raw_file": "a', "line 2: expected JSON, got a line that breaks off"),
        ("[1, 2]", "line 2: expected a JSON object, got list"),
        (json.dumps({"raw_file": "b", "lanes": [[1, 2]]}), "line 2: h_samples: expected a list, got none"),
        (json.dumps({**_tusimple("b"), "h_samples": 3}), "line 2: h_samples: expected a list, got int"),
        (json.dumps({"raw_file": "b", "lanes": 5}), "line 2: lanes: expected a list, got int"),
        (json.dumps({**_tusimple("b"), "raw_file": 3}), "line 2: raw_file: expected a str, got int"),
        (
            json.dumps({**_tusimple("b"), "lanes": [[1, 2]]}),
            r"line 2: lanes\[0\]: expected 3 numbers",
        ),
        (json.dumps({**_tusimple("b"), "h_samples": [1, 3, 2]}), "line 2: h_samples: expected rising rows"),
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
        ("1 590 2 600 3 570", "line 1: expected rows in one direction"),
        ("1 590 2 580 3 580 4 570", "line 1: expected rows in one direction"),
        ("1 590 2 580 1 590 3 570", "line 1: expected rows in one direction"),
        ("1 590 2 x", "line 1: points: expected finite numbers"),
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


def test_segments_use_each_vertex_once_with_long_baselines():
    vertices = np.stack([np.arange(7.0), np.arange(7.0) * 10], axis=-1)
    np.testing.assert_array_equal(paired(vertices, 30)[:, :, 0], [[0, 4], [1, 5], [2, 6]])
    many = np.stack([np.arange(100.0)] * 2, axis=-1)
    segments = paired(many, 30)
    assert segments.shape == (30, 2, 2)
    assert len(np.unique(segments[..., 0])) == 60
    assert segments[0, 0, 0] == 0
    assert segments[-1, 1, 0] == 99
    assert paired(vertices[:1], 30).shape == (0, 2, 2)


def test_segments_lie_on_the_lines_of_an_ideal_pinhole():
    distorted = Camera.from_parameters(
        1000, 1000, 639.5, 359.5, 1280, 720, distortion=[-0.25, 0.04, 1e-4, -1e-4, 0]
    )
    offsets = [-5.4, -1.8, 1.8, 5.4]
    fan = map(torch.from_numpy, _fan(offsets))
    lines = [LaneLine(distorted.distort_points(line).numpy()) for line in fan]
    segments = segments_from_rows([rows_from_lines(lines, distorted)], distorted)
    assert segments.endpoints.shape == (1, 180, 2, 2)
    seen = segments.weight[0] > 0
    for boundary, offset in zip((1, 2, 3, 4), offsets, strict=True):
        points = segments.endpoints[0][seen & (segments.boundary[0] == boundary)].reshape(-1, 2)
        assert len(points) >= 12
        expected = 640 + (points[:, 1] - 300) * offset / 1.5
        assert (points[:, 0] - expected).abs().max() < 0.05  # px: chords of the distorted line
    assert not (seen & ((segments.boundary[0] == 0) | (segments.boundary[0] == 5))).any()


def test_gaps_stay_gaps():
    rows = image_rows(720)
    x = np.where((rows > 400) & (rows < 500), np.nan, 600.0 - 0.5 * rows)
    sampled = rows_from_lines([LaneLine(np.stack([x, rows], axis=-1), 2)], CAMERA)
    np.testing.assert_array_equal(np.isfinite(sampled.x[2]), np.isfinite(x))


@pytest.mark.parametrize("seed", range(3))
def test_lanes_json_gives_the_same_segments_bit_for_bit(tmp_path, seed):
    noise = np.random.default_rng(seed)
    lines = [
        LaneLine(line + noise.normal(0, [1, 0], line.shape)) for line in _fan([-5.4, -1.8, 1.8, 5.5, 9.1])
    ]
    first = rows_from_lines(lines, CAMERA)
    path = _write(tmp_path / "lanes.json", tusimple_line("clip/1.jpg", *first) + "\n")
    again = rows_from_lines(read_lanes(path)[0].lines, CAMERA)
    np.testing.assert_array_equal(again.x, first.x)
    for a, b in zip(segments_from_rows([first], CAMERA), segments_from_rows([again], CAMERA), strict=True):
        assert torch.equal(a, b)
    assert first.x.shape == (6, 72)
    assert np.isfinite(first.x).sum() > 100


def test_a_sigma_of_one_line_leaves_the_others_their_own(tmp_path):
    first, second = _fan([-1.8, 1.8])
    lines = [LaneLine(first, 2, np.full(len(first), 1e-5)), LaneLine(second, 3)]
    rows = rows_from_lines(lines, CAMERA)
    assert np.nanmax(rows.sigma[2]) == 0.001  # lowest that the file tells
    assert set(rows.sigma[3][np.isfinite(rows.x[3])]) == {1.5}
    path = _write(tmp_path / "lanes.json", tusimple_line("1.jpg", *rows))
    np.testing.assert_array_equal(rows_from_lines(read_lanes(path)[0].lines, CAMERA).sigma, rows.sigma)


@pytest.mark.parametrize("seed", range(2))
def test_a_networks_segments_go_through_the_file_bit_for_bit(tmp_path, seed):
    draw = torch.Generator().manual_seed(seed)
    ends, boundary = [], []
    for index, line in enumerate(_fan([-9.0, -5.4, -1.8, 1.8, 5.5, 9.1])):
        vertices = torch.from_numpy(line[np.linspace(0, len(line) - 1, 32).round().astype(int)])
        vertices = vertices + 0.3 * torch.randn(32, 2, generator=draw).double()
        ends.append(torch.stack([vertices[:16], vertices[16:]], dim=1))
        boundary += [index] * 16
    weight = torch.rand(1, 96, generator=draw).double()
    sigma = 0.3 + torch.rand(1, 96, generator=draw).double()
    segments = LaneSegments(torch.cat(ends)[None], torch.tensor(boundary)[None], weight, sigma)
    first = rows_from_segments(segments, CAMERA)
    first = first._replace(fitted=first.x[:5] + 3.0, pose_sigma_scale=1.7)  # what others read, and do not
    path = _write(tmp_path / "lanes.json", tusimple_line("1.jpg", *first) + "\n")
    assert json.loads(path.read_text())["boundary"] == [0, 1, 2, 3, 4]
    assert read_lanes(path)[0].pose_sigma_scale == 1.7
    again = rows_from_lines(read_lanes(path)[0].lines, CAMERA)
    np.testing.assert_array_equal(again.x, first.x)
    np.testing.assert_array_equal(again.sigma, first.sigma)
    for a, b in zip(segments_from_rows([first], CAMERA), segments_from_rows([again], CAMERA), strict=True):
        assert torch.equal(a, b)
    told = segments_from_rows([again], CAMERA)
    for index in range(6):
        said, mine = first.sigma[index], told.sigma[(told.boundary == index) & (told.weight > 0)].numpy()
        assert np.nanmin(said) <= mine.min() < mine.max() <= np.nanmax(said)
    information = (2 * weight / sigma.square()).reshape(6, 16)[2:4].sum(-1)
    kept = np.nansum(1 / first.sigma[2:4] ** 2, axis=-1)
    assert (kept < 1.1 * information.numpy()).all()
    assert (kept > 0.5 * information.numpy()).all()


def test_a_hidden_stretch_stays_hidden():
    vertices = torch.from_numpy(_fan([-1.8])[0])
    vertices = vertices[(vertices[:, 1] < 420) | (vertices[:, 1] > 560)]
    half = len(vertices) // 2
    ends = torch.stack([vertices[:half], vertices[-half:]], dim=1)[None]
    ones = torch.ones(1, half).double()
    rows = rows_from_segments(LaneSegments(ends, torch.full((1, half), 2), ones, ones), CAMERA)
    seen = rows.rows[np.isfinite(rows.x[2])]
    assert not ((seen > 430) & (seen < 550)).any()
    assert len(seen) > 15


@pytest.mark.parametrize(("weight", "there"), [(0.17, True), (0.14, False)])
def test_a_faint_line_counts_less_and_a_trace_of_one_not_at_all(weight, there):
    vertices = torch.from_numpy(_fan([-1.8])[0])
    half = len(vertices) // 2
    ends = torch.stack([vertices[:half], vertices[half : 2 * half]], dim=1)[None]
    ones = torch.ones(1, half).double()
    segments = LaneSegments(ends, torch.full((1, half), 2), weight * ones, ones)
    rows = rows_from_segments(segments, CAMERA)
    assert np.isfinite(rows.x[2]).any() == there
    if there:
        assert np.nanmedian(rows.sigma[2]) == pytest.approx(weight**-0.5, rel=0.2)


def test_empty_frame_writes_a_line_and_reads_back(tmp_path):
    empty = rows_from_lines([], CAMERA)
    path = _write(tmp_path / "lanes.json", tusimple_line("1.jpg", *empty))
    assert read_lanes(path)[0].lines == []
    assert segments_from_rows([empty], CAMERA).weight.sum() == 0


def test_rows_of_a_batch_are_those_alone():
    frames = [rows_from_lines([LaneLine(line) for line in _fan(o)], CAMERA) for o in ([-1.8, 1.8], [-2.0])]
    frames.append(BoundaryRows(image_rows(720), np.full((6, 72), np.nan)))
    together = segments_from_rows(frames, CAMERA)
    for row, frame in enumerate(frames):
        alone = segments_from_rows([frame], CAMERA)
        for a, b in zip(alone, together, strict=True):
            assert torch.equal(a[0], b[row])


@needs_data
def test_real_tusimple_labels_match_their_images():
    frames = read_lanes(DATA / "tusimple" / "label_data.json")
    images = sorted(str(path) for path in (DATA / "tusimple").rglob("*.jpg"))
    matched = match_frames(images, frames)
    assert sorted(matched) == list(range(88))
    for frame in frames:
        x = rows_from_lines(frame.lines, CAMERA).x
        assert np.isfinite(x[2]).any()
        assert np.isfinite(x[3]).any()


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
