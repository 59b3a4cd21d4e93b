"""Cameras of data sets in JSON: nuImages, Cityscapes, ONCE, A2D2, ZOD, DAIR-V2X and others like OpenLane's."""

import json

import pytest
import torch

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
DAIR = {"cam_K": sum(_matrix(2183, 940, 567), []), "cam_D": LENS, "width": 1920, "height": 1080}
LIKE_OPENLANE = {"intrinsic": _matrix(1000, 960, 540), "width": 1920, "height": 1080}


@pytest.mark.parametrize(
    ("content", "name", "expected"),
    [
        ([NUIMAGES], "", (1272, 1274, 826, 479, 1600, 900, LENS)),
        (CITYSCAPES, "", (2262, 2265, 1096, 513, 2048, 1024, ())),
        (ONCE, "", (966, 968, 977, 518, 1920, 1020, LENS)),
        (A2D2, "#front_center", (1500, 1502, 970, 610, 1920, 1208, LENS)),
        (A2D2, "#rear_center", (1500, 1502, 970, 610, 1920, 1208, KANNALA_BRANDT, "fisheye")),
        ({"FC": ZOD_FRONT}, "", (1900, 1902, 1920, 1084, 3848, 2168, KANNALA_BRANDT, "fisheye")),
        (DAIR, "", (2183, 2185, 940, 567, 1920, 1080, LENS)),
        (LIKE_OPENLANE, "", (1000, 1002, 960, 540, 1920, 1080, ())),
        ({**LIKE_OPENLANE, "distortion": LENS}, "", (1000, 1002, 960, 540, 1920, 1080, LENS)),
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
        ({"intrinsic": {"fx": 340, "model": "radial_poly"}}, "fy: expected a value, got none"),
        ({**LIKE_OPENLANE, "distortion": LENS, "model": "ftheta"}, "model: expected one of .*, got 'ftheta'"),
    ],
)
def test_what_cannot_be_read_is_one_clear_line(tmp_path, content, message):
    (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        Camera.from_file(tmp_path / "c.json")


def test_rectified_images_of_a_lens_without_such_a_matrix_are_refused(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps([NUIMAGES]))
    with pytest.raises(ValueError, match="expected P for rectified images, got none"):
        Camera.from_file(tmp_path / "c.json", rectified=True)
