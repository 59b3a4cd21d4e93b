"""Lanes drawn in LabelMe and CVAT, and the labels of VIL-100."""

import json

import numpy as np
import pytest

from lanebev.io.lanes import match_frames, read_lanes
from lanebev.io.lanes.size import lanes_of_whole_images, size_remark

LEFT = [[600.5, 300.0], [400.0, 500.0], [250.25, 700.0]]
RIGHT = [[680.0, 300.0], [900.0, 700.0]]


def _shape(points, kind="linestrip"):
    return {"label": "lane", "points": points, "shape_type": kind, "group_id": None, "flags": {}}


def _labelme(*shapes, image="..\\images\\7.png"):
    size = {"imageHeight": 720, "imageWidth": 1280, "imageData": None}
    return {"version": "5.0.1", "flags": {}, "shapes": list(shapes), "imagePath": image, **size}


def _vil(**changes):
    lanes = [{"id": i, "lane_id": i + 1, "points": points} for i, points in enumerate((LEFT, RIGHT))]
    info = {"height": 720, "width": 1280, "image_path": "0_Road001_Trim003_frames/7.jpg"}
    return {"camera_id": 8272, "info": info, "annotations": {"lane": lanes}, **changes}


def _read(path, value):
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(value))
    return read_lanes(path)


def test_lines_of_labelme_and_of_vil_100(tmp_path):
    car = _shape([[0, 0], [9, 9]], "rectangle")
    files = {
        "7.json": _labelme(
            _shape(LEFT), car, _shape(RIGHT, "line"), _shape([]), {**_shape(LEFT), "label": "kerb"}
        ),
        "7.jpg.json": _vil(),
    }
    for name, content in files.items():
        (frame,) = _read(tmp_path / "labels" / name, content)
        assert len(frame.lines) == 2
        for line, expected in zip(frame.lines, (LEFT, RIGHT), strict=True):
            np.testing.assert_array_equal(line.points, expected)
            assert line.boundary is None
        other = f"{tmp_path}/other/7.png"
        images = [other, f"{tmp_path}/images/7.png", f"{tmp_path}/0_Road001_Trim003_frames/7.jpg"]
        assert match_frames(images, [frame]) == ([None, 0, None] if "jpg" not in name else [None, None, 0])


@pytest.mark.parametrize("content", [_labelme(_shape(LEFT), _shape(RIGHT)), _vil()])
def test_the_size_that_a_file_states_is_compared_with_that_of_the_images(tmp_path, content):
    frames = _read(tmp_path / "7.json", content)
    assert size_remark(frames, (720, 1280)) == ""
    with pytest.raises(ValueError, match=r"got 1280 x 720 in the file; state .* --lanes-size 1280x720"):
        size_remark(frames, (710, 1280))
    with pytest.raises(
        ValueError, match="images of 640 x 360 px, got 1280 x 720 in the file; leave out what"
    ):
        lanes_of_whole_images(frames, (360, 640), None, (710, 1280))
    (frame,) = lanes_of_whole_images(frames, (720, 1280), None, (710, 1280))
    np.testing.assert_allclose(frame.lines[0].points[1], [400.0, 500.5 * 71 / 72 - 0.5])
    assert size_remark([frame], (710, 1280)) == ""


def test_an_image_without_lanes_has_an_entry(tmp_path):
    assert _read(tmp_path / "7.json", _labelme())[0].lines == []
    assert _read(tmp_path / "8.json", _vil(annotations={"lane": []}))[0].lines == []


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            _labelme(_shape(LEFT, "polygon")),
            "expected lanes drawn as lines, got other shapes only; draw polylines",
        ),
        (_labelme(_shape([[1, 2, 3]])), "'7.png', line 0: expected 2 numbers, got 3"),
        (_labelme(_shape([[1, "a"]])), "'7.png', line 0: expected finite numbers, got 1, a"),
        (_labelme(_shape(None)), "points: expected a list, got NoneType"),
        (_labelme(image=None), "imagePath: expected a str, got NoneType"),
        (_labelme(3), "expected a JSON object, got int"),
        (_vil(annotations=[]), "expected keys of a known format, got 'annotations, "),  # COCO's
        (_vil(info={}), "image_path: expected a str, got none"),
    ],
)
def test_bad_files_are_one_clear_line(tmp_path, content, message):
    with pytest.raises(ValueError, match=rf"lane file .*7.json(, line 1)?: {message}") as error:
        _read(tmp_path / "7.json", content)
    assert "\n" not in str(error.value)


def _cvat(shapes):
    image = '<image id="0" name="a/7.jpg" width="1280" height="720">{}</image>'
    empty = '<image id="1" name="a/8.jpg" width="1280" height="720">\n  </image>'
    head = (
        '<?xml version="1.0" encoding="utf-8"?>\n<annotations>\n  <version>1.1</version>\n  <meta></meta>\n'
    )
    return f"{head}{image.format(shapes)}{empty}</annotations>"


def _polyline(points, kind="polyline"):
    return f'<{kind} label="lane" occluded="0" points="{";".join(f"{x},{y}" for x, y in points)}"/>'


def test_polylines_of_cvat(tmp_path):
    path = tmp_path / "annotations.xml"
    others = '<box xtl="1" ytl="2" xbr="3" ybr="4"/>' + _polyline(LEFT).replace('"lane"', '"curb"')
    path.write_text(_cvat(_polyline(LEFT) + others + _polyline(RIGHT)))
    drawn, empty = read_lanes(path)
    assert (drawn.name, empty.name, empty.lines) == ("a/7.jpg", "a/8.jpg", [])
    for line, expected in zip(drawn.lines, (LEFT, RIGHT), strict=True):
        np.testing.assert_array_equal(line.points, expected)
    with pytest.raises(ValueError, match="got 1280 x 720 in the file; state their size with --lanes-size"):
        size_remark([drawn], (360, 640))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (_cvat(_polyline(LEFT, "polygon")), "expected lanes drawn as lines, got other shapes only"),
        (_cvat(_polyline(LEFT))[:-20], "expected CVAT's XML, got a syntax error; is the file cut"),
        ("<annotations><track id='0'/></annotations>", "with images, got none; export as CVAT for images"),
        (_cvat('<polyline points="1,2;3"/>'), "'7.jpg', line 0: expected 2 numbers, got 1"),
        (_cvat('<polyline points=""/>'), "line 0: expected 2 numbers, got 1"),
        ("<annotations><image><polyline/></image></annotations>", "name: expected the image's, got None"),
        (
            "<!DOCTYPE html><html></html>",
            "expected a readable file, got: a web page; download the file again",
        ),
    ],
)
def test_bad_files_of_cvat_are_one_clear_line(tmp_path, content, message):
    (tmp_path / "a.xml").write_text(content)
    with pytest.raises(ValueError, match=message):
        read_lanes(tmp_path / "a.xml")
