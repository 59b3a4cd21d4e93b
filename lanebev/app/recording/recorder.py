"""Write the outputs of a run frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import numpy as np
import torch
from numpy.typing import NDArray

from lanebev.app.concurrency import Background
from lanebev.app.drive.observers import Observation
from lanebev.app.recording.plausibility import drive_remark
from lanebev.app.recording.repeats import RepeatedFrames
from lanebev.app.recording.storage import StoredNumbers, StoredRows
from lanebev.app.recording.view_changes import ViewChanges
from lanebev.app.recording.views import FixedPose, bird_view
from lanebev.camera.model import Camera
from lanebev.estimation.mount import MountCalibration
from lanebev.estimation.tracker import Estimate
from lanebev.io.covariances import write_covariances
from lanebev.io.formats.record import vertex_lines
from lanebev.io.frames import Frame
from lanebev.io.images.pixels import write_png
from lanebev.io.lanes.contrast import LaneContrast
from lanebev.io.lanes.tusimple import tusimple_line
from lanebev.io.results import ExtrinsicsRow, extrinsics_row, write_extrinsics
from lanebev.io.video.writer import VideoWriter
from lanebev.report.lane_curves import lane_curves
from lanebev.report.measure import measure_boundaries, select_inliers
from lanebev.report.overlay import Panel, draw_panels, joined
from lanebev.report.page import Report, summary_facts, write_report
from lanebev.report.pictures import PictureSampler
from lanebev.report.run_folder import FIRST_NUMBER
from lanebev.report.verdict import reason_words
from lanebev.report.worst import EventScores
from lanebev.types import NUM_BOUNDARIES, Extrinsics
from lanebev.view.grid import BEVGrid

_BEFORE_RESOLUTION = 0.1  # m, of the view before: it is only shown small
_CRF = 23  # quality of the videos, H.264's constant rate factor
_LONGEST_NAME = 38  # characters of an image's name in its overlay
_MOST_PROBLEMS = 1000  # problems of frames that are listed, at most


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """Results of one frame.

    Attributes:
        frame: the input frame.
        name: for ``raw_file`` of lanes.json.
        seen: vertices of batch size 1.
        estimate: what they led to.
        filtered: estimate from frames up to this one, where ``estimate`` is smoothed.
    """

    frame: Frame
    name: str
    seen: Observation
    estimate: Estimate
    filtered: Estimate | None = None


@dataclass(kw_only=True)
class Recorder:
    """Writes lanes.json and the pictures in a thread, and at the end the tables and the report.

    Attributes:
        path: gives the path to write an output's name to.
        camera: the lens.
        fps: frame rate of the videos.
        lane_width: m, for the report.
        single: PNGs instead of videos.
        stills: each image on its own.
        grid: grid of the bird's-eye view.
        videos: whether there are any.
        smoothed: whether every pose is from the whole drive.
        given_lanes: whether the lanes are those of a file.
        rows: rows of extrinsics.csv, one for each frame.
        problems: what went wrong, for the report.
    """

    path: Callable[[str], Path]
    camera: Camera
    fps: Fraction
    lane_width: float
    single: bool
    stills: bool
    grid: BEVGrid = field(default_factory=BEVGrid)
    videos: bool = True
    smoothed: bool = False
    given_lanes: bool = False
    rows: StoredRows = field(default_factory=StoredRows)
    problems: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        alone = self.single or self.stills
        self.before_title = "level at 1.5 m" if alone else "first frame's"
        self._before = FixedPose(alone)
        self._coarse = replace(self.grid, resolution=max(self.grid.resolution, _BEFORE_RESOLUTION))
        self._filtered_rows = StoredRows()
        self._covariances = StoredNumbers(4, 4, folder=self.path("."))
        self._first_number: int | None = None
        self._widths = StoredNumbers(2, NUM_BOUNDARIES - 1, folder=self.path("."))
        self._pictures, self._scores = PictureSampler(), EventScores()
        self._repeats, self._views = RepeatedFrames(self.path(".")), ViewChanges()
        self._contrast = LaneContrast()

    def __enter__(self) -> Recorder:
        self._stack = ExitStack()
        lanes = open(self.path("lanes.json"), "w", encoding="utf-8", buffering=1)  # whole lines, if killed
        self._lanes = self._stack.enter_context(lanes)
        if self.videos and not self.single:
            self._bev = self._stack.enter_context(VideoWriter(self.path("bev.mp4"), self.fps, _CRF))
            self._overlay = self._stack.enter_context(VideoWriter(self.path("overlay.mp4"), self.fps, _CRF))
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
            self._note(f"frame {frame.number}: {frame.problem}")
        self._repeats.add(frame.image)
        self._views.add(frame.number, frame.image, frame.dt)
        if not len(self.rows):
            self._first_number = frame.source_number
        self.rows.append(_row(done, done.estimate))
        self._covariances.append(done.estimate.calibration.covariance[0].double().cpu().numpy())
        if self.smoothed and done.filtered is not None:
            self._filtered_rows.append(_row(done, done.filtered))
        self._background.submit(lambda: self._draw(done))

    def _note(self, problem: str) -> None:
        if len(self.problems) < _MOST_PROBLEMS:
            self.problems.append(problem)
        elif len(self.problems) == _MOST_PROBLEMS:
            self.problems.append("further problems of frames are not listed: see the rows without segments")

    def finish(
        self,
        facts: Mapping[str, str],
        title: str,
        truth: Sequence[ExtrinsicsRow] | None = None,
        mount: MountCalibration | None = None,
    ) -> Report:
        """Write the tables and the report, after the last frame and outside of ``with``."""
        write_extrinsics(self.path("extrinsics.csv"), self.rows)
        if self.smoothed:
            write_extrinsics(self.path("filtered.csv"), self._filtered_rows)
        before, after = self._widths.all().transpose(1, 0, 2)
        of_drive = [] if self.stills else [self._views.remark(), self._repeats.remark()]
        of_lanes = self._contrast.remark()
        if of_lanes:
            of_lanes = f"lanes: {of_lanes} see the pictures of report.html"
        remarks = (*of_drive, of_lanes, drive_remark(self.rows))
        report = Report(
            title=title,
            rows=self.rows,
            before=before,
            after=after,
            lane_width=self.lane_width,
            facts=facts,
            pictures=self._pictures.pictures,
            problems=[*filter(None, remarks), *self.problems],  # those of frames last
            is_stills=self.stills,
            is_smoothed=self.smoothed,
            before_title=self.before_title,
            truth=truth,
            camera=self.camera,
            mount=mount,
        )
        began = {} if self._first_number is None else {FIRST_NUMBER: str(self._first_number)}
        report.facts = {**facts, **began, **summary_facts(report)}
        write_report(self.path("report.html"), report)
        write_covariances(self.path("covariance.csv"), self._covariances.all())
        return report

    @torch.inference_mode()
    def _draw(self, done: Recorded) -> None:
        """Write a frame's lanes and pictures, and keep what the report shows of it."""
        if self.given_lanes:
            lines = vertex_lines(done.seen.vertices).values()
            self._contrast.add(done.frame.number, done.frame.image, lines)
        segments, calibration, _, vertical = done.estimate
        curves = lane_curves(segments, calibration, self.camera, vertical)
        self._lanes.write(tusimple_line(done.name, *curves, *done.seen) + "\n")
        before = self._before(calibration)
        self._widths.append(self._lane_widths(done.estimate, before))
        views = self._bird_views(done, before)
        panels = self._panels(done, tuple(views.values()))
        names = ["image", *views]
        number = done.frame.number
        self._pictures.add(number, dict(zip(names, panels, strict=True)), self._scores(self.rows[number]))
        self._write_pictures(done.frame, views["after"].bev, joined(panels))

    def _lane_widths(self, estimate: Estimate, before: Extrinsics | None) -> NDArray[np.float64]:
        """Measure the lanes' widths (2, L-1) in the views with the fixed and with the estimated pose."""
        segments, calibration, _, vertical = estimate
        intrinsics = self.camera.intrinsics[None].to(segments.endpoints)
        lanes = select_inliers(segments, calibration.inliers)
        after = measure_boundaries(
            lanes, intrinsics, calibration.extrinsics, vertical_curvature=vertical
        ).widths
        if before is None:
            return np.stack([np.full_like(after, np.nan), after])
        return np.stack([measure_boundaries(lanes, intrinsics, before).widths, after])

    def _bird_views(self, done: Recorded, before: Extrinsics | None) -> dict[str, Panel]:
        """Make the views with the fixed pose, if it is known, and with the estimated one."""
        image, vertical = done.frame.image, done.estimate.vertical_curvature
        pose = done.estimate.calibration.extrinsics
        bev = bird_view(self.grid, image, self.camera, pose, vertical)
        after = Panel("estimated pose", bev, pose, vertical)
        if before is None:
            return {"after": after}
        coarse = bird_view(self._coarse, image, self.camera, before)
        return {"before": Panel("fixed pose", coarse, before), "after": after}

    def _panels(self, done: Recorded, views: tuple[Panel, ...]) -> list[NDArray[np.uint8]]:
        """Draw the input, with the estimate and the reasons in words, and the views."""
        frame, (segments, calibration, reasons, _) = done.frame, done.estimate
        image = frame.image if frame.image is not None else np.zeros((*self.camera.image_size, 3), np.uint8)
        place = frame.name if self.single or self.stills else f"frame {frame.number}   {frame.time:.2f} s"
        words = ", ".join(reason_words([str(reason.name) for reason in reasons]))
        headline = place if len(place) <= _LONGEST_NAME else "…" + place[1 - _LONGEST_NAME :]
        return draw_panels(image, self.camera, segments, calibration, headline, views, self.grid, words)

    def _write_pictures(self, frame: Frame, bev: NDArray[np.uint8], overlay: NDArray[np.uint8]) -> None:
        """Write the pictures of one image, or the next frames of the videos."""
        if self.single:
            write_png(self.path("bev.png"), bev)
            write_png(self.path("overlay.png"), overlay)
        elif self.videos:
            shown = None if self.stills else frame.time
            self._bev.write(bev, shown)
            self._overlay.write(overlay, shown)


def _row(done: Recorded, estimate: Estimate) -> ExtrinsicsRow:
    """Return the row of a frame with one of its estimates."""
    frame, (segments, calibration, reasons, vertical) = done.frame, estimate
    return extrinsics_row(
        frame.number, frame.time, calibration, segments.weight, frame.name, reasons, vertical
    )
