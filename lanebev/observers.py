"""Where a run's line segments come from: a lane file, or the network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch

from lanebev.geometry.camera import Camera
from lanebev.io.lane_rows import BoundaryRows, rows_from_lines, rows_from_segments, segments_from_rows
from lanebev.io.lanes import FrameLines, match_frames
from lanebev.io.video import Frame, FrameSource
from lanebev.pipeline import LaneBEV
from lanebev.types import LaneSegments


class Observer(Protocol):
    """Finds the lanes of a frame; of one that did not decode it finds none."""

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
        lines = [] if entry is None or frame.image is None else self.entries[entry].lines
        rows = rows_from_lines(lines, self.camera)
        return rows, segments_from_rows([rows], self.camera, dtype=torch.float64)


class NetworkObserver:
    """Lanes from the images.

    What the network sees goes by the rows of ``lanes.json`` to the calibrator, so that the file says all
    that the calibrator was told.

    Args:
        model: its segmenter and extractor are used.
        camera: the lens.
    """

    def __init__(self, model: LaneBEV, camera: Camera) -> None:
        self.model, self.camera = model.eval(), camera

    def __call__(self, frame: Frame) -> tuple[BoundaryRows, LaneSegments]:
        """See :class:`Observer`."""
        if frame.image is None:
            rows = rows_from_lines([], self.camera)
        else:
            image = torch.from_numpy(frame.image.copy()).permute(2, 0, 1)[None].float() / 255
            with torch.inference_mode():  # no lens: pixels as taken
                _, segments = self.model.observe(image, self.camera.intrinsics[None].float())
            rows = rows_from_segments(segments, self.camera)
        return rows, segments_from_rows([rows], self.camera, dtype=torch.float64)
