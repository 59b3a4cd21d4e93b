"""Camera files: read those of many programs and data sets, write a ``camera_info`` YAML.

Reading is strict: an unknown key, a missing, non-finite or absurd value is a ``ValueError`` of one line.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lanebev.camera.choice import Readers, chosen, split_name
from lanebev.camera.datasets import (
    KITTI_CAMERAS,
    colmap_cameras,
    colmap_text,
    is_colmap,
    is_kitti,
    kitti_cameras,
)
from lanebev.camera.formats import opencv_or_ros, without_lens
from lanebev.camera.parameters import CameraParameters, checked
from lanebev.camera.parsing import bare_numbers, is_ros_ini, parse_documents
from lanebev.camera.programs import depthai_cameras, gyroflow, matlab, metashape, nerf, open3d, realsense
from lanebev.camera.reconstruction import openmvg_cameras, opensfm_cameras
from lanebev.camera.records import record_cameras
from lanebev.camera.several import named_cameras, stereo_cameras
from lanebev.camera.slam import (
    as_kalibr,
    camodocal,
    is_kalibr,
    kalibr_cameras,
    orb_slam_cameras,
    orb_slam_fields,
)
from lanebev.numbers import read_text, shown

_BY_KEY = {
    "RadialDistortion": matlab,
    "fisheye_params": gyroflow,
    "model_type": camodocal,
    "fl_x": nerf,
    "projection": metashape,
}
_OF_OTHERS = re.compile(r"width|\bf_?x\b|matrix", re.IGNORECASE)  # in texts other than KITTI's
_POLYNOMIAL = (
    "expected the model pinhole, fisheye or omni, got Scaramuzza's polynomial; calibrate it as a fisheye of "
    "OpenCV or Kalibr, or undistort the images and give the camera of those"
)
_NOT_READ = {  # by words of the file
    **dict.fromkeys(("MappingCoefficients", "poly_parameters", "DIRECT mapping function"), _POLYNOMIAL),
    "focal_length_x_px_": "expected one camera, got several of Argoverse 1; write one as {fx: ..., fy: ..., "
    "cx: ..., cy: ..., width: ..., height: ..., distortion: [k1, k2, 0, 0, k3]}",
}
_OF_OPEN3D = {"intrinsic_matrix", "width", "height"}
_OF_INI = (
    "it states four coefficients and no lens model; they are taken as k1 k2 k3 k4 of a fisheye, as ROS "
    "writes them: if it is a pinhole camera, add a fifth, 0"
)
_OF_MATRIX = "it is a camera matrix alone, which is taken for that of a lens without distortion"
_VIEWS = ("ret", "rvecs", "tvecs", "objpoints", "imgpoints")  # of a calibration, beside the camera
_UNDISTORTED = "roi"  # of OpenCV's getOptimalNewCameraMatrix: what of an undistorted image has no black


def read_camera(
    path: str | Path, image_size: tuple[int, int] | None = None, rectified: bool = False
) -> CameraParameters:
    """Read a camera file of any of these kinds, recognised by its content.

    - OpenCV's FileStorage (YAML, XML, JSON) by its calibration programs' keys (``M1`` and ``D1`` of two
      cameras), and ``mtx`` and ``dist`` of its Python tutorial, also in NumPy's ``.npz``;
    - ROS ``camera_info`` (YAML or INI, or a message as ``rostopic``, ``ros2 topic`` and Foxglove print it),
      its ``roi`` and ``binning_x``, ``binning_y`` applied;
    - our short YAML: fx, fy, cx, cy, width, height, distortion, model;
    - Kalibr's camchain, EuRoC's ``sensor.yaml``, calibrations of Basalt and maplab, CamOdoCal's YAML (VINS,
      KITTI-360), the settings of ORB-SLAM and stella_vslam;
    - KITTI's ``calib.txt`` and ``calib_cam_to_cam.txt``: rectified images (``P_rect_02``, ``P2``);
    - files of MATLAB, Gyroflow, Nerfstudio, RealSense, DepthAI and Metashape, see
      :mod:`lanebev.camera.programs`, and of OpenSfM and OpenMVG, see :mod:`lanebev.camera.reconstruction`;
    - JSON of data sets, see :mod:`lanebev.camera.records`;
    - COLMAP's ``cameras.txt`` and ``cameras.bin``.

    The first camera of a file with several is taken, of KITTI's files the left colour camera. If others
    differ from it, there is a remark; COLMAP's files and those of data sets in JSON are then refused.

    KITTI's object and odometry files and some data sets' JSON do not hold the image's size: it is then
    ``image_size``, or the data set's. Other files without it are taken for ``image_size`` with a remark, if
    the principal point is near the centre.

    Args:
        path: the file; the name of one of its cameras may follow after ``#``.
        image_size: (height, width) px of the images, for a file without a size. Not used otherwise.
        rectified: the images were rectified: take the projection matrix P, and no lens.

    Raises:
        ValueError: the file is missing, cut, holds an unknown key, or a missing or absurd value.
    """
    path, name = split_name(path)
    kind = path.suffix.lower()
    try:
        arrays = _arrays(path) if kind in (".npz", ".npy") else None
        # comments and names may be in other encodings: they are not needed
        text = (
            colmap_text(path) if kind == ".bin" else "" if arrays is not None else read_text(path, "replace")
        )
        bare = bare_numbers(text)
    except ValueError as error:
        raise ValueError(f"camera file {path}: expected a readable camera file, got: {error}") from error
    try:
        if is_colmap(text):
            camera = checked(chosen(colmap_cameras(text), name, has_usual=False))
        elif is_kitti(text) or (kind == ".txt" and not bare and not _OF_OTHERS.search(text)):
            found = kitti_cameras(text, image_size)
            camera = checked(chosen(found, name, has_usual=len(found) <= KITTI_CAMERAS))
        else:
            fields = bare if arrays is None else arrays
            if image_size is None and (bare or kind == ".npy"):
                raise ValueError(
                    "expected the size of the images too, got numbers alone; write fx, fy, cx, cy, width and "
                    "height as YAML"
                )
            camera = _camera_of(
                parse_documents(text) if fields is None else [fields], image_size, rectified, name
            )
            of_ini = _OF_INI if camera.model == "fisheye" and is_ros_ini(text) else ""
            of_matrix = _OF_MATRIX if fields and not fields.get("D", True) else ""
            camera = camera._replace(remark="; ".join(filter(None, (camera.remark, of_ini, of_matrix))))
        return without_lens(camera) if rectified else camera
    except ValueError as error:
        said = next((said for word, said in _NOT_READ.items() if word in text), str(error))
        raise ValueError(f"camera file {path}: {' '.join(said.split())}") from error


def _arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of NumPy's ``savez``, but for those of the views of a calibration.

    That of ``save`` is a camera matrix or a projection matrix.
    """
    try:
        if path.suffix.lower() == ".npy":
            array = np.load(path, mmap_mode="r", allow_pickle=False)
            values = array.ravel()[:17].tolist()
            return bare_numbers(" ".join(map(str, values))) or {"K": values[:10], "D": []}
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
            left_out = (*_VIEWS, _UNDISTORTED)
            found = {name: arrays[name].tolist() for name in arrays.files if name not in left_out}
    except Exception as error:  # zipfile and NumPy raise many kinds for damaged bytes
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())[:100]
        raise ValueError(f"no arrays of numbers as by numpy.save or savez: {reason}") from error
    if found and all(name.startswith("arr_") for name in found):
        raise ValueError("arrays without names; save them by numpy.savez(FILE, mtx=mtx, dist=dist)")
    return found


def _camera_of(
    documents: Sequence[Any], image_size: tuple[int, int] | None, rectified: bool, name: str | None
) -> CameraParameters:
    """Return the camera of a file's documents, such as messages that were printed one after another.

    A second document that is no camera, such as a message that breaks off, does not count.
    """
    readers = {
        str(number): partial(_camera, document, image_size, rectified, None)
        for number, document in enumerate(documents, start=1)
    }
    if len(documents) == 1 or not _is_camera(readers["2"]):
        return _camera(documents[0], image_size, rectified, name)
    return chosen(readers, name, has_usual=True)


def _is_camera(read: Callable[[], CameraParameters]) -> bool:
    try:
        read()
    except ValueError:
        return False
    return True


def _camera(
    content: Any, image_size: tuple[int, int] | None, rectified: bool, name: str | None
) -> CameraParameters:
    """Return the camera of a file's content, whose format is recognised by its keys."""
    if isinstance(content, str):
        raise ValueError(f"expected keys with a colon and a space, such as fx: 1150, got {shown(content)}")
    if not isinstance(content, dict | list) or content == {}:
        raise ValueError("expected keys such as fx, fy, cx, cy, width, height, got none; is the file empty?")
    if cameras := _unordered_cameras(content, image_size, rectified):
        return checked(chosen(cameras, name, has_usual=False))
    if isinstance(content, list):
        raise ValueError("camera_intrinsic: expected a camera with this key, got none")
    content = as_kalibr(content)
    if cameras := _ordered_cameras(content, image_size, rectified):
        return checked(chosen(cameras, name, has_usual=True))
    if name is not None:
        raise ValueError(f"expected no name after # for a file of one camera, got {shown(name)}")
    while len(content) == 1:  # keys below the camera's name, or below two as in ROS 2's settings of nodes
        (only,) = content.values()
        if not isinstance(only, Mapping) or "data" in only:
            break
        content = only
    if read := _reader_by_keys(content):
        return checked(read(content))
    return opencv_or_ros(content, rectified, image_size)


def _reader_by_keys(fields: Mapping[str, Any]) -> Callable[[Mapping[str, Any]], CameraParameters] | None:
    """Return the reader for the program whose keys a file has; None for other files."""
    if fields.keys() == _OF_OPEN3D:  # beside a lens or a size in other keys the matrix is another program's
        return open3d
    if "ppx" in map(str.lower, fields):
        return realsense
    return next((read for key, read in _BY_KEY.items() if key in fields), None)


def _unordered_cameras(content: Any, image_size: tuple[int, int] | None, rectified: bool) -> Readers:
    """Return readers of the cameras of a file that has them in no order; none for other files."""
    finders = (opensfm_cameras, openmvg_cameras, depthai_cameras)
    found = (record_cameras(content, image_size, rectified), *(find(content) for find in finders))
    return next(filter(None, found), {}) or named_cameras(content, rectified, image_size)


def _ordered_cameras(
    fields: Mapping[str, Any], image_size: tuple[int, int] | None, rectified: bool
) -> Readers:
    """Return readers of the cameras of a file whose first one is the usual one; none for other files."""
    if is_kalibr(fields):
        return kalibr_cameras(fields)
    if settings := orb_slam_fields(fields):
        return orb_slam_cameras(settings, rectified)
    return stereo_cameras(fields, rectified, image_size)


def camera_from_fields(fields: Mapping[str, Any], rectified: bool = False) -> CameraParameters:
    """Return the camera of the fields of a ROS ``camera_info``, as a message has them.

    Raises:
        ValueError: an unknown field, or a missing or absurd value.
    """
    camera = _camera(dict(fields), None, rectified, None)
    return without_lens(camera) if rectified else camera


def camera_info(camera: CameraParameters, name: str = "camera") -> dict[str, Any]:
    """Return the camera as the fields of a ROS ``camera_info`` YAML.

    ROS knows no lens with fewer than five pinhole coefficients: zeros are added, the lens stays the same.
    Reading takes all zeros as no distortion. ROS knows no unified model either: its ξ is a field of its own,
    as OpenCV's calibration programs write it.
    """
    height, width = camera.image_size
    coefficients = [float(value) for value in camera.distortion]
    mirror: dict[str, float] = {}
    if camera.model == "fisheye":
        model = "equidistant"
    elif camera.model == "omni":
        model, mirror, coefficients = "omni", {"xi": coefficients[0]}, coefficients[1:]
    else:
        coefficients += [0.0] * (5 - len(coefficients))
        model = "plumb_bob" if len(coefficients) == 5 else "rational_polynomial"
    matrix = [float(value) for value in camera.matrix]
    projection = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
    identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    return {
        "image_width": width,
        "image_height": height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "dt": "d", "data": matrix},
        "distortion_model": model,
        "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "dt": "d", "data": coefficients},
        **mirror,
        "rectification_matrix": {"rows": 3, "cols": 3, "dt": "d", "data": identity},
        "projection_matrix": {"rows": 3, "cols": 4, "dt": "d", "data": projection},
    }


def write_camera(path: str | Path, camera: CameraParameters, name: str = "camera") -> None:
    """Write the camera as a ROS ``camera_info`` YAML, which :func:`read_camera` reads as well."""
    Path(path).write_text(dump_yaml(camera_info(camera, name)), encoding="utf-8")


def dump_yaml(fields: Mapping[str, Any]) -> str:
    """Return plain YAML that PyYAML, yaml-cpp (ROS) and ``cv2.FileStorage`` read."""
    header = "%YAML 1.1\n---\n"  # cv2.FileStorage wants this line
    body: str = yaml.safe_dump(dict(fields), sort_keys=False, default_flow_style=None, width=1000)
    return header + body
