"""Cameras of data sets and programs in JSON, whose numbers have names of their own; OpenCV's tutorial."""

import json

import cv2
import numpy as np
import pytest
import torch
import yaml

from lanebev import Camera

LENS = [-0.3, 0.1, 0.001, -0.002, 0.02]
KANNALA_BRANDT = [0.05, -0.01, 0.002, -0.0003]


def _matrix(focal, cx, cy):
    return [[focal, 0.0, cx], [0.0, focal + 2, cy], [0.0, 0.0, 1.0]]


A2D2_FRONT = {
    "CamMatrix": _matrix(1600, 965, 600),
    "CamMatrixOriginal": _matrix(1500, 970, 610),
    "Distortion": [LENS],
    "Lens": "Telecam",
    "Resolution": [1920, 1208],
}
A2D2_REAR = {**A2D2_FRONT, "Distortion": [KANNALA_BRANDT], "Lens": "Fisheye"}
A2D2 = {"lidars": {"front_left": {}}, "cameras": {"front_center": A2D2_FRONT, "rear_center": A2D2_REAR}}
NUIMAGES = {"token": "a1", "camera_intrinsic": _matrix(1272, 826, 479), "camera_distortion": LENS}
CITYSCAPES = {"extrinsic": {"pitch": 0.038}, "intrinsic": {"fx": 2262, "fy": 2265, "u0": 1096, "v0": 513}}
ONCE = {"meta_info": {}, "calib": {"cam01": {"cam_intrinsic": _matrix(966, 977, 518), "distortion": LENS}}}
ZOD_FRONT = {
    "intrinsics": _matrix(1900, 1920, 1084),
    "image_dimensions": [3848, 2168],
    "distortion": KANNALA_BRANDT,
    "undistortion": [9, 9, 9, 9],
}
DAIR = {"cam_K": [2183, 0, 940, 0, 2185, 567, 0, 0, 1], "cam_D": LENS, "width": 1920, "height": 1080}
AUTOWARE = {  # as cv::FileStorage writes it
    "CameraMat": {"rows": 3, "cols": 3, "dt": "d", "data": [2183, 0, 940, 0, 2185, 567, 0, 0, 1]},
    "DistCoeff": {"rows": 1, "cols": 5, "dt": "d", "data": LENS},
    "ImageSize": [1920, 1080],
    "ReprojectionError": 0.2,
    "DistModel": "plumb_bob",
}
WAYMO = {"name": "FRONT", "intrinsic": [2059, 2061, 936, 635, *LENS], "width": 1920, "height": 1280}
NERF = {
    "fl_x": 900,
    "fl_y": 902,
    "cx": 640.5,
    "cy": 360.5,
    "w": 1280,
    "h": 720.0,
    "frames": [{"file_path": "a"}],
}
BY_NAME = dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True))
FISHEYE_BY_NAME = dict(zip(("k1", "k2", "k3", "k4"), KANNALA_BRANDT, strict=True))
REALSENSE = {"fx": 900, "fy": 902, "ppx": 640, "ppy": 360, "width": 1280, "height": 720}
SHORT = {"fx": 900, "fy": 902, "cx": 640, "cy": 360, "width": 1280, "height": 720}
LIKE_OPENLANE = {"intrinsic": _matrix(1000, 960, 540), "width": 1920, "height": 1080}


@pytest.mark.parametrize(
    ("content", "name", "expected"),
    [
        ([NUIMAGES], "", (1272, 1274, 826, 479, 1600, 900, LENS)),
        (CITYSCAPES, "", (2262, 2265, 1096, 513, 2048, 1024, ())),
        (
            {
                "intrinsics": {
                    "fx": 900,
                    "fy": 902,
                    "cx": 640,
                    "cy": 360,
                    "D": LENS,
                    "width": 1280,
                    "height": 720,
                }
            },
            "",
            (900, 902, 640, 360, 1280, 720, LENS),
        ),
        (ONCE, "", (966, 968, 977, 518, 1920, 1020, LENS)),
        (A2D2, "#front_center", (1500, 1502, 970, 610, 1920, 1208, LENS)),
        (A2D2, "#rear_center", (1500, 1502, 970, 610, 1920, 1208, KANNALA_BRANDT, "fisheye")),
        ({"FC": ZOD_FRONT}, "", (1900, 1902, 1920, 1084, 3848, 2168, KANNALA_BRANDT, "fisheye")),
        (DAIR, "", (2183, 2185, 940, 567, 1920, 1080, LENS)),
        (AUTOWARE, "", (2183, 2185, 940, 567, 1920, 1080, LENS)),
        (ZOD_FRONT, "", (1900, 1902, 1920, 1084, 3848, 2168, KANNALA_BRANDT, "fisheye")),
        (
            {**LIKE_OPENLANE, "dist_coefs": [], "distance": 5, "undistorted": 1, "resolution": 0.1},
            "",
            (1000, 1002, 960, 540, 1920, 1080, ()),
        ),
        (LIKE_OPENLANE, "", (1000, 1002, 960, 540, 1920, 1080, ())),
        ({**LIKE_OPENLANE, "distortion": LENS}, "", (1000, 1002, 960, 540, 1920, 1080, LENS)),
        ({**LIKE_OPENLANE, "k1": -0.3}, "", (1000, 1002, 960, 540, 1920, 1080, (-0.3, 0, 0, 0, 0))),
        (
            [{**WAYMO, "name": "REAR", "width": 960}, {**WAYMO, "name": "FRONT"}],
            "#FRONT",
            (2059, 2061, 936, 635, 1920, 1280, LENS),
        ),
        (WAYMO, "", (2059, 2061, 936, 635, 1920, 1280, LENS)),
        ({**NERF, **BY_NAME}, "", (900, 902, 640, 360, 1280, 720, LENS)),
        (
            {**NERF, **FISHEYE_BY_NAME, "camera_model": "OPENCV_FISHEYE"},
            "",
            (900, 902, 640, 360, 1280, 720, KANNALA_BRANDT, "fisheye"),
        ),
        ({**REALSENSE, "model": "Brown Conrady", "coeffs": LENS}, "", (900, 902, 640, 360, 1280, 720, LENS)),
        (
            {**REALSENSE, "model": "distortion.inverse_brown_conrady", "coeffs": [0] * 5},
            "",
            (900, 902, 640, 360, 1280, 720),
        ),
        ({**SHORT, **BY_NAME}, "", (900, 902, 640, 360, 1280, 720, LENS)),
        ({**SHORT, "distortion": BY_NAME}, "", (900, 902, 640, 360, 1280, 720, LENS)),
        ({**SHORT, "distortion_coefficients": LENS}, "", (900, 902, 640, 360, 1280, 720, LENS)),
        (
            {
                "Camera": {
                    **{k: SHORT[k] for k in ("fx", "fy", "cx", "cy")},
                    **FISHEYE_BY_NAME,
                    "cols": 1280,
                    "rows": 720,
                    "model": "fisheye",
                }
            },
            "",
            (900, 902, 640, 360, 1280, 720, KANNALA_BRANDT, "fisheye"),
        ),
        ({**LIKE_OPENLANE, "dist_coeffs": [LENS]}, "", (1000, 1002, 960, 540, 1920, 1080, LENS)),
        (
            {**LIKE_OPENLANE, "D": KANNALA_BRANDT, "camera_model": "fisheye"},
            "",
            (1000, 1002, 960, 540, 1920, 1080, KANNALA_BRANDT, "fisheye"),
        ),
    ],
)
def test_a_record_is_read_with_its_lens(tmp_path, content, name, expected):
    (tmp_path / "c.json").write_text(json.dumps(content))
    camera = Camera.from_file(f"{tmp_path / 'c.json'}{name}")
    wanted = Camera.from_parameters(*expected)
    torch.testing.assert_close(camera.intrinsics, wanted.intrinsics, rtol=0, atol=0)
    torch.testing.assert_close(camera.distortion, wanted.distortion, rtol=0, atol=0)
    assert (camera.model, camera.image_size) == (wanted.model, wanted.image_size)


def test_the_xml_of_opencvs_interactive_calibration(tmp_path):
    storage = cv2.FileStorage(str(tmp_path / "c.xml"), cv2.FILE_STORAGE_WRITE)
    storage.write("calibrationDate", "Thu 07 Apr 2016 04:23:03 PM MSK")
    storage.write("framesCount", 21)
    storage.write("cameraMatrix", np.array(_matrix(900, 630, 370)))
    storage.write("cameraMatrix_std_dev", np.ones((4, 1)))
    storage.write("dist_coeffs", np.array([LENS]))
    storage.release()
    text = (tmp_path / "c.xml").read_text()  # Python's FileStorage cannot write a cv::Size
    size = "<cameraResolution>\n  1280 720</cameraResolution>\n</opencv_storage>"
    (tmp_path / "c.xml").write_text(text.replace("</opencv_storage>", size))
    camera = Camera.from_file(tmp_path / "c.xml")
    assert camera.intrinsics.tolist() == _matrix(900, 630, 370)
    assert (camera.distortion.tolist(), camera.image_size) == (LENS, (720, 1280))


def test_rectified_images_of_a2d2_have_a_matrix_of_their_own(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps(A2D2))
    camera = Camera.from_file(f"{tmp_path / 'c.json'}#front_center", rectified=True)
    assert camera.intrinsics.tolist() == A2D2_FRONT["CamMatrix"]
    assert not camera.distortion.any()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (A2D2, "expected one camera, got 2: front_center, rear_center; choose one as FILE#front_center"),
        ([{**NUIMAGES, "camera_distortion": [*LENS, 0.1]}], "distortion: expected 0 or 4 .*, got 6"),
        (
            {**LIKE_OPENLANE, "dist": LENS, "distortion": [0.1] * 5},
            "expected one of .* got both, which differ",
        ),
        (
            {**LIKE_OPENLANE, "distortion": LENS, "k1": 0.1},
            "expected one of k1, k2, ... and distortion, got both",
        ),
        ({"intrinsic": {"fx": 340}}, "fy: expected a value, got none"),
        (
            {"intrinsic": {"k1": 340, "model": "radial_poly"}},
            "height: expected a value, got none",
        ),
        (
            {**LIKE_OPENLANE, "dist_koeffs": LENS},
            "expected k1 .* under a known key, got 'dist_koeffs'; rename it",
        ),
        (
            {**LIKE_OPENLANE, "cam_dist_coefs": LENS},
            "expected k1 .* under a known key, got 'cam_dist_coefs'; rename it",
        ),
        ({**LIKE_OPENLANE, "k4": -0.3}, r"k4: expected no such coefficient of a pinhole lens, got -0.3"),
        ({**LIKE_OPENLANE, "k1": -0.3, "p1": 0.1, "model": "fisheye"}, "p1: expected no such coefficient"),
        (
            {**LIKE_OPENLANE, "radial_distortion": [0.1]},
            "under a known key, got 'radial_distortion'; rename it",
        ),
        (
            {**NERF, "camera_model": "EQUIRECTANGULAR"},
            "camera_model: expected one of OPENCV, .* 'EQUIRECTANGULAR'",
        ),
        (
            {**REALSENSE, "model": "Inverse Brown Conrady", "coeffs": LENS},
            "expected brown_conrady, or coeffs of zeros",
        ),
        ({**SHORT, "distortion": {**BY_NAME, "k9": 1}}, "expected k1, k2, p1, p2, k3, got the key 'k9'"),
        ({**SHORT, "k1": 0.1, "D": LENS}, "expected one of k1, k2, ... and D, got both"),
        ({**LIKE_OPENLANE, "distortion": LENS, "model": "ftheta"}, "model: expected one of .*, got 'ftheta'"),
    ],
)
def test_what_cannot_be_read_is_one_clear_line(tmp_path, content, message):
    (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        Camera.from_file(tmp_path / "c.json")


METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>{0}</projection>
  <width>1280</width>
  <height>720</height>
  <f>900</f>
  <cx>3.5</cx>
  <cy>-2.5</cy>
  <b1>2</b1>
  <k1>-0.3</k1>
  <k2>0.1</k2>
  <p1>0.002</p1>
  <p2>-0.001</p2>
  {1}
  <date>2024-01-01T00:00:00Z</date>
</calibration>"""


def test_metashapes_projection(tmp_path):
    """Agisoft Metashape, User Manual: u = w / 2 + cx + x' f + x' B1, the first pixel's centre at 0.5."""
    (tmp_path / "c.xml").write_text(METASHAPE.format("frame", "<k3>0.02</k3>"))
    camera = Camera.from_file(tmp_path / "c.xml")
    x, y = 0.4, -0.2
    r2 = x * x + y * y
    radial = 1 - 0.3 * r2 + 0.1 * r2**2 + 0.02 * r2**3
    distorted_x = x * radial + 0.002 * (r2 + 2 * x * x) + 2 * -0.001 * x * y
    distorted_y = y * radial - 0.001 * (r2 + 2 * y * y) + 2 * 0.002 * x * y
    expected = [639.5 + 3.5 + 902 * distorted_x, 359.5 - 2.5 + 900 * distorted_y]
    points = cv2.projectPoints(
        np.array([[x, y, 1.0]]),
        np.zeros(3),
        np.zeros(3),
        camera.intrinsics.numpy(),
        camera.distortion.numpy(),
    )[0]
    np.testing.assert_allclose(points.ravel(), expected, atol=1e-6)


@pytest.mark.parametrize(("kind", "more"), [("fisheye", ""), ("frame", "<k4>0.1</k4>")])
def test_what_opencv_does_not_have_of_metashapes_is_refused(tmp_path, kind, more):
    (tmp_path / "c.xml").write_text(METASHAPE.format(kind, more))
    with pytest.raises(
        ValueError, match=r"projection: expected frame with k1 k2 k3 p1 p2, got .* export it as"
    ):
        Camera.from_file(tmp_path / "c.xml")


def test_woodscapes_fisheye_is_the_nearest_kannala_brandt_lens(tmp_path):
    intrinsic = {
        "aspect_ratio": 1.0, "cx_offset": 3.9, "cy_offset": -3.1, "width": 1280.0, "height": 966.0,
        "k1": 339.7, "k2": -32.0, "k3": 48.3, "k4": -7.2, "model": "radial_poly", "poly_order": 4,
    }  # fmt: skip
    (tmp_path / "c.json").write_text(json.dumps({"intrinsic": intrinsic, "name": "FV"}))
    camera = Camera.from_file(tmp_path / "c.json")
    assert (camera.model, camera.image_size) == ("fisheye", (966, 1280))
    angles = np.radians([5.0, 30.0, 60.0, 80.0])
    rays = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)[None]
    points = cv2.fisheye.projectPoints(
        rays, np.zeros(3), np.zeros(3), camera.intrinsics.numpy(), camera.distortion.numpy()
    )[0]
    radius = 339.7 * angles - 32.0 * angles**2 + 48.3 * angles**3 - 7.2 * angles**4
    np.testing.assert_allclose(points[0, :, 0], 639.5 + 3.9 + radius, atol=0.5)
    np.testing.assert_allclose(points[0, :, 1], 482.5 - 3.1, atol=1e-6)


def test_rectified_images_of_a_lens_without_such_a_matrix_are_refused(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps([NUIMAGES]))
    with pytest.raises(ValueError, match="expected P for rectified images, got none"):
        Camera.from_file(tmp_path / "c.json", rectified=True)


@pytest.mark.parametrize(("matrix", "distortion"), [("mtx", "dist"), ("camera_matrix", "dist_coeff")])
def test_results_of_opencvs_python_tutorial_are_read_for_images_of_a_given_size(tmp_path, matrix, distortion):
    views = [np.zeros(2), np.zeros(3)]  # of two images, which an array has as objects
    content = {matrix: _matrix(900, 630, 370), distortion: [LENS]}
    np.savez(tmp_path / "c.npz", **content, rvecs=np.array(views, dtype=object))
    (tmp_path / "c.json").write_text(json.dumps({**content, "rvecs": []}))
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(content))
    expected = Camera.from_parameters(900, 902, 630, 370, 1280, 720, LENS)
    for name in ("c.npz", "c.json", "c.yaml"):
        camera = Camera.from_file(tmp_path / name, image_size=(720, 1280))
        assert torch.equal(camera.intrinsics, expected.intrinsics)
        assert torch.equal(camera.distortion, expected.distortion)
        assert camera.remark == "the file states no size of images; 1280 x 720 px are taken"
        with pytest.raises(ValueError, match="image_height: expected a value, got none; add the entry"):
            Camera.from_file(tmp_path / name)
        with pytest.raises(
            ValueError, match="got none, and the principal point 630, 370 is not in the middle"
        ):
            Camera.from_file(tmp_path / name, image_size=(1080, 1920))
    np.savez(tmp_path / "c.npz", **content, width=1280, height=720)
    camera = Camera.from_file(tmp_path / "c.npz", image_size=(1080, 1920))
    assert (camera.image_size, camera.remark) == ((720, 1280), "")


MVG = {
    "width": 1280,
    "height": 720,
    "focal_length": 900,
    "principal_point": [640, 360],
    "disto_K3": [-0.3, 0, 0],
}


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (json.dumps({**REALSENSE, "model": "brown_conrady", "distortion_coeffs": LENS}), "distortion_coeffs"),
        (json.dumps({**NERF, "distortion_params": LENS}), "distortion_params"),
        (json.dumps({"v2": {"projection_type": "brown", "focal": 1, "dist": LENS}}), "dist"),
        (
            json.dumps(
                {"sfm_data_version": "0.3", "intrinsics": [{"value": {"ptr_wrapper": {"data": MVG}}}]}
            ),
            "disto_K3",
        ),
        (METASHAPE.format("frame", "<K3>0.1</K3>"), "K3"),
        ("cam0: {camera_model: pinhole, intrinsics: [9, 9, 6, 4], D: [-0.3, 0.1, 0, 0]}", "D"),
        (
            "value0: {intrinsics: [{camera_type: pinhole, intrinsics: {k1: -0.3}}], resolution: [[12, 8]]}",
            "k1",
        ),
        (
            "{model_type: PINHOLE, image_width: 12, image_height: 8, projection_parameters: {fx: 9}, "
            "distortion_parameters: {k1: -0.3, k2: 0.1, p1: 0, p2: 0, k3: 0.05}}",
            "k3",
        ),
        ("cameras: [{camera: {type: pinhole, distorsion: {parameters: [-0.3]}}}]", "distorsion"),
        ("Camera1.fx: 9\nCamera1.fy: 9\nCamera1.cx: 6\nCamera1.cy: 4\nCamera.k1: -0.3\n", "k1"),
    ],
)
def test_a_lens_under_an_unknown_key_is_not_left_out(tmp_path, text, key):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ValueError, match=f"distortion: expected k1 .* known key, got '{key}'; rename it"):
        Camera.from_file(tmp_path / "c.yaml")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {**REALSENSE, "model": "brown_conrady"},
            "coeffs: expected the coefficients of 'brown_conrady', got n",
        ),
        ({**ZOD_FRONT, "distortion": None}, "distortion: expected the coefficients of a fisheye, got none"),
    ],
)
def test_a_lens_without_its_coefficients_is_no_ideal_one(tmp_path, content, message):
    (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        Camera.from_file(tmp_path / "c.json")
