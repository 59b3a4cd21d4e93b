"""The mount's state in words, for people."""

from lanebev.estimation.mount.config import MountConfig
from lanebev.estimation.mount.results import MountCalibration, MountReason, MountStatus
from lanebev.types import AXES

_FRAME_REASONS = {
    MountReason.NOT_TRACKING: "no lane boundaries in this frame",
    MountReason.UNSURE: "this frame does not determine it",
    MountReason.SLOW: "the vehicle is too slow",
    MountReason.TURNING: "the road or the vehicle turns",
    MountReason.TIME: "the frame's time does not advance",
}
_STATE_REASONS = {
    MountReason.PITCH_LIMIT: "outside the limits of a usable mount",
    MountReason.YAW_LIMIT: "outside the limits of a usable mount",
    MountReason.ROLL_LIMIT: "outside the limits of a usable mount",
    MountReason.HEIGHT_LIMIT: "outside the limits of a usable mount",
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
