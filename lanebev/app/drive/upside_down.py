"""Images that are upside down, in which lanes do not determine a pose."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np
import torch

from lanebev.app.drive.observers import NetworkObserver, Observer, RunTracker
from lanebev.io.frame_source import FrameSource
from lanebev.io.frames import Frame
from lanebev.types import Status

_LOOKED_AT = 8  # frames that are compared, at least
_WITHIN = 120.0  # s of the source, from which these are taken
_SHARE = 0.5  # fraction of frames in which lanes must determine a pose


def upside_down_remark(
    observer: Observer, tracker: RunTracker, source: FrameSource, tracked: int, count: int
) -> str:
    """Return a remark if lanes determine a pose in images turned by 180 degrees, but in few as they are.

    Args:
        observer: finds lanes; a lane file's tell nothing.
        tracker: estimates the pose of single images.
        source: the frames, which are read again, so not of a stream.
        tracked: number of frames that have a pose ...
        count: ... of this number.
    """
    if (
        count < _LOOKED_AT
        or tracked >= _SHARE * count
        or source.is_live
        or not isinstance(observer, NetworkObserver)
    ):
        return ""
    most = math.ceil(_WITHIN * float(source.fps / source.selection.every))
    every = source.selection.every * max(1, min(count, most) // _LOOKED_AT)
    try:
        frames = list(islice(replace(source, selection=source.selection._replace(every=every)), _LOOKED_AT))
    except (OSError, ValueError):  # deleted or changed during the run, which is noticed elsewhere
        return ""
    seen = [(frame, frame.image) for frame in frames if frame.image is not None]
    turned = [frame._replace(image=np.ascontiguousarray(image[::-1, ::-1])) for frame, image in seen]
    shares = [_share_with_pose(observer, tracker, each) for each in (frames, turned)]
    if not shares[0] < _SHARE <= shares[1]:
        return ""
    return (
        f"images: lanes determine a pose in {shares[1]:.0%} of sampled images turned by 180 degrees, in "
        f"{shares[0]:.0%} of these images as they are; if the images are upside down, turn them, for example "
        "by ffmpeg -vf hflip,vflip"
    )


def _share_with_pose(observer: Observer, tracker: RunTracker, frames: Sequence[Frame]) -> float:
    """Return the share of frames whose lanes determine a pose; 0 of none."""
    with torch.inference_mode():
        poses = [tracker.still(observer(frame).vertices, 1.0).calibration for frame in frames]
    return float(np.mean([int(pose.status[0]) == Status.TRACKING for pose in poses])) if poses else 0.0
