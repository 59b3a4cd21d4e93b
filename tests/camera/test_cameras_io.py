"""Camera files: every flavour gives the same lens, and every mistake one clear line."""

import math

import cv2
import numpy as np
import pytest
import torch
import yaml

from lanebev import Camera, Extrinsics
from lanebev.estimation.mount import MountCalibration, MountReason, MountStatus
from lanebev.io.calibration_file import read_mount, vehicle_from_camera, write_calibration
from tests.camera.files import assert_same, read, written

DISTORTION = [-0.25, 0.04, -0.0007, 0.0001, -0.115]
SHORT = {"fx": 1150.0, "fy": 1148.0, "cx": 650.0, "cy": 370.0, "width": 1280, "height": 720}
LENS = Camera.from_parameters(**SHORT, distortion=DISTORTION)


def test_short_yaml(tmp_path):
    assert_same(read(tmp_path / "c.yaml", {**SHORT, "distortion": DISTORTION, "model": "pinhole"}), LENS)


@pytest.mark.parametrize("suffix", ["yml", "xml"])
@pytest.mark.parametrize("shape", [(5,), (5, 1), (1, 5)])
def test_opencv_file_storage(tmp_path, suffix, shape):
    path = tmp_path / f"c.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 1280)
    storage.write("image_height", 720)
    storage.write("camera_matrix", LENS.intrinsics.numpy())
    storage.write("distortion_coefficients", np.array(DISTORTION).reshape(shape))
    storage.write("avg_reprojection_error", 0.3)
    storage.release()
    assert_same(Camera.from_file(path), LENS)


@pytest.mark.parametrize(
    ("name", "coefficients", "model"),
    [
        ("plumb_bob", DISTORTION, "pinhole"),
        ("rational_polynomial", [0.1, 0.01, 0.0, 0.0, 0.001, 0.2, 0.02, 0.0], "pinhole"),
        ("equidistant", [0.01, -0.002, 0.001, 0.0], "fisheye"),
        ("fisheye", [0.01, -0.002, 0.001, 0.0], "fisheye"),
    ],
)
def test_ros_camera_info(tmp_path, name, coefficients, model):
    fields = {
        "image_width": 1280,
        "image_height": 720,
        "camera_name": "front",
        "camera_matrix": {"rows": 3, "cols": 3, "data": LENS.intrinsics.flatten().tolist()},
        "distortion_model": name,
        "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "data": coefficients},
    }
    same = Camera.from_parameters(**SHORT, distortion=coefficients, model=model)
    assert_same(read(tmp_path / "c.yaml", fields), same)
    if len(coefficients) == 8:  # of which the calibrator stated 5: image_pipeline#278
        fields["distortion_coefficients"]["cols"] = 5
        assert_same(read(tmp_path / "c.yaml", fields), same)


def test_ros_message_dump(tmp_path):
    fields = {"width": 1280, "height": 720, "distortion_model": "plumb_bob"}
    fields |= {"K": LENS.intrinsics.flatten().tolist(), "D": DISTORTION}
    assert_same(read(tmp_path / "c.yaml", fields), LENS)


P2 = "P2: 721.5377 0 609.5593 44.85728 0 721.5377 172.854 0.2163791 0 0 1 0.002745884\n"


def test_kitti_object_file_knows_the_recording_day(tmp_path):
    camera = Camera.from_file(
        written(tmp_path / "calib.txt", "P0: " + P2[4:] + P2 + "R0_rect: 1 0 0 0 1 0 0 0 1\n")
    )
    expected = Camera.from_parameters(721.5377, 721.5377, 609.5593, 172.854, 1242, 375)
    assert_same(camera, expected)


def test_resized_kitti_images_need_their_own_camera(tmp_path):
    path = written(tmp_path / "calib.txt", P2)
    assert Camera.from_file(path, image_size=(370, 1240)).image_size == (370, 1240)
    with pytest.raises(ValueError, match=r"expected images of about 1242 x 375 px.* got 621 x 188;"):
        Camera.from_file(path, image_size=(188, 621))


def test_what_ros2_topic_echo_prints(tmp_path):
    matrix = "[500.0, 0.0, 320.0, 0.0, 500.0, 180.0, 0.0, 0.0, 1.0]"
    text = f"width: 640\nheight: 360\ndistortion_model: plumb_bob\nd: []\nk: {matrix}\n"
    camera = read(tmp_path / "info.yaml", f"{text}---\n")
    assert_same(camera, Camera.from_parameters(500, 500, 320, 180, 640, 360))


def test_kittis_images_as_its_cameras_took_them(tmp_path):
    text = "S_02: 1392 512\nK_02: 960 0 696 0 957 224 0 0 1\nD_02: -0.37 0.2 0.001 0.0006 -0.07\n"
    path = written(tmp_path / "calib.txt", f"{text}S_rect_02: 1242 375\n{P2.replace('P2', 'P_rect_02')}\n")
    lens = (-0.37, 0.2, 0.001, 0.0006, -0.07)
    expected = Camera.from_parameters(960, 957, 696, 224, 1392, 512, lens)
    assert_same(Camera.from_file(path, image_size=(512, 1392)), expected)
    assert not len(Camera.from_file(path, image_size=(375, 1242)).distortion)


@pytest.mark.parametrize("change", [("1242 375", "1392 512"), ("D_02", "d_02"), ("K_02", "Date: 1\nDate")])
def test_kittis_images_of_the_rectified_size_are_rectified(tmp_path, change):
    text = "S_02: 1392 512\nK_02: 960 0 696 0 957 224 0 0 1\nD_02: -0.37 0.2 0.001 0.0006 -0.07\n"
    text += f"S_rect_02: 1242 375\n{P2.replace('P2', 'P_rect_02')}\n"
    path = written(tmp_path / "calib.txt", text.replace(*change))
    for rectified in (False, True):
        assert not len(Camera.from_file(path, image_size=(512, 1392), rectified=rectified).distortion)


def test_kitti_raw_file_prefers_its_own_size(tmp_path):
    text = "calib_time: 09-Jan-2012\nS_rect_02: 1.242e+03 3.75e+02\nP_rect_02:" + P2[3:].replace(
        "721.5377", "700"
    )
    camera = read(tmp_path / "calib_cam_to_cam.txt", text, image_size=(10, 10))
    assert camera.image_size == (375, 1242)
    assert float(camera.intrinsics[0, 0]) == 700


def test_kitti_file_of_an_unknown_camera_needs_a_size(tmp_path):
    path = written(tmp_path / "calib.txt", P2.replace("721.5377", "700"))
    with pytest.raises(ValueError, match=r"image size.*S_rect_02: WIDTH HEIGHT"):
        Camera.from_file(path)
    assert Camera.from_file(path, image_size=(370, 1224)).image_size == (370, 1224)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": None}, "fx: expected a value, got none"),
        ({"fx": -5.0}, "fx: expected .* px for an image of 1280 x 720, got -5"),
        ({"fx": 1.2, "fy": 1.2}, "focal lengths are in pixels"),
        ({"fx": 100_000.0}, "fx: expected"),
        ({"fy": 300.0}, "square pixels"),
        ({"cx": 2000.0}, "cx: expected a principal point inside the image, 0 to 1280, got 2000"),
        (
            {"cx": 0.5, "cy": 0.49},
            "cx, cy: expected px, got 0.5, 0.49; multiply shares of the image's sides by 1280",
        ),
        ({"cy": -3.0}, "cy: expected"),
        ({"cy": float("nan")}, "cy: expected finite numbers, got .nan"),
        ({"fx": "wide"}, "fx: expected finite numbers, got wide"),
        ({"width": 0}, "image size: expected"),
        ({"width": 640.5}, "whole pixels"),
        ({"height": None}, "yaml: height: expected a value"),
        ({"fx": 10**400}, "fx: expected finite numbers, got 1000"),
        ({"distortion": [0.1, 0.2]}, "distortion: expected 0 or 4 or 5 or 8 or 12 or 14 coefficients"),
        ({"distortion": [0.1] * 5, "model": "fisheye"}, r"expected 4 coefficients \(fisheye\), got 5"),
        ({"distortion": 0.3}, "distortion: expected a list"),
        ({"distortion": [-900.0, 0, 0, 0]}, "lens that can be inverted"),
        ({"model": "catadioptric"}, "model: expected one of pinhole"),
        ({"focal": 3}, "unknown key 'focal'; .*; rename it, or leave it out"),
        ({"fov": 90}, "unknown key 'fov'; .*; rename it, or leave it out"),
        (
            {"fx": None, "fy": None, "focal": 3},
            "unknown key 'focal'; .*; fx is focal length / sensor width \\(both in mm\\) times",
        ),
        (
            {"fx": None, "fy": None, "fov": 90},
            "unknown key 'fov'; .*; give the horizontal field of view by --fov DEGREES",
        ),
    ],
)
def test_bad_entries_are_one_clear_line(tmp_path, change, message):
    fields = {key: value for key, value in {**SHORT, **change}.items() if value is not None}
    path = written(tmp_path / "c.yaml", fields)
    with pytest.raises(ValueError, match=message) as error:
        Camera.from_file(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("c.yaml", "", "is the file empty"),
        ("c.yaml", "fx=554\nfy=554\n", "keys with a colon and a space, such as fx: 1150, got 'fx=554"),
        ("c.yaml", "f: 554\ncx: 320\ncy: 180\nwidth: 640\n", "unknown key 'f'; expected fx, fy, cx, cy"),
        ("c.yaml", "FX: 554\nFY: 554\n", "height: expected a value, got none; add the entry"),
        ("c.yaml", "fx: 1150\nfx: 1151\n", "'fx' twice"),
        ("c.yaml", "[" * 100_000, "expected YAML, got"),
        ("c.yaml", "camera_matrix: []\nimage_width: 640\n", "image_height: expected a value"),
        (
            "c.yaml",
            "{image_width: 9, image_height: 9, K: [1, 0, 1, 0, 1, 1, 0, 0, 1], "
            "D: {rows: 1.0e+200, cols: 1.0e+200, data: []}}",
            "distortion_coefficients: expected 1000000 numbers, got 0",
        ),
        (
            "c.yaml",
            "camera_matrix: {rows: 3, cols: 3, data: [1150.0, 0.0",
            "syntax error at line 1; is the file cut",
        ),
        (
            "c.xml",
            "<?xml version='1.0'?><opencv_storage><camera_matrix>",
            "syntax error at line 1; is the file cut",
        ),
        ("calib.txt", "R0_rect: 1 0 0", "P_rect_02 or P2"),
        ("calib.txt", "P2: 721.5 0 609", "P2: expected 12 numbers, got 3"),
        ("calib.txt", "P2: 7 0 6 0 0 7 1 0 0 0 1 0\nP2: 8 0 6 0 0 8 1 0 0 0 1 0", "once, got 'P2' twice"),
    ],
)
def test_malformed_files_are_one_clear_line(tmp_path, name, text, message):
    with pytest.raises(ValueError, match=message) as error:
        read(tmp_path / name, text)
    assert "\n" not in str(error.value)


def test_matrix_cut_short(tmp_path):
    fields = {
        "image_width": 1280,
        "image_height": 720,
        "camera_matrix": {"rows": 3, "cols": 3, "data": [1.0] * 8},
    }
    with pytest.raises(ValueError, match="camera_matrix: expected 9 numbers, got 8"):
        read(tmp_path / "c.yaml", fields)


def test_missing_file(tmp_path):
    with pytest.raises(ValueError, match="No such file"):
        Camera.from_file(tmp_path / "none.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(ValueError, match="not a text file"):
        Camera.from_file(tmp_path / "binary.yaml")


@pytest.mark.parametrize(
    ("distortion", "model"),
    [([], "pinhole"), (DISTORTION[:4], "pinhole"), (DISTORTION, "pinhole"), ([0.01] * 4, "fisheye")],
)
def test_write_camera_round_trip(tmp_path, distortion, model):
    camera = Camera.from_parameters(**SHORT, distortion=distortion, model=model)
    camera.to_file(tmp_path / "c.yaml")
    again = Camera.from_file(tmp_path / "c.yaml")
    padded = distortion + [0.0] * (5 - len(distortion)) if distortion and model == "pinhole" else distortion
    assert_same(again, Camera.from_parameters(**SHORT, distortion=padded, model=model))


POSE = Extrinsics(*(torch.tensor([value], dtype=torch.float64) for value in (0.05, -0.02, 0.01, 1.5)))


def mounted(status: list[int], progress: list[float], reasons: list[int]) -> MountCalibration:
    variances = torch.tensor([0.01, 0.02, 0.03, 0.04], dtype=torch.float64).square()
    axes = (torch.tensor([status]), torch.tensor([progress]), torch.tensor([reasons]))
    whole = MountStatus.CALIBRATED if set(status) == {1} else MountStatus.PARTIAL
    least = torch.tensor([min(progress)])
    why = torch.tensor([reasons[0] | reasons[1] | reasons[2] | reasons[3]])
    return MountCalibration(POSE, variances.diag()[None], torch.tensor([int(whole)]), least, why, *axes)


def test_calibration_file_is_read_by_others(tmp_path):
    path = tmp_path / "calibration.yaml"
    write_calibration(path, LENS, mounted([1] * 4, [100.0] * 4, [0, int(MountReason.SLOW), 0, 0]))
    assert_same(Camera.from_file(path), LENS)
    fields = yaml.safe_load(path.read_text())
    assert fields["mount"]["pitch_deg"] == pytest.approx(math.degrees(0.05), abs=1e-12)
    assert fields["mount"]["roll_std_deg"] == pytest.approx(math.degrees(0.03), abs=1e-12)
    assert (fields["mount"]["valid"], fields["mount"]["status"]) == (True, "CALIBRATED")
    assert fields["mount"]["reasons"] == fields["mount"]["axes"]["yaw"]["reasons"] == ["SLOW"]
    assert "needs" not in fields["mount"]
    rotation = torch.tensor(fields["vehicle_from_camera"]["data"]).reshape(4, 4)[:3, :3]
    x, y, z, w = fields["quaternion_xyzw"]
    turned = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]  # the camera's x axis
    np.testing.assert_allclose(rotation[:, 0], turned, atol=1e-6)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("mount").getNode("height_m").real() == 1.5
    np.testing.assert_allclose(storage.getNode("camera_matrix").mat(), LENS.intrinsics)
    np.testing.assert_allclose(storage.getNode("distortion_coefficients").mat()[0], LENS.distortion)
    np.testing.assert_allclose(storage.getNode("vehicle_from_camera").mat(), vehicle_from_camera(POSE)[0])
    prior = read_mount(path)
    torch.testing.assert_close(prior.pose, POSE.stack()[0])
    torch.testing.assert_close(prior.std, torch.tensor([0.01, 0.02, 0.03, 0.04], dtype=torch.float64))


def test_what_is_not_calibrated_cannot_be_mistaken_for_a_pose(tmp_path):
    path = tmp_path / "calibration.yaml"
    few = int(MountReason.FEW_BLOCKS)
    write_calibration(path, LENS, mounted([1, 1, 0, 3], [100.0, 100.0, 40.0, 60.0], [0, 0, few, few]))
    fields = yaml.safe_load(path.read_text())
    mount = fields["mount"]
    assert not mount["valid"]
    assert "vehicle_from_camera" not in fields
    assert "quaternion_xyzw" not in fields
    assert mount.keys() & {"pitch_deg", "yaw_deg", "roll_deg", "height_m"} == {"pitch_deg", "yaw_deg"}
    assert mount["preliminary"].keys() == {"roll_deg", "roll_std_deg", "height_m", "height_std_m"}
    assert mount["axes"]["roll"] == {
        "status": "UNCALIBRATED",
        "progress_percent": 40.0,
        "reasons": ["FEW_BLOCKS"],
    }
    assert mount["needs"][0].startswith(
        "roll: needs 20 s of straight driving with two lanes in view; 8 s so far"
    )
    assert cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ).getNode("mount").isMap()
    prior = read_mount(path)
    assert prior.std.isfinite().tolist() == [True, True, False, False]


def test_a_mount_that_cannot_be_used_is_one_clear_line(tmp_path):
    path = tmp_path / "calibration.yaml"
    write_calibration(path, LENS, mounted([0] * 4, [40.0] * 4, [16] * 4))
    with pytest.raises(ValueError, match=r"expected a calibrated axis, got none: pitch: needs 20 s"):
        read_mount(path)
    for text, said in (
        ("fx: 3", "the key mount"),
        ("mount: {pitch_deg: a}", "pitch_deg"),
        ("mount: {pitch_deg: 95, pitch_std_deg: 1}", "pitch_deg: expected -60 to 60, got 95"),
        ("mount: {height_m: 140, height_std_m: 1}", "height_m: expected 0.1 to 20, got 140"),
        ("mount: {height_m: 1.4, height_std_m: 0}", "height_std_m: expected more than 0, got 0"),
        ("a: [1", "readable"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=said) as caught:
            read_mount(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="readable"):
        read_mount(tmp_path / "none.yaml")


def test_cameras_compare_as_objects():
    assert LENS == LENS
    assert Camera.from_parameters(**SHORT) != Camera.from_parameters(**SHORT)


def test_convention_vehicle_from_camera():
    zero, height = torch.zeros(1, dtype=torch.float64), torch.tensor([1.5], dtype=torch.float64)
    level = vehicle_from_camera(Extrinsics(zero, zero, zero, height))[0]
    forward, right = level @ level.new_tensor([0, 0, 10, 1]), level @ level.new_tensor([2, 0, 0, 1])
    torch.testing.assert_close(forward, level.new_tensor([10, 0, 1.5, 1]))
    torch.testing.assert_close(right, level.new_tensor([0, -2, 1.5, 1]))
    nose_down = vehicle_from_camera(Extrinsics(zero + 0.1, zero, zero, height))[0]
    assert (nose_down @ level.new_tensor([0, 0, 10, 1]))[2] < 1.5
    left = vehicle_from_camera(Extrinsics(zero, zero + 0.1, zero, height))[0]
    assert (left @ level.new_tensor([0, 0, 10, 1]))[1] > 0
