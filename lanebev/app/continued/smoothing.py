"""First pass of ``lanebev run --smooth``: estimate every pose of a drive from all of its frames."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, cast, overload

import numpy as np
import torch
from numpy.typing import NDArray

from lanebev.app.continued.recovery import LANES_FILE, frame_name
from lanebev.app.drive.observers import Observation, RunTracker
from lanebev.app.recording.storage import StoredNumbers
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.layout import POSE
from lanebev.estimation.joint.measurement.residuals import VERTICAL
from lanebev.estimation.joint.smoother import smooth_states, smoothed_calibration
from lanebev.estimation.joint.state import JointState
from lanebev.estimation.tracker import Estimate
from lanebev.io.frame_source import FrameSource
from lanebev.io.frames import Frame
from lanebev.io.lanes.tusimple import tusimple_line
from lanebev.io.output.folder import OutputFolder
from lanebev.types import Calibration, Extrinsics

_NO_LANES = (np.empty(0), np.empty((0, 0)))  # no fitted curves: the second pass reads the vertices only


class SmoothedPoses(NamedTuple):
    """Smoothed poses of a drive by frame number.

    Attributes:
        poses: (F, 4) rad, rad, rad, m.
        covariances: (F, 4, 4).
        vertical_curvatures: (F,) 1/m, of the road.
    """

    poses: NDArray[np.float64]
    covariances: NDArray[np.float64]
    vertical_curvatures: NDArray[np.float64]

    def of(self, estimate: Estimate, number: int) -> Estimate:
        """Return a frame's estimate with the smoothed pose, its covariance and the road's curvature."""
        pose, covariance, vertical = (torch.from_numpy(part[number : number + 1].copy()) for part in self)
        calibration = estimate.calibration._replace(
            extrinsics=Extrinsics.unstack(pose), covariance=covariance
        )
        return estimate._replace(calibration=calibration, vertical_curvature=vertical)


class StoredStates(Sequence[JointState]):
    """States of batch size 1 after every frame, stored in a file so that memory stays constant.

    A state of six boundaries takes 10 kB, so that an hour at 30 frames a second takes 1.1 GB.

    Args:
        like: a state of the same shapes and dtypes.
        folder: where the file, which has no name, is.
    """

    def __init__(self, like: JointState, folder: Path) -> None:
        self._like = like
        self._numbers = StoredNumbers(sum(part.numel() for part in _packed(like)), folder=folder)

    def append(self, state: JointState) -> None:
        """Add the state after the next frame."""
        self._numbers.append(torch.cat([part.flatten().double() for part in _packed(state)]).cpu().numpy())

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, place: int) -> JointState: ...

    @overload
    def __getitem__(self, place: slice) -> list[JointState]: ...

    def __getitem__(self, place: int | slice) -> JointState | list[JointState]:
        if isinstance(place, slice):
            return [self[each] for each in range(*place.indices(len(self)))]
        at = range(len(self))[place]
        like, numbers = self._like, torch.from_numpy(self._numbers.all()[at].copy())
        packed = _packed(like)
        parts = numbers.split([part.numel() for part in packed])
        shaped = (part.reshape(own.shape).to(own.dtype) for part, own in zip(parts, packed, strict=True))
        state = JointState._make(shaped)
        row, column = torch.tril_indices(*like.cov.shape[1:])
        cov = state.cov.new_zeros(like.cov.shape)
        cov[:, row, column] = cov[:, column, row] = state.cov
        return state._replace(cov=cov)


def _packed(state: JointState) -> JointState:
    """Return a state with the lower triangle of its covariance only."""
    row, column = torch.tril_indices(*state.cov.shape[1:])
    return state._replace(cov=state.cov[:, row, column])


def smooth_frames(
    frames: Iterable[tuple[Frame, Observation]],
    tracker: RunTracker,
    out: OutputFolder,
    source: FrameSource,
    config: JointConfig,
) -> SmoothedPoses:
    """Track all frames, and then smooth from the last one to the first.

    The detections are written to lanes.json, for the second pass or, if this one is killed, for another run.

    Args:
        frames: frames of a drive, with what is seen in them.
        tracker: with the joint calibrator.
        out: for lanes.json and, meanwhile, the states.
        source: name of the frames' source.
        config: configuration of the tracker's calibrator.
    """
    states, intervals = StoredStates(cast(JointState, tracker.state), out / "."), StoredNumbers(1)
    covariances, scales = StoredNumbers(4, 4), StoredNumbers(1)
    with open(out / LANES_FILE, "w", encoding="utf-8", buffering=1) as lanes:  # whole lines
        for frame, seen in frames:
            lanes.write(tusimple_line(frame_name(frame, source), *_NO_LANES, *seen) + "\n")
            tracker.drive_frame(seen.vertices, frame.dt, seen.pose_sigma_scale, frame.speed)
            states.append(cast(JointState, tracker.state))
            intervals.append(np.array([frame.dt]))
            covariances.append(tracker.own_covariance[0].double().cpu().numpy())
            scales.append(np.array([seen.pose_sigma_scale]))
    return _smoothed(states, intervals, covariances, scales, tracker, config)


def _smoothed(
    states: StoredStates,
    intervals: StoredNumbers,
    covariances: StoredNumbers,
    scales: StoredNumbers,
    tracker: RunTracker,
    config: JointConfig,
) -> SmoothedPoses:
    """Smooth the poses of kept states, from the last frame to the first.

    Args:
        states: after every frame.
        intervals: s from the frame before.
        covariances: covariances of the pose, scaled.
        scales: factor on the standard deviations of the pose.
        tracker: tracker that gave the states.
        config: configuration of its calibrator.
    """
    steps, count = torch.from_numpy(intervals.all().copy()), len(states)
    result = SmoothedPoses(np.empty((count, 4)), np.empty((count, 4, 4)), np.empty(count))
    backward = zip(range(count - 1, -1, -1), smooth_states(states, steps, config), strict=True)
    for number, smoothed in backward:
        state = states[number]
        scale = float(scales.all()[number, 0])
        given = torch.from_numpy(covariances.all()[number : number + 1] / scale**2)
        pose, no_inliers = Extrinsics.unstack(state.mean[:, POSE]), given.new_zeros(1, 0)
        filtered = Calibration(pose, given, state.status, no_inliers)
        calibration = smoothed_calibration(filtered, state, smoothed).with_std_scaled(scale)
        calibration = tracker.with_common_errors(calibration)
        result.poses[number] = calibration.extrinsics.stack()[0].numpy()
        result.covariances[number] = calibration.covariance[0].numpy()
        result.vertical_curvatures[number] = float(smoothed.mean[0, VERTICAL])
    return result
