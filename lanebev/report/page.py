"""``report.html``: one self-contained page."""

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from lanebev.camera.model import Camera
from lanebev.estimation.mount import MountCalibration, MountStatus, describe_mount
from lanebev.io.results import ExtrinsicsRow
from lanebev.report.axis_states import (
    DIGITS,
    UNITS,
    AxisState,
    all_axis_states,
    axis_states,
    estimate_stds,
    estimates,
    plus_minus,
)
from lanebev.report.figures import bokeh_script
from lanebev.report.lens_table import lens_table
from lanebev.report.pictures import Jpegs
from lanebev.report.plots import plot_estimates, plot_widths, width_deviation, width_limits
from lanebev.report.templates import template
from lanebev.report.timeline import STATE_WORDS, places_on_axis, shown_frames, strips, ticks
from lanebev.report.verdict import describe, reason_words, verdict
from lanebev.report.worst import worst_moments
from lanebev.types import AXES


@dataclass
class Report:
    """Contents of the page.

    Attributes:
        title: the source's name.
        rows: rows of ``extrinsics.csv``.
        before: (F, L-1) m, lane widths in the view with the fixed pose.
        after: (F, L-1) m, with the estimated pose.
        lane_width: m, assumed.
        facts: what ran, label to value.
        pictures: pictures of some frames by place of their row: "image", "before" and "after" as JPEG.
        problems: frames that did not decode and the like, one line each.
        is_stills: each image on its own.
        is_smoothed: each pose from the whole drive.
        before_title: which pose the fixed one is.
        truth: a row per frame, of a rendered drive.
        camera: the lens.
        mount: mount estimate at the end, of batch size 1.
    """

    title: str
    rows: Sequence[ExtrinsicsRow]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    lane_width: float
    facts: Mapping[str, str]
    pictures: Mapping[int, Jpegs] = field(default_factory=dict)
    problems: Sequence[str] = field(default_factory=list)
    is_stills: bool = False
    is_smoothed: bool = False
    before_title: str = "first frame's"
    truth: Sequence[ExtrinsicsRow] | None = None
    camera: Camera | None = None
    mount: MountCalibration | None = None

    @property
    def after_title(self) -> str:
        """From which images each pose was estimated."""
        if self.is_stills:
            return "from each image alone"
        return "from all frames (smoothed)" if self.is_smoothed else "from the frames up to each"


def write_report(path: str | Path, report: Report) -> None:
    """Write the page; nothing in it is loaded from elsewhere, and every name in it is escaped."""
    page = template("report.html.j2").render(page_context(report))
    Path(path).write_text(page, encoding="utf-8", errors="replace")


def page_context(report: Report) -> dict[str, Any]:
    """Return the values that the template shows."""
    rows, stills = report.rows, report.is_stills
    found = verdict(rows, stills)
    worst = [] if stills else worst_moments(rows)
    edges = places_on_axis(rows, stills)
    places = shown_frames(rows, [*report.pictures, *(moment.place for moment in worst)])
    several = len(rows) > 1
    return {
        "title": report.title,
        "stills": stills,
        "verdict": found,
        "tracking": sum(row.status == "TRACKING" for row in rows),
        "findings": [(finding.first, describe(finding)) for finding in found.findings],
        "width_sentence": _width_sentence(report),
        "table": pose_table(rows),
        "strips": strips(rows, stills) if several else [],
        "ticks": ticks(edges) if several else [],
        "worst": worst,
        "rows": rows,
        "mount": mount_table(report.mount) if several else [],
        "facts": {name: text for name, text in report.facts.items() if not name.startswith("mount")},
        "problems": report.problems,
        "lens": lens_table(report.camera) if report.camera else {},
        "before_title": report.before_title,
        "after_title": report.after_title,
        "plots": _plots(report, edges[:-1]) if several else {},
        "bokeh": Markup(bokeh_script()) if several else "",
        "data": page_data(report, places, edges),
        "axes": AXES,
    }


def page_data(report: Report, places: Sequence[int], edges: NDArray[np.float64]) -> dict[str, Any]:
    """Return the values of each frame that the page's script shows, as plain values."""
    rows = [report.rows[place] for place in places]
    reasons = list(dict.fromkeys(row.reasons for row in rows))
    return {
        "place": list(places),
        "x": _plain(edges[places], 3),
        "range": _plain(edges[[0, -1]], 3),
        "frame": [row.frame for row in rows],
        "status": [row.status for row in rows],
        "reason": [reasons.index(row.reasons) for row in rows],
        "reasons": [", ".join(reason_words([name for name in each.split("|") if name])) for each in reasons],
        "value": _plain(estimates(rows), 4),
        "std": _plain(estimate_stds(rows), 4),
        "state": [[int(state) for state in axis_states(row)] for row in rows],
        "states": [STATE_WORDS[state] for state in AxisState],
        "kinds": [state.name.lower() for state in AxisState],
        "segments": [row.segments for row in rows],
        "image": [row.image for row in rows] if any(row.image for row in rows) else None,
        "before": _plain(report.before[places], 3),
        "after": _plain(report.after[places], 3),
        "stills": report.is_stills,
        "pictures": {
            str(place): {
                name: f"data:image/jpeg;base64,{base64.b64encode(data).decode('ascii')}"
                for name, data in pictures.items()
            }
            for place, pictures in report.pictures.items()
        },
    }


def pose_table(rows: Sequence[ExtrinsicsRow]) -> list[tuple[str, list[str]]]:
    """Return median, minimum, maximum and median sigma of each axis over the frames that measure it."""
    states = all_axis_states(rows)
    value, std = estimates(rows), estimate_stds(rows)
    table = []
    for axis, name in enumerate(AXES):
        seen = (states[:, axis] <= AxisState.UNCERTAIN) & np.isfinite(value[:, axis])
        if seen.any():
            at = value[seen, axis]
            numbers = [np.median(at), at.min(), at.max(), np.median(std[seen, axis])]
            table.append((name, [f"{float(each):.{DIGITS[axis]}f}{UNITS[axis]}" for each in numbers]))
    return table


def mount_table(mount: MountCalibration | None) -> list[dict[str, Any]]:
    """Return name, status, progress, value and needs of each axis of the mount."""
    if mount is None:
        return []
    values = mount.extrinsics.stack()[0].tolist()
    stds = mount.covariance[0].diagonal().clamp_min(0).sqrt().tolist()
    table = []
    for axis, sentence in enumerate(describe_mount(mount)):
        value, std = values[axis], stds[axis]
        if axis < 3:
            value, std = math.degrees(value), math.degrees(std)
        name, _, words = sentence.partition(": ")
        table.append(
            {
                "name": name,
                "status": MountStatus(int(mount.axis_status[0, axis])).name.lower(),
                "progress": round(float(mount.axis_progress[0, axis])),
                "value": plus_minus(axis, value, std),
                "words": words,
            }
        )
    return table


def summary_facts(report: Report) -> dict[str, str]:
    """Return the standard deviations of lane widths with the fixed and the estimated pose."""
    names = {f"fixed pose ({report.before_title})": report.before, "estimated poses": report.after}
    return {
        f"standard deviation of lane widths, {name}": f"{100 * width_deviation(widths):.1f} cm"
        for name, widths in names.items()
        if np.isfinite(widths).sum() > 1
    }


def _plots(report: Report, x: NDArray[np.float64]) -> dict[str, Any]:
    label = "image" if report.is_stills else "time (s)"
    rows, places = report.rows, shown_frames(report.rows, [])
    truth = None if report.truth is None else [report.truth[place] for place in places]
    plots = {"estimates": plot_estimates(x[places], [rows[i] for i in places], report.is_stills, truth)}
    if np.isfinite(report.before).any() or np.isfinite(report.after).any():
        limits = width_limits(report.before, report.after, report.lane_width)
        for name, widths in (("before", report.before), ("after", report.after)):
            plots[name] = plot_widths(x[places], widths[places], report.lane_width, limits, label)
    return plots


def _width_sentence(report: Report) -> str:
    before, after = width_deviation(report.before), width_deviation(report.after)
    if not math.isfinite(after):
        return ""
    fixed = f"; with the fixed pose ({report.before_title}): {100 * before:.1f} cm"
    compared = fixed if math.isfinite(before) else ""
    return f"Standard deviation of lane widths in the bird's-eye view: {100 * after:.1f} cm{compared}."


def _plain(values: NDArray[np.float64], digits: int) -> Any:
    """Return nested lists of rounded numbers, None where one is not finite: JSON has no NaN."""
    rounded = np.round(values, digits).astype(object)
    rounded[~np.isfinite(values)] = None
    return rounded.tolist()
