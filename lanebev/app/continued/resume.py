"""Start from the state of an earlier run."""

from dataclasses import replace
from pathlib import Path

from lanebev.app.config import CALIBRATORS, RunConfig
from lanebev.app.drive.build import make_tracker
from lanebev.app.drive.observers import RunTracker
from lanebev.camera.model import Camera
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


def resume_remark(config: RunConfig) -> str:
    """Return a remark on a state to resume that was saved with lanes of another width; else nothing."""
    if config.resume is None:
        return ""
    remark = lane_width_remark(load_state(Path(config.resume) / STATE_FILE), config.taken_lane_width[0])
    return f"resume: {remark}" if remark else ""


def backup_state(resume: str, out: OutputFolder) -> str:
    """Keep a refused state that this run would replace, and its mount, under other names; say which."""
    replaced = out.folder / STATE_FILE
    if not (replaced.exists() and replaced.samefile(Path(resume) / STATE_FILE)):
        return ""
    names = [name for name in (STATE_FILE, CALIBRATION_FILE) if (out.folder / name).is_file()]
    return f"; kept as {', '.join(out.keep(name, 'refused') for name in names)}"
