"""Lane labels of LLAMAS and BDD100K."""

import json

import numpy as np
import pytest

from lanebev.io.lanes import match_frames, read_lanes
from lanebev.io.lanes.bdd100k import bezier_points
from lanebev.observation.boundary_order import boundary_indices

LEFT = [[305.25, 449.5], [209.0, 500.0], [106.5, 560.0]]


def _write(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))
    return path


# LLAMAS


def _marker(x, y, to_x, to_y):
    """A dash, whose near end is its start; numbers are texts in the data set."""
    world = {"x": "0", "y": "0", "z": "9.5"}
    pixels = [{"x": str(a), "y": str(b)} for a, b in ((x, y), (to_x, to_y))]
    ends = {"pixel_start": pixels[0], "pixel_end": pixels[1], "world_start": world, "world_end": world}
    return {"lane_marker_id": "lane_marker_2", **ends}


def _llamas(**changes):
    dashes = [_marker(500, 600, 520, 560), _marker(440, 700, 480, 640)]
    lanes = [{"lane_id": "l0", "markers": dashes}, {"lane_id": "r3", "markers": []}]
    return {"image_name": "1419286747_10", "projection_matrix": [[1, 0, 0]], "lanes": lanes, **changes}


def test_llamas_dashes_are_joined_from_bottom_to_top(tmp_path):
    path = _write(tmp_path / "labels" / "train" / "images-2014" / "1419286747_10.json", _llamas())
    (frame,) = read_lanes(path)
    (line,) = frame.lines
    np.testing.assert_array_equal(line.points, [[440, 700], [480, 640], [500, 600], [520, 560]])
    assert line.boundary is None


@pytest.mark.parametrize("colour", ["gray", "color"])
def test_llamas_labels_belong_to_images_of_longer_names(tmp_path, colour):
    for folder in ("images-a", "images-b"):
        _write(tmp_path / "labels" / "train" / folder / "1419286747_10.json", _llamas())
    frames = read_lanes(tmp_path / "labels")
    image = f"color_images/train/images-b/1419286747_10_{colour}_rect.png"
    assert match_frames([image], frames) == [1]


@pytest.mark.parametrize(
    ("lane", "message"),
    [
        ({"lane_id": "l0"}, "markers: expected a list, got none"),
        ({"markers": [{"pixel_start": {"x": 1, "y": 2}}]}, "pixel_end: expected a dict, got none"),
        (
            {"markers": [{"pixel_start": {"x": "a", "y": 2}, "pixel_end": {"x": 1, "y": 2}}]},
            r"lanes\[0\].markers\[0\].pixel_start: expected finite numbers, got a, 2",
        ),
        ({"markers": [5]}, "expected a JSON object, got int"),
        ({"markers": [_marker(1, 2, 1e9, 4)]}, r"lanes\[0\]: expected pixels, got 1e\+09"),
    ],
)
def test_what_is_no_llamas_is_one_clear_line(tmp_path, lane, message):
    path = _write(tmp_path / "1.json", _llamas(lanes=[lane]))
    with pytest.raises(ValueError, match=rf"lane file .*1.json: {message}"):
        read_lanes(path)


# BDD100K


def _label(vertices=LEFT, types="LLL", kind="single white", direction="parallel"):
    attributes = {"laneDirection": direction, "laneStyle": "solid", "laneTypes": kind}
    poly2d = [{"vertices": vertices, "types": types, "closed": False}]
    return {"id": "0", "attributes": attributes, "category": kind, "poly2d": poly2d}


CAR = {"category": "car", "attributes": {"occluded": False}, "box2d": {"x1": 1, "y1": 2, "x2": 3, "y2": 4}}
FORMER = {  # of the first release, a file per image
    "category": "lane/single white",
    "attributes": {"direction": "parallel", "style": "solid"},
    "poly2d": [[*point, "L"] for point in LEFT],
}
OF_ALL_LABELS = _label() | {"category": "lane"}  # in a file of all kinds of labels


@pytest.mark.parametrize(
    "value",
    [
        [{"name": "1.jpg", "labels": [_label()]}, {"name": "2.jpg"}],  # lane_train.json
        [{"name": "1.jpg", "labels": [CAR, OF_ALL_LABELS]}, {"name": "2.jpg", "labels": None}],
        {"frames": [{"name": "1.jpg", "labels": [OF_ALL_LABELS]}, {"name": "2.jpg", "labels": []}]},
        {"name": "1", "frames": [{"timestamp": 10000, "objects": [CAR, FORMER]}]},
        {"frames": [{"timestamp": 10000, "objects": [FORMER]}]},  # named as the file is
        {"name": "1.jpg", "labels": [OF_ALL_LABELS]},
    ],
)
def test_bdd100k_of_every_release(tmp_path, value):
    frames = read_lanes(_write(tmp_path / "1.json", value))
    assert [frame.name.removesuffix(".jpg") for frame in frames] == ["1", "2"][: len(frames)]
    (line,) = frames[0].lines
    np.testing.assert_array_equal(line.points, LEFT)
    assert not any(frame.lines for frame in frames[1:])
    assert match_frames(["bdd/1.jpg"], frames) == [0]


@pytest.mark.parametrize("types", ["LCCC", "LCCL", "CCCL"])  # the data set has all of them
def test_bdd100ks_curves(tmp_path, types):
    vertices = [[800.0, 340.0], [700.0, 360.0], [500.0, 480.0], [370.0, 570.0]]
    path = _write(tmp_path / "1.json", [{"name": "1", "labels": [_label(vertices, types)]}])
    points = read_lanes(path)[0].lines[0].points
    assert points.shape == (9, 2)
    np.testing.assert_array_equal(points[[0, -1]], [vertices[0], vertices[-1]])
    np.testing.assert_allclose(points[4], np.array([1, 3, 3, 1]) @ np.array(vertices) / 8)  # half-way


def test_an_image_of_a_folder_may_have_other_labels_only(tmp_path):
    _write(tmp_path / "1.json", {"name": "1", "frames": [{"objects": [CAR, FORMER]}]})
    _write(tmp_path / "2.json", {"name": "2", "frames": [{"objects": [CAR]}]})
    assert [len(frame.lines) for frame in read_lanes(tmp_path)] == [1, 0]


def test_bdd100ks_first_image_may_have_no_labels(tmp_path):
    frames = [{"name": "1"}, {"name": "2", "labels": [_label([[1, 2], [3, 4]], "LL")]}]
    assert [len(frame.lines) for frame in read_lanes(_write(tmp_path / "1.json", frames))] == [0, 1]


def test_a_bezier_curve_with_controls_on_its_chord_is_the_chord():
    points = bezier_points(np.zeros(2), np.array([[1.0, 2.0], [2.0, 4.0], [3.0, 6.0]]))
    np.testing.assert_allclose(points, np.linspace(0, 1, 9)[1:, None] * [3.0, 6.0])


def test_bdd100ks_kerbs_and_what_crosses_the_road_are_left_out(tmp_path):
    labels = [
        _label(kind="road curb"),
        OF_ALL_LABELS | {"attributes": {"laneDirection": "parallel", "laneType": "crosswalk"}},
        _label(direction="vertical"),
        FORMER | {"attributes": {"direction": "vertical"}},
        FORMER | {"category": "lane/road curb"},
        OF_ALL_LABELS | {"score": 0.3},
        _label([[1, 2], [3, 4]], "LL"),
    ]
    (frame,) = read_lanes(_write(tmp_path / "1.json", [{"name": "1", "labels": labels}]))
    (line,) = frame.lines
    np.testing.assert_array_equal(line.points, [[1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([{"name": "1", "labels": [_label("a")]}], "vertices: expected a list, got str"),
        ([{"name": "1", "labels": [_label([[1]])]}], "vertices: expected 2 numbers, got 1"),
        ([{"name": "1", "labels": [_label([[1, None]])]}], "vertices: expected finite numbers, got 1, None"),
        ([{"name": "1", "labels": 5}], "labels: expected a list, got 5"),
        ([{"name": 1, "labels": []}], "name: expected the image's, got 1"),
        ({"frames": {}}, "frames: expected a list, got {}"),
        ([{"name": "1", "labels": [{"category": "lane"}]}], "poly2d: expected a list, got none"),
        (
            {"frames": [{"raw_file": "a.jpg", "lanes": [], "h_samples": []}]},
            "frames: expected name and labels, as BDD100K has, got 'raw_file, lanes, h_samples'; for",
        ),
    ],
)
def test_what_is_no_bdd100k_is_one_clear_line(tmp_path, value, message):
    path = _write(tmp_path / "1.json", value)
    with pytest.raises(ValueError, match=rf"lane file .*1.json(, line 1)?: {message}"):
        read_lanes(path)


def test_of_both_edges_of_a_marking_the_longer_counts_not_the_one_with_more_points():
    short = np.stack([np.linspace(400, 350, 9), np.linspace(500, 550, 9)], axis=-1)
    long = np.array([[502.0, 400.0], [202.0, 700.0]])
    right = np.array([[780.0, 400.0], [1080.0, 700.0]])
    assert boundary_indices([short, long, right]) == [None, 2, 3]
