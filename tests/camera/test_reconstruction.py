"""Camera files of OpenSfM, OpenMVG, DepthAI, COLMAP's radial models and OpenCV's stereo calibration."""

import math

import pytest
import torch

from lanebev import Camera
from tests.camera.files import read, written

MATRIX = [[700.0, 0.0, 641.0], [0.0, 705.0, 357.0], [0.0, 0.0, 1.0]]


def _opensfm(kind, **fields):
    return {"v2 make model 1280 720": {"projection_type": kind, "width": 1280, "height": 720, **fields}}


BROWN = {
    "focal_x": 0.6,
    "focal_y": 0.61,
    "c_x": 0.01,
    "c_y": -0.02,
    "k1": -0.3,
    "k2": 0.1,
    "p1": 0.001,
    "p2": -0.002,
}


@pytest.mark.parametrize(
    "place", [lambda cameras: cameras, lambda cameras: [{"cameras": cameras, "shots": {}}]]
)
def test_opensfms_lengths_are_shares_of_the_longer_side(tmp_path, place):
    camera = read(tmp_path / "c.json", place(_opensfm("brown", k3=0.02, **BROWN)))
    assert camera.intrinsics.flatten().tolist() == pytest.approx(
        [768, 0, 639.5 + 12.8, 0, 780.8, 359.5 - 25.6, 0, 0, 1]
    )
    assert camera.distortion.tolist() == pytest.approx([-0.3, 0.1, 0.001, -0.002, 0.02])
    assert (camera.model, camera.image_size) == ("pinhole", (720, 1280))


def test_opensfms_other_lenses(tmp_path):
    camera = read(tmp_path / "c.json", _opensfm("perspective", focal=0.6, k1=-0.1, k2=0.01))
    assert camera.intrinsics[:2, 2].tolist() == [639.5, 359.5]
    assert camera.distortion.tolist() == pytest.approx([-0.1, 0.01, 0, 0, 0])
    camera = read(tmp_path / "c.json", _opensfm("fisheye", focal=0.4, k1=0.1, k2=0.01))
    assert (camera.model, camera.distortion.tolist()) == ("fisheye", [0.1, 0.01, 0, 0])
    for kind in ("spherical", "fisheye624"):
        with pytest.raises(
            ValueError, match=f"projection_type: expected one of perspective, .*, got '{kind}'"
        ):
            read(tmp_path / "c.json", _opensfm(kind, focal=0.4))


def _openmvg(**lens):
    data = {"width": 1280, "height": 720, "focal_length": 700.0, "principal_point": [641.0, 357.0], **lens}
    pointer = {"id": 2147483650, "data": data}
    value = {"polymorphic_id": 2147483649, "polymorphic_name": "pinhole", "ptr_wrapper": pointer}
    return {
        "sfm_data_version": "0.3",
        "views": [],
        "intrinsics": [{"key": 0, "value": value}],
        "structure": [],
    }


@pytest.mark.parametrize(
    ("lens", "model", "distortion"),
    [
        ({}, "pinhole", []),
        ({"disto_k1": [-0.1]}, "pinhole", [-0.1, 0, 0, 0, 0]),
        ({"disto_k3": [-0.1, 0.02, 0.003]}, "pinhole", [-0.1, 0.02, 0, 0, 0.003]),
        ({"disto_t2": [-0.1, 0.02, 0.003, 1e-3, 2e-3]}, "pinhole", [-0.1, 0.02, 1e-3, 2e-3, 0.003]),
        ({"fisheye": [0.1, 0.02, 0.003, 0.001]}, "fisheye", [0.1, 0.02, 0.003, 0.001]),
    ],
)
@pytest.mark.parametrize("nested", [False, True])
def test_openmvgs_lenses(tmp_path, lens, model, distortion, nested):
    content = _openmvg(**lens)
    if nested:  # since 1.4
        pointer = content["intrinsics"][0]["value"]["ptr_wrapper"]
        own = {key: value for key, value in pointer["data"].items() if key not in lens}
        pointer["data"] = {"value0": own, **lens}
    camera = read(tmp_path / "c.json", content)
    assert camera.intrinsics.tolist() == [[700, 0, 641], [0, 700, 357], [0, 0, 1]]
    assert (camera.model, camera.image_size) == (model, (720, 1280))
    assert camera.distortion.tolist() == pytest.approx(distortion)


def test_cameras_of_depthai_are_chosen_by_their_sockets(tmp_path):
    camera = {"cameraType": 0, "distortionCoeff": [0.1] + [0.0] * 13, "height": 720, "width": 1280}
    cameras = [
        [0, {**camera, "intrinsicMatrix": MATRIX}],
        [1, {**camera, "cameraType": 1, "intrinsicMatrix": MATRIX}],
    ]
    content = {"batchName": "", "boardName": "OAK", "cameraData": cameras}
    with pytest.raises(ValueError, match="expected one camera, got 2: 0, 1; choose one as FILE#0"):
        read(tmp_path / "c.json", content)
    colour = Camera.from_file(f"{tmp_path}/c.json#0")
    assert colour.intrinsics.tolist() == MATRIX
    assert (colour.model, colour.distortion[0].item()) == ("pinhole", 0.1)
    assert Camera.from_file(f"{tmp_path}/c.json#1").model == "fisheye"


def test_colmaps_fov_camera_is_the_nearest_kannala_brandt_camera(tmp_path):
    camera = read(tmp_path / "cameras.txt", "1 FOV 1280 720 700 700 640.5 360.5 0.9\n")
    rays = torch.tensor([[0.1, 0.0], [0.5, 0.3], [0.9, -0.4]], dtype=torch.float64)
    radius = rays.norm(dim=-1, keepdim=True)
    seen = 700 * rays / radius * torch.atan(2 * radius * math.tan(0.45)) / 0.9 + 640
    seen[:, 1] -= 280
    ideal = rays @ camera.intrinsics[:2, :2].mT + camera.intrinsics[:2, 2]
    torch.testing.assert_close(camera.distort_points(ideal), seen, rtol=0, atol=0.5)
    plain = read(tmp_path / "cameras.txt", "1 FISHEYE 1280 720 700 705 640.5 360.5\n")
    assert (plain.model, plain.distortion.tolist()) == ("fisheye", [0, 0, 0, 0])


@pytest.mark.parametrize(
    ("matrix", "lens"), [("M", "D"), ("K", "D"), ("cameraMatrix", "distCoeffs"), ("mtx", "dist")]
)
def test_of_opencvs_stereo_calibration_the_left_camera_is_taken(tmp_path, matrix, lens):
    fields = {f"{matrix}{i}": [[700 + i, 0, 641], [0, 700, 357], [0, 0, 1]] for i in (1, 2)}
    fields |= {f"{lens}{i}": [[-0.3, 0.1, 0, 0, 0.01 * i]] for i in (1, 2)} | {"R": MATRIX, "T": [1, 0, 0]}
    camera = read(tmp_path / "c.json", fields, image_size=(720, 1280))
    assert (camera.intrinsics[0, 0].item(), camera.distortion[4].item()) == (701, 0.01)
    assert f"of which {matrix}1 is taken; choose another as FILE#{matrix}2" in camera.remark
    path = written(tmp_path / "c.json", {**fields, "width": 1280, "height": 720})
    right = Camera.from_file(f"{path}#{matrix}2")
    assert (right.intrinsics[0, 0].item(), right.distortion[4].item()) == (702, 0.02)


def test_coefficients_of_a_ros_file_may_have_keys_of_their_own(tmp_path):
    fields = {
        "image_width": 1280,
        "image_height": 720,
        "camera_matrix": MATRIX,
        "distortion_model": "plumb_bob",
    }
    camera = read(tmp_path / "c.json", {**fields, "k1": -0.3, "p2": 0.002})
    assert camera.distortion.tolist() == pytest.approx([-0.3, 0, 0, 0.002, 0])
    with pytest.raises(
        ValueError, match=r"expected one of k1, k2, ... and distortion_coefficients, got both"
    ):
        read(tmp_path / "c.json", {**fields, "k1": -0.3, "distortion_coefficients": [0, 0, 0, 0, 0]})
    with pytest.raises(
        ValueError, match="distortion_coefficients: expected a value, got none; add the entry"
    ):
        read(tmp_path / "c.json", fields)
