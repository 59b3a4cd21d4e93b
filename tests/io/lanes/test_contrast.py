"""Lanes that are not where the images show lines."""

import json

import cv2
import numpy as np
import pytest
import torch

from lanebev import Session
from lanebev.io.lanes.contrast import LaneContrast, share_of_less_contrast
from lanebev.io.lanes.doubts import LaneDoubts
from lanebev.io.lanes.parsing import FrameLines
from lanebev.observation.polylines import LaneLine
from tests.app.straight_road import CAMERA, HEIGHT, WIDTH, lane_lines, run

FRAMES = 12
ROWS, LINES = (np.array(json.loads(lane_lines(["a"])[0])[key]) for key in ("h_samples", "lanes"))
POINTS = [np.stack([line, ROWS], -1)[line >= 0] for line in LINES]


def _image(number, level=200):
    """An image of the lines, on a road with noise and beside it meadows of larger noise."""
    noise = np.random.default_rng(number)
    image = noise.integers(60, 120, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    road = np.array([POINTS[0][0], POINTS[-1][0], POINTS[-1][-1], POINTS[0][-1]]).round().astype(np.int32)
    cv2.fillConvexPoly(image, road, (80, 80, 80))
    for points in POINTS:
        cv2.polylines(image, [points.round().astype(np.int32)], False, (level, level, level), 2)
    return image


def _remark(change, images=_image, frames=FRAMES):
    seen = LaneContrast()
    for number in range(frames):
        seen.add(number, images(number), [change(points) for points in POINTS])
    return seen.remark()


@pytest.mark.parametrize(
    ("change", "is_noticed"),
    [
        (lambda points: points, False),
        (lambda points: np.add(points, (1.5, 0.0)), False),  # an edge of a marking
        (lambda points: points[::3], False),
        (lambda points: points * 0.8, True),
        (lambda points: points * 0.9, True),
        (lambda points: points * 1.1, True),
        (lambda points: np.add(points, (0.0, 20.0)), True),
        (lambda points: np.add(points, (25.0, 0.0)), True),
    ],
)
def test_lines_beside_those_of_the_images_are_noticed(change, is_noticed):
    assert ("the images show no edges along these lines" in _remark(change)) == is_noticed


def test_images_without_contrast_and_few_lines_tell_nothing():
    shifted = np.add(POINTS[0], (25.0, 0.0))
    assert (
        _remark(lambda points: shifted, images=lambda number: np.full((HEIGHT, WIDTH, 3), 90, np.uint8)) == ""
    )
    assert _remark(lambda points: shifted, images=lambda number: None) == ""
    assert _remark(lambda points: points * 0.9, frames=5) == ""


def test_the_share_of_a_line_by_hand():
    """A vertical edge at column 200 has more contrast than any other place, column 180 none."""
    image = np.zeros((100, 400, 3), np.uint8)
    image[:, 200:] = 100
    image[:, :200] += np.arange(100, dtype=np.uint8)[:, None, None]
    rows = np.arange(100.0)
    assert share_of_less_contrast(image, np.stack([np.full(100, 200.0), rows], -1)) == 1.0
    assert share_of_less_contrast(image, np.stack([np.full(100, 180.0), rows], -1)) == 0.0
    assert share_of_less_contrast(image, np.stack([np.full(3, 200.0), rows[:3]], -1)) is None


def test_a_run_says_it(tmp_path, capsys):
    (tmp_path / "images").mkdir()
    CAMERA.to_file(tmp_path / "camera.yaml")
    names = [f"images/{number}.png" for number in range(FRAMES)]
    for number, name in enumerate(names):
        cv2.imwrite(str(tmp_path / name), _image(number))
    (tmp_path / "lanes.json").write_text("\n".join(lane_lines(names)))
    assert run(tmp_path, out=tmp_path / "out") == 0
    assert "images show no edges" not in capsys.readouterr().out
    lines = [json.loads(text) for text in lane_lines(names)]
    raised = [json.dumps({**line, "h_samples": (ROWS - 20).tolist()}) for line in lines]
    (tmp_path / "raised.json").write_text("\n".join(raised))
    assert run(tmp_path, lanes="raised.json", out=tmp_path / "out") == 0
    assert "lanes: the images show no edges along these lines; do the lines belong" in capsys.readouterr().out


def test_a_session_with_images_says_it():
    session, image = Session(CAMERA, grid=None), _image(0)
    polylines = [np.add(points, (0.0, -20.0)) for points in POINTS]
    for number in range(160):
        reasons = session(image, number / 20, polylines=polylines).reasons
    assert any("the images show no edges along these lines" in reason for reason in reasons)


def test_a_second_without_paint_is_no_doubt():
    """Frames of a second look alike: they tell no more than one of them."""
    doubts, plain, painted = LaneDoubts(CAMERA), _image(0, level=80), _image(0)
    lines = FrameLines("", [LaneLine(points) for points in POINTS])
    for number in range(400):
        image = plain if 100 <= number < 140 else painted
        doubts.add(lines, torch.from_numpy(image).movedim(-1, 0))
        assert doubts.doubt == ""
