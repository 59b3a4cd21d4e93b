"""Lines drawn in Supervisely, V7, Labelbox and VIA, and exports of Datumaro."""

import json

import numpy as np
import pytest

from lanebev.io.lanes import match_frames, read_lanes

POINTS = [[[500.5, 700.0], [560.0, 500.0], [600.0, 420.0]], [[800.0, 700.0], [740.0, 500.0]]]
AS_DICTS = [[{"x": x, "y": y} for x, y in line] for line in POINTS]
SIZE = {"height": 720, "width": 1280}
BOX = [[5, 5], [9, 9]]


def _supervisely(lines=POINTS):
    drawn = [
        {"geometryType": "line", "classTitle": "lane", "points": {"exterior": line, "interior": []}}
        for line in lines
    ]
    box = {"geometryType": "rectangle", "points": {"exterior": BOX, "interior": []}}
    return {"description": "", "tags": [], "size": SIZE, "objects": [*drawn, box]}


def _darwin(lines=AS_DICTS):
    drawn = [{"name": "lane", "line": {"path": line}} for line in lines]
    item = {"name": "1.jpg", "path": "/", "slots": [{"slot_name": "0", **SIZE}]}
    return {
        "version": "2.0",
        "item": item,
        "annotations": [*drawn, {"name": "car", "bounding_box": {"x": 1}}],
    }


def _labelbox(lines=AS_DICTS):
    drawn = [{"name": "lane", "annotation_kind": "ImagePolyline", "line": line} for line in lines]
    labels = [{"annotations": {"objects": [*drawn, {"bounding_box": {"top": 1}}], "classifications": []}}]
    row = {"id": "a", "external_id": "1.jpg", "row_data": "a://b/1.jpg"}
    return {"data_row": row, "media_attributes": SIZE, "projects": {"p": {"name": "q", "labels": labels}}}


def _datumaro(lines=POINTS):
    drawn = [
        {"id": 0, "type": "polyline", "points": [value for point in line for value in point]}
        for line in lines
    ]
    item = {
        "id": "1",
        "annotations": [*drawn, {"type": "bbox"}],
        "image": {"path": "1.jpg", "size": [720, 1280]},
    }
    return {"info": {}, "categories": {}, "items": [item]}


def _via(lines=POINTS):
    shapes = [
        {"name": "polyline", "all_points_x": [x for x, _ in line], "all_points_y": [y for _, y in line]}
        for line in lines
    ]
    regions = [
        {"shape_attributes": each, "region_attributes": {}} for each in (*shapes, {"name": "rect", "x": 1})
    ]
    return {"1.jpg123": {"filename": "1.jpg", "size": 123, "regions": regions, "file_attributes": {}}}


def _via_project(lines=POINTS):
    return {"_via_settings": {}, "_via_img_metadata": _via(lines), "_via_attributes": {}}


def _via_1(lines=POINTS):
    (image,) = _via(lines).values()
    return {"1.jpg123": {**image, "regions": {str(i): each for i, each in enumerate(image["regions"])}}}


TOOLS = (_supervisely, _darwin, _labelbox, _datumaro, _via, _via_project, _via_1)


@pytest.mark.parametrize("write", TOOLS)
def test_lines_that_a_tool_exports_are_read(tmp_path, write):
    path = tmp_path / "1.jpg.json"
    path.write_text(json.dumps(write()))
    (frame,) = read_lanes(path)
    assert match_frames(["/data/images/1.jpg", "/data/images/2.jpg"], [frame]) == [0, None]
    assert [line.points.tolist() for line in frame.lines] == POINTS
    assert frame.image_size == (None if "via" in write.__name__ else (720, 1280))


@pytest.mark.parametrize("label", ["Curb", "stop line", "zebra_crossing"])
@pytest.mark.parametrize("write", TOOLS[:3])
def test_lines_whose_labels_say_that_they_bound_no_lane_are_left_out(tmp_path, write, label):
    path = tmp_path / "1.jpg.json"
    path.write_text(json.dumps(write()).replace('"lane"', f'"{label}"', 1))
    (frame,) = read_lanes(path)
    assert [line.points.tolist() for line in frame.lines] == POINTS[1:]


@pytest.mark.parametrize("write", TOOLS[:3])
def test_a_picture_with_a_kerb_alone_has_no_lane(tmp_path, write):
    path = tmp_path / "1.jpg.json"
    path.write_text(json.dumps(write()).replace('"lane"', '"curb"'))
    assert read_lanes(path)[0].lines == []


def test_a_label_with_the_word_horizontal_is_no_horizon(tmp_path):
    path = tmp_path / "1.jpg.json"
    path.write_text(json.dumps(TOOLS[0]()).replace('"lane"', '"horizontal lane"', 1))
    assert len(read_lanes(path)[0].lines) == len(POINTS)


@pytest.mark.parametrize("write", TOOLS)
def test_pictures_without_a_line_are_an_error_if_other_shapes_are_drawn(tmp_path, write):
    path = tmp_path / "1.jpg.json"
    path.write_text(json.dumps(write([])))
    with pytest.raises(
        ValueError, match=r"1\.jpg\.json: expected lanes drawn as lines, got other shapes only"
    ):
        read_lanes(path)


def test_rows_of_labelbox_are_an_image_each(tmp_path):
    rows = [_labelbox(), _labelbox([])]
    rows[1]["data_row"]["external_id"] = "2.jpg"
    (tmp_path / "l.ndjson").write_text("\n".join(map(json.dumps, rows)))
    first, second = read_lanes(tmp_path / "l.ndjson")
    assert (first.name, len(first.lines), second.name, second.lines) == ("1.jpg", 2, "2.jpg", [])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (_supervisely([[[5, "x"]]]), "json: '1.jpg', line 0: expected finite numbers, got 5, x"),
        (_supervisely([[[5]]]), "line 0: expected 2 numbers, got 1"),
        (_darwin([[{"x": 5}]]), "'1.jpg', line 0: expected finite numbers, got 5, None"),
        (_darwin([[[np.inf, 2]]]), "expected finite numbers, got inf, 2"),
        ({**_darwin(), "item": {"slots": []}}, "name: expected the image's, got None"),
        ({**_labelbox(), "projects": None}, "projects: expected a dict, got NoneType"),
        (_datumaro([[[5, 6], [7]]]), "line 0: expected 2 numbers, got 1"),
    ],
)
def test_what_cannot_be_read_is_one_clear_line(tmp_path, content, message):
    path = tmp_path / "1.jpg.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message) as error:
        read_lanes(path)
    assert "\n" not in str(error.value)
