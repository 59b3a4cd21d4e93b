"""Files with several cameras: which one is taken, that it is said, and how another is chosen."""

import json

import pytest

from lanebev import Camera
from lanebev.app.config import RunConfig
from lanebev.app.fleet.manifest import read_manifest
from lanebev.app.fleet.plan import settings_fingerprint
from lanebev.camera.choice import camera_file
from lanebev.camera.plausibility import camera_remarks
from tests.camera.files import read, written

P = "{0} 0 640 0 0 {0} 360 0 0 0 1 0"


def _kalibr(*focals):
    lens = "{camera_model: pinhole, distortion_model: radtan, distortion_coeffs: [-0.1, 0, 0, 0], "
    lens += "intrinsics: [%s, %s, 640, 360], resolution: [1280, 720]}"
    return "".join(f"cam{i}: {lens % (focal, focal)}\n" for i, focal in enumerate(focals))


def _kitti(*focals):
    return "".join(f"P{i}: {P.format(focal)}\n" for i, focal in enumerate(focals))


def _raw_kitti(*focals):
    entry = "P_rect_{0:02d}: {1}\nS_rect_{0:02d}: 1280 720\n"
    return "".join(entry.format(i, P.format(focal)) for i, focal in enumerate(focals))


def _orb_slam(*focals):
    sizes = "Camera.width: 1280\nCamera.height: 720\n"
    numbers = "Camera{0}.fx: {1}\nCamera{0}.fy: {1}\nCamera{0}.cx: 640\nCamera{0}.cy: 360\n"
    return sizes + "".join(numbers.format(i, focal) for i, focal in enumerate(focals, start=1))


def _colmap(*focals):
    return "".join(f"{i} PINHOLE 1280 720 {focal} {focal} 640.5 360.5\n" for i, focal in enumerate(focals, 1))


def _nuscenes(*focals):
    matrices = [[[focal, 0, 640], [0, focal, 360], [0, 0, 1]] for focal in focals]
    size = {"width": 1280, "height": 720}
    tokens = ("a1", "b2", "c3")
    lidar = {"token": "d4", "camera_intrinsic": []}
    cameras = [{"token": t, "camera_intrinsic": m, **size} for t, m in zip(tokens, matrices, strict=False)]
    return json.dumps([lidar, *cameras])


USUAL = [  # with the names of three cameras, the usual one first
    (_kalibr, ("cam0", "cam1", "cam2"), (0, 1, 2)),
    (_kitti, ("P2", "P0", "P1"), (2, 0, 1)),
    (_raw_kitti, ("P_rect_02", "P_rect_00", "P_rect_01"), (2, 0, 1)),
    (_orb_slam, ("Camera1", "Camera2"), (0, 1)),
]


def _named(*focals):
    cameras = [
        {"K": [[f, 0, 640], [0, f, 360], [0, 0, 1]], "D": [], "width": 1280, "height": 720} for f in focals
    ]
    named = dict(zip(("CAM_1", "CAM_2", "CAM_3"), cameras, strict=False))
    return json.dumps({"cameras": named} if len(focals) > 2 else named)


UNUSUAL = [
    (_named, ("CAM_1", "CAM_2", "CAM_3"), (0, 1, 2)),
    (_colmap, ("1", "2", "3"), (0, 1, 2)),
    (_nuscenes, ("a1", "b2", "c3"), (0, 1, 2)),
]
FOCALS = (800, 900, 1000)


@pytest.mark.parametrize(("write", "names", "places"), [*USUAL, *UNUSUAL])
def test_a_camera_is_chosen_by_its_name(tmp_path, write, names, places):
    path = written(tmp_path / "cameras.yaml", write(*FOCALS[: len(names)]))
    for name, place in zip(names, places, strict=True):
        camera = Camera.from_file(f"{path}#{name}", image_size=(720, 1280))
        assert camera.intrinsics[0].tolist() == [FOCALS[place], 0, 640]
        assert camera.remark == ""
    with pytest.raises(ValueError, match=f"expected one of .*{names[1]}.* after #, got 'front'$"):
        Camera.from_file(f"{path}#front", image_size=(720, 1280))


@pytest.mark.parametrize(("write", "names", "places"), USUAL)
def test_the_usual_camera_is_taken_and_said(tmp_path, write, names, places):
    path = written(tmp_path / "cameras.yaml", write(*FOCALS[: len(names)]))
    camera = Camera.from_file(path, image_size=(720, 1280))
    assert camera.intrinsics[0, 0] == FOCALS[places[0]]
    words = f"of which {names[0]} is taken; choose another as FILE#{names[1]}"
    assert [remark for remark in camera_remarks(camera.scaled((360, 640))) if words in remark]
    same = read(tmp_path / "cameras.yaml", write(*[800] * len(names)), image_size=(720, 1280))
    assert same.remark == ""  # KITTI's four have the same numbers


STEREO = """%YAML:1.0
Camera.fx: 435.2
Camera.fy: 435.2
Camera.cx: 367.4
Camera.cy: 252.2
Camera.k1: 0.0
Camera.k2: 0.0
Camera.width: 752
Camera.height: 480
LEFT.height: 480
LEFT.width: 752
LEFT.D: !!opencv-matrix {rows: 1, cols: 5, dt: d, data: [-0.283, 0.074, 0.0002, 1.8e-05, 0.0]}
LEFT.K: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [458.7, 0, 367.2, 0, 457.3, 248.4, 0, 0, 1]}
RIGHT.height: 480
RIGHT.width: 752
RIGHT.D: !!opencv-matrix {rows: 1, cols: 5, dt: d, data: [-0.284, 0.075, -0.0001, -3.6e-05, 0.0]}
RIGHT.K: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [457.6, 0, 380.0, 0, 456.1, 255.2, 0, 0, 1]}
"""


def test_a_camera_may_have_a_negative_number(tmp_path):
    text = _colmap(800) + "-1 PINHOLE 1280 720 900 900 640.5 360.5\n"
    path = written(tmp_path / "cameras.yaml", text)
    assert Camera.from_file(f"{path}#-1").intrinsics[0, 0] == 900
    with pytest.raises(ValueError, match="expected one camera, got 2: 1, -1; choose one as FILE#1"):
        Camera.from_file(path)


def test_orb_slams_stereo_settings_have_the_camera_of_rectified_images_too(tmp_path):
    path = written(tmp_path / "cameras.yaml", STEREO)
    taken = Camera.from_file(path)
    assert (float(taken.intrinsics[0, 0]), float(taken.distortion[0])) == (458.7, -0.283)
    assert "the cameras LEFT, RIGHT, Camera, of which LEFT is taken" in taken.remark
    rectified = Camera.from_file(path, rectified=True)
    assert (float(rectified.intrinsics[0, 0]), len(rectified.distortion)) == (435.2, 0)
    assert Camera.from_file(f"{path}#RIGHT").intrinsics[0, 2] == 380


@pytest.mark.parametrize(("write", "names", "places"), UNUSUAL)
def test_of_cameras_in_no_order_one_must_be_chosen(tmp_path, write, names, places):
    path = written(tmp_path / "cameras.yaml", write(*FOCALS))
    with pytest.raises(ValueError, match=f"expected one camera, got 3: .*; choose one as FILE#{names[0]}$"):
        Camera.from_file(path)
    assert read(tmp_path / "cameras.yaml", write(800, 800, 800)).intrinsics[0, 0] == 800


def test_of_more_cameras_than_kittis_one_must_be_chosen(
    tmp_path,
):  # Waymo's in KITTI's format: P0 is in front
    path = written(tmp_path / "cameras.yaml", _kitti(800, 810, 820, 830, 840))
    with pytest.raises(
        ValueError, match="expected one camera, got 5: P2, P3, P0, P1, P4; choose one as FILE#P2"
    ):
        Camera.from_file(path, image_size=(720, 1280))
    assert Camera.from_file(f"{path}#P4", image_size=(720, 1280)).intrinsics[0, 0] == 840


def test_fields_of_a_lens_have_no_camera_of_rectified_images():
    lens = {"camera_model": "pinhole", "distortion_model": "radtan", "distortion_coeffs": [-0.1, 0, 0, 0]}
    fields = {**lens, "intrinsics": [800, 800, 640, 360], "resolution": [1280, 720]}
    assert Camera.from_fields(fields).distortion[0] == -0.1
    with pytest.raises(ValueError, match="projection_matrix: expected P for rectified images, got none"):
        Camera.from_fields(fields, rectified=True)


def test_a_broken_camera_beside_the_one_that_is_taken_is_another(tmp_path):
    text = _kalibr(800, 900).replace("[900", "[x")
    assert "cam0 is taken" in read(tmp_path / "cameras.yaml", text).remark
    with pytest.raises(ValueError, match="intrinsics: expected finite numbers"):
        Camera.from_file(f"{tmp_path}/cameras.yaml#cam1")


def test_a_file_of_one_camera_has_no_names(tmp_path):
    path = tmp_path / "lens#1.yaml"  # its own name has the sign
    path.write_text("{fx: 800, fy: 800, cx: 640, cy: 360, width: 1280, height: 720}")
    assert Camera.from_file(path).intrinsics[0, 0] == 800
    with pytest.raises(ValueError, match=r"lens#1\.yaml: expected no name after # for .* got 'cam0'$"):
        Camera.from_file(f"{path}#cam0")


def test_the_file_is_an_input_whatever_camera_of_it_is_taken(tmp_path):
    path = written(tmp_path / "cameras.yaml", _kalibr(*FOCALS))
    assert camera_file(f"{path}#cam1") == path
    config = RunConfig(source="drive.mp4", camera=f"{path}#cam1")
    before = settings_fingerprint(config)
    path.write_text(_kalibr(*FOCALS[:2]))
    assert settings_fingerprint(config) != before


def test_drives_of_several_cameras_of_a_file_are_not_those_of_one(tmp_path):
    written(tmp_path / "cameras.yaml", _kalibr(*FOCALS))
    drives = "video,camera\na.mp4,cameras.yaml#cam0\nb.mp4,cameras.yaml#cam1\n"
    (tmp_path / "drives.csv").write_text(drives)
    manifest = read_manifest(tmp_path / "drives.csv")
    assert [drive.camera_id for drive in manifest] == ["cameras-cam0", "cameras-cam1"]


MESSAGE = (
    "width: 1280\nheight: 720\nk: [{0}, 0, 640, 0, {0}, 360, 0, 0, 1]\nd: []\nheader: {{stamp: {1}}}\n---\n"
)


def test_messages_of_one_camera_that_were_printed_one_after_another(tmp_path):
    text = "".join(MESSAGE.format(800, stamp) for stamp in range(3))
    for cut in (text, text[:-20], text[: len(text) // 2 - 30]):
        camera = read(tmp_path / "cameras.yaml", cut)
        assert (float(camera.intrinsics[0, 0]), camera.remark) == (800, "")


def test_messages_of_two_cameras_that_were_printed_one_after_another(tmp_path):
    path = written(tmp_path / "cameras.yaml", MESSAGE.format(800, 1) + MESSAGE.format(900, 2))
    camera = Camera.from_file(path)
    assert camera.intrinsics[0, 0] == 800
    assert camera.remark == "the file has the cameras 1, 2, of which 1 is taken; choose another as FILE#2"
    assert Camera.from_file(f"{path}#2").intrinsics[0, 0] == 900


@pytest.mark.parametrize(
    "more", [MESSAGE.format(900, 2)[:60], "a: 1\na: 2", "? [1]\n: 2", "note: it is rectified"]
)
def test_a_second_document_that_is_no_camera_does_not_count(tmp_path, more):
    path = written(tmp_path / "cameras.yaml", f"{MESSAGE.format(800, 1)}{more}\n")
    camera = Camera.from_file(path)
    assert (float(camera.intrinsics[0, 0]), camera.remark) == (800, "")
    with pytest.raises(ValueError, match=r"expected no name after # for a file of one camera, got '2'$"):
        Camera.from_file(f"{path}#2")


def test_keys_that_are_indented_in_several_ways_are_named(tmp_path):
    text = "  fx: 800\nfy: 800\ncx: 640\ncy: 360\nwidth: 1280\nheight: 720\n"
    with pytest.raises(
        ValueError, match=r"expected all keys in one block, equally indented, got more .* line 2$"
    ):
        read(tmp_path / "cameras.yaml", text)


@pytest.mark.parametrize("more", ["distortion: [-0.3, 0.1, 0, 0, 0]", "model: fisheye", "{fx: 900}"])
def test_keys_after_the_braces_are_not_left_out(tmp_path, more):
    text = f"{{fx: 800, fy: 800, cx: 640, cy: 360, width: 1280, height: 720}}\n{more}\n"
    with pytest.raises(ValueError, match=r"expected all keys in the braces, got more after them at line 2$"):
        read(tmp_path / "cameras.yaml", text)


def _opencv(extra, distortion="[0.1, 0.01, 0.001, 0.002]"):
    return (
        "image_width: 1280\nimage_height: 720\ncamera_matrix: [800, 0, 640, 0, 800, 360, 0, 0, 1]\n"
        f"distortion_coefficients: {distortion}\n{extra}\n"
    )


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ("distortion_model: plumb_bob\ncamera_model: fisheye", "plumb_bob and fisheye"),
        ("distortion_model: rational_polynomial\nfisheye_model: 1", "rational_polynomial and fisheye_model"),
        ("distortion_model: equidistant\nxi: 1.2", "equidistant and xi of an omni"),
    ],
)
def test_models_that_contradict_each_other_are_refused(tmp_path, extra, words):
    with pytest.raises(ValueError, match=f"model: expected one, got {words}; keep the right one$"):
        read(tmp_path / "cameras.yaml", _opencv(extra))


def test_a_pinhole_may_have_the_distortion_of_a_fisheye_as_kalibr_has_it(tmp_path):
    text = _opencv("distortion_model: equidistant\ncamera_model: pinhole")
    assert read(tmp_path / "cameras.yaml", text).model == "fisheye"


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ("[]", "[0, 0, 0, 0, 0]", []),
        ("[0, 0, 0, 0]", "[]", []),
        ("[-0.1, 0.01, 0, 0, 0]", "[-0.1, 0.01, 0, 0]", [-0.1, 0.01, 0, 0, 0]),
    ],
)
def test_coefficients_that_differ_in_zeros_at_their_end_are_the_same(tmp_path, one, other, expected):
    camera = read(tmp_path / "cameras.yaml", _opencv(f"D: {other}", one))
    assert camera.distortion.tolist() == expected
