"""Camera files as more programs write them, each after a public report, and what only looks like one."""

import json
import pickle
import struct

import cv2
import numpy as np
import pytest
import torch
import yaml

from lanebev import Camera
from tests.camera.files import assert_is, read

# what ROS melodic's camera_calibration writes (image_pipeline#682)
OST = """image_width: 1640
image_height: 1232
camera_name: csi_cam_0
camera_matrix:
  rows: 3
  cols: 3
  data: [ 403.97646,   -0.96635,  871.2187 ,
            0.     ,  404.70652,  597.37327,
            0.     ,    0.     ,    1.     ]
camera_model: fisheye
distortion_coefficients:
  rows: 1
  cols: 4
  data: [0.175653, -0.031772, 0.000362, -0.000719]
"""
MODEL = "camera_model: fisheye"
COLMAP = {  # numbers of its models
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
    "FOV": 7,
    "SIMPLE_RADIAL_FISHEYE": 8,
    "RADIAL_FISHEYE": 9,
}
MATRIX = [[633.0, 0, 408.0], [0, 633.0, 245.0], [0, 0, 1]]


@pytest.mark.parametrize(
    ("line", "model"),
    [
        (MODEL, "fisheye"),
        ("camera_model: plumb_bob", "pinhole"),
        ("distortion_model: EQUIDISTANT", "fisheye"),
        ("distortion_model: equi", "fisheye"),  # Kalibr's
        ("distortion_model: radtan", "pinhole"),
        ("distortion_model: Plumb Bob", "pinhole"),
        ("distortion_model: radial-tangential", "pinhole"),
        ("distortion_model: brown_conrady", "pinhole"),  # realsense-ros
        ("camera_model: OPENCV_FISHEYE", "fisheye"),
        ("distortion_model: kannala_brandt4", "fisheye"),
        ("distortion_model: kb4", "fisheye"),
        ("distortion_model: pinhole-equi", "fisheye"),
        ("distortion_model: equidistant\nmodel: GoPro", "fisheye"),  # a product's name
        ("fisheye_model: 1", "fisheye"),
        ("fisheye_model: true", "fisheye"),  # booleans of OpenCV 5
        ("fisheye_model: 0", "pinhole"),
        ("fisheye_model: false", "pinhole"),
    ],
)
def test_the_lens_has_the_model_that_the_file_names(tmp_path, line, model):
    camera = read(tmp_path / "ost.yaml", OST.replace(MODEL, line))
    assert camera.model == model
    assert camera.intrinsics[0, 1] == -0.96635  # skew


@pytest.mark.parametrize("name", ["none", "None", "no_distortion"])
def test_a_camera_may_state_that_it_has_no_lens(tmp_path, name):
    zeros = OST.replace("[0.175653, -0.031772, 0.000362, -0.000719]", "[0, 0, 0, 0]")
    camera = read(tmp_path / "c.yaml", zeros.replace(MODEL, f"distortion_model: {name}"))
    assert (camera.model, camera.distortion.tolist()) == ("pinhole", [])
    with pytest.raises(ValueError, match="model: expected the lens model of the coefficients, got none"):
        read(tmp_path / "c.yaml", OST.replace(MODEL, f"distortion_model: {name}"))


def test_skew_moves_pixels_as_opencv_moves_them(tmp_path):
    camera = read(tmp_path / "ost.yaml", OST)
    rays = torch.tensor([[0.1, 0.3], [-0.5, 0.2], [0.4, -0.4]], dtype=torch.float64)
    ideal = rays @ camera.intrinsics[:2, :2].mT + camera.intrinsics[:2, 2]
    given = (camera.intrinsics.numpy(), camera.distortion.numpy())
    seen = cv2.fisheye.distortPoints(rays[None].numpy(), *given, alpha=-0.96635 / 403.97646)[0]
    torch.testing.assert_close(camera.distort_points(ideal), torch.from_numpy(seen), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("\n", "\r\n"),
        ("1640", "1640\t"),
        ("1640", "1640\t# px"),
        ("rows: 3", "rows:\t3"),
        (",   -0.9", ",\t-0.9"),
        ("csi", "Stra\u00dfe"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_ends_of_lines_tabs_between_words_and_foreign_letters(tmp_path, old, new, encoding):
    plain = read(tmp_path / "c.yaml", OST)
    changed = read(tmp_path / "d.yaml", OST.replace(old, new).encode(encoding))
    assert changed.fingerprint() == plain.fingerprint()


def test_spaces_of_web_pages(tmp_path):
    copied = read(tmp_path / "c.yaml", OST.replace(": ", ":\u00a0"))
    assert copied.fingerprint() == read(tmp_path / "c.yaml", OST).fingerprint()


def test_rows_that_are_indented_by_tabs_are_one_clear_line(tmp_path):
    with pytest.raises(ValueError, match=r"expected YAML, got a tab at line 5; indent by spaces$"):
        read(tmp_path / "c.yaml", OST.replace("\n  ", "\n\t"))


def test_foxglove_prints_a_cameras_message(tmp_path):
    fields = {"timestamp": {"sec": 1, "nsec": 2}, "frame_id": "front", "width": 1280, "height": 720}
    fields |= {"distortion_model": "plumb_bob", "D": [-0.3, 0.1, 0, 0, 0], "R": [], "P": []}
    camera = read(tmp_path / "c.json", {**fields, "K": [800, 0, 640, 0, 801, 360, 0, 0, 1]})
    assert_is(camera, 800, 801, 640, 360, 1280, 720, [-0.3, 0.1, 0, 0, 0])


INI = """# oST version 5.0 parameters


[image]

width
640

height
480

[mono_left]

camera matrix
369.344588 0.000000 320.739078
0.000000 367.154330 203.592450
0.000000 0.000000 1.000000

distortion
0.189544 -0.018229 -0.000630 0.000054 -0.000212

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000

projection
262.9 0.0 320.9 0.0
0.0 302.1 188.5 0.0
0.0 0.0 1.0 0.0
"""


@pytest.mark.parametrize("name", ["ost.txt", "left.ini"])
def test_ros_ini(tmp_path, name):  # image_common#33
    distortion = [0.189544, -0.018229, -0.000630, 0.000054, -0.000212]
    assert_is(read(tmp_path / name, INI), 369.344588, 367.15433, 320.739078, 203.59245, 640, 480, distortion)
    assert_is(read(tmp_path / name, INI, rectified=True), 262.9, 302.1, 320.9, 188.5, 640, 480)
    with pytest.raises(ValueError, match="camera_matrix: expected 9 numbers, got 6"):
        read(tmp_path / name, INI.replace("0.000000 0.000000 1.000000\n\ndist", "\ndist"))
    with pytest.raises(ValueError, match="expected each key once, got 'camera_matrix' twice"):
        read(tmp_path / name, INI + INI[INI.index("[mono") :])


P = "7.2e+02 0 6.09e+02 4.4e+01 0 7.2e+02 1.7e+02 2.1e-01 0 0 1 2.7e-03"


@pytest.mark.parametrize("name", ["0001.txt", "calib", "calib.TXT"])
@pytest.mark.parametrize(
    "text",
    [f"P0: {P}\nP2: {P}\nR_rect 9.9e-01 1\nTr_velo_cam 7.5\n\n", f"  P2 :\t{P}\r\n", f"P_rect_00: {P}\n"],
)
def test_kittis_files_by_any_name(tmp_path, name, text):
    camera = read(tmp_path / name, text, image_size=(375, 1242))
    assert_is(camera, 720, 720, 609, 170, 1242, 375)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("SIMPLE_PINHOLE 1280 720 800 640 360", ([], "pinhole", 800)),
        ("PINHOLE 1280 720 800 801 640 360", ([], "pinhole", 801)),
        ("RADIAL 1280 720 800 640 360 -0.3 0.1", ([-0.3, 0.1, 0, 0, 0, 0, 0, 0], "pinhole", 800)),
        (
            "OPENCV 1280 720 800 801 640 360 -0.3 0.1 1e-3 -2e-3",
            ([-0.3, 0.1, 1e-3, -2e-3, 0, 0, 0, 0], "pinhole", 801),
        ),
        (
            "FULL_OPENCV 1280 720 800 801 640 360 .1 .2 1e-3 0 .03 .04 .05 .06",
            ([0.1, 0.2, 1e-3, 0, 0.03, 0.04, 0.05, 0.06], "pinhole", 801),
        ),
        (
            "OPENCV_FISHEYE 1280 720 800 801 640 360 .1 .01 0 0",
            ([0.1, 0.01, 0, 0], "fisheye", 801),
        ),
        ("SIMPLE_RADIAL_FISHEYE 1280 720 800 640 360 .1", ([0.1, 0, 0, 0], "fisheye", 800)),
        ("RADIAL_FISHEYE 1280 720 800 640 360 .1 .01", ([0.1, 0.01, 0, 0], "fisheye", 800)),
    ],
)
def test_colmaps_pixels_begin_at_their_corner(tmp_path, line, expected):  # colmap#2587
    distortion, model, fy = expected
    text = f"# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL\n1 {line}\n"
    camera = read(tmp_path / "cameras.txt", text)
    assert_is(camera, 800, fy, 639.5, 359.5, 1280, 720, distortion, model)
    name, *sides, values = line.split(maxsplit=3)
    values = [float(value) for value in values.split()]
    data = struct.pack(f"<QiiQQ{len(values)}d", 1, 1, COLMAP[name], *map(int, sides), *values)
    assert_is(read(tmp_path / "cameras.bin", data), 800, fy, 639.5, 359.5, 1280, 720, distortion, model)
    for cut in (data[:-8], data[:40], data[:8], data + b"1"):
        with pytest.raises(ValueError, match=r"got: a cameras\.bin of COLMAP that is cut, or"):
            read(tmp_path / "cameras.bin", cut)


ORB_SLAM = """%YAML:1.0

#--------------------------------------------------------------------------------------------
Camera.type: "{0}"

Camera{1}.fx: 458.654
Camera{1}.fy: 457.296
Camera{1}.cx: 367.215
Camera{1}.cy: 248.375

Camera{1}.k1: -0.28340811
Camera{1}.k2: 0.07395907
{2}
Camera.width: 752
Camera.height: 480
Camera.fps: 20.0
ORBextractor.nFeatures: 1200
"""


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "cameras.txt",
            "1 PINHOLE 9 9 1 1 1 1\n2 PINHOLE 9 9 2 2 1 1\n",
            "one camera, got 2: 1, 2;",
        ),
        (
            "cameras.txt",
            "1 THIN_PRISM_FISHEYE 1280 720 1 1 1 1 1\n",
            "model: expected one of SIMPLE_PINHOLE, .*, got THIN_PRISM_FISHEYE",
        ),
        ("cameras.txt", "1 PINHOLE 1280 720 800 800 640\n", "PINHOLE: expected 4 numbers, got 3"),
        ("calib_velo_to_cam.txt", "R: 7.5 1\nT: 1 2 3\n", "expected P_rect_02 or P2 .*, got 'R:'"),
        (
            "SN1.conf",
            "[LEFT_CAM_HD]\nfx=700.1\nk1=-0.17\n",
            r"got the section \[LEFT_CAM_HD\], as of INI or TOML",
        ),
        ("k.txt", "1000 0 640\n0 1000 360\n", "of KITTI, or keys such as fx: 1150, got '1000'"),
        (
            "c.yaml",
            "fx: 500\n".encode("utf-16-le").decode(),
            "got: not a text file, or one in UTF-16 without a byte order mark; save it as UTF-8",
        ),
        (  # ORB_SLAM2#583
            "c.yaml",
            "%YAML:1.0\n---\nimage_width:1280\nimage_height:720\ncamera_matrix: !!opencv-matrix\n rows: 3\n",
            "expected a space after each colon, got image_width:1280$",
        ),
        (
            "c.npz",
            "PK\x03\x04" + 20 * "K.npy\0",
            "got: no arrays of numbers as by numpy.save or savez: File is not a zip",
        ),
        (
            "c.yaml",
            ORB_SLAM.format("PinHole", "", "Camera.k3: 0.1\nCamera.k4: 0.2"),
            "Camera.k4: expected no k4 of PinHole, got it; is Camera.type: KannalaBrandt8 missing",
        ),
        (
            "c.yaml",
            "{camera_model: pinhole, intrinsics: [800, 800, 640, 360], resolution: [1280, 720], "
            "distortion_coeffs: [-0.3, 0.1, 0, 0]}",
            "distortion_model: expected the lens model of distortion_coeffs, got none",
        ),
        (
            "c.json",
            json.dumps({"camera_intrinsic": MATRIX}),
            "got a principal point of 408, 245; add width and",
        ),
        (
            "c.json",
            json.dumps({"intrinsic": MATRIX}),
            "expected a camera of 1920 x 1280 px, OpenLane's, got a",
        ),
        (
            "c.yaml",
            "fx: 1150, fy: 1150",
            "expected a key a line, or all of them in braces, got more at line 1",
        ),
        ("c.json", json.dumps({"intrinsic": {"fx": 1, "u0": 2}}), "fy: expected a value, got none"),
        ("c.mat", b"\x89HDF\r\n\x1a\n" + bytes(99), "got: HDF5, as of MATLAB 7.3 and h5py; save it as JSON"),
        (
            "c.json",
            json.dumps({"K": np.array(MATRIX).T.tolist(), "D": [], "width": 800, "height": 450}),
            r"camera matrix: expected \[fx s cx; 0 fy cy; 0 0 1\], got its transpose",
        ),
    ],
)
def test_what_is_no_camera_is_one_clear_line(tmp_path, name, text, message):
    with pytest.raises(ValueError, match=message) as error:
        read(tmp_path / name, text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("key", ["camera_intrinsic", "intrinsic"])
def test_a_data_sets_format_with_other_images(tmp_path, key):
    stated = json.dumps({key: MATRIX, "width": 800, "height": 450})
    assert_is(read(tmp_path / "c.json", stated, image_size=(900, 1600)), 633, 633, 408, 245, 800, 450)
    assert_is(
        read(tmp_path / "c.json", {key: MATRIX}, image_size=(450, 800)),
        633,
        633,
        408,
        245,
        800,
        450,
    )


def test_a_matrix_of_the_binned_images_is_refused(tmp_path):  # avt_vimba_camera#82
    fields = {"height": 1544, "width": 2064, "distortion_model": "plumb_bob", "D": [-0.09, 0.08, 0, 0, 0]}
    fields |= {"binning_x": 4, "binning_y": 4}
    matrix = [299.54396, 0.0, 254.14465, 0.0, 300.14093, 183.94307, 0.0, 0.0, 1.0]
    message = (
        "camera_matrix: expected one for the full 2064 x 1544 px, got .* if the matrix is for these, write w"
    )
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "c.json", {**fields, "K": matrix})
    with pytest.raises(ValueError, match=message):
        read(
            tmp_path / "c.json",
            json.dumps({**fields, "P": [*matrix[:3], 0, *matrix[3:6], 0, 0, 0, 1, 0]}),
            rectified=True,
        )
    full = [4 * matrix[0], 0, 4 * matrix[2], 0, 4 * matrix[4], 4 * matrix[5], 0, 0, 1]
    assert read(tmp_path / "c.json", {**fields, "K": full}).image_size == (386, 516)


@pytest.mark.parametrize("rectified", [False, True])
def test_kittis_camera_of_resized_images_is_refused(tmp_path, rectified):
    text = "P2: 800 0 700 0 0 800 250 0 0 0 1 0\n"  # of no known recording day
    assert_is(
        read(tmp_path / "c.txt", text, image_size=(500, 1400), rectified=rectified),
        800,
        800,
        700,
        250,
        1400,
        500,
    )
    with pytest.raises(
        ValueError, match="P2: expected a camera of the images' 700 x 250 px, got a principal"
    ):
        read(tmp_path / "c.txt", text, image_size=(250, 700), rectified=rectified)


def test_rectified_images_have_no_lens_of_colmaps(tmp_path):
    with pytest.raises(ValueError, match="projection_matrix: expected P for rectified images, got none"):
        read(tmp_path / "cameras.txt", "1 RADIAL 1280 720 800 640 360 -0.3 0.1\n", rectified=True)
    camera = read(tmp_path / "cameras.txt", "1 SIMPLE_PINHOLE 1280 720 800 640 360\n", rectified=True)
    assert_is(camera, 800, 800, 639.5, 359.5, 1280, 720)


@pytest.mark.parametrize("of", ["", "1"])
@pytest.mark.parametrize(
    ("kind", "more", "expected"),
    [
        (
            "PinHole",
            "Camera{0}.p1: 1e-4\nCamera{0}.p2: 2e-5",
            ([-0.28340811, 0.07395907, 1e-4, 2e-5, 0], "pinhole"),
        ),
        (
            "KannalaBrandt8",
            "Camera{0}.k3: 0.1\nCamera{0}.k4: 0.2",
            ([-0.28340811, 0.07395907, 0.1, 0.2], "fisheye"),
        ),
        ("Rectified", "", ([], "pinhole")),
    ],
)
def test_orb_slams_settings(tmp_path, of, kind, more, expected):  # ORB_SLAM3#493
    camera = read(tmp_path / "c.yaml", ORB_SLAM.format(kind, of, more.format(of)))
    assert_is(camera, 458.654, 457.296, 367.215, 248.375, 752, 480, *expected)
    with pytest.raises(ValueError, match=r"Camera\.type: expected one of pinhole, .*, fisheye, got 'Omni'"):
        read(tmp_path / "c.yaml", ORB_SLAM.format("Omni", of, ""))
    with pytest.raises(ValueError, match=r"Camera\.height: expected a value, got none"):
        read(tmp_path / "c.yaml", ORB_SLAM.format(kind, of, "").replace("Camera.height", "Camera.high"))


BASALT = {
    "value0": {
        "intrinsics": [
            {
                "camera_type": "kb4",
                "intrinsics": {
                    **{"fx": 350, "fy": 351, "cx": 366, "cy": 249},
                    **{"k1": 0.01, "k2": -0.02, "k3": 0.003, "k4": 0.0},
                },
            },
            {"camera_type": "pinhole", "intrinsics": {"fx": 450, "fy": 451, "cx": 370, "cy": 250}},
        ],
        "resolution": [[752, 480], [752, 480]],
    }
}
MAPLAB = """label: "Euroc dataset - original intrinsics"
cameras:
- camera:
    label: cam0
    line-delay-nanoseconds: 0
    image_height: 480
    image_width: 752
    type: pinhole
    intrinsics:
      cols: 1
      rows: 4
      data: [458.654, 457.296, 367.215, 248.375]
    distortion:
      type: radial-tangential
      parameters:
        cols: 1
        rows: 4
        data: [-0.28, 0.07, 0.0002, 0.00002]
  T_B_C:
    cols: 4
    rows: 4
    data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
"""


def test_calibrations_of_basalt_and_maplab(tmp_path):  # maplab#4
    camera = read(tmp_path / "c.yaml", MAPLAB)
    assert_is(camera, 458.654, 457.296, 367.215, 248.375, 752, 480, [-0.28, 0.07, 0.0002, 0.00002])
    (tmp_path / "calibration.json").write_text(json.dumps(BASALT))
    first = Camera.from_file(f"{tmp_path / 'calibration.json'}#cam0")
    assert_is(first, 350, 351, 366, 249, 752, 480, [0.01, -0.02, 0.003, 0.0], "fisheye")
    second = Camera.from_file(f"{tmp_path / 'calibration.json'}#cam1")
    assert_is(second, 450, 451, 370, 250, 752, 480)
    sphere = {"fx": 349.7, "fy": 348.7, "cx": 365.8, "cy": 249.3, "xi": -0.28, "alpha": 0.57}
    kalibr = {"cam0": {"camera_model": "ds", "distortion_model": "none", "resolution": [752, 480]}}
    kalibr["cam0"]["intrinsics"] = [-0.28, 0.57, 349.7, 348.7, 365.8, 249.3]
    basalt = {"intrinsics": [{"camera_type": "ds", "intrinsics": sphere}], "resolution": [[752, 480]]}
    one, other = (read(tmp_path / "c.json", each) for each in ({"value0": basalt}, kalibr))
    assert one.fingerprint() == other.fingerprint()
    lens = [-0.3, 0.1, 0.001, 0.002, 0.01, 0.02, 0.03, 0.04]
    named = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), lens, strict=True))
    rational = {"camera_type": "pinhole-radtan8", "intrinsics": {**sphere, **named, "rpmax": 2.7}}
    rational = {"intrinsics": [rational], "resolution": [[752, 480]]}
    camera = read(tmp_path / "c.json", {"value0": rational})
    assert_is(camera, 349.7, 348.7, 365.8, 249.3, 752, 480, lens)
    basalt["intrinsics"][0]["camera_type"] = "ftheta"
    with pytest.raises(ValueError, match=r"camera_type: expected one of ds, eucm, pinhole, .*, got 'ftheta'"):
        read(tmp_path / "c.json", {"value0": basalt})
    with pytest.raises(ValueError, match="resolution: expected the image size of each camera, got none"):
        read(tmp_path / "c.json", json.dumps({"value0": {**basalt, "resolution": None}}))


MESSAGE = (
    "{K: [500, 0, 320, 0, 500, 240, 0, 0, 1], width: 640, height: 480, distortion_model: equidistant, D: %s}"
)


def test_a_fisheye_may_have_zeros_after_its_coefficients(tmp_path):
    parameters = (500, 500, 320, 240, 640, 480)
    assert_is(
        read(tmp_path / "c.yaml", MESSAGE % "[0.1, 0.01, 0, 0, 0]"),
        *parameters,
        [0.1, 0.01, 0, 0],
        "fisheye",
    )
    assert_is(read(tmp_path / "c.yaml", MESSAGE % "[0, 0, 0, 0, 0]"), *parameters, [0.0] * 4, "fisheye")
    with pytest.raises(ValueError, match=r"distortion: expected 4 coefficients \(fisheye\), got 5"):
        read(tmp_path / "c.yaml", MESSAGE % "[0.1, 0.01, 0, 0, 0.2]")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("K: [700, 0, 32, 0, 700, 24, 0, 0, 1]", "camera_matrix and K"),
        ("D: [0.3, 0, 0, 0, 0]", "distortion_coefficients and D"),
        ("width: 128", "image_width and width"),
    ],
)
def test_two_values_of_one_quantity_are_refused(tmp_path, more, words):
    Camera.from_parameters(60, 60, 31.5, 23.5, 64, 48, (-0.1, 0.0, 0.0, 0.0, 0.0)).to_file(
        tmp_path / "c.yaml"
    )
    with open(tmp_path / "c.yaml", "a") as file:
        file.write(f"{more}\n")
    with pytest.raises(
        ValueError, match=f"expected one of {words}, got both, which differ; keep the right one"
    ):
        Camera.from_file(tmp_path / "c.yaml")


@pytest.mark.parametrize(
    "more",
    [
        "K: [60.0, 0, 31.5, 0, 60, 23.50, 0, 0, 1]",
        "K: [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]",
        "D: [-1e-1, 0, 0, 0, 0]",
        "width: 64.0",
    ],
)
def test_one_value_written_in_two_ways_is_taken(tmp_path, more):
    camera = Camera.from_parameters(60, 60, 31.5, 23.5, 64, 48, (-0.1, 0.0, 0.0, 0.0, 0.0))
    camera.to_file(tmp_path / "c.yaml")
    with open(tmp_path / "c.yaml", "a") as file:
        file.write(f"{more}\n")
    assert torch.equal(Camera.from_file(tmp_path / "c.yaml").intrinsics, camera.intrinsics)


def test_what_python_dumps(tmp_path):
    fields = {"K": (500.0, 0, 320.0, 0, 500.0, 240.0, 0, 0, 1), "D": (), "width": 640, "height": 480}
    assert_is(read(tmp_path / "c.yaml", yaml.dump(fields)), 500, 500, 320, 240, 640, 480)
    with pytest.raises(ValueError, match=r"expected numbers, texts and lists, got another object at line 2$"):
        read(tmp_path / "c.yaml", yaml.dump({**fields, "K": np.eye(3)}))


# what the calibration program of OpenCV 2.4 and 3.0 writes
OPENCV_2 = """%YAML:1.0
calibration_Time: "Thu 05 Mar 2020 10:12:12 AM UTC"
nrOfFrames: 2
image_Width: 1280
image_Height: 720
board_Width: 9
board_Height: 6
square_Size: 25.
FixAspectRatio: 1.
# flags: +fix_aspectRatio+fix_principal_point+zero_tangent_dist
flagValue: 14
Camera_Matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1150., 0., 640., 0., 1150., 360., 0., 0., 1. ]
Distortion_Coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.3, 0.1, 0., 0., 0. ]
Avg_Reprojection_Error: 0.5
Per_View_Reprojection_Errors: !!opencv-matrix
   rows: 1
   cols: 1
   dt: f
   data: [ 0.5 ]
"""


@pytest.mark.parametrize(
    "text",
    [
        OPENCV_2,
        OPENCV_2.replace("Camera_M", "CameraM").replace("Distortion_C", "DistortionC"),
        OPENCV_2.replace("calibration_Time", "calibration_date") + "rms: 0.3\nT_cam_lidar: [1, 0, 0]\n",
        OPENCV_2 + "orientation: [1, 0, 0, 0]\nintrinsics: [1150, 1150, 640, 360]\n",
    ],
)
def test_keys_in_other_cases_and_what_a_program_records_beside_the_camera(tmp_path, text):
    assert_is(read(tmp_path / "c.yaml", text), 1150, 1150, 640, 360, 1280, 720, [-0.3, 0.1, 0, 0, 0])


@pytest.mark.parametrize(
    "more",
    [
        "lens_type: fisheye",
        "crop: 1",
        "DIM: [640, 480]",
        "p_9: 1",
        "rectified: 1",
        "cropSize: [640]",
        "region_of_interest: [0, 0, 640, 360]",
        "offset_x: 8",
        "scaling: 0.5",
        "flip: 1",
        "rotate: 180",
        "digital_zoom: 2",
        "w: 640",
    ],
)
def test_keys_beside_the_camera_that_may_concern_the_lens_or_the_images_are_refused(tmp_path, more):
    with pytest.raises(ValueError, match=f"unknown key '{more.split(':')[0]}'; expected fx"):
        read(tmp_path / "c.yaml", OPENCV_2 + more)


@pytest.mark.parametrize("key", ["disortion_coefficients", "coeffs", "kc", "D1"])
def test_a_misspelled_key_of_the_coefficients_is_an_error(tmp_path, key):
    with pytest.raises(ValueError, match="distortion_coefficients: expected a value, got none"):
        read(tmp_path / "c.yaml", OPENCV_2.replace("Distortion_Coefficients", key))


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("wide_dist_pickle.p", pickle.dumps({"mtx": MATRIX}), "a pickle of Python, .*; save it as JSON$"),
        ("k.npy", b"\x93NUMPY\1\0", "no arrays of numbers as by numpy.save"),
        ("k.mat", b"MATLAB 5.0 MAT-file, Platform: PCWIN64\0\0", "MATLAB's own format; save it as JSON"),
        ("c.zip", b"PK\x03\x04\0\0", "a ZIP archive, or a sheet of Excel; unpack it, or save"),
        ("cameras.bin", bytes(8), "convert it by colmap model_converter --output_type TXT$"),
    ],
)
def test_binary_files_say_how_to_write_them_as_texts(tmp_path, name, data, words):
    with pytest.raises(ValueError, match=f"{name}: expected a readable camera file, got: .*{words}"):
        read(tmp_path / name, data)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        (
            "fisheye.json",
            '{"MappingCoefficients": [875, -3e-4, 1e-7, 0], "ImageSize": [720, 1280]}',
            "polynom",
        ),
        (
            "c.yaml",
            "model_type: scaramuzza\nimage_width: 1280\npoly_parameters:\n   p0: -300\n",
            "polynomial",
        ),
        (
            "calib_results.txt",
            "#polynomial coefficients for the DIRECT mapping function\n5 -290 0\n",
            "polynom",
        ),
        (
            "argoverse.json",
            '{"camera_data_": [{"value": {"focal_length_x_px_": 1392}}]}',
            "got several of Argoverse 1; .*k3",
        ),
    ],
)
def test_what_is_not_read_says_what_to_do(tmp_path, name, text, words):
    with pytest.raises(ValueError, match=f"{name}: expected .*{words}"):
        read(tmp_path / name, text)


def test_a_comment_on_what_is_not_read_is_a_comment(tmp_path):
    text = "# from MappingCoefficients\n{fx: 633, fy: 633, cx: 408, cy: 245, width: 800, height: 480}\n"
    assert_is(read(tmp_path / "c.yaml", text), 633, 633, 408, 245, 800, 480)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("K.txt", "# camera matrix\n6.33e+02 0.0 4.08e+02\r\n0 633 245\r\n0 0 1\r\n"),
        ("K.csv", "633,0,408\n0,633,245\n0,0,1\n"),
        ("K.json", json.dumps(MATRIX)),
        ("K.txt", str(np.array(MATRIX))),
        ("K.txt", "633 0 408; 0 633 245; 0 0 1"),
        ("P.txt", "633 0 408 -380.5 0 633 245 0 0 0 1 0.01"),
    ],
)
def test_a_camera_matrix_alone_is_read_for_images_of_a_given_size(tmp_path, name, text):
    camera = read(tmp_path / name, text, image_size=(480, 800))
    assert_is(camera, 633, 633, 408, 245, 800, 480)
    assert camera.remark.endswith(
        "it is a camera matrix alone, which is taken for that of a lens without distortion"
    )
    with pytest.raises(ValueError, match="principal point 408, 245 is not in the middle of 1280 x 720 px"):
        Camera.from_file(tmp_path / name, image_size=(720, 1280))
    with pytest.raises(ValueError, match="expected the size of the images too, got numbers alone; write fx,"):
        Camera.from_file(tmp_path / name)
    np.save(tmp_path / "frames.npy", np.zeros((9, 9)))
    with pytest.raises(ValueError, match="camera_matrix: expected 9 numbers, got 10"):
        Camera.from_file(tmp_path / "frames.npy", image_size=(480, 800))
    for matrix in (MATRIX, np.column_stack([MATRIX, [-380.5, 0.0, 0.01]])):
        np.save(tmp_path / "K.npy", matrix)
        assert Camera.from_file(tmp_path / "K.npy", image_size=(480, 800)).remark == camera.remark


@pytest.mark.parametrize("lens", [[], [-0.3, 0.1, 0.001, 0.002], [-0.3, 0.1, 0.001, 0.002, 0.05]])
def test_a_line_of_numbers_has_the_focal_lengths_the_principal_point_and_the_lens(tmp_path, lens):
    text = " ".join(map(str, [633.0, 632.0, 408.0, 245.0, *lens]))  # of DROID-SLAM
    assert_is(read(tmp_path / "c.txt", text, image_size=(480, 800)), 633, 632, 408, 245, 800, 480, lens)


@pytest.mark.parametrize(
    "sides",
    [
        {"image_size": [800, 480]},
        {"imgSize": [480, 800]},
        {"DIM": [800, 480]},
        {"size": "800x480"},
        {"image_shape": [480, 800, 3]},
        {"image_shape": [3, 480, 800]},  # of PyTorch
        {
            "camera_resolution": {
                "type_id": "opencv-matrix",
                "rows": 2,
                "cols": 1,
                "dt": "d",
                "data": [480.0, 800.0],
            }
        },
        {"resolution": {"width": 800, "height": 480}},
    ],
)
def test_a_list_of_both_sides_is_in_the_order_in_which_the_principal_point_is_in_the_middle(tmp_path, sides):
    lens = [-0.3, 0.1, 0.001, 0.002, 0.05]
    fields = {"camera_matrix": MATRIX, "dist_coeff": [lens], **sides}
    expected = (633, 633, 408, 245, 800, 480, lens)
    assert_is(read(tmp_path / "c.json", fields), *expected)
    stereo = {"M1": MATRIX, "D1": [lens], "M2": MATRIX, "D2": [lens], **sides}
    assert_is(read(tmp_path / "c.json", stereo), *expected)
    short = {"fx": 633, "fy": 633, "cx": 408, "cy": 245, "distortion": lens, **sides}
    assert_is(read(tmp_path / "c.json", short), *expected)
    record = {"camera_intrinsic": MATRIX, "camera_dist_coeffs": lens, **sides}  # as of R3LIVE
    assert_is(read(tmp_path / "c.json", record), *expected)


@pytest.mark.parametrize(
    "field",
    [
        {"resolution": [0.1, 0.1]},  # m, of a map
        {"resolution": []},
        {"img_shape": 6 * [[900, 1600, 3]]},  # of all cameras
        {"max_dist": 50.0},
        {"image_distorted": "a/b.jpg"},
    ],
)
def test_other_fields_of_a_record_are_no_size_and_no_lens(tmp_path, field):
    text = json.dumps({"intrinsic": MATRIX, **field})
    assert_is(read(tmp_path / "c.json", text, image_size=(480, 800)), 633, 633, 408, 245, 800, 480)


@pytest.mark.parametrize("matrix", ["intrinsics", "intrinsic_matrix", "Intrinsics"])
@pytest.mark.parametrize("lens", ["dist_coefs", "distortion"])
def test_other_usual_keys_of_matrix_and_coefficients(tmp_path, matrix, lens):
    fields = {matrix: MATRIX, lens: [-0.3, 0.1, 0, 0, 0.05], "resolution": [800, 480]}
    expected = 633, 633, 408, 245, 800, 480, [-0.3, 0.1, 0, 0, 0.05]
    assert_is(read(tmp_path / "c.json", fields), *expected)
    assert_is(read(tmp_path / "c.json", {"a": fields, "b": fields}), *expected)


@pytest.mark.parametrize("rows", [3, 4])
def test_a_camera_matrix_may_be_padded(tmp_path, rows):  # ScanNet's text, mmdetection3d's cam2img
    padded = np.eye(4)[:rows]
    padded[:3, :3] = MATRIX
    expected, lens = (633, 633, 408, 245, 800, 480), [-0.3, 0.1, 0, 0, 0.05]
    for key in ("K", "camera_intrinsic"):
        fields = {key: padded.tolist(), "D": lens, "width": 800, "height": 480}
        assert_is(read(tmp_path / "c.json", fields), *expected, lens)
    np.savetxt(tmp_path / "intrinsic_color.txt", padded)
    assert_is(Camera.from_file(tmp_path / "intrinsic_color.txt", image_size=(480, 800)), *expected)
    np.save(tmp_path / "k.npy", padded)
    assert_is(Camera.from_file(tmp_path / "k.npy", image_size=(480, 800)), *expected)
    fields = {"K": (padded + np.eye(4)[:rows, ::-1]).tolist(), "D": [], "width": 800, "height": 480}
    with pytest.raises(ValueError, match=f"camera_matrix: expected 9 numbers, got {4 * rows}"):
        read(tmp_path / "c.json", fields)


def test_keys_with_their_unit(tmp_path):  # of Argoverse 2
    fields = {"fx_px": 633, "fy_px": 633, "cx_px": 408, "cy_px": 245, "width_px": 800, "height_px": 480}
    camera = read(tmp_path / "c.json", json.dumps({"sensor_name": "ring_front_center", **fields, "k1": -0.3}))
    assert_is(camera, 633, 633, 408, 245, 800, 480, [-0.3, 0, 0, 0, 0])


def test_a_camera_matrix_by_names(tmp_path):
    named = {"fx": 633, "fy": 633, "cx": 408, "cy": 245}
    fields = {"camera_matrix": named, "distortion": [-0.3, 0.1, 0, 0, 0.05], "width": 800, "height": 480}
    assert_is(read(tmp_path / "c.json", fields), *named.values(), 800, 480, fields["distortion"])


def test_a_text_of_keys_without_a_size_is_of_the_images(tmp_path):
    (tmp_path / "c.txt").write_text("fx: 633\nfy: 633\ncx: 408\ncy: 245\n")
    camera = Camera.from_file(tmp_path / "c.txt", image_size=(480, 800))
    assert_is(camera, 633, 633, 408, 245, 800, 480)
    assert camera.remark == "the file states no size of images; 800 x 480 px are taken"


def test_keys_that_differ_in_case_only_are_an_error(tmp_path):
    with pytest.raises(
        ValueError, match="one of K and k, which mean the same, got both; rename one, or leave"
    ):
        read(tmp_path / "c.json", {"K": MATRIX, "k": [-0.3, 0.1], "p": [0, 0], "D": []})


def test_numpys_file_with_opencvs_roi_or_without_names(tmp_path):
    lens = {"mtx": MATRIX, "dist": [[-0.3, 0.1, 0, 0, 0.05]]}
    np.savez(tmp_path / "c.npz", **lens, newcameramtx=MATRIX, roi=(9, 9, 780, 460))
    camera = Camera.from_file(tmp_path / "c.npz", image_size=(480, 800))
    assert_is(camera, 633, 633, 408, 245, 800, 480, [-0.3, 0.1, 0, 0, 0.05])
    np.savez(tmp_path / "c.npz", intrinsics=5.0, resolution=3.0)
    with pytest.raises(ValueError, match="unknown key 'resolution'"):
        Camera.from_file(tmp_path / "c.npz", image_size=(480, 800))
    np.savez(tmp_path / "c.npz", np.zeros(3), **lens)
    assert_is(
        Camera.from_file(tmp_path / "c.npz", image_size=(480, 800)),
        633,
        633,
        408,
        245,
        800,
        480,
        lens["dist"][0],
    )
    np.savez(tmp_path / "c.npz", *lens.values())
    with pytest.raises(
        ValueError, match=r"got: arrays without names; save them by numpy.savez\(FILE, mtx=mtx"
    ):
        Camera.from_file(tmp_path / "c.npz", image_size=(480, 800))


def test_numpys_file_without_a_camera_says_so(tmp_path):
    np.savez(tmp_path / "c.npz", rvecs=np.zeros(3))
    with pytest.raises(ValueError, match=r"c\.npz: expected keys such as fx, .*, got none"):
        Camera.from_file(tmp_path / "c.npz", image_size=(480, 800))


@pytest.mark.parametrize("key", ["distortion", "distortion_coeffs", "dist_coeffs"])
def test_matrices_without_rows_and_other_names_of_coefficients(tmp_path, key):
    lens = [-0.3, 0.1, 0.001, 0.002, 0.05]
    entries = np.ravel(MATRIX).tolist()
    fields = {"cameraMatrix": {"data": entries}, "width": 800, "height": 480}
    texts = str(lens), "-0.3, 0.1, 0.001, 0.002, 0.05"
    without_commas = ["-0.3 0.1 0.001 0.002 0.05"]  # image_pipeline#533
    for value in (lens, [lens], {"data": lens}, *texts, without_commas, {"data": without_commas}):
        camera = read(tmp_path / "c.json", {**fields, key: value})
        assert_is(camera, 633, 633, 408, 245, 800, 480, lens)
    with pytest.raises(ValueError, match="coefficients: expected finite numbers, got -0,3"):
        read(tmp_path / "c.json", {**fields, key: "-0,3 0,1 0,0 0,0"})
    with pytest.raises(ValueError, match="camera_matrix: expected 9 numbers, got 8"):
        read(
            tmp_path / "c.json",
            json.dumps({**fields, "cameraMatrix": {"data": entries[:8]}, key: lens}),
        )


def test_names_dates_and_errors_beside_the_focal_lengths_are_ignored(tmp_path):
    fields = {"fx": 633, "fy": 633, "cx": 408, "cy": 245, "width": 800, "height": 480}
    more = {"rms": 0.55, "camera_name": "front", "date": "2026-11-30", "reprojection_error": 0.2, "_note": ""}
    assert_is(read(tmp_path / "c.json", {**fields, **more}), 633, 633, 408, 245, 800, 480)
    for key in ("lens_name", "distorsion", "skew", "radial_error"):
        with pytest.raises(ValueError, match=f"unknown key '{key}'"):
            read(tmp_path / "c.json", {**fields, key: 1})


@pytest.mark.parametrize("sides", [[800], [800, 0], [1, 2, 3, 4]])
def test_a_list_of_other_than_both_sides_is_refused(tmp_path, sides):
    with pytest.raises(ValueError, match="image_size: expected width and height, got"):
        read(tmp_path / "c.json", {"K": MATRIX, "D": [], "image_size": sides})


def test_a_list_of_cameras_of_another_program_is_named(tmp_path):  # OKVIS
    with pytest.raises(ValueError, match="unknown key 'cameras'; expected fx"):
        read(tmp_path / "c.yaml", "cameras:\n - {image_dimension: [752, 480], focal_length: [458, 457]}\n")


OST_INI = """# oST version 5.0 parameters

[image]

width
1640

height
1232

[narrow_stereo]

camera matrix
404.0 0.0 820.0
0.0 404.0 616.0
0.0 0.0 1.0

distortion
{}
"""


def test_four_coefficients_in_the_ini_of_ros_are_those_of_a_fisheye(tmp_path):
    size = (404, 404, 820, 616, 1640, 1232)
    assert_is(
        read(tmp_path / "ost.txt", OST_INI.format("0.01 -0.03 0.004 -0.0007")),
        *size,
        [0.01, -0.03, 0.004, -0.0007],
        "fisheye",
    )
    remark = read(tmp_path / "ost.txt", OST_INI.format("0.01 -0.03 0.004 -0.0007")).remark
    assert remark.endswith("as ROS writes them: if it is a pinhole camera, add a fifth, 0")
    for lens in ([-0.1, 0.01, 0.0004, -0.0007, 0.0], [-0.1, 0.01, 0.0, 0.0], [0.0] * 4):
        camera = read(tmp_path / "ost.txt", OST_INI.format(" ".join(map(str, lens))))
        assert_is(camera, *size, lens if any(lens) else [])
        assert camera.remark == ""


def test_four_coefficients_without_a_lens_model_are_remarked_on(tmp_path):
    fields = {"K": MATRIX, "D": [[-0.05], [0.01], [-0.008], [0.002]], "width": 816, "height": 490}
    camera = read(tmp_path / "c.json", fields)
    assert camera.remark.endswith(
        "; they are taken as k1 k2 p1 p2 of a pinhole camera: if it is a fisheye, add model: fisheye"
    )
    for more in (
        {"model": "pinhole"},
        {"fisheye_model": 0},
        {"D": [-0.05, 0.01, 0, 0]},
        {"D": [-0.05, 0.01, 0.001, 0, 0.1]},
    ):
        assert read(tmp_path / "c.json", {**fields, **more}).remark == ""
    del fields["width"], fields["height"]
    remark = read(tmp_path / "c.json", fields, image_size=(490, 816)).remark
    assert remark.startswith("the file states no size of images; 816 x 490 px are taken; it states four")


@pytest.mark.parametrize(
    "fields",
    [{"fx": 500, "fy": 500, "cx": 320, "cy": 240}, {"K": [500, 0, 320, 0, 500, 240, 0, 0, 1], "D": []}],
)
def test_keys_below_the_cameras_name_are_read(tmp_path, fields):
    camera = {**fields, "width": 640, "height": 480}
    for below in ({"front": camera}, {"/**": {"ros__parameters": camera}}):
        assert_is(read(tmp_path / "c.yaml", yaml.safe_dump(below)), 500, 500, 320, 240, 640, 480)
