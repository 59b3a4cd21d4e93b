"""Remarks on an implausible pose, mount or image of a run."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from lanebev.camera.model import Camera
from lanebev.camera.plausibility import field_of_view
from lanebev.io.results import ExtrinsicsRow
from lanebev.types import AXES

_POSE = ((-15.0, 25.0), (-8.0, 8.0), (-8.0, 8.0), (0.8, 4.0))  # pitch, yaw, roll (degrees), height (m)
_SAME_VIEW = 2.0  # degrees, by which fields of view of one camera may differ
_BAR, _BAR_NOISE = 24, 8  # grey levels of 255: largest of a black bar, and largest range in a column of it
_BAR_WIDTH = 0.02  # fraction of the image, the smallest


def mount_remark(path: str | None, camera: Camera) -> str:
    """Return a remark on a ``calibration.yaml`` whose camera sees another angle than this one; else nothing.

    That of resized images sees the same.
    """
    if path is None:
        return ""
    try:
        other = field_of_view(Camera.from_file(path))
    except ValueError:  # a mount without a camera
        return ""
    own = field_of_view(camera)
    if abs(other - own) <= _SAME_VIEW:
        return ""
    return (
        f"mount {path}: its camera has {other:.0f} degrees of view across, this one {own:.0f}; is it of "
        "another camera?"
    )


def unfit_mount_remark(path: str | None, rows: Sequence[ExtrinsicsRow]) -> str:
    """Return a remark on a mount as a prior that lanes do not fit in any frame; else nothing."""
    unfit = sum("FEW_INLIERS" in row.reason_names for row in rows)
    if path is None or any(row.status == "TRACKING" for row in rows) or 2 * unfit <= len(rows):
        return ""
    return (
        f"mount {path}: what was seen fits its pose in no frame; is it of another camera, or was the camera "
        "moved? leave out --mount"
    )


def pose_words(pose: Sequence[float]) -> list[str]:
    """Return pitch, yaw, roll (degrees) and height (m) with their names and units."""
    units = ("degrees", "degrees", "degrees", "m")
    return [f"{name} {value:+.1f} {unit}" for name, value, unit in zip(AXES, pose, units, strict=True)]


def pose_remark(pose: Sequence[float]) -> str:
    """Return a remark on pitch, yaw, roll (degrees), height (m) unusual for a car's camera; else nothing."""
    unusual = [
        words
        for words, value, (low, high) in zip(pose_words(pose), pose, _POSE, strict=True)
        if not low <= value <= high
    ]
    if not unusual:
        return ""
    return (
        f"pose: {', '.join(unusual)} is unusual for a camera in a car: are camera and lane width right, "
        "and the image size of lanes that were given?"
    )


def drive_remark(rows: Iterable[ExtrinsicsRow]) -> str:
    """Return a remark on the median pose of the frames that were tracked; empty if it is plausible."""
    poses = [row.pose for row in rows if row.status == "TRACKING"]
    return pose_remark(np.median(poses, axis=0).tolist()) if poses else ""


def bars_remark(image: NDArray[np.uint8] | None) -> str:
    """Return a remark on black bars at the left and the right of an image (H, W, 3); else nothing."""
    if image is None:
        return ""
    brightest, darkest = image.max(0).max(-1), image.min(0).min(-1)  # (W,); NumPy takes long over (0, 2)
    inside = np.flatnonzero((brightest > _BAR) | (brightest - darkest > _BAR_NOISE))
    width = image.shape[1]
    if not len(inside) or min(left := inside[0], right := width - 1 - inside[-1]) < _BAR_WIDTH * width:
        return ""
    return (
        f"fov: images have black bars, {left} px wide at the left and {right} px at the right; the field of "
        "view must include them: cut them off, or give a camera file"
    )
