"""Facts about a run: for the report, and printed at its end."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

import numpy as np

from lanebev import __version__
from lanebev.app.config import RunConfig
from lanebev.camera.model import Camera
from lanebev.estimation.mount import MountCalibration, MountStatus, describe_mount
from lanebev.io.frame_source import FrameSource
from lanebev.io.live import LiveSource
from lanebev.io.results import ExtrinsicsRow
from lanebev.report.page import Report
from lanebev.report.verdict import reason_words

_SHOWN = {"pitch_deg": "deg", "yaw_deg": "deg", "roll_deg": "deg", "height_m": "m"}
_PROBLEMS = 5  # problems that are printed, at most
_REASONS = 2  # reasons that are printed, at most
_SMOOTHED = "every pose is from the whole drive, later frames too; those of the filter are in filtered.csv"


def run_facts(config: RunConfig, source: FrameSource, camera: Camera) -> dict[str, str]:
    """Return the settings of the run for the report."""
    height, width = camera.image_size
    fx, fy = float(camera.intrinsics[0, 0]), float(camera.intrinsics[1, 1])
    lens = config.camera or ("the bag" if config.fov is None else f"field of view of {config.fov:g} deg")
    kind = "images, each on its own" if config.stills else "frames"
    rate = "" if config.stills or source.is_single else f" at {float(source.fps):g} fps"
    network = "the network" if config.weights is None else f"the network, {config.weights}"
    return {
        "source": f"{source.source} ({width} x {height})",
        kind: f"{source.taken_count}{rate}",
        "camera": f"{lens}: {camera.model}, f = {fx:.1f} / {fy:.1f} px",
        "lanes from": config.lanes or network,
        "lane width": lane_width_words(config),
        "calibrator": config.calibrator,
        "lanebev": __version__,
        **({"stream": source.figures.words()} if isinstance(source, LiveSource) else {}),
        **({"smoothed": _SMOOTHED} if config.smooth else {}),
        **_other_settings(config),
    }


def lane_width_words(config: RunConfig) -> str:
    """Return the lane width used, and the effect of its standard deviation on the height, in words."""
    width, std = config.taken_lane_width
    words = f"{width:.4g} m" if config.lane_width is not None else f"assumed to be {width:.4g} m"
    if std:
        words += f", with a standard deviation of {std:.2g} m, which is {std / width:.1%} of the height"
    return words if config.lane_width is not None else f"{words}; if you know it, give --lane-width"


def _other_settings(config: RunConfig) -> dict[str, str]:
    """Return the settings that the facts do not name, by their names on the command line."""
    named = {"source", "camera", "lanes", "lane_width", "calibrator", "weights", "out"}
    settings = {item.name: getattr(config, item.name) for item in fields(config) if item.name not in named}
    settings["focal_std"] = config.relative_focal_std
    settings["lane_width_std"] = config.taken_lane_width[1]
    near, far, left, right, step = config.grid
    settings["grid"] = f"{near:g}:{far:g},{left:g}:{right:g}/{step:g}"
    if config.lanes_size is not None:
        settings["lanes_size"] = "{1}x{0}".format(*config.lanes_size)
    if config.lanes_crop is not None:
        settings["lanes_crop"] = "{3}x{2}+{1}+{0}".format(*config.lanes_crop)
    return {f"--{name.replace('_', '-')}": setting_words(value) for name, value in settings.items()}


def setting_words(value: object) -> str:
    """Return the value of a setting as one would give it; flags as yes or no."""
    if value is None:
        return "not given"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "none"
    return f"{value:.12g}" if isinstance(value, float) else str(value)  # compare and convert read it back


def mount_facts(mounted: MountCalibration) -> dict[str, str]:
    """Return how far the mount is calibrated, for the report."""
    status = MountStatus(int(mounted.status[0])).name
    axes = dict(sentence.split(": ", 1) for sentence in describe_mount(mounted))
    facts = {f"mount, {axis}": words for axis, words in axes.items()}
    return {"mount": f"{status}, {float(mounted.progress[0]):.0f} % of the driving that it needs"} | facts


def untracked_words(rows: Iterable[ExtrinsicsRow]) -> list[str]:
    """Return the most frequent reasons of frames that are not tracked, in a line; none if all are."""
    others = [row for row in rows if row.status != "TRACKING"]
    names = ([name for name in row.reason_names if name != "NO_START"] for row in others)
    reasons = Counter(words for each in names for words in reason_words(each))  # NO_START has another cause
    if not reasons:
        return []
    words = ", ".join(f"{word} (in {count})" for word, count in reasons.most_common(_REASONS))
    return [f"{len(others)} not tracked: {words}"]


def summary(report: Report, config: RunConfig) -> str:
    """Return the text to print when a run is done."""
    tracking = [row for row in report.rows if row.status == "TRACKING"]
    lines = [f"{len(report.rows)} frame{'s'[: len(report.rows) != 1]}, {len(tracking)} TRACKING"]
    if tracking:
        middle = {name: float(np.median([getattr(row, name) for row in tracking])) for name in _SHOWN}
        values = "  ".join(f"{name.rsplit('_', 1)[0]} {middle[name]:+.3f} {_SHOWN[name]}" for name in _SHOWN)
        lines.append(f"median  {values}")
    lines += untracked_words(report.rows)
    shown = ("lane width", "standard deviation of lane widths", "mount", "smoothed", "reused", "stream")
    lines += [f"{label}: {text}" for label, text in report.facts.items() if label.startswith(shown)]
    lines += [f"problem: {problem}" for problem in report.problems[:_PROBLEMS]]
    if len(report.problems) > _PROBLEMS:
        lines.append(f"and {len(report.problems) - _PROBLEMS} more, see the report")
    written = sorted(path.name for path in Path(config.out).iterdir())
    return "\n".join([*lines, f"{config.out}: {', '.join(written)}"])
