"""Start from the state of an earlier run."""

from dataclasses import replace
from pathlib import Path

from lanebev.app.config import CALIBRATORS, RunConfig
from lanebev.app.continued.recovery import size_and_time
from lanebev.app.drive.build import make_tracker
from lanebev.app.drive.observers import RunTracker
from lanebev.camera.model import Camera
from lanebev.io.frame_source import FrameSource
from lanebev.io.output.folder import OutputFolder
from lanebev.io.state import lane_width_remark, load_state

STATE_FILE, CALIBRATION_FILE = "state.safetensors", "calibration.yaml"


def load_states(config: RunConfig, tracker: RunTracker, camera: Camera) -> str | None:
    """Load the states that a run begins with, if it is to resume.

    Returns:
        why they are not those asked for, if they are not: the file is damaged.
    """
    if config.resume is None:
        return None
    path = Path(config.resume) / STATE_FILE
    if not path.is_file():
        raise ValueError(
            f"resume: expected the output folder of an earlier run, got {config.resume}: no {STATE_FILE}"
        )
    loaded = load_state(path, tracker.states())
    for name in CALIBRATORS if loaded.problem else ():
        other = make_tracker(replace(config, calibrator=name, mount=None), camera)
        if load_state(path, other.states()).problem is None:
            raise ValueError(
                f"resume: expected a state of the {config.calibrator} calibrator, got one of the {name} "
                f"calibrator in {config.resume}; give --calibrator {name} or leave out --resume"
            )
    if loaded.problem is not None:
        return f"state ignored: {loaded.problem}; calibration starts anew"
    if loaded.metadata.get("camera") != camera.fingerprint():
        raise ValueError(
            f"resume: expected a state of the camera in {config.camera or '--fov'}, got another camera's in "
            f"{config.resume}; give its camera file or leave out --resume"
        )
    tracker.state, tracker.mount_state = loaded.states["calibrator"], loaded.states["mount"]
    return None


def resume_remark(config: RunConfig, source: FrameSource) -> str:
    """Return a remark on a state of lanes of another width or of frames that come again; else nothing."""
    if config.resume is None:
        return ""
    loaded = load_state(Path(config.resume) / STATE_FILE)
    of_width = lane_width_remark(loaded, config.taken_lane_width[0])
    remark = of_width or _again_remark(source, loaded.metadata.get("last_frame"))
    return f"resume: {remark}" if remark else ""


def last_frame(source: FrameSource, count: int) -> list[str | int] | None:
    """Return the last one of so many frames of a source, as :func:`_again_remark` recognises it again.

    Returns:
        name, size and time of change of its file, and its number in the source; None of a stream.
    """
    numbers = [] if source.is_live else source.taken_numbers[:count]
    return [*_file_of(source, numbers[-1]), numbers[-1]] if numbers else None


def _again_remark(source: FrameSource, last: list[str | int] | None) -> str:
    """Return a remark on a source of which the last frame of a state, or one after it, is taken again."""
    numbers = [] if source.is_live or not last else source.taken_numbers
    if not (last and numbers):
        return ""
    *file, number = last
    if source.is_video:
        is_again = numbers[0] <= int(number) and _file_of(source, numbers[0]) == file
    else:
        is_again = any(_file_of(source, each) == file for each in numbers)
    if not is_again:
        return ""
    return (
        f"the state contains frames of this source already, up to number {number}, which now count twice; "
        "begin after it by --start, or without --resume"
    )


def _file_of(source: FrameSource, number: int) -> list[str | int]:
    """Return name, size and time of change of the file of a frame."""
    path = Path(source.source if source.is_video else source.paths[number])
    return [path.name, *size_and_time(path)]


def backup_state(resume: str, out: OutputFolder) -> str:
    """Keep a refused state that this run would replace, and its mount, under other names; say which."""
    replaced = out.folder / STATE_FILE
    if not (replaced.exists() and replaced.samefile(Path(resume) / STATE_FILE)):
        return ""
    names = [name for name in (STATE_FILE, CALIBRATION_FILE) if (out.folder / name).is_file()]
    return f"; kept as {', '.join(out.keep(name, 'refused') for name in names)}"
