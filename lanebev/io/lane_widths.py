"""Lanes that are not equally wide, which the pose takes them for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median

from lanebev.camera.model import Camera
from lanebev.io.lane_parsing import FrameLines
from lanebev.observation.polylines import lane_width_ratio

_LOOKED_AT = 50  # frames
_UNEQUAL = 1.8  # ratio; equally wide lanes have it if the camera is rolled by about 5 degrees


def unequal_lanes_remark(frames: Sequence[FrameLines], camera: Camera) -> str:
    """Return a remark on lanes whose widths differ much, unless the camera is rolled; else nothing.

    Two lanes of any widths look like equal ones to a camera with a certain roll, so that the pose does not
    tell.

    Args:
        frames: lanes of a drive.
        camera: the lens.
    """
    looked_at = frames[:: max(1, len(frames) // _LOOKED_AT)]
    ratios = [lane_width_ratio(frame.lines, camera) for frame in looked_at]
    known = [ratio for ratio in ratios if math.isfinite(ratio)]
    if not known or median(known) < _UNEQUAL:
        return ""
    return (
        f"lanes: one lane is {median(known):.1f} times as wide as another, unless the camera is rolled; if a "
        "line bounds no lane, as that of a shoulder, leave it out, since roll and height suppose equal lanes"
    )
