"""``lanebev demo``: run on a rendered drive and compare the result with the truth."""

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import torch

from lanebev.app.concurrency import Background
from lanebev.app.config import RunConfig
from lanebev.app.progress import Progress, no_progress
from lanebev.app.run import run
from lanebev.app.summary import summary
from lanebev.io.lanes.tusimple import tusimple_line
from lanebev.io.output.folder import OutputFolder
from lanebev.io.results import ExtrinsicsRow, extrinsics_row, write_extrinsics
from lanebev.io.video.writer import VideoWriter
from lanebev.observation.frames import image_bytes
from lanebev.observation.polylines import BoundaryRows, LaneLine, rows_from_vertices, vertices_from_lines
from lanebev.render import Drive, RenderedFrame
from lanebev.types import Calibration, Extrinsics, Status

SEED, FRAMES, FPS, IMAGE_SIZE = 10, 200, 20, (360, 640)
_RENDERED_CRF = 16  # nearly as rendered

ProgressOf = Callable[[str], Progress]


def demo(out: str, progress: ProgressOf = lambda _: no_progress) -> str:
    """Render a drive into ``out/drive``, run on it, and compare with the truth.

    Args:
        out: output folder; the drive itself goes to ``drive`` in it, see :func:`write_drive`.
        progress: makes a wrapper of frames from a label, see :func:`lanebev.app.run.run`.

    Returns:
        what to print.
    """
    drive = Drive(SEED, IMAGE_SIZE, FRAMES, float(FPS))
    folder = Path(out) / "drive"
    with OutputFolder(folder) as inside:
        truth, lane_width = write_drive(drive, inside.__truediv__, progress("rendering"))
    config = RunConfig(str(folder / "drive.mp4"), str(folder / "camera.yaml"), out, lane_width)
    report = run(config, progress("calibrating"), truth)
    return "\n".join([summary(report, config), against_truth(report.rows, truth)])


def write_drive(
    drive: Drive, path: Callable[[str], Path], progress: Progress = no_progress
) -> tuple[list[ExtrinsicsRow], float]:
    """Render a drive to ``drive.mp4``, ``camera.yaml``, ``truth.csv`` and ``lanes.json``.

    Args:
        drive: what to render.
        path: gives the path to write a name to.
        progress: wraps the frame numbers, given their number.

    Returns:
        the truth, a row per frame, and the mean lane width (m).
    """
    numbers = iter(range(len(drive)))
    rows, widths, lines = [], [], []
    drive.camera.to_file(path("camera.yaml"))
    with VideoWriter(path("drive.mp4"), Fraction(FPS), _RENDERED_CRF) as video, Background() as background:
        for number in progress(numbers, len(drive)):
            frame = drive.frame(number)
            background.submit(partial(video.write, image_bytes(frame.image[0])))
            rows.append(_truth_row(number, float(drive.times[number]), frame))
            widths.append(float(frame.lane_width.mean()))
            lines.append(tusimple_line(f"drive.mp4/{number:06d}", *true_lanes(drive, frame)))
    write_extrinsics(path("truth.csv"), rows)
    path("lanes.json").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return rows, float(np.mean(widths))


def true_lanes(drive: Drive, frame: RenderedFrame) -> BoundaryRows:
    """Return the lanes of a rendered frame on image rows, as a perfect detector would find them."""
    lines = []
    for index, (points, visible) in enumerate(zip(frame.boundaries[0], frame.visible[0], strict=True)):
        as_taken = drive.camera.distort_points(points).double()
        as_taken[visible < 0.5] = torch.nan
        as_taken[:, 1] = points[:, 1]  # rows of the gaps
        if (visible >= 0.5).any():
            lines.append(LaneLine(as_taken.numpy(), index))
    return rows_from_vertices(vertices_from_lines(lines, drive.camera), drive.camera.image_size)


def against_truth(found: Sequence[ExtrinsicsRow], truth: Sequence[ExtrinsicsRow]) -> str:
    """Return the root mean square errors of the tracked frames, in one line."""
    tracked = [(row, true) for row, true in zip(found, truth, strict=True) if row.status == "TRACKING"]
    if not tracked:
        return "RMSE against the truth: no frame was tracked"
    error = np.array([np.subtract(row.pose, true.pose) for row, true in tracked])
    pitch, yaw, roll, height = np.sqrt((error**2).mean(0))
    return (
        f"RMSE against the truth: pitch {pitch:.3f} deg  yaw {yaw:.3f} deg  roll {roll:.3f} deg  "
        f"height {100 * height:.1f} cm"
    )


def _truth_row(number: int, time: float, frame: RenderedFrame) -> ExtrinsicsRow:
    pose: Extrinsics = frame.extrinsics
    status = torch.tensor([int(Status.TRACKING)])
    calibration = Calibration(pose, torch.zeros(1, 4, 4), status, torch.zeros(1, 0))
    return extrinsics_row(number, time, calibration, (frame.visible > 0.5).any(-1).float(), "")
