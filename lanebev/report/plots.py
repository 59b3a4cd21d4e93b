"""Interactive plots of a run: the four estimates with ±2 sigma, and lane widths with both poses."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.embed import json_item
from bokeh.models import ColumnDataSource, HoverTool, Span
from numpy.typing import NDArray

from lanebev.io.results import ExtrinsicsRow
from lanebev.report.axis_states import AxisState, all_axis_states, estimate_stds, estimates
from lanebev.report.figures import (
    INK,
    LEAST_RANGE,
    finish,
    new_figure,
    separated,
    single,
    stacked,
    value_limits,
    x_range,
)
from lanebev.report.overlay import BOUNDARY_COLOURS

_LABELS = ("pitch (°)", "yaw (°)", "roll (°)", "height (m)")
Style = tuple[str, str]
"""Colour of a line, and its name in the legend or nothing."""

_LINE, _UNDETERMINED, _TRUTH, _SECOND = "#1f6feb", "#7d8794", "#24292f", "#c2410c"


def plot_estimates(
    x: NDArray[np.float64],
    rows: Sequence[ExtrinsicsRow],
    stills: bool,
    truth: Sequence[ExtrinsicsRow] | None = None,
) -> dict[str, Any]:
    """Return a plot of pitch, yaw, roll and height with ±2 sigma, grey where they are not determined.

    Args:
        x: (F,) time in s, or the image's number.
        rows: what was found.
        stills: each image is on its own.
        truth: a row per frame where it is known.
    """
    styles = ((_LINE, "estimate ±2σ"), (_UNDETERMINED, "not determined"))
    return _plot_runs(x, [rows], [styles], stills, truth)


def plot_two(
    x: NDArray[np.float64], first: Sequence[ExtrinsicsRow], second: Sequence[ExtrinsicsRow], stills: bool
) -> dict[str, Any]:
    """Return a plot of the estimates of two runs with ±2 sigma, fainter where they are not determined.

    Args:
        x: (F,) time in s, or the image's number.
        first: rows of the frames.
        second: rows of the same frames.
        stills: each image is on its own.
    """
    styles = [((colour, name), (f"{colour}80", "")) for colour, name in ((_LINE, "A"), (_SECOND, "B"))]
    return _plot_runs(x, [first, second], styles, stills)


def _plot_runs(
    x: NDArray[np.float64],
    runs: Sequence[Sequence[ExtrinsicsRow]],
    styles: Sequence[tuple[Style, Style]],
    stills: bool,
    truth: Sequence[ExtrinsicsRow] | None = None,
) -> dict[str, Any]:
    """Return a plot of the estimates of runs; styles: of each where it is measured, and undetermined."""
    values, stds = (np.stack([of(rows) for rows in runs]) for of in (estimates, estimate_stds))
    states = np.stack([all_axis_states(rows) for rows in runs])
    figures: list[Any] = []
    shown = x_range(x)
    for axis, label in enumerate(_LABELS):
        value, std, state = values[..., axis], stds[..., axis], states[..., axis]
        known, measured = state != AxisState.UNKNOWN, state <= AxisState.UNCERTAIN
        plot = new_figure(label, shown, value_limits(value, std, known, axis))
        for i, (style, faint) in enumerate(styles):
            kinds = {style: measured[i], faint: known[i] & ~measured[i]}
            _draw_estimate(plot, x, value[i], std[i], kinds, stills)
        if truth is not None:
            true = estimates(truth)[:, axis]
            plot.line(x, true, color=_TRUTH, line_dash=[5, 3], line_width=1.2, legend_label="truth")
        finish(plot, axis == len(_LABELS) - 1, "image" if stills else "time (s)", legend=axis == 0)
        figures.append(plot)
    return stacked(figures)


def plot_differences(
    x: NDArray[np.float64], change: NDArray[np.float64], sigma: NDArray[np.float64], stills: bool
) -> dict[str, Any]:
    """Return a plot of the change from one run to another with ±2 sigma about zero.

    Args:
        x: (F,) time in s, or the image's number.
        change: (F, 4) deg and m.
        sigma: (F, 4) of the change.
        stills: each image is on its own.
    """
    figures: list[Any] = []
    shown = x_range(x)
    for axis, label in enumerate(_LABELS):
        finite = np.isfinite(change[:, axis]) & np.isfinite(sigma[:, axis])
        most = float(np.abs(change[finite, axis]).max(initial=0.1 * LEAST_RANGE[axis]))
        plot = new_figure(f"Δ {label}", shown, (-1.2 * most, 1.2 * most), height=120)
        where = {"x": x[finite], "change": change[finite, axis], "two_sigma": 2 * sigma[finite, axis]}
        source = ColumnDataSource({key: single(column) for key, column in where.items()})
        plot.varea(
            x[finite], -2 * sigma[finite, axis], 2 * sigma[finite, axis], color=_UNDETERMINED, fill_alpha=0.2
        )
        if not stills:
            plot.line("x", "change", source=source, color=INK, line_width=1.5)
        dots = plot.scatter("x", "change", source=source, color=INK, size=4, alpha=1.0 if stills else 0.0)
        tooltips = [("at", "@x{0.00}"), ("B − A", "@change{0.000} (2σ @two_sigma{0.000})")]
        plot.add_tools(HoverTool(renderers=[dots], tooltips=tooltips, mode="vline"))
        finish(plot, axis == len(_LABELS) - 1, "image" if stills else "time (s)", legend=False)
        figures.append(plot)
    return stacked(figures)


def plot_widths(
    x: NDArray[np.float64],
    widths: NDArray[np.float64],
    lane_width: float,
    limits: tuple[float, float],
    xlabel: str,
) -> dict[str, Any]:
    """Return a plot of the lanes' widths in the bird's-eye view.

    Args:
        x: (F,) times or numbers of the frames.
        widths: (F, L-1) m, NaN where a lane was not seen.
        lane_width: m, what was assumed.
        limits: m, of the axis, see :func:`width_limits`.
        xlabel: label of the axis.
    """
    plot = new_figure("lane width (m)", x_range(x), limits, height=240)
    for lane in np.flatnonzero(np.isfinite(widths).any(0)).tolist():
        seen = np.isfinite(widths[:, lane])
        source = ColumnDataSource({"x": x[seen], "width": widths[seen, lane]})
        on_dark = BOUNDARY_COLOURS[lane % len(BOUNDARY_COLOURS)]
        colour = "#{:02x}{:02x}{:02x}".format(*(round(0.72 * part) for part in on_dark))  # for white paper
        name = f"lane {lane}–{lane + 1}"
        plot.scatter("x", "width", source=source, size=4, color=colour, alpha=0.8, legend_label=name)
    plot.add_layout(Span(location=lane_width, dimension="width", line_color=INK, line_dash=[6, 4]))
    plot.add_tools(HoverTool(tooltips=[(xlabel, "@x{0.00}"), ("width", "@width{0.000} m")]))
    finish(plot, True, xlabel, legend=True)
    item: dict[str, Any] = json_item(plot)
    return item


def width_limits(
    before: NDArray[np.float64], after: NDArray[np.float64], lane_width: float
) -> tuple[float, float]:
    """Return limits in m that show both, outliers left out."""
    both = np.concatenate([before.ravel(), after.ravel(), [lane_width]])
    low, high = np.percentile(both[np.isfinite(both)], [1, 99]).tolist()
    margin = max(0.15 * (high - low), 0.2)
    return min(low, lane_width) - margin, max(high, lane_width) + margin


def width_deviation(widths: NDArray[np.float64]) -> float:
    """Return the standard deviation of all observed lane widths, m; NaN with fewer than two."""
    seen = widths[np.isfinite(widths)]
    return float(seen.std()) if len(seen) > 1 else float("nan")


def _stretches(at: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Return the places of each stretch of neighbours in which ``at`` holds."""
    places = np.flatnonzero(at)
    return [part for part in np.split(places, np.flatnonzero(np.diff(places) > 1) + 1) if len(part)]


def _extended(at: NDArray[np.bool_], other: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return ``at`` with the first frame of the other kind after each stretch, so that lines meet."""
    after = np.zeros_like(at)
    after[1:] = at[:-1] & other[1:]
    return at | after


def _draw_estimate(
    plot: Any,
    x: NDArray[np.float64],
    value: NDArray[np.float64],
    std: NDArray[np.float64],
    kinds: dict[Style, NDArray[np.bool_]],
    stills: bool,
) -> None:
    """Draw an axis with ±2 sigma, in two styles; kinds: style to where it holds."""
    low, high = value - 2 * std, value + 2 * std
    finite = np.isfinite(low) & np.isfinite(high)
    for ((colour, name), own), other in zip(kinds.items(), reversed(kinds.values()), strict=True):
        mask = finite & (own if stills else _extended(own, other))
        if not mask.any():
            continue
        label = {"legend_label": name} if name else {}
        columns = {"x": x, "value": value, "two_sigma": 2 * std}
        columns |= {"low": low, "high": high} if stills else {}
        source = ColumnDataSource({key: single(column[mask]) for key, column in columns.items()})
        if stills:
            plot.segment("x", "low", "x", "high", source=source, color=colour, alpha=0.5)
        else:
            stretches = _stretches(mask)
            sides = separated([np.concatenate([x[at], x[at][::-1]]) for at in stretches])
            band = separated([np.concatenate([low[at], high[at][::-1]]) for at in stretches])
            plot.patch(sides, band, fill_color=colour, fill_alpha=0.22, line_color=None)
            lines = (separated([column[at] for at in stretches]) for column in (x, value))
            plot.line(*lines, color=colour, line_width=1.8, **label)
        dots = plot.scatter("x", "value", source=source, size=5, color=colour, alpha=1.0 if stills else 0.0,
                            **label)  # fmt: skip
        tooltips = [("at", "@x{0.00}"), ("value", "@value{0.000} ± @two_sigma{0.000}")]
        plot.add_tools(HoverTool(renderers=[dots], tooltips=tooltips, mode="vline"))
