"""Results of a run, the input of every format."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from pathlib import PurePath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lanebev.camera.model import Camera
from lanebev.io.frames import Frame
from lanebev.io.results import ExtrinsicsRow, poses_of
from lanebev.observation.boundary_vertices import BoundaryVertices
from lanebev.types import Extrinsics

Lines = Mapping[int, NDArray[np.float64]]
"""Boundaries of a frame by index: (P, 2) px of the image as taken."""

_SAME_TIME = 2e-3  # s, by which times of one frame may differ: files have microseconds


@dataclass(frozen=True)
class StandingPose:
    """The pose of the camera over the road, one for a whole run.

    Attributes:
        extrinsics: each (1,), float64.
        source: origin of the pose, in words.
    """

    extrinsics: Extrinsics
    source: str


class RecordedFrame(NamedTuple):
    """A frame's results.

    Attributes:
        row: row of ``extrinsics.csv``.
        pose: each (1,), float64.
        lines: boundaries as fitted; empty if they are not known.
    """

    row: ExtrinsicsRow
    pose: Extrinsics
    lines: Lines


@dataclass(frozen=True)
class RunRecord:
    """A run's results.

    Attributes:
        name: name of the run, for titles.
        rows: rows of ``extrinsics.csv``, a frame each.
        covariances: (N, 4, 4) of pitch, yaw, roll (rad) and height (m), a frame each; NaN where not known.
        lanes: boundaries as fitted, a frame each; None if they are not known.
        camera: the lens, None if it is not known.
        mounted: the pose of the mount if all its axes are calibrated, each (1,); else None.
        start: time of the first frame, s since 1970; 0 if it is not known.
    """

    name: str
    rows: Sequence[ExtrinsicsRow]
    covariances: NDArray[np.float64]
    lanes: Iterable[Lines] | None = None
    camera: Camera | None = None
    mounted: Extrinsics | None = None
    start: float = 0.0

    def lens(self) -> Camera:
        """Return the camera.

        Raises:
            ValueError: it is not known.
        """
        if self.camera is None:
            raise ValueError(f"run {self.name}: expected a camera, got none; give --camera FILE")
        return self.camera

    def frames(self) -> Iterator[RecordedFrame]:
        """Return a frame's results after another's."""
        poses = self.poses().stack()
        lanes = repeat({}) if self.lanes is None else self.lanes
        for number, (row, lines) in enumerate(zip(self.rows, lanes, strict=False)):
            yield RecordedFrame(row, Extrinsics.unstack(poses[number : number + 1]), lines)

    def poses(self) -> Extrinsics:
        """Return the pose of every frame, each (N,), float64."""
        return poses_of(self.rows)

    def standing_pose(self) -> StandingPose:
        """Return the mount's pose if it is calibrated, else the median of the frames that were tracked.

        Raises:
            ValueError: there is neither.
        """
        if self.mounted is not None:
            return StandingPose(self.mounted, "the calibrated mount")
        tracked = [number for number, row in enumerate(self.rows) if row.status == "TRACKING"]
        if not tracked:
            raise ValueError(
                f"run {self.name}: expected a calibrated mount or a frame that is TRACKING, got neither"
            )
        values = self.poses().stack()[tracked].quantile(0.5, dim=0)[None]
        words = f"the median of {len(tracked)} TRACKING frames; the mount is not calibrated"
        return StandingPose(Extrinsics.unstack(values), words)


def with_images(
    record: RunRecord, images: Iterable[Frame] | None
) -> Iterator[tuple[RecordedFrame, NDArray[np.uint8] | None]]:
    """Return every frame's results with its image (H, W, 3) RGB; None where there is none.

    Args:
        record: record of the run.
        images: frames of the run's source, by rising number; some before the last may be missing.

    Raises:
        ValueError: the frames are not the run's: they have other names or times, or there are more or fewer.
    """
    pictures = iter(() if images is None else images)
    picture = next(pictures, None)
    for frame in record.frames():
        if picture is None and images is not None:
            raise ValueError(
                f"images: expected the {len(record.rows)} frames of the run, got none from number "
                f"{frame.row.frame + 1} on; is it the run's source?"
            )
        while picture is not None and picture.number < frame.row.frame:
            picture = next(pictures, None)
        image = None
        if picture is not None and picture.number == frame.row.frame:
            _check_same(picture, frame.row)
            if record.camera is not None:
                _check_size(picture, record.camera)
            image, picture = picture.image, next(pictures, None)
        yield frame, image
    if picture is not None:
        raise ValueError(
            f"images: expected the {len(record.rows)} frames of the run, got number {picture.number + 1} "
            "too; is it the run's source?"
        )


def _check_same(picture: Frame, row: ExtrinsicsRow) -> None:
    """Raise if a frame is not the run's of its number: by the name of its image, or else by its time."""
    if picture.name and row.image:
        if PurePath(picture.name).name != PurePath(row.image).name:
            raise ValueError(f"images: expected {row.image} as frame {row.frame}, got {picture.name}")
    elif abs(picture.time - row.time_s) > _SAME_TIME:
        raise ValueError(
            f"images: expected frame {row.frame} at {row.time_s:.3f} s as in the run, got it at "
            f"{picture.time:.3f} s; is it the run's source?"
        )


def _check_size(picture: Frame, camera: Camera) -> None:
    """Raise if a frame's image has not the size of those of the run's camera."""
    if picture.image is not None and picture.image.shape[:2] != camera.image_size:
        (height, width), (rows, columns) = camera.image_size, picture.image.shape[:2]
        raise ValueError(
            f"images: expected {width} x {height} px as of the run's camera, got {columns} x {rows} in frame "
            f"{picture.number}; is it the run's source?"
        )


def vertex_lines(vertices: BoundaryVertices) -> Lines:
    """Return a frame's vertices, of batch size 1, as the lines through them."""
    found: dict[int, NDArray[np.float64]] = {}
    for boundary, points, weight in zip(
        vertices.boundary[0].tolist(), vertices.points[0], vertices.weight[0], strict=True
    ):
        if bool((weight > 0).any()):
            found.setdefault(boundary, points[weight > 0].double().numpy())
    return found
