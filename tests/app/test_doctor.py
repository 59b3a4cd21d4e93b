"""``lanebev doctor`` says what is amiss, and how much; ``--print-completion`` completes."""

import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest

from lanebev import Camera
from lanebev.app.doctor import (
    DOUBT,
    OK,
    WRONG,
    Sample,
    check_centre,
    check_field_of_view,
    check_lanes,
    check_lens,
    check_pixels,
    check_pose,
    check_size,
    check_times,
)
from lanebev.app.drive.build import match_image_size
from lanebev.app.recording.plausibility import bars_remark, mount_remark, pose_remark
from lanebev.camera.plausibility import camera_remarks, field_of_view, model_remark
from lanebev.cli import main
from lanebev.io.opening import open_source
from lanebev.io.video.writer import VideoWriter

CAMERA = Camera.from_fov(60.0, 640, 360)
GOOD_POSE = [2.0, -1.0, 0.5, 1.4]


def _lens(focal, distortion, model="pinhole", width=640):
    return Camera.from_parameters(focal, focal, width / 2, 180, width, 360, distortion, model)


def _sample(poses=(GOOD_POSE,), boundaries=(2, 2, 4), steps=(1.0, 1.0), undecoded=0):
    return Sample(undecoded, list(steps), list(boundaries), [list(pose) for pose in poses])


@pytest.mark.parametrize(
    ("finding", "level", "word"),
    [
        (check_size(CAMERA, (360, 640)), OK, "as in the camera file"),
        (check_size(CAMERA, (720, 1280)), WRONG, "Camera.scaled((720, 1280))"),
        (check_size(CAMERA, (480, 640)), WRONG, "another shape"),
        (check_field_of_view(CAMERA), OK, "60 degrees of view across"),
        (check_field_of_view(Camera.from_fov(10.0, 640, 360)), DOUBT, "10 degrees of view across"),
        (check_field_of_view(Camera.from_fov(150.0, 640, 360)), DOUBT, "150 degrees of view across"),
        (check_centre(CAMERA), OK, "+0 px right"),
        (check_centre(CAMERA.cropped(100, 0, 260, 640)), DOUBT, "-50 px below"),
        (check_lens(CAMERA), OK, "lens: pinhole, 0 distortion coefficients"),
        (check_lens(_lens(286, (-0.0048, 0.0414, -0.0389, 0.0066))), DOUBT, "then model: fisheye is missing"),
        (check_field_of_view(_lens(200, (-0.3, 0.03, 0.0, 0.0))), OK, "focal length: 200 px"),
        (check_lens(_lens(200, (-0.3, 0.03, 0.0, 0.0))), DOUBT, "of the pixels cannot be undistorted"),
        (check_pixels(CAMERA, Fraction(1)), OK, "pixels: square, as the focal lengths say"),
        (check_pixels(CAMERA, Fraction(4, 3)), DOUBT, "but the video states 1.33 times: is fx that"),
        (check_times(_sample()), OK, "evenly spaced"),
        (check_times(_sample(steps=(1.0, 1.0, 5.0))), DOUBT, "a gap of 5 times"),
        (check_times(_sample(steps=(2.0, 2.0))), DOUBT, "is 2.00 times that of the stated"),
        (check_times(_sample(undecoded=2)), DOUBT, "2 of 3 do not decode"),
        (check_lanes(_sample()), OK, "100% of 3 frames"),
        (check_lanes(_sample(boundaries=(0, 1, 2))), DOUBT, "33% of 3 frames"),
        (check_pose(_sample()), OK, "pitch +2.0 degrees"),
        (check_pose(_sample(poses=())), DOUBT, "pose: none"),
        (check_pose(_sample(poses=([2.0, 1.0, 0.5, 9.0],))), DOUBT, "height +9.0 m is unusual"),
        (check_pose(_sample(poses=([-40.0, 1.0, 20.0, 1.4],))), DOUBT, "pitch -40.0 degrees, roll +20.0"),
    ],
)
def test_findings(finding, level, word):
    assert finding.level == level
    assert word in finding.words


FISHEYES = [(286, (-0.0048, 0.0414, -0.0389, 0.0066)), (190, (0.0035, 0.0007, -0.002, 0.0002))]
FISHEYES += [(278, (-0.0137, 0.0207, -0.0127, 0.0025)), (320, (-0.05, 0.1, -0.1, 0.03))]
LENSES = [(390, (-0.283, 0.0739, 0.0002, 0.00002)), (517, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))]
LENSES += [(452, (-0.373, 0.204, 0.0022, 0.0014, -0.0723)), (350, (-0.17, 0.025, 0, 0, 0))]
LENSES += [(600, (0.05, -0.2, 0.012, -0.008, 0.1)), (224, ()), (500, (-0.3, 0.1, 0.001, 0.0005))]


def test_the_lens_model_that_coefficients_are_like():
    for focal, given in FISHEYES:
        assert model_remark(_lens(focal, given, "fisheye")) == ""
        (remark,) = camera_remarks(_lens(focal, given))
        assert "are they k1 k2 k3 k4 of a fisheye? then model: fisheye is missing" in remark
    for focal, given in LENSES:
        assert model_remark(_lens(focal, given)) == ""
    (remark,) = camera_remarks(_lens(*LENSES[0], "fisheye"))
    assert "is like one of plumb_bob, not of a fisheye" in remark


def test_coefficients_in_another_order_or_of_another_sign():
    for given in ((-0.1, 0.05, 0.04, 0.0, 0.001), (-0.3, 0.1, -0.012, 1e-4, 5e-4), (-0.3, 0.1, 0.02, 0, 0)):
        (remark,) = camera_remarks(_lens(600, given))  # k1 k2 k3 p1 p2
        assert "more tangential distortion than is usual; is the order k1 k2 p1 p2 k3?" in remark
    assert model_remark(_lens(600, (-0.3, 0.1, 0.009, 0.001, 0.0))) == ""  # calibrated without k3
    assert model_remark(_lens(600, (-0.3, 0.1, 0.009, 0.0, 0.0)))  # k1 k2 k3 without p1 and p2
    assert not camera_remarks(_lens(600, (-0.3, 0.1, 0.002, 1e-4, 0.0)))
    (remark,) = camera_remarks(_lens(500, (1.5, 0.0, 0.0, 0.0)))
    assert "moves the left edge 1.3 times as far from the centre, more than is usual" in remark


def test_a_camera_of_images_that_were_turned(data):
    Camera.from_fov(40.0, 360, 640).to_file(data / "portrait.yaml")
    source = open_source(str(data / "drive.mp4"))
    with pytest.raises(
        ValueError, match=r"640 x 360 px, got one for 360 x 640; .* before the images were tur"
    ):
        match_image_size(Camera.from_file(data / "portrait.yaml"), source)


def test_a_camera_that_was_calibrated_at_another_size():
    small = Camera.from_parameters(600, 600, 319.5, 179.5, 640, 360)
    wrong = Camera.from_parameters(600, 600, 319.5, 179.5, 960, 540)
    (remark,) = camera_remarks(wrong)
    assert "320, 180 is in the middle of images of 640 x 360 px, not of 960 x 540" in remark
    assert check_centre(wrong).words == remark.removeprefix("camera: ")
    assert camera_remarks(small) == camera_remarks(small.cropped(100, 0, 260, 640)) == []
    (remark,) = camera_remarks(Camera.from_parameters(600, 600, 179.5, 319.5, 640, 360))
    assert (
        "180, 320 is in the middle of images of 360 x 640 px, not of 640 x 360: are cx and cy, or" in remark
    )
    (remark,) = camera_remarks(Camera.from_parameters(600, 600, 50, 50, 640, 360))  # percent of the sides
    assert "principal point 50, 50 is far from the middle of the 640 x 360 px: is it in pixels" in remark
    (remark,) = camera_remarks(Camera.from_fov(10.0, 640, 360))
    assert "10 degrees of view across, where cameras on cars have 25 to 130: was it calibrated" in remark
    (remark,) = camera_remarks(Camera.from_parameters(4.2, 4.2, 319.5, 179.5, 640, 360))
    assert remark.endswith("are the focal lengths in pixels?")


def test_focal_lengths_of_pixels_that_are_not_square():
    squeezed = Camera.from_parameters(450, 600, 239.5, 179.5, 480, 360)
    square = Camera.from_parameters(600, 600, 239.5, 179.5, 480, 360)
    assert camera_remarks(squeezed, Fraction(4, 3)) == camera_remarks(square) == []
    assert camera_remarks(Camera.from_parameters(600, 625, 239.5, 179.5, 480, 360)) == []  # 4 %
    (remark,) = camera_remarks(square, Fraction(4, 3))
    assert remark.endswith(
        "the video states 1.33 times: is fx that of frames as players show them? then divide it by 1.333"
    )
    (remark,) = camera_remarks(squeezed)
    assert "fy / fx is 1.33, of pixels 1.33 times as wide as high: were images squeezed, or" in remark


def test_black_bars_left_and_right():
    image = np.full((36, 64, 3), 128, np.uint8)
    assert bars_remark(None) == bars_remark(image) == bars_remark(np.zeros_like(image)) == ""
    image[:, :8] = image[:, -10:] = 16
    assert bars_remark(image).startswith("fov: images have black bars, 8 px wide at the left and 10 px at")
    image[20, 3] = 30  # not evenly black: the dark edge of an image
    image[20, -3] = 0
    image[:, -10:] = np.arange(36)[:, None, None] % 20
    assert bars_remark(image) == ""


def test_a_mount_of_another_camera(tmp_path):
    CAMERA.to_file(tmp_path / "calibration.yaml")
    path = str(tmp_path / "calibration.yaml")
    assert mount_remark(None, CAMERA) == mount_remark(path, CAMERA.scaled((720, 1280))) == ""
    assert mount_remark(str(tmp_path / "none.yaml"), CAMERA) == ""
    remark = mount_remark(path, Camera.from_fov(90.0, 640, 360))
    assert "its camera has 60 degrees of view across, this one 90; is it of another camera?" in remark


def test_a_pose_that_is_unusual_for_a_camera_in_a_car():
    assert pose_remark(GOOD_POSE) == ""
    assert pose_remark([2.0, -17.2, 0.5, 0.5]).startswith("pose: yaw -17.2 degrees, height +0.5 m is unusual")
    assert "yaw +9.0 degrees is unusual" in pose_remark([2.0, 9.0, 0.5, 1.4])  # openpilot allows 4 degrees


def test_field_of_view_of_a_lens():
    assert field_of_view(CAMERA) == pytest.approx(60.0, abs=0.1)  # between middles of the outer pixels
    fisheye = Camera.from_parameters(250, 250, 319.5, 179.5, 640, 360, (0.0,) * 4, "fisheye")
    assert field_of_view(fisheye) == pytest.approx(np.degrees(639 / 250), abs=1e-3)  # r = f times the angle


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    CAMERA.to_file(root / "camera.yaml")
    Camera.from_fov(60.0, 320, 180).to_file(root / "half.yaml")
    with VideoWriter(root / "drive.mp4", Fraction(10)) as writer:
        for number in range(4):
            writer.write(np.full((360, 640, 3), 10 * number, np.uint8))
    return root


def test_status_is_that_of_the_worst(data, capsys):
    assert main(["doctor", f"{data}/drive.mp4", "--camera", f"{data}/camera.yaml"]) == 1  # no lanes
    out = capsys.readouterr().out
    assert "ok     size: 640 x 360 px" in out
    assert "doubt  lanes: two boundaries or more in 0% of 4 frames" in out
    assert main(["doctor", f"{data}/drive.mp4", "--camera", f"{data}/half.yaml"]) == 2
    out = capsys.readouterr().out
    assert out.startswith("wrong  size: the images are 640 x 360 px, the camera is for 320 x 180")
    assert main(["doctor", f"{data}/none.mp4", "--camera", f"{data}/half.yaml"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_what_a_run_says_of_the_source_and_the_camera_file(data, tmp_path, capsys):
    (tmp_path / "joined.mp4").write_bytes(2 * (data / "drive.mp4").read_bytes())
    lens = "{camera_model: pinhole, intrinsics: [%d, %d, 320, 180], resolution: [640, 360]}"
    (tmp_path / "chain.yaml").write_text(f"cam0: {lens % (500, 500)}\ncam1: {lens % (600, 600)}\n")
    assert main(["doctor", f"{tmp_path}/joined.mp4", "--camera", f"{tmp_path}/chain.yaml"]) == 1
    out = capsys.readouterr().out
    assert "doubt  camera: the file has the cameras cam0, cam1, of which cam0 is taken; choose another" in out
    assert "doubt  source: video " in out
    assert "another video is appended to it" in out
    main(["doctor", f"{data}/drive.mp4", "--camera", f"{tmp_path}/chain.yaml#cam1"])
    out = capsys.readouterr().out
    assert "focal length: 600 px" in out
    assert "of which" not in out


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion(shell, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--print-completion", shell])
    assert stopped.value.code == 0
    script = capsys.readouterr().out
    for word in ("lanebev", "--lane-width", "doctor", "convert", "parquet", "--print-completion"):
        assert word in script
    if shell == "bash":
        checked = subprocess.run(["bash", "-n"], input=script, text=True, capture_output=True, check=False)
        assert checked.returncode == 0, checked.stderr


@pytest.mark.parametrize("option", ["--print-completion=bash", "--help"])
def test_words_that_nobody_reads_are_no_error(option):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "lanebev", option]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_completion_without_its_library(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "shtab", None)
    with pytest.raises(SystemExit) as stopped:
        main(["--print-completion", "bash"])
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "pip install 'lanebev[completion]'" in error
