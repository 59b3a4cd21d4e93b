"""Plots of a run: the four estimates with ±2 sigma, and lane widths before and after."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lanebev.io.results import ExtrinsicsRow
from lanebev.report.overlay import BOUNDARY_COLOURS

_ESTIMATES = (
    ("pitch_deg", "pitch (°)"), ("yaw_deg", "yaw (°)"), ("roll_deg", "roll (°)"), ("height_m", "height (m)"),
)  # fmt: skip
_LINE, _BAND, _GRID = "#1f6feb", "#1f6feb", "#d9dee5"
_STATUS_COLOURS = {
    "TRACKING": "#12a37a",
    "COASTING": "#f0a30a",
    "LOST": "#e5484d",
    "UNINITIALISED": "#9aa4b2",
}
_LEAST_RANGE = {"pitch_deg": 0.5, "yaw_deg": 0.5, "roll_deg": 0.5, "height_m": 0.1}  # no zoom into nothing


def plot_estimates(
    rows: Sequence[ExtrinsicsRow], stills: bool = False, truth: Sequence[ExtrinsicsRow] | None = None
) -> bytes:
    """PNG of pitch, yaw, roll and height over time (or image number) with ±2 sigma, status below.

    Args:
        rows: what was found.
        stills: each image on its own.
        truth: a row per frame where it is known.
    """
    figure = Figure(figsize=(11, 8), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(5, 1, sharex=True, height_ratios=[4, 4, 4, 4, 0.6])
    x = np.array([row.frame if stills else row.time_s for row in rows], dtype=np.float64)
    known = np.array([row.status != "UNINITIALISED" for row in rows])
    for axis, (name, label) in zip(axes[:4], _ESTIMATES, strict=True):
        value = np.array([getattr(row, name) for row in rows])
        base, unit = name.rsplit("_", 1)
        std = np.array([getattr(row, f"{base}_std_{unit}") for row in rows])
        if stills:
            axis.errorbar(x[known], value[known], 2 * std[known], fmt="o", ms=3, lw=1, color=_LINE)
        else:
            shown = np.where(known, value, np.nan)
            axis.fill_between(x, shown - 2 * std, shown + 2 * std, color=_BAND, alpha=0.18, lw=0, label="±2σ")
            if truth is not None:
                true = [getattr(row, name) for row in truth]
                axis.plot(x, true, color="#24292f", lw=1.0, ls=(0, (4, 2)), label="truth")
            axis.plot(x, shown, color=_LINE, lw=1.4, label="estimate")
        _limit(axis, value[known], std[known], _LEAST_RANGE[name])
        axis.set_ylabel(label)
        _tidy(axis)
    if not stills:
        axes[0].legend(loc="upper right", ncols=3, frameon=False, fontsize=9)
    _status_strip(axes[4], x, [row.status for row in rows])
    axes[4].set_xlabel("image" if stills else "time (s)")
    figure.align_ylabels(axes)
    return _png(figure)


def plot_widths(
    x: NDArray[np.float64],
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    lane_width: float,
    titles: tuple[str, str] = ("first frame's pose held", "online"),
    xlabel: str = "time (s)",
) -> bytes:
    """PNG of the lanes' widths in the bird's-eye view, before beside after.

    Args:
        x: (F,) times or numbers of the frames.
        before: (F, L-1) m, NaN where a lane was not seen.
        after: (F, L-1) m.
        lane_width: m, what was assumed.
        titles: of the two halves.
        xlabel: of both.
    """
    figure = Figure(figsize=(11, 3.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    both = np.concatenate([before.ravel(), after.ravel()])
    both = both[np.isfinite(both)]
    for axis, widths, title in zip(axes, (before, after), titles, strict=True):
        for lane in range(widths.shape[1]):
            if np.isfinite(widths[:, lane]).any():
                colour = tuple(c / 255 for c in BOUNDARY_COLOURS[lane % len(BOUNDARY_COLOURS)])
                axis.plot(
                    x, widths[:, lane], "o", ms=2.6, color=colour, alpha=0.8, label=f"{lane}-{lane + 1}"
                )
        axis.axhline(lane_width, color="#57606a", lw=1, ls=(0, (5, 4)))
        axis.set_title(f"{title}: σ = {_centimetres(widths)}", fontsize=11, loc="left")
        axis.set_xlabel(xlabel)
        _tidy(axis)
    if len(both):
        low, high = np.percentile(both, [1, 99])
        margin = max(0.15 * (high - low), 0.2)
        axes[0].set_ylim(min(low, lane_width) - margin, max(high, lane_width) + margin)
        seen = axes[1] if np.isfinite(after).any() else axes[0]
        seen.legend(title="lane", loc="upper right", ncols=3, fontsize=8, title_fontsize=8, frameon=False)
    axes[0].set_ylabel("lane width (m)")
    return _png(figure)


def width_deviation(widths: NDArray[np.float64]) -> float:
    """Standard deviation of all observed lane widths, m; NaN with fewer than two."""
    seen = widths[np.isfinite(widths)]
    return float(seen.std()) if len(seen) > 1 else float("nan")


def _centimetres(widths: NDArray[np.float64]) -> str:
    deviation = width_deviation(widths)
    return "not seen" if np.isnan(deviation) else f"{100 * deviation:.1f} cm"


def _limit(axis: Axes, value: NDArray[np.float64], std: NDArray[np.float64], least: float) -> None:
    if len(value):
        band = np.minimum(2 * std, 1.5 * max(np.ptp(value), least))  # a wide start must not flatten the rest
        low, high = float((value - band).min()), float((value + band).max())
        margin = 0.05 * (high - low) + max(0.0, 0.5 * (least - (high - low)))
        axis.set_ylim(low - margin, high + margin)


def _status_strip(axis: Axes, x: NDArray[np.float64], statuses: Sequence[str]) -> None:
    step = float(np.median(np.diff(x))) if len(x) > 1 else 1.0
    colours = [_STATUS_COLOURS.get(status, "#000000") for status in statuses]
    axis.bar(x, np.ones(len(x)), width=step * 1.05, color=colours, align="center", linewidth=0)
    axis.set_ylim(0, 1)
    axis.set_yticks([])
    axis.set_ylabel("status", rotation=0, ha="right", va="center")
    present = [status for status in _STATUS_COLOURS if status in set(statuses)]
    for i, status in enumerate(present):
        place = (1.0 - 0.13 * (len(present) - 1 - i), 1.1)
        axis.annotate(status, place, xycoords="axes fraction", ha="right", va="bottom", fontsize=8,
                      color=_STATUS_COLOURS[status], weight="bold")  # fmt: skip
    for side in axis.spines.values():
        side.set_visible(False)


def _tidy(axis: Axes) -> None:
    axis.grid(color=_GRID, lw=0.7)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.margins(x=0.01)


def _png(figure: Figure) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png")
    return data.getvalue()
