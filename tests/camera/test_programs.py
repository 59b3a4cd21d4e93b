"""Camera files of MATLAB, Gyroflow and Open3D."""

import json

import pytest
import torch

from lanebev import Camera
from tests.camera.files import read

MATLAB = {  # of toStruct(cameraParameters), from R2022b on
    "RadialDistortion": [-0.3, 0.1],
    "TangentialDistortion": [0.001, -0.002],
    "ImageSize": [720, 1280],
    "K": [[900.0, 0.5, 641.0], [0.0, 905.0, 361.0], [0.0, 0.0, 1.0]],
    "WorldUnits": "mm",
}
OLDER = {**MATLAB, "K": None, "IntrinsicMatrix": [[900, 0, 0], [0.5, 905, 0], [641, 361, 1]]}
GYROFLOW = {
    "name": "GoPro HERO 1280x720",
    "calib_dimension": {"w": 1280, "h": 720},
    "orig_dimension": {"w": 2704, "h": 1520},
    "fisheye_params": {
        "RMS_error": 0.4,
        "camera_matrix": [[560.0, 0.0, 642.0], [0.0, 561.0, 358.0], [0.0, 0.0, 1.0]],
        "distortion_coeffs": [0.03, 0.02, -0.01, 0.003],
    },
}


@pytest.mark.parametrize("fields", [MATLAB, OLDER])
def test_matlabs_first_pixel_is_at_1_and_its_lens_is_opencvs(tmp_path, fields):
    camera = read(tmp_path / "c.json", fields)
    assert camera.intrinsics.tolist() == [[900, 0.5, 640], [0, 905, 360], [0, 0, 1]]
    assert camera.distortion.tolist() == pytest.approx([-0.3, 0.1, 0.001, -0.002])
    assert camera.image_size == (720, 1280)
    three = read(tmp_path / "c.json", {**fields, "RadialDistortion": [-0.3, 0.1, 0.02]})
    assert three.distortion.tolist() == pytest.approx([-0.3, 0.1, 0.001, -0.002, 0.02])


def test_matlabs_camera_below_a_name(tmp_path):
    expected = read(tmp_path / "c.json", MATLAB).fingerprint()
    assert read(tmp_path / "c.json", {"cameraParams": MATLAB}).fingerprint() == expected


def test_what_librealsenses_tool_prints(tmp_path):
    text = "  Width:      \t{}\n  Height:     \t720\n  PPX:        \t640.25\n  PPY:        \t360.5\n"
    text += "  Fx:  \t910\n  Fy:  \t911\n  Distortion: \tInverse Brown Conrady\n"
    text += "  Coeffs: \t{}  \t0  \t0  \t0  \t0\n"
    (tmp_path / "color.txt").write_text(text.format(1280, 0) + "  FOV (deg):  \t70.2 x 43.2\n")
    expected = Camera.from_parameters(910, 911, 640.25, 360.5, 1280, 720)
    assert Camera.from_file(tmp_path / "color.txt").fingerprint() == expected.fingerprint()
    (tmp_path / "color.txt").write_text(text.format(1280, 0.1))
    with pytest.raises(ValueError, match="coeffs of zeros, got 'Inverse Brown Conrady'; calibrate by OpenCV"):
        Camera.from_file(tmp_path / "color.txt")


def test_matlabs_camera_intrinsics(tmp_path):
    own = {"FocalLength": [900, 905], "PrincipalPoint": [641, 361], "RadialDistortion": [0, 0]}
    camera = read(tmp_path / "c.json", {**MATLAB, **own, "K": None})
    assert camera.intrinsics.tolist() == [[900, 0, 640], [0, 905, 360], [0, 0, 1]]


@pytest.mark.parametrize(
    "matrix", [[440.7, 0, 0, 0, 440.5, 0, 354.8, 232.1, 1], [[440.7, 0, 354.8], [0, 440.5, 232.1], [0, 0, 1]]]
)
def test_open3ds_matrix_is_given_column_by_column(tmp_path, matrix):
    fields = {"height": 480, "intrinsic_matrix": matrix, "width": 720}
    (tmp_path / "c.json").write_text(json.dumps(fields))
    expected = Camera.from_parameters(440.7, 440.5, 354.8, 232.1, 720, 480)
    assert Camera.from_file(tmp_path / "c.json").fingerprint() == expected.fingerprint()


def test_a_matrix_under_open3ds_key_beside_a_lens_is_no_open3ds(tmp_path):
    fields = {"height": 480, "width": 720, "dist": [0.1, 0, 0, 0, 0]}
    columns = [440.7, 0, 0, 0, 440.5, 0, 354.8, 232.1, 1]
    (tmp_path / "c.json").write_text(json.dumps({**fields, "intrinsic_matrix": columns}))
    with pytest.raises(ValueError, match="got its transpose"):
        Camera.from_file(tmp_path / "c.json")


def test_a_lens_profile_of_gyroflow(tmp_path):
    expected = Camera.from_parameters(560, 561, 642, 358, 1280, 720, (0.03, 0.02, -0.01, 0.003), "fisheye")
    for fields in (GYROFLOW, {**GYROFLOW, "distortion_model": "opencv_fisheye", "digital_lens": None}):
        camera = read(tmp_path / "c.json", fields)
        assert torch.equal(camera.intrinsics, expected.intrinsics)
        assert torch.equal(camera.distortion, expected.distortion)
        assert (camera.model, camera.image_size) == ("fisheye", (720, 1280))
    assert read(tmp_path / "c.json", {**GYROFLOW, "distortion_model": "opencv_standard"}).model == "pinhole"


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({**MATLAB, "RadialDistortion": [0.1]}, "RadialDistortion: expected 2 or 3 numbers, got 1"),
        ({**MATLAB, "RadialDistortion": 0.1}, "RadialDistortion: expected a list of numbers, got '0.1'"),
        ({**MATLAB, "ImageSize": []}, "ImageSize: expected 2 numbers, got 0"),
        ({**GYROFLOW, "digital_lens": "gopro_superview"}, "opencv_standard, got 'gopro_superview'"),
        (
            {**GYROFLOW, "distortion_model": "poly5"},
            "expected opencv_fisheye or opencv_standard, got 'poly5'",
        ),
        ({**GYROFLOW, "calib_dimension": None}, "calib_dimension: expected a value, got none"),
    ],
)
def test_what_cannot_be_read_is_one_clear_line(tmp_path, fields, message):
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "c.json", fields)
