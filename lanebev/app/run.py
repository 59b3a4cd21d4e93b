"""``lanebev run``: frames in, extrinsics and a stable bird's-eye view out."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import torch

from lanebev.app.config import RunConfig
from lanebev.app.continued.part_observation import observer_of_parts
from lanebev.app.continued.recovery import facts_of, frame_name, observer_of_second_pass, recover_run
from lanebev.app.continued.resume import (
    CALIBRATION_FILE,
    STATE_FILE,
    backup_state,
    last_frame,
    load_states,
    resume_remark,
)
from lanebev.app.continued.smoothing import SmoothedPoses, smooth_frames
from lanebev.app.continued.source_changes import changes_remark, count_remark, files_of
from lanebev.app.convert import writer
from lanebev.app.drive.build import (
    input_files,
    joint_config,
    make_grid,
    make_observer,
    make_tracker,
    match_image_size,
)
from lanebev.app.drive.observers import Observation, Observer, RunTracker
from lanebev.app.drive.shared_network import SharedNetwork
from lanebev.app.drive.sources import camera_of, ended_by_signals, first_image, make_source, observed_frames
from lanebev.app.drive.upside_down import upside_down_remark
from lanebev.app.progress import Progress, no_progress
from lanebev.app.recording.plausibility import bars_remark, mount_remark, unfit_mount_remark
from lanebev.app.recording.recorder import Recorded, Recorder
from lanebev.app.summary import mount_facts, run_facts
from lanebev.camera.model import Camera
from lanebev.camera.plausibility import camera_remarks
from lanebev.io.calibration_file import write_calibration
from lanebev.io.formats.folder import read_record
from lanebev.io.formats.names import FORMATS, check_installed
from lanebev.io.formats.record import RecordedFrame, vertex_lines
from lanebev.io.formats.rerun import open_viewer
from lanebev.io.frame_source import FrameSource
from lanebev.io.frames import Frame
from lanebev.io.output.folder import OutputFolder, check_inputs_stay, check_new_or_of_run
from lanebev.io.results import ExtrinsicsRow
from lanebev.io.state import save_state
from lanebev.report.page import Report

STILLS_FPS = Fraction(2)  # Hz, of the videos of still images


logger = logging.getLogger(__name__)


def run(
    config: RunConfig,
    progress: Progress = no_progress,
    truth: Sequence[ExtrinsicsRow] | None = None,
    network: SharedNetwork | None = None,
    parts: Sequence[Path] = (),
) -> Report:
    """Run on all frames and write the output folder, all of it or nothing.

    Frames are decoded in one thread, processed by the network in others, and drawn and encoded in one more.
    The detections of a run with the same settings into the same folder that was killed are reused.

    Args:
        config: what to run.
        progress: wraps the frames, given their number.
        truth: truth of a rendered drive, a row per frame, for the report.
        network: an already loaded network with the weights and device of the settings.
        parts: files of :func:`lanebev.app.continued.part_observation.observe_part` for parts of the source,
            in order; the network is not run again on their frames.

    Returns:
        what the report page shows.

    Raises:
        ValueError: bad input; one line says which and what would be right.
    """
    check_installed(config.formats)
    config, source, camera = open_inputs(config)
    files = files_of(source)
    tracker, refusal = resumed_tracker(config, camera)
    observer = make_observer(config, source, camera, network, tracker)
    viewer = None if config.rerun is None else open_viewer(config.rerun, camera)
    progress = no_progress if source.is_live else progress
    with OutputFolder(config.out) as out, torch.inference_mode():
        if config.resume and refusal:
            refusal += backup_state(config.resume, out)
        if parts:
            reusing = observer_of_parts(parts, observer)
        else:
            reusing = recover_run(out, config, source, camera, observer)
        last_observer, smoothed = reusing, None
        if config.smooth:
            smoothed = first_pass(config, source, tracker, reusing, out, progress)
            source = replace(source, most=len(smoothed.poses))
            tracker, _ = resumed_tracker(config, camera)
            last_observer = observer_of_second_pass(out, observer, reusing, source)
        recorder = _recorder(config, source, camera, out)
        resumed = refusal or resume_remark(config, source)
        recorder.problems += filter(None, (source.problem, resumed, observer.remark))
        recorder.problems += setting_remarks(config, source, camera)
        frames = observed_frames(source, last_observer)
        with recorder, closing(frames), ended_by_signals(source):
            shown = progress(frames, source.taken_count)
            for done in recorded_frames(shown, config, source, tracker, smoothed):
                recorder.add(done)
                if viewer is not None:
                    pose, lines = done.estimate.calibration.extrinsics, vertex_lines(done.seen.vertices)
                    viewer.add(RecordedFrame(recorder.rows[-1], pose, lines), done.frame.image)
        rows = recorder.rows
        tracked = sum(row.status == "TRACKING" for row in rows)
        of_source = (changes_remark(source, files), count_remark(source, len(rows)))
        upside_down = upside_down_remark(observer, tracker, source, tracked, len(rows))
        recorder.problems += filter(None, (*of_source, unfit_mount_remark(config.mount, rows), upside_down))
        saved = _save_tracker(tracker, camera, last_frame(source, len(rows)), out)
        facts = run_facts(config, source, camera) | facts_of(reusing) | saved
        logger.info("writing the report")
        report = recorder.finish(facts, Path(source.source).name, truth, tracker.mount)
        if config.formats:
            _write_formats(config, out, report, camera, source)
        return report


def open_inputs(config: RunConfig) -> tuple[RunConfig, FrameSource, Camera]:
    """Open the source and the camera, and check that the output folder may be written.

    Returns:
        the settings, which are those of a still if the source is one image; the source; the camera. A drive's
        first frame has smaller standard deviations than a still, because the frames after it correct it.

    Raises:
        ValueError: see :func:`~lanebev.app.drive.sources.make_source` and
            :func:`~lanebev.app.drive.sources.camera_of`; or the run would replace one of its inputs.
    """
    source = make_source(config)
    if source.is_single and not (config.resume or config.smooth):
        config = replace(config, stills=True)
    check_inputs_stay(config.out, input_files(config, source))
    check_new_or_of_run(config.out)
    camera = camera_of(config, source)
    source = match_image_size(camera, source)
    logger.info("%s: %d frames of %d x %d", source.source, source.count, *reversed(camera.image_size))
    return config, source, camera


def recorded_frames(
    frames: Iterator[tuple[Frame, Observation]],
    config: RunConfig,
    source: FrameSource,
    tracker: RunTracker,
    smoothed: SmoothedPoses | None,
) -> Iterator[Recorded]:
    """Estimate frame by frame, with the smoothed poses where there are any."""
    for frame, seen in frames:
        if config.stills:
            filtered = tracker.still(seen.vertices, seen.pose_sigma_scale)
        else:
            filtered = tracker.drive_frame(seen.vertices, frame.dt, seen.pose_sigma_scale, frame.speed)
        estimate = filtered if smoothed is None else smoothed.of(filtered, frame.number)
        name = frame_name(frame, source)
        yield Recorded(frame=frame, name=name, seen=seen, estimate=estimate, filtered=filtered)


def _save_tracker(
    tracker: RunTracker, camera: Camera, last: list[str | int] | None, out: OutputFolder
) -> dict[str, str]:
    """Write the state and the mount after a drive, and return the mount's facts; nothing after stills."""
    if tracker.mount is None:
        return {}
    plain = {"camera": camera.fingerprint(), "lane_width": tracker.lane_width, "last_frame": last}
    save_state(out / STATE_FILE, {**tracker.states(), **plain})
    write_calibration(out / CALIBRATION_FILE, camera, tracker.mount)
    return mount_facts(tracker.mount)


def _write_formats(
    config: RunConfig, out: OutputFolder, report: Report, camera: Camera, source: FrameSource
) -> None:
    """Write the results for other programs; formats with images take the frames of the run again."""
    record = replace(read_record(out / "."), name=report.title, rows=report.rows, camera=camera)
    images = None if source.is_live else replace(source, most=len(report.rows))
    for name in config.formats:
        writer(name)(out / FORMATS[name].file, record, images)


def resumed_tracker(config: RunConfig, camera: Camera) -> tuple[RunTracker, str | None]:
    """Make the tracker with the states to continue from; also return what is wrong with these."""
    tracker = make_tracker(config, camera)
    return tracker, load_states(config, tracker, camera)


def _recorder(config: RunConfig, source: FrameSource, camera: Camera, out: OutputFolder) -> Recorder:
    """Make what writes the rows, lanes and pictures of a run."""
    return Recorder(
        path=out.__truediv__,
        camera=camera,
        fps=STILLS_FPS if config.stills else source.fps / config.every,
        lane_width=config.taken_lane_width[0],
        single=source.is_single,
        stills=config.stills,
        grid=make_grid(config),
        videos=not config.no_video,
        smoothed=config.smooth,
        given_lanes=config.lanes is not None,
    )


def setting_remarks(config: RunConfig, source: FrameSource, camera: Camera) -> list[str]:
    """Return remarks on an implausible camera, field of view or mount of the settings."""
    bars = "" if config.fov is None else bars_remark(first_image(source))
    mount = mount_remark(config.mount, camera)
    return [*filter(None, (bars, mount)), *camera_remarks(camera, source.pixel_aspect)]


def first_pass(
    config: RunConfig,
    source: FrameSource,
    tracker: RunTracker,
    observer: Observer,
    out: OutputFolder,
    progress: Progress,
) -> SmoothedPoses:
    """Process the whole drive once, and estimate every pose from all frames."""
    with closing(observed_frames(source, observer)) as frames:
        logger.info("first of two passes")
        shown = progress(frames, source.taken_count)
        return smooth_frames(shown, tracker, out, source, joint_config(config))
