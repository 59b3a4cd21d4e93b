"""Reasons why a frame is not, or not fully, tracked."""

from enum import IntFlag


class Reason(IntFlag):
    """Why a row is not, or not fully, tracked; several may hold at once.

    Later versions may add values; these keep their meaning.

    Attributes:
        NONE: every axis was updated.
        NO_SEGMENTS: no lane boundary was seen in this frame, or there was no image.
        FEW_INLIERS: the boundaries seen do not fit the estimate.
        TIME: the frame is not later than the one before and was not used, or its time is unknown and one was
            assumed.
        NO_START: not started yet: this frame does not determine pitch and yaw.
        ROLL_UNSEEN: at most one lane was seen, or the frame was not used: roll is not updated and its
            standard deviation grows.
        HEIGHT_UNSEEN: no lane with both boundaries was seen, or the frame was not used: the height is not
            updated and its standard deviation grows.
        LANE_CHANGE: the boundary indices changed by one in this frame.
        RESTARTED: estimation started with this frame.
        DIRECTION_UNSEEN: at most one boundary was seen, or the frame was not used: pitch and yaw are not
            updated.
    """

    NONE = 0
    NO_SEGMENTS = 1
    FEW_INLIERS = 2
    TIME = 4
    NO_START = 8
    ROLL_UNSEEN = 16
    HEIGHT_UNSEEN = 32
    LANE_CHANGE = 64
    RESTARTED = 128
    DIRECTION_UNSEEN = 256


REASON_WORDS = {
    Reason.NO_SEGMENTS: "no lane boundaries seen",
    Reason.FEW_INLIERS: "what was seen does not fit the road",
    Reason.TIME: "the frames' times do not advance",
    Reason.NO_START: "no frame yet to start from",
    Reason.DIRECTION_UNSEEN: "one boundary only",
    Reason.HEIGHT_UNSEEN: "no lane with both its boundaries",
    Reason.ROLL_UNSEEN: "one lane only",
    Reason.LANE_CHANGE: "lane change",
    Reason.RESTARTED: "started in this frame",
}
WHOLE_FRAME = (Reason.NO_SEGMENTS, Reason.FEW_INLIERS, Reason.TIME, Reason.NO_START)
UNSEEN = {  # axes that are not determined; the first that holds implies those after it
    Reason.DIRECTION_UNSEEN: ("pitch", "yaw"),
    Reason.HEIGHT_UNSEEN: ("height",),
    Reason.ROLL_UNSEEN: ("roll",),
}


def telling_reasons(reasons: Reason) -> list[Reason]:
    """Select the reasons that no other one implies, in the order of :data:`REASON_WORDS`.

    Where nothing of the frame was used, no axis is determined; and one boundary alone leaves open what one
    lane alone does.
    """
    unseen = [reason for reason in UNSEEN if reason & reasons]
    implied = unseen if any(reason & reasons for reason in WHOLE_FRAME) else unseen[1:]
    return [reason for reason in REASON_WORDS if reason & reasons and reason not in implied]


def describe_reasons(reasons: Reason) -> list[str]:
    """Describe why a frame is not (fully) tracked, a phrase for each reason that no other one implies."""
    axes = [axis for reason, names in UNSEEN.items() if reason & reasons for axis in names]
    what = f"{', '.join(axes)} not determined: "
    return [(what if reason in UNSEEN else "") + REASON_WORDS[reason] for reason in telling_reasons(reasons)]
