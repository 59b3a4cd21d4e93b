"""Lanes that are not equally wide, which the pose takes them for."""

import math
from collections.abc import Sequence

import numpy as np

from lanebev.camera.model import Camera
from lanebev.io.lanes.parsing import FrameLines
from lanebev.observation.polylines import lane_width_ratios

_LOOKED_AT = 50  # frames
_UNEQUAL = 1.8  # ratio
_MOST_ROLL = 2  # degrees; with it six boundaries of equally wide lanes look as if of a ratio of up to 2.4


def unequal_lanes_remark(frames: Sequence[FrameLines], camera: Camera) -> str:
    """Return a remark on lanes whose widths differ much for any usual roll of the camera; else nothing.

    Two lanes of any widths look like equal ones to a camera with a certain roll, so that the pose does not
    tell.

    Args:
        frames: lanes of a drive.
        camera: the lens.
    """
    looked_at = frames[:: max(1, len(frames) // _LOOKED_AT)]
    rolls = [0.0, *(math.radians(sign * roll) for roll in range(1, _MOST_ROLL + 1) for sign in (-1, 1))]
    ratios = np.array([lane_width_ratios(frame.lines, camera, rolls) for frame in looked_at])
    known = ratios[np.isfinite(ratios[:, 0])] if len(ratios) else ratios
    if not len(known) or np.median(np.nanmin(known, axis=-1)) < _UNEQUAL:
        return ""
    return (
        f"lanes: one lane is {np.median(known[:, 0]):.1f} times as wide as another, unless the camera is "
        f"rolled by more than {_MOST_ROLL} degrees; if a line bounds no lane, as that of a shoulder, leave "
        "it out, since roll and height suppose equal lanes"
    )
