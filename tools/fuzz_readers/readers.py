"""Every kind of file that the package reads, with valid files of it."""

import io
import json
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import yaml
from PIL import Image
from safetensors.torch import save

from lanebev import Camera, Extrinsics
from lanebev.io.calibration_file import read_mount
from lanebev.io.images.pixels import read_image
from lanebev.io.lanes import read_lanes
from lanebev.io.opening import open_source
from lanebev.io.results import ExtrinsicsRow, read_extrinsics, write_extrinsics
from lanebev.io.state import load_state, save_state
from lanebev.weights import load_segmenter, read_metadata

_CURVELANES = b'{"Lines": [[{"x": "5.0", "y": "590"}, {"x": 7, "y": 580}]]}'
_LLAMAS = (
    b'{"image_name": "1", "lanes": [{"lane_id": "l0", "markers": [{"pixel_start": {"x": "5", "y": "590"}, '
    b'"pixel_end": {"x": 7, "y": 580}}]}]}'
)
_BDD100K = [
    b'[{"name": "1.jpg", "labels": [{"category": "lane", "attributes": {"laneDirection": "parallel"}, '
    b'"poly2d": [{"vertices": [[5, 590], [7, 580.5], [9, 560], [10, 540]], "types": "LCCC"}]}]}]',
    b'{"name": "1", "frames": [{"objects": [{"category": "lane/x", "poly2d": [[5, 590, "L"], [7, 8]]}]}]}',
]
_DRAWN = [
    b'{"imagePath": "1.png", "shapes": [{"shape_type": "linestrip", "points": [[5, 590], [7.5, 580]]}]}',
    b'{"info": {"image_path": "a/1.jpg"}, "annotations": {"lane": [{"points": [[5, 590], [7, 580]]}]}}',
    b'{"objects": [{"geometryType": "line", "points": {"exterior": [[5, 590], [7, 580]], "interior": []}}]}',
    b'{"item": {"name": "1"}, "annotations": [{"line": {"path": [{"x": 5, "y": 590}, {"x": 7, "y": 580}]}}]}',
    b'{"data_row": {"external_id": "1"}, "projects": {"a": {"labels": [{"annotations": {"objects": '
    b'[{"line": [{"x": 5, "y": 590}]}]}}]}}}',
    b'{"items": [{"id": "1", "image": {"size": [9, 9]}, "annotations": [{"type": "polyline", '
    b'"points": [5, 6]}]}]}',
    b'{"a": {"filename": "1", "regions": [{"shape_attributes": {"name": "polyline", "all_points_x": [5], '
    b'"all_points_y": [6]}}]}}',
]


class Reader(NamedTuple):
    """A kind of file.

    Attributes:
        read: a path, to a value or a ValueError.
        suffix: suffix of its files' names.
        seeds: valid files.
        share: share of the inputs, relative to the others.
    """

    read: Callable[[Path], Any]
    suffix: str
    seeds: list[bytes]
    share: int = 10


def readers() -> dict[str, Reader]:
    """Return every kind of file that the package reads, with valid ones."""
    return {
        "camera.yaml": Reader(_read_cameras, ".yaml", _camera_yaml(), 30),
        "camera.json": Reader(_read_cameras, ".json", _camera_json()),
        "camera.xml": Reader(_read_cameras, ".xml", [_opencv(".xml")]),
        "calib.txt": Reader(
            _read_cameras,
            "calib.txt",
            [
                b"P2: 721.5377 0 609.5 44.8 0 721.5377 172.8 0.2 0 0 1 0\n",
                b"1 OPENCV 1280 720 800 801 640 360 -0.3 0.1 0.001 -0.002\n",
                b"1 FOV 1280 720 800 801 640 360 0.9\n",
                b"[image]\n\nwidth\n640\n\nheight\n480\n\n[a]\n\ncamera matrix\n369 0 320\n0 367 203\n0 0 1\n"
                b"distortion\n0.19 -0.02 0 0 0\n",
            ],
        ),
        "lanes.json": Reader(read_lanes, ".json", _tusimple(), 30),
        "openlane.json": Reader(
            partial(read_lanes, intrinsics=np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])),
            ".json",
            [*_openlane(), *_lanes3d(), _CURVELANES, _LLAMAS, *_BDD100K, *_DRAWN],
            20,
        ),
        "culane": Reader(
            read_lanes, ".lines.txt", [b"10 590 12.5 580 15 570 17 560\n500.25 590 510 580 520 570\n"], 20
        ),
        "calibration.yaml": Reader(read_mount, ".yaml", [_calibration()], 20),
        "state": Reader(_read_state, ".safetensors", [_state()], 20),
        "weights": Reader(_read_weights, ".safetensors", [_weights()]),
        "extrinsics.csv": Reader(read_extrinsics, ".csv", [_extrinsics()]),
        "image": Reader(read_image, ".png", _images()),
        "video": Reader(_read_video, ".mp4", _videos(), 2),
    }


def _read_cameras(path: Path) -> None:
    for rectified in (False, True):
        try:
            Camera.from_file(path, rectified=rectified)
        except ValueError as error:
            failed = error
        else:
            return
    raise failed


def _read_state(path: Path) -> None:
    like = {"pose": Extrinsics(*torch.zeros(4, 1))}
    for expected in (None, like):
        if (loaded := load_state(path, expected)).problem is not None:
            raise ValueError(loaded.problem)


def _read_weights(path: Path) -> None:
    read_metadata(path)
    load_segmenter(path)


def _read_video(path: Path) -> None:
    for _ in open_source(str(path)):
        pass


def _camera_yaml() -> list[bytes]:
    lens = Camera.from_parameters(812.5, 810, 641, 355, 1280, 720, [-0.31, 0.11, 0.0004, -0.0007, -0.017])
    omni = Camera.from_parameters(812.5, 810, 641, 355, 1280, 720, [1.2, 0.1, 0.0, 0.0, 0.0], "omni")
    message = {
        "header": {"frame_id": "a"}, "height": 720, "width": 1280, "distortion_model": "plumb_bob",
        "D": [0.0] * 5, "K": [500.0, 0, 640, 0, 500, 360, 0, 0, 1], "R": [1, 0, 0, 0, 1, 0, 0, 0, 1],
        "P": [500.0, 0, 640, 0, 0, 500, 360, 0, 0, 0, 1, 0], "binning_x": 2, "binning_y": 1,
        "roi": {"x_offset": 4, "y_offset": 2, "height": 700, "width": 1200, "do_rectify": False},
    }  # fmt: skip
    kalibr = {
        "camera_model": "pinhole", "intrinsics": [500, 500, 320, 240], "distortion_model": "radtan",
        "distortion_coeffs": [0.1, 0.0, 0.0, 0.0], "resolution": [640, 480],
    }  # fmt: skip
    short = b"fx: 500\nfy: 500\ncx: 320\ncy: 240\nwidth: 640\nheight: 480\ndistortion: [-0.1, 0, 0, 0]\n"
    mei = (
        b"%YAML:1.0\n---\nmodel_type: MEI\nimage_width: 640\nimage_height: 480\n"
        b"mirror_parameters: {xi: 1.1}\n"
        b"distortion_parameters: {k1: 0, k2: 0, p1: 0, p2: 0}\n"
        b"projection_parameters: {gamma1: 700, gamma2: 700, u0: 320, v0: 240}\n"
    )
    dumped = [yaml.safe_dump(each).encode() for each in (message, {"cam0": kalibr}, kalibr)]
    return [_written(lens), _written(omni), _opencv(".yml"), short, mei, *dumped]


def _written(camera: Camera) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        camera.to_file(Path(folder) / "camera.yaml")
        return (Path(folder) / "camera.yaml").read_bytes()


def _opencv(suffix: str) -> bytes:
    """Return a calibration as OpenCV writes it."""
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([-0.1, 0.02, 0.0, 0.0, 0.0]))
    return str(storage.releaseAndGetString()).encode()


def _camera_json() -> list[bytes]:
    matrix = [[1266.4, 0, 816.3], [0, 1266.4, 491.5], [0, 0, 1]]
    records: list[Any] = [{"camera_intrinsic": matrix}, [{"camera_intrinsic": matrix}], {"intrinsic": matrix}]
    lens = {"k1": -0.3, "k2": 0.1, "p1": 0.001, "p2": 0.0}
    named = {"fx": 900, "fy": 900, "cx": 640, "cy": 360}
    fisheye = {"k1": 339.7, "k2": -32.0, "k3": 48.3, "k4": -7.2, "cx_offset": 3.9, "cy_offset": -3.1}
    size = {"width": 1600, "height": 900}
    openmvg = {**size, "focal_length": 1266.4, "principal_point": [816.3, 491.5], "disto_k1": [-0.1]}
    basalt = {"camera_type": "ds", "intrinsics": {**named, "xi": -0.28, "alpha": 0.57}}
    records += [
        {"fl_x": 900, "cx": 640, "cy": 360, "w": 1280, "h": 720, **lens},
        {"fx": 900, "fy": 900, "ppx": 640, "ppy": 360, "width": 1280, "height": 720, "coeffs": [0] * 5},
        {"intrinsic": [2059, 2061, 936, 635, -0.3, 0.1, 0, 0, 0], "width": 1920, "height": 1280},
        {"intrinsic": {"aspect_ratio": 1, "width": 1280, "height": 966, "model": "radial_poly", **fisheye}},
        {"Camera": {**named, **lens, "cols": 1280, "rows": 720, "model": "perspective"}},
        {"value0": {"intrinsics": [basalt], "resolution": [[1280, 720]]}},
        {
            "a": {
                "projection_type": "brown",
                "focal_x": 0.6,
                "focal_y": 0.6,
                "width": 1280,
                "height": 720,
                **lens,
            }
        },
        {"sfm_data_version": "0.3", "intrinsics": [{"key": 0, "value": {"ptr_wrapper": {"data": openmvg}}}]},
        {
            "cameraData": [
                [0, {"cameraType": 0, "intrinsicMatrix": matrix, "distortionCoeff": [0] * 14, **size}]
            ]
        },
        {"M1": matrix, "D1": [0.1] * 5, "M2": matrix, "D2": [0.1] * 5, **size},
    ]
    return [_opencv(".json"), *(json.dumps(each).encode() for each in records)]


def _tusimple() -> list[bytes]:
    frame = {"raw_file": "a/1.jpg", "h_samples": [500, 510, 520], "lanes": [[-2, 5, 6.5], [7, 8, None]]}
    sure = {**frame, "raw_file": "a/2.jpg", "boundary": [2, 3], "sigma": [[-2, 1, 1], [1, 1, -2]]}
    vertices = {"points": [[[5, 500], [6, 510.5]]], "sigma": [[1, 2]], "weight": [[1, 0.5]], "boundary": [2]}
    seen = {**frame, "raw_file": "a/3.jpg", "seen": vertices, "pose_sigma_scale": 1.5}
    return ["\n".join(json.dumps(each) for each in (frame, sure, seen)).encode()]


def _lanes3d() -> list[bytes]:
    ground = {
        "raw_file": "1.jpg",
        "cam_height": 1.5,
        "cam_pitch": 0.1,
        "laneLines": [[[1.8, 10, 0], [1.8, 20, 0]]],
    }
    once = {
        "lanes": [[[1.8, 1.5, 10], [1.8, 1.5, 20]]],
        "calibration": [[900, 0, 640], [0, 900, 360], [0, 0, 1]],
    }
    return [
        json.dumps(each).encode() for each in (ground, {**ground, "laneLines_visibility": [[1, 0]]}, once)
    ]


def _openlane() -> list[bytes]:
    flat = {"uv": [[1, 2, 3], [590, 580, 570]], "category": 1}
    label = {"xyz": [[10, 20, 30], [1, 1, 1], [-1.5, -1.5, -1.5]], "visibility": [1, 0, 1]}
    predicted = {"xyz": [[1.8, 10, 0], [1.8, 20, 0.1], [1.7, 30, 0], [1.7, 40, 0]], "category": 2}
    fields = {
        "file_path": "a/1.jpg",
        "intrinsic": [[1000, 0, 640], [0, 1000, 360], [0, 0, 1]],
        "extrinsic": [[1, 0, 0, 1.5], [0, 1, 0, 0], [0, 0, 1, 2.1], [0, 0, 0, 1]],
        "lane_lines": [flat, label, predicted],
    }
    return [json.dumps(fields).encode(), json.dumps(fields, indent=1).encode()]


def _calibration() -> bytes:
    mount = {"valid": False, "pitch_deg": 1.0, "pitch_std_deg": 0.1, "height_m": 1.5, "height_std_m": 0.05}
    return yaml.safe_dump({"image_width": 640, "mount": {**mount, "needs": ["yaw: needs 20 s"]}}).encode()


def _state() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "state.safetensors"
        save_state(path, {"pose": Extrinsics(*torch.rand(4, 1)), "camera": "pinhole 640x480", "time": 1.5})
        return path.read_bytes()


def _weights() -> bytes:
    config = json.dumps({"base_width": 8, "decoder_width": 8, "image_size": [64, 64], "context": [1, 2]})
    metadata = {"format": "lanebev.LaneSegmenter/1", "config": config, "seed": "1"}
    return bytes(save({"a.weight": torch.rand(2, 2), "b": torch.zeros(1, dtype=torch.int64)}, metadata))


def _extrinsics() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "extrinsics.csv"
        values: dict[str, Any] = dict.fromkeys(ExtrinsicsRow._fields, 0.5)
        values |= {"frame": 0, "status": "TRACKING", "segments": 5, "image": "a,b.jpg", "reasons": ""}
        write_extrinsics(path, [ExtrinsicsRow(**values)])
        return path.read_bytes()


def _images() -> list[bytes]:
    pictures = []
    for kind, mode in (
        ("png", "RGB"),
        ("jpeg", "RGB"),
        ("png", "I;16"),
        ("tiff", "RGB"),
        ("bmp", "L"),
        ("webp", "RGB"),
    ):
        with io.BytesIO() as file:
            Image.new(mode, (16, 12), 40 if len(mode) != 3 else (40, 50, 60)).save(file, kind)
            pictures.append(file.getvalue())
    return pictures


def _videos() -> list[bytes]:
    from fractions import Fraction

    from lanebev.io.video.writer import VideoWriter

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "v.mp4"
        with VideoWriter(path, Fraction(10)) as writer:
            for i in range(6):
                writer.write(np.full((16, 16, 3), 40 * i, np.uint8))
        return [path.read_bytes()]
