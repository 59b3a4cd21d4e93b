"""``index.html`` of a fleet: verdicts, failures, mounts over time, a link to each drive's report."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict
from urllib.parse import quote

import numpy as np
from bokeh.models import ColumnDataSource, HoverTool, Whisker
from bokeh.plotting import figure
from markupsafe import Markup

from lanebev.app.fleet.manifest import Drive
from lanebev.app.fleet.mounts import DriveMount, Stretch, days
from lanebev.app.fleet.plan import DRIVES, Outcome
from lanebev.report.axis_states import UNITS, plus_minus
from lanebev.report.figures import bokeh_script, finish, new_figure, stacked, value_limits, x_range
from lanebev.report.templates import template
from lanebev.report.verdict import Verdict
from lanebev.types import AXES

_SCALE = np.array([180 / math.pi] * 3 + [1.0])
_COLOUR, _MOVED = "#1f6feb", "#e5484d"
_MOST_DRIVES = 2000  # drives that are listed one by one, at most; failed ones come first


@dataclass(frozen=True)
class CameraMounts:
    """The mount of one camera over its drives.

    Attributes:
        camera_id: its name.
        mounts: mounts of each drive, in order of time.
        stretches: between the camera's moves.
    """

    camera_id: str
    mounts: Sequence[DriveMount]
    stretches: Sequence[Stretch]


class StretchWords(TypedDict):
    """A stretch as the page shows it: number and names of its drives, values and drifts by axis."""

    drives: int
    names: str
    values: list[str]
    drifts: list[str]


def fleet_page(
    title: str,
    drives: Sequence[Drive],
    outcomes: Mapping[str, Outcome],
    verdicts: Mapping[str, Verdict],
    cameras: Sequence[CameraMounts],
) -> str:
    """Return the page; nothing in it is loaded from elsewhere, and every name in it is escaped.

    Args:
        title: name of the fleet's folder.
        drives: all of the manifest.
        outcomes: by name of the drive.
        verdicts: verdicts of finished drives.
        cameras: the mounts.
    """
    failed = [drive for drive in drives if outcomes[drive.name].failure]
    done = [drive for drive in drives if not outcomes[drive.name].failure]
    poor = sorted(done, key=lambda drive: ("poor", "fair", "good").index(verdicts[drive.name].grade))
    plots = {str(number): plot_mounts(camera) for number, camera in enumerate(cameras) if camera.mounts}
    return template("fleet.html.j2").render(
        title=title,
        failed=[(drive, outcomes[drive.name].failure) for drive in failed],
        drives=[
            (drive, quote(f"{DRIVES}/{drive.name}/report.html"), verdicts[drive.name], outcomes[drive.name])
            for drive in poor[:_MOST_DRIVES]
        ],
        omitted=max(0, len(poor) - _MOST_DRIVES),
        counts={
            grade: sum(each.grade == grade for each in verdicts.values())
            for grade in ("good", "fair", "poor")
        },
        frames=sum(outcome.frames for outcome in outcomes.values()),
        cameras=[(camera, [stretch_words(each) for each in camera.stretches]) for camera in cameras],
        axes=AXES,
        plots=plots,
        bokeh=Markup(bokeh_script()) if plots else "",
    )


def stretch_words(stretch: Stretch) -> StretchWords:
    """Return the drives of a stretch, and value and drift of each axis, in words."""
    value, std, drift, drift_std = (
        part * _SCALE for part in (stretch.pose, stretch.std, stretch.drift, stretch.drift_std)
    )
    values = [
        plus_minus(axis, at, sigma) if math.isfinite(at) else "not known"
        for axis, (at, sigma) in enumerate(zip(value, std, strict=True))
    ]
    drifts = [
        f"{plus_minus(axis, by, sigma, '+', 1)} a day" if math.isfinite(by) else ""
        for axis, (by, sigma) in enumerate(zip(drift, drift_std, strict=True))
    ]
    names = stretch.first if stretch.drives == 1 else f"{stretch.first} to {stretch.last}"
    return {"drives": stretch.drives, "names": names, "values": values, "drifts": drifts}


def plot_mounts(camera: CameraMounts) -> dict[str, object]:
    """Return a plot of the mount of each drive with ±2 sigma, red where the camera was moved."""
    times = np.array([days(mount.time) for mount in camera.mounts])
    known = bool(np.isfinite(times).all()) and len(set(times.tolist())) > 1
    x = times - times[0] if known else np.arange(len(times), dtype=np.float64)
    pose = np.stack([mount.pose for mount in camera.mounts]) * _SCALE
    std = np.stack([mount.std for mount in camera.mounts]) * _SCALE
    moved = np.stack([mount.moved for mount in camera.mounts])
    figures: list[figure] = []
    for axis, name in enumerate(AXES):
        seen = np.isfinite(pose[:, axis])
        shown = figures[0].x_range if figures else x_range(x)
        label = f"{name} ({UNITS[axis].strip()})"
        plot = new_figure(label, shown, value_limits(pose[:, axis], std[:, axis], seen, axis))
        source = ColumnDataSource(
            {
                "x": x[seen],
                "value": pose[seen, axis],
                "two_sigma": 2 * std[seen, axis],
                "low": (pose - 2 * std)[seen, axis],
                "high": (pose + 2 * std)[seen, axis],
                "name": [mount.name for mount, there in zip(camera.mounts, seen, strict=True) if there],
                "colour": [_MOVED if each else _COLOUR for each in moved[seen, axis]],
            }
        )
        plot.add_layout(Whisker(base="x", lower="low", upper="high", source=source, line_color=_COLOUR))
        dots = plot.scatter("x", "value", source=source, size=7, color="colour")
        tooltips = [("drive", "@name"), ("value", "@value{0.000} ± @two_sigma{0.000}")]
        plot.add_tools(HoverTool(renderers=[dots], tooltips=tooltips))
        finish(plot, axis == len(AXES) - 1, "days since the first drive" if known else "drive", legend=False)
        figures.append(plot)
    return stacked(figures)
