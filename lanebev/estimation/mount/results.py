"""State and results of the mount estimator, and their description in words."""

from enum import IntEnum, IntFlag
from typing import NamedTuple

from torch import Tensor

from lanebev.estimation.mount.config import MountConfig
from lanebev.torch_internals import register_pytree
from lanebev.types import AXES, Extrinsics


class MountStatus(IntEnum):
    """Status of a mount estimate or of one axis.

    Later versions may add values; these keep their meaning.

    Attributes:
        UNCALIBRATED: not enough blocks yet.
        CALIBRATED: enough blocks, and the estimate is within the limits of a usable mount.
        INVALID: enough blocks, but the estimate is outside the limits: mount the camera again.
        RECALIBRATING: estimation has started again, because the camera was moved or frames contradicted the
            estimate.
        PARTIAL: of the mount as a whole: some axes are calibrated, others are not yet.
    """

    UNCALIBRATED = 0
    CALIBRATED = 1
    INVALID = 2
    RECALIBRATING = 3
    PARTIAL = 4


class MountReason(IntFlag):
    """Why an estimate is not (yet) valid, or this frame was not used; several may hold at once.

    Attributes:
        NONE: the frame was used and the estimate is valid.
        NOT_TRACKING: the frame's pose is not TRACKING.
        UNSURE: the standard deviation of the frame's pose is too large (``MountConfig.largest_std``).
        SLOW: the vehicle is slower than ``MountConfig.min_speed``.
        TURNING: the yaw rate of the vehicle or the curvature of the road is too large.
        FEW_BLOCKS: progress is below 100 %.
        PITCH_LIMIT, YAW_LIMIT, ROLL_LIMIT, HEIGHT_LIMIT: the estimate is outside the limits of a usable
            mount.
        SUSPECT: the latest blocks or frames contradict the estimate.
        MOVED: the camera was moved; estimation restarted in this frame.
        TIME: dt is not positive or not finite.
        WITHDRAWN: the estimate was dropped in this frame: it is older than a move of the camera, or was
            contradicted.
        STALE: no new block for a long time.
    """

    NONE = 0
    NOT_TRACKING = 1
    UNSURE = 2
    SLOW = 4
    TURNING = 8
    FEW_BLOCKS = 16
    PITCH_LIMIT = 32
    YAW_LIMIT = 64
    ROLL_LIMIT = 128
    HEIGHT_LIMIT = 256
    SUSPECT = 512
    MOVED = 1024
    TIME = 2048
    WITHDRAWN = 4096
    STALE = 8192


@register_pytree
class MountState(NamedTuple):
    """The state of the estimator between frames, tensors only. K blocks of each axis, the newest first.

    Attributes:
        blocks: (B, K, 4) mean pose of each.
        variances: (B, K, 4) mean variance of the frames' poses in each.
        filled: (B, K, 4) 1 where there is a block.
        ages: (B, K, 4) s since the block was begun.
        pose_sum: (B, 4) of the current block, times seconds.
        variance_sum: (B, 4) likewise.
        seconds: (B, 4) of accepted frames in the current block.
        begun: (B, 4) s since the current block was begun.
        suspect: (B, 4) int64, newest blocks that contradict the others.
        contradicted: (B, 4) s for which frames that are too unsure to be used have contradicted the estimate.
        former: (B, 4) estimate before the last restart.
        blend: (B, 4) in [0, 1], its share in what is given out.
        status: (B, 4) int64, values of MountStatus.
        reasons: (B, 4) int64, MountReason flags of the last frame.
    """

    blocks: Tensor
    variances: Tensor
    filled: Tensor
    ages: Tensor
    pose_sum: Tensor
    variance_sum: Tensor
    seconds: Tensor
    begun: Tensor
    suspect: Tensor
    contradicted: Tensor
    former: Tensor
    blend: Tensor
    status: Tensor
    reasons: Tensor


@register_pytree
class MountCalibration(NamedTuple):
    """The current mount estimate.

    Attributes:
        extrinsics: pitch, yaw, roll, height of the camera in the vehicle, each (B,).
        covariance: (B, 4, 4).
        status: (B,) int64, values of :class:`MountStatus`, of the mount as a whole: CALIBRATED where every
            axis is.
        progress: (B,) per cent of the blocks needed, of the axis that has the fewest.
        reasons: (B,) int64, :class:`MountReason` flags of all axes together.
        axis_status: (B, 4) int64, values of :class:`MountStatus` of pitch, yaw, roll, height.
        axis_progress: (B, 4) per cent.
        axis_reasons: (B, 4) int64, :class:`MountReason` flags.
    """

    extrinsics: Extrinsics
    covariance: Tensor
    status: Tensor
    progress: Tensor
    reasons: Tensor
    axis_status: Tensor
    axis_progress: Tensor
    axis_reasons: Tensor


_FRAME_REASONS = {
    MountReason.NOT_TRACKING: "no lane boundaries in this frame",
    MountReason.UNSURE: "this frame does not determine it",
    MountReason.SLOW: "the vehicle is too slow",
    MountReason.TURNING: "the road or the vehicle turns",
    MountReason.TIME: "the frame's time does not advance",
}
LIMIT_REASONS = (  # of each axis
    MountReason.PITCH_LIMIT, MountReason.YAW_LIMIT, MountReason.ROLL_LIMIT, MountReason.HEIGHT_LIMIT,
)  # fmt: skip
_STATE_REASONS = {
    **dict.fromkeys(LIMIT_REASONS, "outside the limits of a usable mount"),
    MountReason.SUSPECT: "the latest frames contradict the estimate",
    MountReason.STALE: "not confirmed for a long time",
}
_NEEDS = {
    "roll": "straight driving with two lanes in view",
    "height": "straight driving with a lane of known width in view",
}


def describe_mount(mounted: MountCalibration, config: MountConfig | None = None, row: int = 0) -> list[str]:
    """Describe the mount, a sentence for each axis: whether it is calibrated, or what it still needs.

    Args:
        mounted: mount estimate of any batch size.
        config: config of the estimator; None is the default.
        row: row of the batch.

    Returns:
        four sentences, of pitch, yaw, roll and height, such as "roll: needs 20 s of straight driving with two
        lanes in view; 8 s so far".
    """
    config = config or MountConfig()
    sentences = []
    for axis, name in enumerate(AXES):
        status = MountStatus(int(mounted.axis_status[row, axis]))
        reasons = MountReason(int(mounted.axis_reasons[row, axis]))
        notes = [text for flag, text in _STATE_REASONS.items() if reasons & flag]
        if status == MountStatus.CALIBRATED:
            sentence = "calibrated"
        elif status == MountStatus.INVALID:
            sentence = "not usable"
        else:
            needed = config.needed * config.block_time
            done = needed * float(mounted.axis_progress[row, axis]) / 100
            what = _NEEDS.get(name, "straight driving")
            sentence = f"needs {needed:.0f} s of {what}; {done:.0f} s so far"
            if status == MountStatus.RECALIBRATING:
                sentence = f"restarted because the camera was moved: {sentence}"
            notes += [text for flag, text in _FRAME_REASONS.items() if reasons & flag]
        unique = list(dict.fromkeys(notes))
        sentences.append(f"{name}: {sentence}" + (f" ({', '.join(unique)})" if unique else ""))
    return sentences
