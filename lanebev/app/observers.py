"""Where a run's line segments come from: a lane file, or the network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from lanebev.camera.model import Camera
from lanebev.estimation.joint.boundary_curves import boundary_polylines, fit_boundaries
from lanebev.estimation.joint.single_frame import fit_single_frame
from lanebev.io.lane_size import size_remark
from lanebev.io.lanes import FrameLines, match_frames
from lanebev.io.video import Frame, FrameSource
from lanebev.observation.polylines import (
    BoundaryRows,
    rows_from_lines,
    rows_from_segments,
    segments_from_rows,
)
from lanebev.pipeline import LaneBEV
from lanebev.types import LaneSegments


class Observer(Protocol):
    """Finds the lanes of a frame; of one that did not decode it finds none.

    Attributes:
        remark: what should be said of all lanes together, else empty.
    """

    remark: str

    def __call__(self, frame: Frame) -> tuple[BoundaryRows, LaneSegments]:
        """Boundaries on image rows, and segments of batch size 1 in undistorted pixels, float64."""
        ...


class LaneFileObserver:
    """Another detector's lanes, matched to the frames of a source.

    Args:
        entries: of the lane file.
        source: the frames; images are matched by the longest common tail of their path, a video by order.
        camera: the lens.

    Raises:
        ValueError: the entries do not fit the source.
    """

    def __init__(self, entries: Sequence[FrameLines], source: FrameSource, camera: Camera) -> None:
        self.entries, self.camera = entries, camera
        self.remark = size_remark(entries, camera.image_size)
        if source.is_video:
            if len(entries) != source.count:
                raise ValueError(
                    f"lanes: expected {source.count} entries, one per frame of {source.source}, got "
                    f"{len(entries)}; is the lane file cut?"
                )
            self.matches: list[int | None] = list(range(len(entries)))
        else:
            self.matches = match_frames(source.paths, entries)

    def __call__(self, frame: Frame) -> tuple[BoundaryRows, LaneSegments]:
        """See :class:`Observer`."""
        entry = self.matches[frame.number] if frame.number < len(self.matches) else None
        found = FrameLines(frame.name, []) if entry is None else self.entries[entry]
        lines = [] if frame.image is None else found.lines
        rows = rows_from_lines(lines, self.camera)._replace(pose_sigma_scale=found.pose_sigma_scale)
        return rows, segments_from_rows([rows], self.camera, dtype=torch.float64)


FITTED_SUPPORT = 1.0  # segments' weights that a boundary needs to be written as a lane
FITTED_REACH = 60.0  # m that a fitted boundary is drawn at least: all lead to one horizon


class NetworkObserver:
    """Lanes from the images.

    What the network sees goes by the rows of ``lanes.json`` to the calibrator, so that the file says all
    that the calibrator was told.

    Args:
        model: its segmenter and extractor are used.
        camera: the lens.
        lane_width: m.
    """

    remark = ""

    def __init__(self, model: LaneBEV, camera: Camera, lane_width: float) -> None:
        self.model, self.camera, self.lane_width = model.eval(), camera, lane_width

    def __call__(self, frame: Frame) -> tuple[BoundaryRows, LaneSegments]:
        """See :class:`Observer`."""
        if frame.image is None:
            rows = rows_from_lines([], self.camera)
        else:
            image = torch.from_numpy(frame.image.copy()).permute(2, 0, 1)[None].float() / 255
            with torch.inference_mode():  # no lens: pixels as taken
                _, segments = self.model.observe(image, self.camera.intrinsics[None].float())
            rows = rows_from_segments(segments, self.camera)
        seen = segments_from_rows([rows], self.camera, dtype=torch.float64)
        fitted = fitted_rows(seen, rows.rows, self.camera, self.lane_width)
        return rows._replace(fitted=fitted, pose_sigma_scale=self.model.pose_sigma_scale), seen


def fitted_rows(
    segments: LaneSegments, rows: NDArray[np.float64], camera: Camera, lane_width: float
) -> NDArray[np.float64]:
    """All boundaries of one frame fitted together, one pose and one curvature for all, on image rows.

    A boundary that is seen in pieces is whole then, and what fits no road is left out.

    Args:
        segments: of batch size 1, in undistorted pixels.
        rows: (R,) px, rising.
        camera: the lens.
        lane_width: m.

    Returns:
        (L, R) px of the image as it came; NaN where there is no boundary.
    """
    intrinsics = camera.intrinsics[None].to(segments.endpoints)
    fit = fit_single_frame(segments, intrinsics, lane_width)
    curves = fit_boundaries(segments, intrinsics, fit.extrinsics, fit.curvature, least_support=FITTED_SUPPORT)
    far = curves.extent[..., 1].clamp(min=FITTED_REACH)
    curves = curves._replace(
        extent=torch.stack([torch.ones_like(far), far], dim=-1), present=curves.present & fit.valid[:, None]
    )
    lines, shown = boundary_polylines(curves, intrinsics, fit.extrinsics, num_points=96)
    x = np.full((lines.shape[1], len(rows)), np.nan)
    for index, (line, there) in enumerate(zip(lines[0], shown[0], strict=True)):
        points = camera.distort_points(line[there]).double().numpy()
        if len(points) > 1:
            order = np.argsort(points[:, 1])
            across = np.interp(rows, points[order, 1], points[order, 0], np.nan, np.nan)
            x[index] = np.where((across >= 0) & (across <= camera.image_size[1] - 1), across, np.nan)
    return x
