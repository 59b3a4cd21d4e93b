"""Everything a run writes, frame by frame, while it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lanebev.app.concurrency import Background
from lanebev.camera.model import Camera
from lanebev.estimation.joint.state import Reason
from lanebev.estimation.mount import MountCalibration
from lanebev.io.lanes import tusimple_line
from lanebev.io.results import ExtrinsicsRow, extrinsics_row, write_extrinsics
from lanebev.io.video import Frame, VideoWriter, write_png
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.observation.segments import LaneSegments
from lanebev.report.lane_curves import lane_curves
from lanebev.report.measure import believed, measure_boundaries
from lanebev.report.moments import MomentSampler
from lanebev.report.overlay import Panel, Picture, draw_panels, joined
from lanebev.report.page import Report, summary_facts, write_report
from lanebev.report.verdict import reason_words
from lanebev.report.worst import EventScores
from lanebev.types import NUM_BOUNDARIES, Calibration, Extrinsics
from lanebev.view.grid import BEVGrid


class Recorded(NamedTuple):
    """One frame, done.

    Attributes:
        frame: as it came.
        name: for ``raw_file`` of lanes.json.
        vertices: of batch size 1, as seen.
        pose_sigma_scale: of the pose's sigmas.
        segments: of batch size 1, what the calibrator was given.
        calibration: of batch size 1.
        reasons: why the frame is not (fully) tracked.
        before: pose of the view before, each (1,); None before anything is known.
        bev_before, bev_after: (U, V, 3) RGB.
    """

    frame: Frame
    name: str
    vertices: BoundaryVertices
    pose_sigma_scale: float
    segments: LaneSegments
    calibration: Calibration
    reasons: Reason
    before: Extrinsics | None
    bev_before: Picture
    bev_after: Picture


class Recorder:
    """Writes lanes.json and the pictures in a thread, and at the end extrinsics.csv and the report.

    Args:
        path: gives the path to write an output's name to.
        camera: the lens.
        grid: of the bird's-eye views.
        fps: of the videos.
        lane_width: m, for the report.
        single: PNGs instead of videos.
        stills: each image on its own.
    """

    def __init__(
        self,
        path: Callable[[str], Path],
        camera: Camera,
        grid: BEVGrid,
        fps: Fraction,
        lane_width: float,
        single: bool,
        stills: bool,
    ) -> None:
        self.path, self.camera, self.grid = path, camera, grid
        self.fps, self.lane_width, self.single, self.stills = fps, lane_width, single, stills
        self.rows: list[ExtrinsicsRow] = []
        self.problems: list[str] = []
        self.before_title = "uncalibrated" if single or stills else "first frame's pose held"
        self._widths: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
        self._moments, self._scores = MomentSampler(), EventScores()

    def __enter__(self) -> Recorder:
        self._stack = ExitStack()
        self._lanes = self._stack.enter_context(open(self.path("lanes.json"), "w", encoding="utf-8"))
        if not self.single:
            self._bev = self._stack.enter_context(VideoWriter(self.path("bev.mp4"), self.fps))
            self._overlay = self._stack.enter_context(VideoWriter(self.path("overlay.mp4"), self.fps))
        self._background = self._stack.enter_context(Background())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def add(self, done: Recorded) -> None:
        """Take one frame; its pictures are drawn and encoded in the background."""
        frame = done.frame
        if frame.problem:
            self.problems.append(f"frame {frame.number}: {frame.problem}")
        weight = done.segments.weight
        self.rows.append(
            extrinsics_row(frame.number, frame.time, done.calibration, weight, frame.name, done.reasons)
        )
        self._background.submit(lambda: self._write(done))

    def finish(
        self,
        facts: Mapping[str, str],
        title: str,
        truth: Sequence[ExtrinsicsRow] | None = None,
        mount: MountCalibration | None = None,
    ) -> Report:
        """Write extrinsics.csv and the report, after the last frame and outside of ``with``.

        Args:
            facts: what ran, for the report.
            title: of the report.
            truth: a row per frame, of a rendered drive.
            mount: as it is known at the end.
        """
        write_extrinsics(self.path("extrinsics.csv"), self.rows)
        before, after = (np.array([pair[i] for pair in self._widths]) for i in (0, 1))
        report = Report(
            title=title,
            rows=self.rows,
            before=before,
            after=after,
            lane_width=self.lane_width,
            facts=facts,
            moments=self._moments.moments,
            problems=self.problems,
            is_stills=self.stills,
            before_title=self.before_title,
            truth=truth,
            camera=self.camera,
            mount=mount,
        )
        report.facts = {**facts, **summary_facts(report)}
        write_report(self.path("report.html"), report)
        return report

    def _write(self, done: Recorded) -> None:
        curves = lane_curves(done.segments, done.calibration, self.camera)
        line = tusimple_line(done.name, *curves, seen=done.vertices, pose_sigma_scale=done.pose_sigma_scale)
        self._lanes.write(line + "\n")
        intrinsics = self.camera.intrinsics[None].to(done.segments.endpoints)
        lanes = believed(done.segments, done.calibration.inliers)
        poses = (done.before, done.calibration.extrinsics)
        before, after = (self._measure(lanes, intrinsics, pose) for pose in poses)
        self._widths.append((before, after))
        frame = done.frame
        image = frame.image if frame.image is not None else np.zeros((*self.camera.image_size, 3), np.uint8)
        place = frame.name if self.single or self.stills else f"frame {frame.number}   {frame.time:.2f} s"
        views = [Panel("after", done.bev_after, done.calibration.extrinsics)]
        if done.before is not None:
            views.insert(0, Panel("before", done.bev_before, done.before))
        words = ", ".join(reason_words([str(reason.name) for reason in done.reasons]))
        panels = draw_panels(
            image,
            self.camera,
            done.segments,
            done.calibration,
            _shortened(place),
            tuple(views),
            self.grid,
            words,
        )
        names = ["image", *(view.title for view in views)]
        scores = self._scores(self.rows[frame.number])
        self._moments.add(frame.number, dict(zip(names, panels, strict=True)), scores)
        picture = joined(panels)
        if self.single:
            write_png(self.path("bev.png"), done.bev_after)
            write_png(self.path("overlay.png"), picture)
        else:
            shown = None if self.stills else done.frame.time
            self._bev.write(done.bev_after, shown)
            self._overlay.write(picture, shown)

    def _measure(
        self, segments: LaneSegments, intrinsics: Tensor, pose: Extrinsics | None
    ) -> NDArray[np.float64]:
        if pose is None:
            return np.full(NUM_BOUNDARIES - 1, np.nan)
        return measure_boundaries(segments, intrinsics, pose).widths


def _shortened(name: str, most: int = 38) -> str:
    return name if len(name) <= most else "…" + name[-most + 1 :]
