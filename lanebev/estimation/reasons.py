"""Why a frame is not (fully) tracked."""

from __future__ import annotations

from enum import IntFlag


class Reason(IntFlag):
    """Why a row is not (fully) tracked; several may hold at once. A new meaning is a new value."""

    NONE = 0
    NO_SEGMENTS = 1  # nothing was seen in this frame
    FEW_INLIERS = 2  # what was seen does not fit the estimate
    TIME = 4  # not later than the last frame, and not used; or the time unknown, and one assumed
    NO_START = 8  # not started yet: this frame does not determine pitch and yaw
    ROLL_UNSEEN = 16  # one lane or less, or the frame was not used: roll is not updated, its sigma grows
    HEIGHT_UNSEEN = 32  # no lane, or the frame was not used: height is not updated, its sigma grows
    LANE_CHANGE = 64  # the boundary indices moved by one in this frame
    RESTARTED = 128  # started, or started anew, in this frame
    DIRECTION_UNSEEN = 256  # one boundary or less, or not used: pitch and yaw are not updated
