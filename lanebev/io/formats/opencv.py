"""OpenCV: lens and poses for ``cv2.projectPoints``, in a file of ``cv2.FileStorage``."""

from pathlib import Path
from typing import Any

from torch import Tensor

from lanebev.camera.files import camera_info, dump_yaml
from lanebev.io.formats.record import RunRecord


def opencv_poses(record: RunRecord) -> dict[str, Any]:
    """Return the file's fields: lens, one pose for the run, and every frame's.

    Source: OpenCV's camera model: ``rvec`` (rad, Rodrigues) and ``tvec`` (m) take points of the road's frame
    (X right, Y down, Z along the lanes, origin on the road below the camera) to the camera's (x right, y
    down, z forward). ``rvecs`` and ``tvecs`` have a row per frame, ``frames`` its number. For the model
    "fisheye" it is ``cv2.fisheye.projectPoints``.
    """
    rvecs, tvecs = record.poses().rvec_tvec()
    rvec, tvec = record.standing_pose().extrinsics.rvec_tvec()
    lens = camera_info(record.lens().parameters())
    kept = ("image_width", "image_height", "camera_matrix", "distortion_model", "distortion_coefficients")
    numbers = [row.frame for row in record.rows]
    return {
        **{name: lens[name] for name in kept},
        **({"xi": lens["xi"]} if "xi" in lens else {}),
        "pose_source": record.standing_pose().source,
        "rvec": _matrix(rvec.mT),
        "tvec": _matrix(tvec.mT),
        "frames": {"rows": len(numbers), "cols": 1, "dt": "i", "data": numbers},
        "rvecs": _matrix(rvecs),
        "tvecs": _matrix(tvecs),
    }


def write(path: Path, record: RunRecord) -> None:
    """Write the run."""
    path.write_text(dump_yaml(opencv_poses(record)), encoding="utf-8")


def _matrix(values: Tensor) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "dt": "d", "data": values.flatten().tolist()}
