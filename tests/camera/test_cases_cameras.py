"""Camera files as their own writers write them."""

import json

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lanebev import Camera
from tests.camera.files import assert_is, assert_same, read, written

LENS = Camera.from_parameters(812.5, 810.0, 641.25, 355.5, 1280, 720, [-0.31, 0.11, 0.0004, -0.0007, -0.017])
K, D = LENS.intrinsics.flatten().tolist(), LENS.distortion.tolist()
P = [700.0, 0.0, 630.0, -42.0, 0.0, 700.0, 360.0, 0.0, 0.0, 0.0, 1.0, 0.0]
TILTED = [0.8, -0.4, 0.0003, 0.0002, 0.05, 1.1, -0.35, 0.02, 4e-4, -1e-4, 2e-4, 1e-4, 0.004, -0.003]


def _message(**fields):
    """A ROS CameraInfo as ``rostopic echo`` prints it."""
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    message = {
        "header": {"seq": 1, "stamp": {"secs": 1, "nsecs": 2}, "frame_id": "front"},
        "height": 720, "width": 1280, "distortion_model": "plumb_bob", "D": D, "K": K,
        "R": [1.0, 0, 0, 0, 1, 0, 0, 0, 1], "P": P, "binning_x": 0, "binning_y": 0, "roi": roi,
    }  # fmt: skip
    return message | fields


@pytest.mark.parametrize("suffix", ["json", "yml", "xml", "yaml"])
def test_opencv_file_storage_of_every_format(tmp_path, suffix):
    path = tmp_path / f"c.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Fri 27 Nov")
    storage.write("image_width", 1280)
    storage.write("image_height", 720)
    storage.write("flags", 0)
    storage.write("camera_matrix", LENS.intrinsics.numpy())
    storage.write("distortion_coefficients", np.array(TILTED).reshape(14, 1))
    storage.write("avg_reprojection_error", 3e-05)
    storage.release()
    assert_is(Camera.from_file(path), 812.5, 810, 641.25, 355.5, 1280, 720, TILTED)


@pytest.mark.parametrize("suffix", ["json", "yml", "xml"])
def test_opencvs_omnidirectional_calibration(tmp_path, suffix):
    path = tmp_path / f"c.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("nFrames", 9)
    storage.write("image_width", 1280)
    storage.write("image_height", 720)
    storage.write("camera_matrix", LENS.intrinsics.numpy())
    storage.write("distortion_coefficients", np.array([[-0.1, 0.2, 0.001, -0.002]]))
    storage.write("xi", 1.3)
    storage.release()
    expected = Camera.from_parameters(
        812.5, 810, 641.25, 355.5, 1280, 720, [1.3, -0.1, 0.2, 0.001, -0.002], "omni"
    )
    assert_same(Camera.from_file(path), expected)
    expected.to_file(tmp_path / "own.yaml")
    assert_same(Camera.from_file(tmp_path / "own.yaml"), expected)


@pytest.mark.parametrize(
    "fields", [{"distortion_model": "", "D": []}, {"distortion_model": "plumb_bob", "D": []}]
)
def test_an_ideal_camera_with_an_empty_model(tmp_path, fields):
    ideal = Camera.from_parameters(812.5, 810, 641.25, 355.5, 1280, 720)
    assert_same(read(tmp_path / "c.yaml", _message(**fields)), ideal)
    empty = {"rows": 1, "cols": 0, "data": []}
    written = {
        "image_width": 1280, "image_height": 720, "camera_name": "front", "distortion_model": "",
        "camera_matrix": {"rows": 3, "cols": 3, "data": K}, "distortion_coefficients": empty,
    }  # fmt: skip
    assert_same(read(tmp_path / "d.yaml", written), ideal)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("name", ["c.yaml", "c.json", "c.xml", "calib.txt"])
def test_byte_order_marks(tmp_path, encoding, name):
    path = tmp_path / name
    if name == "calib.txt":
        text = "P2: 721.5377 0 609.5593 44.85728 0 721.5377 172.854 0.2163791 0 0 1 0.002745884\n"
        expected = Camera.from_parameters(721.5377, 721.5377, 609.5593, 172.854, 1242, 375)
    elif name == "c.yaml":
        LENS.to_file(path)
        text, expected = path.read_text(), LENS
    else:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", 1280)
        storage.write("image_height", 720)
        storage.write("camera_matrix", LENS.intrinsics.numpy())
        storage.write("distortion_coefficients", LENS.distortion.numpy())
        storage.release()
        text, expected = path.read_text(), LENS
    path.write_text(text, encoding=encoding)
    assert_same(Camera.from_file(path), expected)


@pytest.mark.parametrize("width", ["0640", "640", "640.0", "6.4e2", "'640'", "!!int 0640"])
def test_numbers_are_decimal_as_they_are_written(tmp_path, width):
    text = f"fx: 0500\nfy: 5e2\ncx: 320\ncy: 0240.5\nwidth: {width}\nheight: 0480\n"
    camera = read(tmp_path / "c.yaml", text)
    assert_is(camera, 500, 500, 320, 240.5, 640, 480)


@pytest.mark.parametrize("width", ["0x280", "0o1200", "10:40", "0b1010000000", "yes", "2024-01-01", "~"])
def test_numbers_of_other_bases_are_none(tmp_path, width):
    text = f"fx: 500\nfy: 500\ncx: 320\ncy: 240\nwidth: {width}\nheight: 480\n"
    with pytest.raises(ValueError, match=r"width: expected (finite numbers, got|a value, got none)"):
        read(tmp_path / "c.yaml", text)


@pytest.mark.parametrize(
    "box", [(0, 0, 720, 1280), (500, 0, 220, 400), (-30, 900, 300, 500), (40, 30, 48, 64)]
)
@pytest.mark.parametrize("distortion", [[], D, TILTED])
def test_cropped_cameras_that_were_written_are_read(tmp_path, box, distortion):
    whole = Camera.from_parameters(812.5, 810, 641.25, 355.5, 1280, 720, distortion)
    whole.cropped(*box).to_file(tmp_path / "c.yaml")
    assert_same(Camera.from_file(tmp_path / "c.yaml"), whole.cropped(*box))


def test_a_principal_point_outside_is_a_mistake_where_a_person_wrote_it(tmp_path):
    fields = {"fx": 500, "fy": 500, "cx": -20, "cy": 240, "width": 640, "height": 480}
    with pytest.raises(ValueError, match=r"cx: expected a principal point inside .* Camera\.cropped"):
        read(tmp_path / "c.yaml", fields)
    with pytest.raises(
        ValueError, match="cx: expected a principal point inside"
    ):  # R = I, but P is not [K | 0]
        read(tmp_path / "c.yaml", _message(width=600))


def test_ros_binning_and_region_of_interest_are_applied(tmp_path):
    binned = read(tmp_path / "c.yaml", _message(binning_x=2, binning_y=2))
    assert_same(binned, LENS.scaled((360, 640)))
    roi = {"x_offset": 200, "y_offset": 100, "height": 400, "width": 801, "do_rectify": True}
    cut = read(tmp_path / "c.yaml", _message(roi=roi))
    assert_same(cut, LENS.cropped(100, 200, 400, 801))
    both = read(tmp_path / "c.yaml", _message(roi=roi, binning_x=2, binning_y=4))
    assert_same(both, LENS.cropped(100, 200, 400, 800).scaled((100, 400)))
    ideal = read(tmp_path / "c.yaml", _message(roi=roi, binning_x=2), rectified=True)
    assert_same(
        ideal,
        Camera.from_parameters(700, 700, 630, 360, 1280, 720).cropped(100, 200, 400, 800).scaled((400, 400)),
    )
    assert_same(read(tmp_path / "c.yaml", _message(binning_x=1, binning_y=1)), LENS)


def test_a_region_of_interest_may_leave_out_the_principal_point(tmp_path):
    for roi in ({"width": 600, "height": 700}, {"y_offset": 400}):
        cut = read(tmp_path / "c.yaml", _message(roi=roi))
        expected = LENS.cropped(roi.get("y_offset", 0), 0, roi.get("height", 320), roi.get("width", 1280))
        assert_same(cut, expected)
    with pytest.raises(ValueError, match="cx: expected a principal point inside the image, 0 to 1280"):
        read(tmp_path / "c.yaml", _message(K=[812.5, 0, 1300, 0, 810, 355, 0, 0, 1]))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"binning_x": 0.5}, "binning_x: expected whole pixels, got 0.5"),
        ({"binning_y": -2}, "binning_y: expected 0 to 64, got -2"),
        (
            {"roi": {"x_offset": 1000, "width": 400}},
            "roi: expected a part of the 1280 x 720 px, got 400 x 720",
        ),
        ({"roi": {"x_offset": 2000}}, "roi: expected a part"),
        ({"roi": {"y_offset": -1}}, "roi: expected a part"),
        ({"roi": [1, 2]}, "roi: expected x_offset, .* got a list; if it is OpenCV's, .* leave it out"),
        ({"distortion_model": "inverse_brown_conrady"}, "model: expected one of pinhole, plumb_bob"),
        (
            {"K": [0.0, 0, 320, 0, 0, 240, 0, 0, 1], "R": np.eye(3).tolist()},
            "camera matrix: expected focal lengths, got zeros, by which ROS marks",
        ),
        ({"K": [0.0] * 9}, "camera matrix: expected focal lengths, got zeros, by which ROS marks"),
    ],
)
def test_impossible_messages_are_one_clear_line(tmp_path, fields, message):
    with pytest.raises(ValueError, match=message) as error:
        read(tmp_path / "c.yaml", _message(**fields))
    assert "\n" not in str(error.value)


def test_rectified_images_have_the_projection_matrix_and_no_lens(tmp_path):
    path = written(tmp_path / "c.yaml", _message())
    assert_is(Camera.from_file(path, rectified=True), 700, 700, 630, 360, 1280, 720)
    assert_same(Camera.from_file(path), LENS)
    LENS.to_file(tmp_path / "own.yaml")
    ideal = Camera.from_parameters(812.5, 810, 641.25, 355.5, 1280, 720)
    assert_same(Camera.from_file(tmp_path / "own.yaml", rectified=True), ideal)
    message = _message()
    del message["P"]
    short = {"fx": 500, "fy": 500, "cx": 320, "cy": 240, "width": 640, "height": 480}
    for fields in (
        message,
        {**short, "distortion": D},
        {**short, "distortion": [0.0] * 4, "model": "fisheye"},
    ):
        with pytest.raises(ValueError, match="projection_matrix: expected P for rectified images, got none"):
            read(tmp_path / "c.yaml", fields, rectified=True)
    expected = Camera.from_parameters(500, 500, 320, 240, 640, 480)
    assert_same(read(tmp_path / "c.yaml", short, rectified=True), expected)


FISHEYE = [0.01, 0.02, -0.01, 0.0]
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: {0}
  distortion_coeffs: {1}
  distortion_model: {2}
  intrinsics: {3}
  resolution: [1280, 720]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0, 0, 0, 0]
  distortion_model: radtan
  intrinsics: [1, 1, 1, 1]
  resolution: [2, 2]
"""


@pytest.mark.parametrize(
    ("model", "coefficients", "distortion", "intrinsics", "expected"),
    [
        ("pinhole", D[:4], "radtan", [812.5, 810.0, 641.25, 355.5], (D[:4], "pinhole")),
        ("pinhole", FISHEYE, "equi", [812.5, 810.0, 641.25, 355.5], (FISHEYE, "fisheye")),
        ("omni", D[:4], "radtan", [1.9, 812.5, 810.0, 641.25, 355.5], ([1.9, *D[:4]], "omni")),
        ("pinhole", [], "none", [812.5, 810.0, 641.25, 355.5], ([], "pinhole")),
        ("omni", [], "none", [1.9, 812.5, 810.0, 641.25, 355.5], ([1.9, 0, 0, 0, 0], "omni")),
    ],
)  # fmt: skip
def test_kalibrs_camera_chain(tmp_path, model, coefficients, distortion, intrinsics, expected):
    path = written(tmp_path / "camchain.yaml", KALIBR.format(model, coefficients, distortion, intrinsics))
    assert_is(Camera.from_file(path), 812.5, 810, 641.25, 355.5, 1280, 720, *expected)


@pytest.mark.parametrize("name", ["radial-tangential", "equidistant"])
def test_eurocs_sensor_yaml(tmp_path, name):
    text = f"""# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: {name}
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
    model = "pinhole" if name == "radial-tangential" else "fisheye"
    distortion = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
    expected = Camera.from_parameters(458.654, 457.296, 367.215, 248.375, 752, 480, distortion, model)
    assert_same(read(tmp_path / "sensor.yaml", text), expected)


CAMODOCAL = """%YAML:1.0
---
model_type: {0}
camera_name: image_02
image_width: 1400
image_height: 1400
"""
MEI = """mirror_parameters:
   xi: 2.2
distortion_parameters:
   k1: 0.016
   k2: 1.65
   p1: 0.0004
   p2: -0.0003
projection_parameters:
   gamma1: 1336.3
   gamma2: 1335.8
   u0: 716.9
   v0: 705.7
"""
KANNALA = """projection_parameters:
   k2: 0.01
   k3: -0.02
   k4: 0.003
   k5: 0.0
   mu: 600.0
   mv: 601.0
   u0: 716.9
   v0: 705.7
"""


def test_camodocals_cameras(tmp_path):
    path = written(tmp_path / "image_02.yaml", CAMODOCAL.format("MEI") + MEI)
    expected = [2.2, 0.016, 1.65, 0.0004, -0.0003]
    assert_same(
        Camera.from_file(path),
        Camera.from_parameters(1336.3, 1335.8, 716.9, 705.7, 1400, 1400, expected, "mei"),
    )
    path = written(tmp_path / "a.yaml", CAMODOCAL.format("KANNALA_BRANDT") + KANNALA)
    expected = Camera.from_parameters(
        600, 601, 716.9, 705.7, 1400, 1400, [0.01, -0.02, 0.003, 0.0], "fisheye"
    )
    assert_same(Camera.from_file(path), expected)
    pinhole = MEI[MEI.index("distortion") :].replace("gamma1", "fx").replace("gamma2", "fy")
    pinhole = pinhole.replace("u0", "cx").replace("v0", "cy")
    path = written(tmp_path / "a.yaml", CAMODOCAL.format("PINHOLE") + pinhole)
    expected = [0.016, 1.65, 0.0004, -0.0003]
    assert_is(Camera.from_file(path), 1336.3, 1335.8, 716.9, 705.7, 1400, 1400, expected)
    with pytest.raises(
        ValueError, match="model_type: expected PINHOLE, KANNALA_BRANDT or MEI, got 'SCARAMUZZA'"
    ):
        read(path, CAMODOCAL.format("SCARAMUZZA") + MEI)


def test_nuscenes_and_openlane_json(tmp_path):
    matrix = [[1266.4, 0.0, 816.3], [0.0, 1266.4, 491.5], [0.0, 0.0, 1.0]]
    record = {"token": "a", "sensor_token": "b", "translation": [1, 2, 3], "rotation": [1, 0, 0, 0]}
    path = tmp_path / "calibrated_sensor.json"
    expected = Camera.from_parameters(1266.4, 1266.4, 816.3, 491.5, 1600, 900)
    lidar = {**record, "camera_intrinsic": []}
    for content in ({**record, "camera_intrinsic": matrix}, [lidar, {**record, "camera_intrinsic": matrix}]):
        path.write_text(json.dumps(content))
        assert_same(Camera.from_file(path), expected)
        assert_same(Camera.from_file(path, image_size=(900, 1600)), expected)
    with pytest.raises(ValueError, match="expected images of about 1600 x 900 px, nuScenes', got 800 x 450"):
        Camera.from_file(path, image_size=(450, 800))
    with pytest.raises(ValueError, match="nuScenes', got 1920 x 1080"):
        Camera.from_file(path, image_size=(1080, 1920))
    for width, height in ((640, 360), (1920, 1080), (1280, 960)):  # another program's
        own = [[500.0, 0.0, 0.51 * width], [0.0, 500.0, 0.49 * height], [0.0, 0.0, 1.0]]
        path.write_text(json.dumps([{**record, "camera_intrinsic": own}]))
        expected = Camera.from_parameters(500.0, 500.0, 0.51 * width, 0.49 * height, width, height)
        assert_same(Camera.from_file(path, image_size=(height, width)), expected)
        with pytest.raises(ValueError, match="expected images of about 1600 x 900"):
            Camera.from_file(path, image_size=(height // 2, width // 2))
    other = [[1200.0, 0.0, 800.0], *matrix[1:]]
    path.write_text(json.dumps([{**record, "camera_intrinsic": each} for each in (matrix, other)]))
    with pytest.raises(ValueError, match=r"expected one camera, got 2: 0, 1; choose one as FILE#0$"):
        Camera.from_file(path)
    path.write_text(
        json.dumps({"intrinsic": [[2059, 0, 935.1], [0, 2059, 635], [0, 0, 1]], "lane_lines": []})
    )
    assert_is(Camera.from_file(path), 2059, 2059, 935.1, 635, 1920, 1280)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("c.json", "[]", "camera_intrinsic: expected a camera with this key"),
        ("c.json", '{"a": 1, "a": 2}', "expected each key once, got 'a' twice"),
        ("c.json", '{"image_width": 1280, "image_height"', "syntax error at line 1; is the file cut"),
        (
            "c.json",
            '{"image_width": true, "image_height": 3}',
            "image_width: expected finite numbers, got True",
        ),
        ("c.xml", "<a><b>1</b><b>2</b></a>", "expected each key once, got 'b' twice"),
        ("c.yaml", "cam0: 3", "cam0: expected keys and values, got '3'"),
        ("c.yaml", "intrinsics: [1, 2]\ncamera_model: dsx", "camera_model: expected one of pinhole-none"),
        (
            "c.yaml",
            "intrinsics: [1, 2, 3, 4]\nresolution: [5, 6]",
            "camera_model: expected a value, got none",
        ),
        ("c.xml", "<!--\n[note]\n-->\n<a><b>1</b><b>2</b></a>", "expected each key once, got 'b' twice"),
        ("c.yaml", "? [1, 2]\n: 3\n", "expected plain keys"),
        ("c.yaml", "x: &x [*x]", "expected YAML, got a syntax error|unknown key"),
        ("c.yaml", "fx: 1\n" * 200_000, "characters of YAML"),
    ],
)
def test_malformed_files_are_one_clear_line(tmp_path, name, text, message):
    with pytest.raises(ValueError, match=message) as error:
        read(tmp_path / name, text)
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)


def test_files_that_unfold_to_endless_ones_are_refused_at_once(tmp_path):
    bomb = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True):
        bomb += f"{name}: &{name} [{', '.join(['*' + before] * 9)}]\n"
    with pytest.raises(ValueError, match="unknown key 'a'"):
        read(tmp_path / "c.yaml", bomb)
    wide = (
        "header: &a ["
        + "1, " * 2000
        + "1]\nimage_width: 640\nimage_height: 480\nK: ["
        + "*a, " * 2000
        + "*a]\n"
    )
    with pytest.raises(ValueError, match="camera_matrix: expected a few numbers, got more than 1000"):
        read(tmp_path / "c.yaml", wide)


lengths = st.sampled_from([("pinhole", n) for n in (0, 4, 5, 8, 12, 14)] + [("fisheye", 4), ("omni", 5)])


@settings(max_examples=60, deadline=None)
@given(
    lengths,
    st.floats(200, 3000),
    st.floats(0.8, 1.2),
    st.tuples(st.floats(-300, 2000), st.floats(-300, 2000)),
    st.tuples(st.integers(1, 3000), st.integers(1, 3000)),
    st.lists(st.floats(-0.05, 0.05), min_size=14, max_size=14),
)
def test_every_camera_that_we_write_we_read(
    tmp_path_factory, lens, focal, aspect, centre, size, coefficients
):
    model, count = lens
    distortion = [abs(coefficients[0]), *coefficients[1:5]] if model == "omni" else coefficients[:count]
    camera = Camera.from_parameters(focal, focal * aspect, *centre, *size, distortion, model)
    path = tmp_path_factory.mktemp("c") / "camera.yaml"
    camera.to_file(path)
    again = Camera.from_file(path)
    assert again.fingerprint() == camera.fingerprint()
    torch.testing.assert_close(again.intrinsics, camera.intrinsics, rtol=0, atol=0)
    assert Camera.from_file(path, rectified=True).distortion.numel() == 0


def test_a_run_on_rectified_images(tmp_path):
    from PIL import Image

    from lanebev.app.config import RunConfig
    from lanebev.app.run import run

    Image.fromarray(np.zeros((72, 128, 3), np.uint8)).save(tmp_path / "0.png")
    camera = _message(width=128, height=72, K=(np.array(K) / 10).tolist(), P=(np.array(P) / 10).tolist())
    camera["K"][8] = camera["P"][10] = 1.0
    (tmp_path / "0.lines.txt").write_text("")
    paths = {"source": "[0].png", "camera": "c.yaml", "lanes": "0.lines.txt", "out": "out"}
    written(tmp_path / "c.yaml", camera)
    report = run(RunConfig(**{key: str(tmp_path / name) for key, name in paths.items()}, rectified=True))
    assert report.facts["camera"].endswith("pinhole, f = 70.0 / 70.0 px")
    again = Camera.from_file(tmp_path / "out" / "calibration.yaml")
    assert_is(again, 70, 70, 63, 36, 128, 72)
