"""Results of ``tools.evaluate_real``: evaluate each part of the data beside its targets."""

import csv
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from lanebev import Camera, Extrinsics, JointCalibrator, LaneSegments, Status
from lanebev.app.drive.observers import FarViewObserver, NetworkObserver
from lanebev.estimation.still import calibrate_still
from lanebev.estimation.tracker import Tracker
from lanebev.io.lanes import match_frames, read_lanes
from lanebev.io.opening import open_source
from lanebev.observation.segments import camera_segments, segments_from_lines
from lanebev.report.lane_curves import lane_curves
from lanebev.report.measure import measure_boundaries, select_inliers, spread
from lanebev.report.plots import width_deviation
from lanebev.tensors import join_tensors

TUSIMPLE_FOCAL = 1000.0  # px, assumed: the camera is not published
UDACITY_LANE_WIDTH, CARLA_LANE_WIDTH, TUSIMPLE_LANE_WIDTH = 3.66, 3.5, 3.7


@dataclass(frozen=True)
class Figure:
    """One result beside its target; ``least`` if more is better."""

    part: str
    name: str
    calibrator: str
    value: float
    target: float | None
    unit: str = ""
    least: bool = False

    @property
    def met(self) -> bool | None:
        """Whether it meets the target; None without one."""
        if self.target is None:
            return None
        return bool(self.value >= self.target if self.least else self.value <= self.target)

    def as_dict(self) -> dict[str, Any]:
        """Return the figure as plain values for JSON."""
        return {**asdict(self), "met": self.met}


class Drive(NamedTuple):
    """A drive's poses (F, 4) in rad and m, status (F,), times (F,) s, segments and inliers of each frame.

    ``curvatures`` are the road's vertical ones, (1,) 1/m each, or None for a plane.
    """

    poses: torch.Tensor
    status: torch.Tensor
    times: np.ndarray
    segments: list[LaneSegments]
    lanes: list[LaneSegments]
    curvatures: list[torch.Tensor | None]


def tusimple_camera() -> Camera:
    """Return the assumed camera: 1280 x 720, f = 1000 px, centred."""
    return Camera.from_parameters(TUSIMPLE_FOCAL, TUSIMPLE_FOCAL, 640, 360, 1280, 720)


def tusimple_segments(data: Path) -> tuple[list[str], LaneSegments]:
    """Return paths of the 88 images and their labelled lanes."""
    frames = read_lanes(data / "tusimple" / "label_data.json")
    images = [str(data / "tusimple" / frame.name) for frame in frames]
    match_frames(images, frames)
    camera = tusimple_camera()
    return images, segments_from_lines([frame.lines for frame in frames], camera)


def tusimple_labels(data: Path, calibrators: dict[str, Any]) -> Iterable[Figure]:
    """Evaluate the label file's lanes, one image each."""
    _, segments = tusimple_segments(data)
    count = segments.boundary.shape[0]
    intrinsics = tusimple_camera().intrinsics.expand(count, 3, 3)
    for name, calibrator in calibrators.items():
        calibration = calibrate_still(calibrator, segments, intrinsics, TUSIMPLE_LANE_WIDTH)
        directions, widths = [], []
        for i in range(count):
            one = LaneSegments(*(part[i : i + 1] for part in segments))
            pose = Extrinsics(*(value[i : i + 1] for value in calibration.extrinsics))
            measured = measure_boundaries(one, intrinsics[:1], pose)
            directions.append(spread(measured.direction))
            widths.append(spread(measured.widths))
        height = calibration.extrinsics.height.numpy()
        tracking = int((calibration.status == Status.TRACKING).sum())
        part = "tusimple, labels"
        yield Figure(part, "images calibrated", name, tracking, 88, least=True)
        yield Figure(part, "direction spread, median", name, np.degrees(np.nanmedian(directions)), 2.4, "deg")
        yield Figure(part, "lane width spread, median", name, 100 * np.nanmedian(widths), 27, "cm")
        iqr = float(np.subtract(*np.percentile(height, [75, 25])))
        yield Figure(part, "height, interquartile range", name, 100 * iqr, 12, "cm")
        yield Figure(part, "height, median", name, float(np.median(height)), None, "m")


def tusimple_pixels(data: Path, model: Any, calibrators: dict[str, Any]) -> Iterable[Figure]:
    """Evaluate lanes from images against the labels' points, and the pose against that from the labels."""
    from train.metrics import tusimple_score  # needs lightning

    images, labelled = tusimple_segments(data)
    camera = tusimple_camera()
    seen = still_segments(images, model, camera)
    frames = read_lanes(data / "tusimple" / "label_data.json")
    scores = []
    for one, frame in zip(seen, frames, strict=True):
        found = calibrate_still(calibrators["joint"], one, camera.intrinsics[None], TUSIMPLE_LANE_WIDTH)
        curves = lane_curves(one, found, camera)
        scores.append(tusimple_score(curves.x, curves.rows, frame))
    accuracy, false_positive, false_negative = np.mean(scores, axis=0)
    part = "tusimple, pixels"
    yield Figure(part, "accuracy", "-", accuracy, 0.92, least=True)
    yield Figure(part, "false positives", "-", false_positive, 0.25)
    yield Figure(part, "false negatives", "-", false_negative, 0.15)
    segments = join_tensors(torch.cat, seen)
    intrinsics = camera.intrinsics.expand(len(images), 3, 3)
    for name, calibrator in calibrators.items():
        pose = calibrate_still(calibrator, segments, intrinsics, TUSIMPLE_LANE_WIDTH).extrinsics.stack()
        truth = calibrate_still(calibrator, labelled, intrinsics, TUSIMPLE_LANE_WIDTH).extrinsics.stack()
        error = (pose - truth).abs()
        error[:, 3] /= truth[:, 3]
        middle = error.nanmedian(0).values.tolist()
        for axis, value, target in zip(("pitch", "yaw", "roll"), middle, (0.15, 0.15, 0.4), strict=False):
            yield Figure(part, f"{axis} against labels, median", name, np.degrees(value), target, "deg")
        yield Figure(part, "height against labels, median", name, 100 * middle[3], 3, "%")


def still_segments(images: list[str], model: Any, camera: Camera) -> list[LaneSegments]:
    """Return what the network finds in each image, in double precision."""
    tracker = Tracker(JointCalibrator(), camera, TUSIMPLE_LANE_WIDTH)
    observer = make_observer(model, tracker, camera, stills=True)
    return [camera_segments(observer(next(iter(open_source(image)))).vertices, camera) for image in images]


def make_observer(model: Any, tracker: Tracker[Any], camera: Camera, stills: bool) -> NetworkObserver:
    """Make what finds boundaries: with far views about the tracker's horizon if the model has such."""
    if model.far_view is None:
        return NetworkObserver(model, camera)
    return FarViewObserver(model, tracker, camera, stills)


def carla_truth(data: Path) -> dict[str, torch.Tensor]:
    """Return the true pose (4,) in rad and m of each image."""
    lines = (data / "carla" / "truth.csv").read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    names = ("pitch_deg", "yaw_deg", "roll_deg", "height_m")
    poses = {row["image"]: torch.tensor([float(row[name]) for name in names]).double() for row in rows}
    return {image: torch.cat([pose[:3].deg2rad(), pose[3:]]) for image, pose in poses.items()}


def carla_stills(data: Path, model: Any, calibrators: dict[str, Any]) -> Iterable[Figure]:
    """Evaluate five renderings, one frame each."""
    truth = carla_truth(data)
    camera = Camera.from_file(data / "carla" / "camera.yaml")
    names = [name for name in truth if name.endswith(".png")]
    seen = still_segments([str(data / "carla" / name) for name in names], model, camera)
    segments = join_tensors(torch.cat, seen)
    intrinsics = camera.intrinsics.expand(len(names), 3, 3)
    expected = torch.stack([truth[name] for name in names])
    for name, calibrator in calibrators.items():
        found = calibrate_still(calibrator, segments, intrinsics, CARLA_LANE_WIDTH).extrinsics.stack()
        error = _in_units((found - expected).abs())
        yield from _per_axis("carla stills", "mean error", name, error.mean(0), (0.15, 0.12, 0.35, 5))
        yield from _per_axis("carla stills", "worst error", name, error.amax(0), (0.4, 0.3, 1.0, 12))


def carla_drive(data: Path, model: Any, calibrators: dict[str, Any]) -> Iterable[Figure]:
    """Evaluate the drive's straight frames 10-66 against the truth."""
    camera = Camera.from_file(data / "carla" / "camera.yaml")
    expected = carla_truth(data)["drive.mp4"]
    drives = run_calibrators(str(data / "carla" / "drive.mp4"), camera, model, calibrators, CARLA_LANE_WIDTH)
    for name, drive in drives.items():
        error = _in_units(drive.poses[10:67] - expected).square().mean(0).sqrt()
        yield from _per_axis("carla drive 10-66", "RMSE", name, error, (0.1, 0.1, 0.2, 3))
        yield from _width_figures("carla drive", name, drive, camera, targets=False)


def udacity(data: Path, model: Any, calibrators: dict[str, Any]) -> Iterable[Figure]:
    """Evaluate two highway videos: frames tracked, and equal lane widths in the bird's-eye view."""
    camera = Camera.from_file(data / "udacity" / "camera.yaml")
    for video, count in (("highway_a", 76), ("highway_b", 201)):
        path = str(data / "udacity" / f"{video}.mp4")
        drives = run_calibrators(path, camera, model, calibrators, UDACITY_LANE_WIDTH)
        for name, drive in drives.items():
            part = f"udacity {video}"
            yield Figure(part, "rows", name, len(drive.poses), count, least=True)
            later = torch.from_numpy(drive.times > 1.0)
            share = (drive.status[later] == Status.TRACKING).double().mean()
            yield Figure(part, "TRACKING after 1 s", name, 100 * float(share), 95, "%", least=True)
            yield from _width_figures(part, name, drive, camera, targets=True)


def run_calibrators(
    source: str, camera: Camera, model: Any, calibrators: dict[str, Any], lane_width: float
) -> dict[str, Drive]:
    """Run every calibrator on the same observations of a video; far views are about joint's horizon."""
    tracker = Tracker(calibrators["joint"], camera, lane_width)
    observer = make_observer(model, tracker, camera, stills=False)
    states = {
        name: calibrator.initial_state(1, dtype=torch.float64) for name, calibrator in calibrators.items()
    }
    results: dict[str, list[Any]] = {name: [] for name in calibrators}
    times, seen = [], []
    for frame in open_source(source):
        segments = camera_segments(observer(frame).vertices, camera)
        times.append(frame.time)
        seen.append(segments)
        for name, calibrator in calibrators.items():
            with torch.inference_mode():
                calibration, states[name] = calibrator(
                    segments, camera.intrinsics[None], states[name], frame.dt, lane_width
                )
            pose, inliers = calibration.extrinsics.stack()[0], select_inliers(segments, calibration.inliers)
            vertical = calibrator.vertical_curvature(states[name])
            results[name].append((pose, calibration.status[0], inliers, vertical))
        tracker.state = states["joint"]
    drives = {}
    for name, frames in results.items():
        poses, status, lanes, curvatures = map(list, zip(*frames, strict=True))
        drives[name] = Drive(
            torch.stack(poses), torch.stack(status), np.array(times), seen, lanes, curvatures
        )
    return drives


def _width_figures(part: str, name: str, drive: Drive, camera: Camera, targets: bool) -> Iterable[Figure]:
    tracked = (drive.status == Status.TRACKING).nonzero().flatten()
    if not len(tracked):
        yield Figure(part, "lane width deviation, online", name, float("nan"), 5.0, "cm")
        return

    plane: list[torch.Tensor | None] = [None] * len(drive.poses)

    def deviation(
        seen: list[LaneSegments], poses: torch.Tensor, curvatures: list[torch.Tensor | None]
    ) -> float:
        widths = [
            measure_boundaries(
                segments, camera.intrinsics[None], Extrinsics.unstack(pose[None]), vertical_curvature=vertical
            ).widths
            for segments, pose, vertical in zip(seen, poses, curvatures, strict=True)
        ]
        return 100 * width_deviation(np.array(widths))

    first = drive.poses[int(tracked[0])].expand_as(drive.poses)
    fixed = deviation(drive.lanes, first, plane)
    online = deviation(drive.lanes, drive.poses, drive.curvatures)
    target = max(5.0, fixed / 3) if targets else None
    yield Figure(part, "lane width deviation, first frame's pose", name, fixed, None, "cm")
    yield Figure(part, "lane width deviation, online", name, online, target, "cm")
    on_plane = deviation(drive.lanes, drive.poses, plane)
    yield Figure(part, "the same, the road taken as plane", name, on_plane, None, "cm")
    fixed = deviation(drive.segments, first, plane)
    online = deviation(drive.segments, drive.poses, drive.curvatures)
    yield Figure(part, "the same of all that was detected, first pose", name, fixed, None, "cm")
    yield Figure(part, "the same of all that was detected, online", name, online, None, "cm")


def _in_units(pose: torch.Tensor) -> torch.Tensor:
    """Convert (..., 4) rad and m to deg and cm."""
    return torch.cat([pose[..., :3].rad2deg(), 100 * pose[..., 3:]], dim=-1)


def _per_axis(
    part: str, what: str, name: str, values: torch.Tensor, targets: tuple[float, float, float, float]
) -> Iterable[Figure]:
    axes = (("pitch", "deg"), ("yaw", "deg"), ("roll", "deg"), ("height", "cm"))
    for (axis, unit), value, target in zip(axes, values.tolist(), targets, strict=True):
        yield Figure(part, f"{axis}, {what}", name, value, target, unit)
