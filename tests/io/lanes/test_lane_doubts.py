"""Lane files that fit their images badly: repeated, unequal, missing lines, and entries out of order."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from lanebev import Camera
from lanebev.app.drive.observers import LaneFileObserver
from lanebev.io.frames import Selection
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.lanes.remarks import two_scales_remark, unequal_lanes_remark
from lanebev.io.opening import open_source
from lanebev.io.video.writer import VideoWriter
from lanebev.observation.polylines import LaneLine

SIZE = (48, 64)


@pytest.mark.parametrize(
    ("names", "wrong"),
    [
        (["f/1.jpg", "f/10.jpg", "f/2.jpg"], "f/10.jpg"),  # sorted as texts
        (["f/1.jpg", "f/2.jpg", "f/10.jpg"], ""),
        (["v.mp4/000000", "v.mp4/000001", "v.mp4/000002"], ""),
        (["b", "a", "c"], ""),  # of names without numbers nothing is known
    ],
)
def test_lanes_of_a_video_are_in_the_order_of_its_frames(tmp_path, names, wrong):
    path = tmp_path / "v.mp4"
    with VideoWriter(path, Fraction(10)) as writer:
        for _ in range(3):
            writer.write(np.zeros((*SIZE, 3), np.uint8))
    entries = [FrameLines(name, []) for name in names]
    camera = Camera.from_fov(60.0, 64, 48)
    if wrong:
        with pytest.raises(
            ValueError, match=f"expected entries in the order of the frames of .*, got '{wrong}' out"
        ):
            LaneFileObserver(entries, open_source(str(path)), camera)
    else:
        assert LaneFileObserver(entries, open_source(str(path)), camera).matches == [0, 1, 2]


def test_lanes_that_a_slow_detector_repeats_are_noticed(tmp_path):
    for number in range(6):
        Image.new("RGB", SIZE[::-1]).save(tmp_path / f"{number}.png")
    source, camera = open_source(str(tmp_path)), Camera.from_fov(60, *SIZE[::-1])
    line = np.array([[0.5, 0.5], [1.0, 1.0]]) * (np.array(SIZE[::-1]) - 1.0)
    remarks = {
        every: LaneFileObserver(
            [FrameLines(f"{i}.png", [LaneLine(line - i // every)]) for i in range(6)], source, camera
        ).remark
        for every in (1, 2, 3, 6)
    }
    assert remarks[1] == remarks[6] == ""  # all the same: nothing moves
    assert remarks[2].startswith("lanes: 3 of 6 frames have the lines of the frame before")
    assert remarks[3].startswith("lanes: 4 of 6 frames have the lines of the frame before")


@pytest.mark.parametrize(
    ("scale", "lowest", "pitch"),
    [(0.5, 1.0, 0.0), (0.8, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, 0.7, 0.0), (1.0, 1.0, 0.06), (1.0, 0.7, 0.06)],
)
def test_lanes_of_two_scales_are_noticed(scale, lowest, pitch):
    """Some frames in pixels of smaller images; not lanes that begin farther ahead, or another pitch."""
    rng = np.random.default_rng(0)
    frames = []
    for number in range(12):
        horizon = 170.0 - 500 * (pitch * (number > 6) + rng.normal(0, 0.003))
        rows = np.arange(horizon + 10, 350.0 * (lowest if number > 6 else 1.0), 10.0)
        lines = [np.stack([315 + place * (rows - horizon), rows], axis=-1) for place in (-3.9, -1.3, 1.3)]
        factor = scale if number > 6 else 1.0
        frames.append(FrameLines(f"{number}", [LaneLine(factor * line) for line in lines]))
    said = f"lanes: those of 5 of 12 frames are {scale:g} times as large as the others"
    assert two_scales_remark(frames).partition(", as of")[0] == (said if scale < 1 else "")
    assert two_scales_remark(frames[:7]) == two_scales_remark([]) == ""


def test_lanes_of_different_widths_are_noticed(tmp_path):
    Image.new("RGB", SIZE[::-1]).save(tmp_path / "0.png")
    height, width = SIZE
    camera, source = Camera.from_fov(60, width, height), open_source(str(tmp_path))
    rows = np.linspace(0.5 * height, height - 1.0, 20)
    entry = FrameLines(
        "0.png",
        [
            LaneLine(np.stack([0.5 * width + 0.7 * place * (rows - 0.4 * height), rows], axis=-1))
            for place in (-1.85, 1.85, 3.35)
        ],
    )
    assert LaneFileObserver([entry], source, camera).remark.startswith(
        "lanes: one lane is 2.5 times as wide as another, unless the camera is rolled by more than 2 degrees;"
    )
    assert LaneFileObserver([entry], source, camera, stills=True).remark == ""
    equal = entry._replace(lines=entry.lines[:2])
    assert LaneFileObserver([equal], source, camera).remark == ""
    slopes = np.tan(np.arctan(0.7 * 3.7 * np.arange(-2.5, 3.0)) + math.radians(2.0))  # the camera is rolled
    rolled = [LaneLine(np.stack([0.5 * width + slope * (rows - 0.4 * height), rows], -1)) for slope in slopes]
    assert unequal_lanes_remark([entry._replace(lines=rolled)], camera) == ""
    lens = Camera.from_parameters(
        fx=0.55 * width, fy=0.55 * width, cx=0.5 * width, cy=0.5 * height, width=width, height=height,
        distortion=(-0.3, 0.1, 0.0, 0.0, 0.0),
    )  # fmt: skip
    ideal = entry._replace(principal_point=(0.5 * width, 0.5 * height))  # 3D points, projected without it
    assert LaneFileObserver([ideal], source, lens).remark.startswith("lanes: one lane is 2.5 times as wide")


def test_3d_points_of_a_camera_of_another_focal_length_are_noticed(tmp_path):
    Image.new("RGB", SIZE[::-1]).save(tmp_path / "0.png")
    camera, source = Camera.from_fov(60, *SIZE[::-1]), open_source(str(tmp_path))
    focal = float(camera.intrinsics[0, 0])
    rows = np.linspace(0.5, 0.99, 20) * SIZE[0]
    entry = FrameLines("0.png", [LaneLine(np.stack([rows, rows], axis=-1))])
    for own, said in ((None, False), (1.005 * focal, False), (1.02 * focal, True)):
        frame = entry._replace(principal_point=(0.5 * SIZE[1], 0.5 * SIZE[0]), focal_length=own)
        remark = LaneFileObserver([frame], source, camera).remark
        assert ("of their 3D points has a focal length of" in remark) == said


def test_images_without_lanes_are_counted(tmp_path):
    """As where names of lanes begin at 1 and those of images at 0."""
    for number in range(6):
        Image.new("RGB", SIZE[::-1]).save(tmp_path / f"{number}.png")
    camera = Camera.from_fov(60, *SIZE[::-1])
    height, width = SIZE
    line = LaneLine(np.array([[0.5 * width, 0.5 * height], [width - 1.0, height - 1.0]]))
    entries = [FrameLines(f"{number}.png", [line]) for number in range(1, 7)]
    source = open_source(str(tmp_path))
    remark = "lanes: 1 of 6 images have no entry, the first is number 0; 1 entries have no image"
    assert LaneFileObserver(entries, source, camera).remark == remark
    part = replace(source, selection=Selection(0.01))
    assert LaneFileObserver(entries, part, camera).remark == ""
    empty = [entry._replace(lines=[]) for entry in entries]
    assert LaneFileObserver(empty, part, camera).remark == "lanes: none of the entries has a line"
    assert LaneFileObserver(entries[:3], part, camera).remark.endswith(
        "2 of 5 images have no entry, the first is number 4"
    )
