"""3D lanes of ONCE-3DLanes and Apollo's synthetic data set."""

import json
import math

import numpy as np
import pytest

from lanebev.io.lanes import read_lanes

MATRIX = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]])
CAMERA = np.array([[-1.8, 1.5, 10.0], [-1.8, 1.5, 20.0], [-1.7, 1.4, 40.0]])  # m: x right, y down, z forward
PIXELS = CAMERA[:, :2] / CAMERA[:, 2:] * 1000 + [640, 360]


@pytest.mark.parametrize("calibration", [None, MATRIX.tolist(), np.pad(MATRIX, [(0, 0), (0, 1)]).tolist()])
def test_lanes_of_once_are_in_camera_axes(tmp_path, calibration):
    fields = {"lanes": [CAMERA.tolist(), []]}
    fields |= {} if calibration is None else {"lane_num": 2, "calibration": calibration}
    (tmp_path / "1616.json").write_text(json.dumps(fields))
    (frame,) = read_lanes(tmp_path / "1616.json", MATRIX if calibration is None else 2 * MATRIX)
    assert frame.name == f"{tmp_path}/1616"
    assert (frame.principal_point, frame.focal_length) == ((640, 360), 1000)
    (line,) = frame.lines
    np.testing.assert_allclose(line.points, PIXELS)
    if calibration is None:
        with pytest.raises(
            ValueError, match="intrinsics: expected the camera matrix of lanes in 3D, got none"
        ):
            read_lanes(tmp_path / "1616.json")


@pytest.mark.parametrize("pitch", [0.0, 0.1])
def test_lanes_of_apollo_are_on_the_ground(tmp_path, pitch):
    ground = np.array([[1.8, 10.0, 0.0], [1.8, 30.0, 0.2], [1.8, 60.0, 0.5]])  # m: right, forward, up
    image = {
        "raw_file": "images/05/1.jpg", "cam_height": 1.5, "cam_pitch": pitch, "centerLines": [[[0, 5, 0]]],
        "laneLines": [ground.tolist()], "laneLines_visibility": [[1.0, 1.0, 0.0]],
    }  # fmt: skip
    (tmp_path / "test.json").write_text("\n".join([json.dumps(image)] * 2))
    frame, _ = read_lanes(tmp_path / "test.json", MATRIX)
    assert frame.name == "images/05/1.jpg"
    (line,) = frame.lines
    assert len(line.points) == 2  # the last one is not seen
    angles = np.arctan((line.points[:, 1] - 360) / 1000) + pitch  # below the horizontal
    down, forward = 1.5 * math.cos(pitch) - ground[:2, 2], ground[:2, 1] - 1.5 * math.sin(pitch)
    np.testing.assert_allclose(np.tan(angles), down / forward, rtol=1e-9)


def test_improbable_lines_of_predictions_are_left_out(tmp_path):
    once = {"lanes": [{"points": CAMERA.tolist(), "score": score} for score in (0.9, 0.1)]}
    apollo = {
        "raw_file": "1.jpg", "cam_height": 1.5, "cam_pitch": 0.0,
        "laneLines": [[[1, 9, 0], [1, 20, 0]], [[2, 9, 0]]],
        "laneLines_prob": [0.6, 0.4], "laneLines_visibility": [[1.0]],  # of the labels
    }  # fmt: skip
    openlane = {
        "file_path": "1.jpg", "intrinsic": MATRIX.tolist(),
        "lane_lines": [
            {"xyz": [[9, 20], [1, 1], [-1, -1]], "category": 1, "laneLines_prob": probability}
            for probability in (0.7, 0.2, [0.1, 0.8], [0.3, 0.3], [], None)
        ],
    }  # fmt: skip
    for fields, count in ((once, 1), (apollo, 1), (openlane, 4)):
        (tmp_path / "1.json").write_text(json.dumps(fields))
        (frame,) = read_lanes(tmp_path / "1.json", MATRIX)
        assert len(frame.lines) == count
    (tmp_path / "1.json").write_text(json.dumps({**apollo, "laneLines_prob": [0.6]}))
    with pytest.raises(ValueError, match="laneLines_prob: expected a value for each of 2 lines, got 1"):
        read_lanes(tmp_path / "1.json", MATRIX)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"laneLines": [], "raw_file": "1.jpg", "cam_height": 1e308, "cam_pitch": 0},
            "cam_height, cam_pitch: expected m and rad, got 1e",
        ),
        ({"lanes": [[[1, 2]]]}, r"lanes\[0\]: expected three lists of one length"),
        ({"lanes": [[[1, 2, "x"]]]}, r"lanes\[0\]: expected finite numbers, or null"),
        (
            {"lanes": [], "calibration": [[1, 2, 3]]},
            "calibration: expected the camera matrix, 3 x 3 or 3 x 4",
        ),
        (
            {"laneLines": [[[1, 2, 3]]], "raw_file": "1.jpg"},
            "cam_height, cam_pitch: expected finite numbers, got None",
        ),
        (
            {
                "laneLines": [[[1, 2, 3]]],
                "laneLines_visibility": [[]],
                "raw_file": "1",
                "cam_height": 1,
                "cam_pitch": 0,
            },
            r"laneLines\[0\]_visibility: expected 1 numbers, got 0",
        ),
    ],
)
def test_what_cannot_be_read_is_one_clear_line(tmp_path, fields, message):
    (tmp_path / "1.json").write_text(json.dumps(fields))
    with pytest.raises(ValueError, match=message) as error:
        read_lanes(tmp_path / "1.json", MATRIX)
    assert "\n" not in str(error.value)
