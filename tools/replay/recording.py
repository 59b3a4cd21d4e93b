"""The input of a calibrator for one drive, and for several drives as rows of one batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from lanebev.batch import select_rows
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.mount import MountCalibration, MountEstimator
from lanebev.observation.segments import LaneSegments, camera_segments
from lanebev.tensors import join_tensors
from lanebev.testing.moments import CAMERA, WIDTH, Moment, observe
from lanebev.types import Calibration
from tools.replay.kinds import Generated
from tools.replay.lens_drives import vertices_through_lens

SIGMA = 1.0  # px, noise of an end point
SEGMENTS = 8  # of each boundary


class Recording(NamedTuple):
    """T frames of one drive.

    Attributes:
        segments: (T, N), a row of each frame.
        intrinsics: (3, 3) px.
        dt: (T,) s.
        lane_width: m.
        sigma_scale: factor on the standard deviations of the pose.
        truth: (T, 4) rad and m.
        hard: (T,) bool, the event's frames.
        resumed: segments and dt of the drive whose last state is the first one here, or None.
        mount: also run the mount estimator.
        moments: moments of a generated drive, else empty.
        speed: (T,) m/s, which the calibrator is given; None if it is not.
    """

    segments: LaneSegments
    intrinsics: Tensor
    dt: Tensor
    lane_width: float
    sigma_scale: float
    truth: Tensor
    hard: Tensor
    resumed: tuple[LaneSegments, Tensor] | None = None
    mount: bool = False
    moments: Sequence[Moment] = ()
    speed: Tensor | None = None

    def begin_at(self, frame: int) -> Recording:
        """Return the drive without the frames before one, begun anew."""
        return self._replace(
            segments=LaneSegments._make(part[frame:] for part in self.segments),
            dt=self.dt[frame:],
            truth=self.truth[frame:],
            hard=self.hard[frame:],
            resumed=None,
            moments=self.moments[frame:],
            speed=None if self.speed is None else self.speed[frame:],
        )


class Replayed(NamedTuple):
    """Results of a calibrator on R drives of T frames.

    Attributes:
        pose: (T, R, 4) rad and m.
        covariance: (T, R, 4, 4).
        status: (T, R) int64.
        reasons: (T, R) int64, zero of a calibrator that gives none.
        mounts: T answers of the mount estimator about all rows.
    """

    pose: Tensor
    covariance: Tensor
    status: Tensor
    reasons: Tensor
    mounts: list[MountCalibration]


def record(generated: Generated, seed: int) -> Recording:
    """Draw the segments of a generated drive."""
    drive = generated.moments()
    camera = generated.camera
    if camera is None:
        segments, intrinsics = _segments(drive, seed), CAMERA
    else:
        vertices = vertices_through_lens(drive, camera, SIGMA, 2 * SEGMENTS, seed)
        segments, intrinsics = camera_segments(vertices, camera), camera.intrinsics
    before = None if generated.resumed is None else generated.resumed()
    return Recording(
        segments=segments,
        intrinsics=intrinsics,
        dt=_intervals(drive),
        lane_width=WIDTH,
        sigma_scale=1.0,
        truth=torch.tensor([moment.pose for moment in drive], dtype=torch.float64),
        hard=torch.tensor([bool(moment.tag) for moment in drive]),
        resumed=None if before is None else (_segments(before, seed + 1), _intervals(before)),
        mount=generated.mount,
        moments=drive,
        speed=_numbers([moment.speed for moment in drive]) if generated.speed_given else None,
    )


def _segments(drive: list[Moment], seed: int) -> LaneSegments:
    """Convert segments to (T, N) in the pixels of the ideal camera."""
    frames = [found for _, found in observe(drive, 1, SIGMA, SEGMENTS, seed, torch.float64)]
    return join_tensors(torch.cat, frames)


def _intervals(drive: list[Moment]) -> Tensor:
    return _numbers([moment.dt for moment in drive])


def _numbers(values: Sequence[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def replay(calibrator: Calibrator[Any], recordings: Sequence[Recording]) -> Replayed:
    """Run a calibrator over drives of equally many frames, each a row of one batch."""
    rows = len(recordings)
    segments = _side_by_side([recording.segments for recording in recordings])
    intrinsics = torch.stack([recording.intrinsics for recording in recordings])
    dt = torch.stack([recording.dt for recording in recordings], dim=1)  # (T, R)
    widths = torch.tensor([recording.lane_width for recording in recordings], dtype=torch.float64)
    scale = torch.tensor([recording.sigma_scale for recording in recordings], dtype=torch.float64)
    unknown = torch.full_like(dt[:, 0], torch.nan)
    speed = torch.stack([unknown if each.speed is None else each.speed for each in recordings], dim=1)
    mount = MountEstimator()
    mount_state = mount.initial_state(rows, dtype=torch.float64)
    state = _first_states(calibrator, recordings)
    answers: list[Calibration] = []
    reasons, mounts = [], []
    with torch.inference_mode():
        for k in range(len(dt)):
            now = LaneSegments(*(part[k] for part in segments))
            answer, state = calibrator(now, intrinsics, state, dt[k], widths)
            answer = _scaled(calibrator, answer, state, scale, widths)
            state = calibrator.with_speed(state, speed[k])
            bend = calibrator.curvature(state)
            mounted, mount_state = mount(answer, mount_state, dt[k], curvature=bend)
            answers.append(answer)
            reasons.append(calibrator.reasons(state))
            mounts.append(mounted)
    return Replayed(
        pose=torch.stack([answer.extrinsics.stack() for answer in answers]),
        covariance=torch.stack([answer.covariance for answer in answers]),
        status=torch.stack([answer.status for answer in answers]),
        reasons=torch.stack(reasons),
        mounts=mounts,
    )


def _scaled(
    calibrator: Calibrator[Any], answer: Calibration, state: Any, scale: Tensor, widths: Tensor
) -> Calibration:
    """Scale the standard deviations of every row by its factor (R,), with its lane width (R,) m."""
    for factor in set(scale.tolist()):
        scaled = calibrator.scale_drive(answer, state, factor, widths)
        answer = select_rows(scale == factor, scaled, answer)
    return answer


def _first_states(calibrator: Calibrator[Any], recordings: Sequence[Recording]) -> Any:
    """Return initial states; in rows that resume another drive, that drive's last state."""
    state = calibrator.initial_state(len(recordings), dtype=torch.float64)
    for row, recording in enumerate(recordings):
        if recording.resumed is not None:
            before, dt = recording.resumed
            other = calibrator.initial_state(1, dtype=torch.float64)
            with torch.inference_mode():
                for k in range(len(dt)):
                    now = LaneSegments(*(part[k : k + 1] for part in before))
                    _, other = calibrator(
                        now, recording.intrinsics[None], other, dt[k : k + 1], recording.lane_width
                    )
            here = torch.arange(len(recordings)) == row
            state = select_rows(here, _repeated(other, len(recordings)), state)
    return state


def _repeated(state: Any, rows: int) -> Any:
    return type(state)(*(part.repeat(rows, *[1] * (part.ndim - 1)) for part in state))


def _side_by_side(drives: Sequence[LaneSegments]) -> LaneSegments:
    """Stack R drives of (T, N) segments to (T, R, N), padded with weight 0."""
    most = max(drive.weight.shape[1] for drive in drives)

    def padded(part: Tensor) -> Tensor:
        return pad(part, [0, 0] * (part.ndim - 2) + [0, most - part.shape[1]])

    return LaneSegments._make(
        torch.stack([padded(part) for part in parts], dim=1) for parts in zip(*drives, strict=True)
    )
