"""The main job: frames in, extrinsics and a stable bird's-eye view out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lanebev.app.concurrency import prefetch
from lanebev.app.observers import LaneFileObserver, NetworkObserver, Observer
from lanebev.app.recorder import Recorded, Recorder
from lanebev.camera.model import Camera
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.state import Reason
from lanebev.estimation.mount import (
    MountCalibration,
    MountEstimator,
    MountReason,
    MountStatus,
    describe_mount,
)
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.geometry.lens import DISTORTION_LENGTHS
from lanebev.io.calibration_file import write_calibration
from lanebev.io.lane_size import resized_lanes
from lanebev.io.lanes import lane_files, read_lanes
from lanebev.io.results import ExtrinsicsRow, OutputFolder, check_inputs_stay
from lanebev.io.state import load_state, save_state
from lanebev.io.video import Frame, FrameSource, image_size, open_source
from lanebev.observation.segments import LaneSegments, camera_segments
from lanebev.pipeline import LaneBEV
from lanebev.report.overlay import Picture
from lanebev.report.page import Report
from lanebev.types import Calibration, Extrinsics, Status
from lanebev.view.frame import remap_frame
from lanebev.view.grid import BEVGrid

CALIBRATORS = ("joint", "two-stage")
STATE_FILE, CALIBRATION_FILE = "state.safetensors", "calibration.yaml"
STILLS_FPS = Fraction(2)  # of the videos that show images one after another
STILL_PASSES = 4  # updates on one image: the linearisation settles
_LOOKED_AT = 20  # images of a folder, for one of the camera's size
_NOMINAL_HEIGHT = 1.5  # m, of the view before anything is known

_BEFORE_RESOLUTION = 0.1  # m, of the view before: it is only shown small

Progress = Callable[[Iterator[Frame], int], Iterator[Frame]]


@dataclass(frozen=True)
class RunConfig:
    """What to run.

    Attributes:
        source: video, folder, glob or image.
        camera: camera file.
        out: output folder.
        lane_width: m.
        lanes: lane file or folder of another detector, None for the network.
        stills: every image on its own.
        resume: output folder of an earlier run, with the same calibrator, whose state to begin with.
        calibrator: one of CALIBRATORS.
        fps: of a folder, a glob or a raw stream; None is what names or the stream say, else 30. A video knows
            its own.
        lanes_size: (height, width) px of the images that ``lanes`` was drawn on; None is the source's own.
        rectified: the images were rectified: the camera is the camera file's projection matrix P.
    """

    source: str
    camera: str
    out: str
    lane_width: float = 3.7
    lanes: str | None = None
    stills: bool = False
    resume: str | None = None
    calibrator: str = "joint"
    fps: float | None = None
    lanes_size: tuple[int, int] | None = None
    rectified: bool = False

    @property
    def frame_rate(self) -> Fraction | None:
        """``fps`` as a fraction."""
        return None if self.fps is None else Fraction(self.fps).limit_denominator(1000)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.lane_width) and 1.0 < self.lane_width < 10.0):
            raise ValueError(f"lane width: expected 1 to 10 m, got {self.lane_width:g}")
        if self.fps is not None and not (math.isfinite(self.fps) and 0.01 <= self.fps <= 10_000):
            raise ValueError(f"fps: expected 0.01 to 10000 frames per second, got {self.fps:g}")
        if self.calibrator not in CALIBRATORS:
            raise ValueError(f"calibrator: expected {' or '.join(CALIBRATORS)}, got {self.calibrator!r}")
        if self.stills and self.resume:
            raise ValueError("resume: expected a drive, got --stills; images on their own have no state")


def run(
    config: RunConfig, progress: Progress | None = None, truth: Sequence[ExtrinsicsRow] | None = None
) -> Report:
    """Run on all frames and write the output folder, all of it or nothing.

    Args:
        config: what to run.
        progress: wraps the frames, told how many there are.
        truth: of a rendered drive, a row per frame, for the report.

    Returns:
        what the report page shows.

    Raises:
        ValueError: bad input; one line says which and what would be right.
    """
    source = open_source(config.source, config.frame_rate)
    check_inputs_stay(config.out, inputs(config, source))
    camera = Camera.from_file(config.camera, source.image_size, config.rectified)
    source = of_camera(camera, source)
    observer = make_observer(config, source, camera)
    calibrator, mount = make_calibrator(config.calibrator), MountEstimator()
    states, problem = begin(config, calibrator, mount, camera)
    frames: Iterator[Frame] = prefetch(source)
    frames = progress(frames, source.count) if progress else frames
    grid, coarse = BEVGrid(), BEVGrid(resolution=_BEFORE_RESOLUTION)
    with OutputFolder(config.out) as out, torch.inference_mode():
        if config.resume and problem:
            problem += keep_refused(config.resume, out)
        recorder = Recorder(
            out.__truediv__,
            camera,
            grid,
            STILLS_FPS if config.stills else source.fps,
            config.lane_width,
            source.is_single,
            config.stills,
        )
        recorder.problems += filter(None, (source.problem, problem, observer.remark, lens_remark(camera)))
        before = None
        with recorder:
            for frame in frames:
                vertices, pose_sigma_scale = observer(frame)
                segments = camera_segments(vertices, camera)
                calibration, states["calibrator"] = calibrate(
                    calibrator, segments, camera, states["calibrator"], frame, config
                )
                calibration = calibration.with_std_scaled(pose_sigma_scale)
                bend = curvature(calibrator, states["calibrator"])
                mounted, states["mount"] = mount(calibration, states["mount"], frame.dt, curvature=bend)
                before = pose_before(before, calibration, config.stills or source.is_single, camera)
                recorder.add(
                    Recorded(
                        frame,
                        frame.name or f"{Path(source.source).name}/{frame.number:06d}",
                        vertices,
                        pose_sigma_scale,
                        segments,
                        calibration,
                        reasons_of(states["calibrator"]),
                        before,
                        bird_view(coarse, frame, camera, before),
                        bird_view(grid, frame, camera, calibration.extrinsics),
                    )
                )
        facts = run_facts(config, source, camera)
        if not config.stills:
            save_state(out / STATE_FILE, {**states, "camera": lens(camera)})
            facts |= mount_facts(mounted)
            write_calibration(out / CALIBRATION_FILE, camera, mounted)
        return recorder.finish(facts, Path(source.source).name, truth, None if config.stills else mounted)


def begin(
    config: RunConfig, calibrator: Any, mount: MountEstimator, camera: Camera
) -> tuple[dict[str, Any], str | None]:
    """The states to begin with, by name, and why they are not those asked for, if they aren't.

    Raises:
        ValueError: ``resume`` is no earlier run's folder, or of one with another calibrator or camera.
    """
    fresh = {
        "calibrator": calibrator.initial_state(1, dtype=torch.float64),
        "mount": mount.initial_state(1, dtype=torch.float64),
    }
    if config.resume is None:
        return fresh, None
    path = Path(config.resume) / STATE_FILE
    if not path.is_file():
        raise ValueError(
            f"resume: expected the output folder of an earlier run, got {config.resume}: no {STATE_FILE}"
        )
    loaded = load_state(path, fresh)
    for name in CALIBRATORS if loaded.problem else ():
        other = make_calibrator(name).initial_state(1, dtype=torch.float64)
        if load_state(path, fresh | {"calibrator": other}).problem is None:
            raise ValueError(
                f"resume: expected a state of the {config.calibrator} calibrator, got one of the {name} "
                f"calibrator in {config.resume}; give --calibrator {name} or leave out --resume"
            )
    if loaded.problem is None and loaded.metadata.get("camera", lens(camera)) != lens(camera):
        raise ValueError(
            f"resume: expected a state of the camera in {config.camera}, got another camera's in "
            f"{config.resume}; give its camera file or leave out --resume"
        )
    return fresh | loaded.states, loaded.problem


def lens(camera: Camera) -> dict[str, Any]:
    """What tells one camera from another, in values that JSON can hold; of any number of coefficients."""
    missing = max(map(max, DISTORTION_LENGTHS.values())) - len(camera.distortion)
    return {
        "image_size": list(camera.image_size),
        "model": camera.model,
        "intrinsics": camera.intrinsics.tolist(),
        "distortion": [*camera.distortion.tolist(), *[0.0] * missing],
    }


def keep_refused(resume: str, out: OutputFolder) -> str:
    """Keep a refused state that this run would replace, and its mount; where, for the report."""
    replaced = out.folder / STATE_FILE
    if not (replaced.exists() and replaced.samefile(Path(resume) / STATE_FILE)):
        return ""
    names = [name for name in (STATE_FILE, CALIBRATION_FILE) if (out.folder / name).is_file()]
    return f"; kept as {', '.join(out.keep(name, 'refused') for name in names)}"


def inputs(config: RunConfig, source: FrameSource) -> list[str | Path]:
    """The files that a run reads and does not mean to replace."""
    lanes = [] if config.lanes is None else lane_files(config.lanes)
    return [*(source.paths or [source.source]), config.camera, *lanes]


def make_observer(config: RunConfig, source: FrameSource, camera: Camera) -> Observer:
    """Lanes from a file if one is given, else from the network."""
    if config.lanes is not None:
        entries = read_lanes(config.lanes, camera.intrinsics.double().numpy())
        if config.lanes_size is not None:
            entries = resized_lanes(entries, config.lanes_size, camera.image_size)
        return LaneFileObserver(entries, source, camera)
    return NetworkObserver(LaneBEV.from_pretrained(), camera)


def make_calibrator(name: str) -> Any:
    """The calibrator of this name with default settings."""
    return TwoStageCalibrator() if name == "two-stage" else JointCalibrator()


def lens_remark(camera: Camera) -> str:
    """Say at how many of its pixels the camera's lens images nothing; empty if there are none."""
    share = camera.share_without_rays()
    if share == 0:
        return ""
    return f"camera: {share:.2%} of the pixels cannot be undistorted by the lens; lanes there are left out"


def of_camera(camera: Camera, source: FrameSource) -> FrameSource:
    """The source with the camera's image size, which is its first frame's or, if that is a stray, another's.

    Raises:
        ValueError: the camera file is for images of another size.
    """
    if camera.image_size == source.image_size:
        return source
    if any(image_size(path) == camera.image_size for path in source.paths[1:_LOOKED_AT]):
        return replace(source, image_size=camera.image_size)
    (height, width), (rows, columns) = camera.image_size, source.image_size
    raise ValueError(
        f"camera: expected one for the source's {columns} x {rows} px, got one for {width} x {height}; "
        "give the calibration of these images or resize them"
    )


def calibrate(
    calibrator: nn.Module, segments: LaneSegments, camera: Camera, state: Any, frame: Frame, config: RunConfig
) -> tuple[Calibration, Any]:
    """One frame of a drive, or one image on its own with a fresh state."""
    intrinsics = camera.intrinsics[None]
    calibration: Calibration
    if config.stills:
        return _still(calibrator, segments, intrinsics, config.lane_width)
    calibration, state = calibrator(segments, intrinsics, state, frame.dt, config.lane_width)
    return calibration, state


def reasons_of(state: Any) -> Reason:
    """Return why the frame is not (fully) tracked; nothing where the calibrator gives no reasons."""
    return Reason(int(state.reasons[0])) if hasattr(state, "reasons") else Reason.NONE


def curvature(calibrator: Any, state: Any) -> Tensor | None:
    """Of the road at the camera, (1,) 1/m, where the calibrator estimates it."""
    bend: Tensor | None = calibrator.curvature(state) if hasattr(calibrator, "curvature") else None
    return bend


def calibrate_still(
    calibrator: nn.Module, segments: LaneSegments, intrinsics: Tensor, lane_width: float
) -> Calibration:
    """Images of their own, each from the start.

    A calibrator that starts with a fit to the first frame is done after one pass. One that starts with a
    guess takes several, each with its share of the information. Source: with the end points' variance times
    the number of passes, all passes together say as much as the image does once (progressive update), so the
    covariance stays honest while the linearisation settles.

    Args:
        calibrator: any.
        segments: B images.
        intrinsics: (B, 3, 3).
        lane_width: m.
    """
    return _still(calibrator, segments, intrinsics, lane_width)[0]


def _still(
    calibrator: nn.Module, segments: LaneSegments, intrinsics: Tensor, lane_width: float
) -> tuple[Calibration, Any]:
    passes = 1 if isinstance(calibrator, JointCalibrator) else STILL_PASSES
    initial_state: Any = calibrator.initial_state
    state = initial_state(segments.sigma.shape[0], dtype=segments.sigma.dtype, device=segments.sigma.device)
    shared = segments._replace(sigma=segments.sigma * math.sqrt(passes))
    for _ in range(passes):
        calibration: Calibration
        calibration, state = calibrator(shared, intrinsics, state, 1e-3, lane_width)
    return calibration, state


def pose_before(
    before: Extrinsics | None, now: Calibration, alone: bool, camera: Camera
) -> Extrinsics | None:
    """Pose of the view before: level for images on their own, in a drive the first that was tracked."""
    if alone:
        return Extrinsics.from_values(0.0, 0.0, 0.0, _NOMINAL_HEIGHT)
    if before is None and int(now.status[0]) == Status.TRACKING:
        return now.extrinsics
    return before


def bird_view(grid: BEVGrid, frame: Frame, camera: Camera, extrinsics: Extrinsics | None) -> Picture:
    """Resample a frame to (U, V, 3) uint8 RGB, black where the camera does not see, or nothing is known."""
    if frame.image is None or extrinsics is None:
        return np.zeros((*grid.shape, 3), np.uint8)
    return remap_frame(frame.image, camera, extrinsics, grid)[0]


def run_facts(config: RunConfig, source: FrameSource, camera: Camera) -> dict[str, str]:
    """What ran, for the report."""
    from lanebev import __version__

    height, width = camera.image_size
    fx, fy = float(camera.intrinsics[0, 0]), float(camera.intrinsics[1, 1])
    kind = "images, each on its own" if config.stills else "frames"
    rate = "" if config.stills or source.is_single else f" at {float(source.fps):g} fps"
    return {
        "source": f"{source.source} ({width} x {height})",
        kind: f"{source.count}{rate}",
        "camera": f"{config.camera}: {camera.model}, f = {fx:.1f} / {fy:.1f} px",
        "lanes from": config.lanes or "the network",
        "lane width": f"{config.lane_width:.4g} m",
        "calibrator": config.calibrator,
        "lanebev": __version__,
    }


def mount_facts(mounted: MountCalibration) -> dict[str, str]:
    """How far the mount is known, for the report."""
    status = MountStatus(int(mounted.status[0])).name
    reasons = MountReason(int(mounted.reasons[0]))
    why = f" ({reasons.name})" if reasons else ""
    words = "; ".join(describe_mount(mounted))
    return {"mount": f"{status}, {float(mounted.progress[0]):.0f} %{why}", "mount, axis by axis": words}


def summary(report: Report, config: RunConfig) -> str:
    """What to print when a run is done."""
    tracking = [row for row in report.rows if row.status == "TRACKING"]
    lines = [f"{len(report.rows)} frames, {len(tracking)} TRACKING"]
    if tracking:
        middle = {name: float(np.median([getattr(row, name) for row in tracking])) for name in _SHOWN}
        values = "  ".join(f"{name.rsplit('_', 1)[0]} {middle[name]:+.3f} {_SHOWN[name]}" for name in _SHOWN)
        lines.append(f"median  {values}")
    shown = ("lane width σ", "mount")
    lines += [f"{label}: {text}" for label, text in report.facts.items() if label.startswith(shown)]
    lines += [f"problem: {problem}" for problem in report.problems[:5]]
    if len(report.problems) > 5:
        lines.append(f"and {len(report.problems) - 5} more, see the report")
    written = sorted(path.name for path in Path(config.out).iterdir())
    return "\n".join([*lines, f"{config.out}: {', '.join(written)}"])


_SHOWN = {"pitch_deg": "deg", "yaw_deg": "deg", "roll_deg": "deg", "height_m": "m"}
