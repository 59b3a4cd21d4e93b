"""Interactive plots of a run: the four estimates with ±2 sigma, and lane widths before and after."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.embed import json_item
from bokeh.layouts import gridplot
from bokeh.models import ColumnDataSource, HoverTool, Range1d, Span
from bokeh.plotting import figure
from bokeh.resources import Resources
from numpy.typing import NDArray

from lanebev.io.results import ExtrinsicsRow
from lanebev.report.axis_states import AxisState, axis_states, deviations, estimates
from lanebev.report.overlay import BOUNDARY_COLOURS

_LABELS = ("pitch (°)", "yaw (°)", "roll (°)", "height (m)")
_LEAST_RANGE = (0.5, 0.5, 0.5, 0.1)  # deg, deg, deg, m: no zoom into nothing
_LINE, _HELD, _TRUTH, _GRID, _INK = "#1f6feb", "#7d8794", "#24292f", "#e5e9ef", "#57606a"
_NOW = "now"  # name of the lines that mark the frame shown
_TOOLS = "xpan,xbox_zoom,xwheel_zoom,reset,save"
_FONT = "system-ui, sans-serif"


def bokeh_script() -> str:
    """Return BokehJS to embed, with all addresses in it cut, so that it can load nothing."""
    script = "\n".join(Resources(mode="inline", components=["bokeh"], log_level="error").js_raw)
    return re.sub(r"([\"'`])https?://(?!www\.w3\.org/)", r"\1#", script)


def plot_estimates(
    x: NDArray[np.float64],
    rows: Sequence[ExtrinsicsRow],
    stills: bool = False,
    truth: Sequence[ExtrinsicsRow] | None = None,
) -> dict[str, Any]:
    """Return a plot of pitch, yaw, roll and height with ±2 sigma, grey where they are not determined.

    Args:
        x: (F,) time in s, or the image's number.
        rows: what was found.
        stills: each image is on its own.
        truth: a row per frame where it is known.
    """
    value, std = estimates(rows), deviations(rows)
    states = np.array([axis_states(row) for row in rows]).reshape(-1, 4)
    known = states != AxisState.UNKNOWN
    measured = states <= AxisState.UNCERTAIN
    true = None if truth is None else estimates(truth)
    figures: list[Any] = []
    for axis, label in enumerate(_LABELS):
        shown = figures[0].x_range if figures else _x_range(x)
        plot = _figure(label, shown, _limits(value[:, axis], std[:, axis], known[:, axis], axis))
        held = known[:, axis] & ~measured[:, axis]
        _draw_estimate(plot, x, value[:, axis], std[:, axis], measured[:, axis], held, stills)
        if true is not None:
            plot.line(x, true[:, axis], color=_TRUTH, line_dash=[5, 3], line_width=1.2, legend_label="truth")
        _finish(plot, axis == len(_LABELS) - 1, "image" if stills else "time (s)", legend=axis == 0)
        figures.append(plot)
    grid = gridplot([[plot] for plot in figures], sizing_mode="stretch_width", toolbar_location="right")
    item: dict[str, Any] = json_item(grid)
    return item


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
        xlabel: of the axis.
    """
    plot = _figure("lane width (m)", _x_range(x), limits, height=240)
    for lane in np.flatnonzero(np.isfinite(widths).any(0)).tolist():
        seen = np.isfinite(widths[:, lane])
        source = ColumnDataSource({"x": x[seen], "width": widths[seen, lane]})
        colour = "#{:02x}{:02x}{:02x}".format(*_dark(BOUNDARY_COLOURS[lane % len(BOUNDARY_COLOURS)]))
        plot.scatter(
            "x",
            "width",
            source=source,
            size=4,
            color=colour,
            alpha=0.8,
            legend_label=f"lane {lane}–{lane + 1}",
        )
    plot.add_layout(Span(location=lane_width, dimension="width", line_color=_INK, line_dash=[6, 4]))
    plot.add_tools(HoverTool(tooltips=[(xlabel, "@x{0.00}"), ("width", "@width{0.000} m")]))
    _finish(plot, True, xlabel, legend=True)
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
    extended: NDArray[np.bool_] = at | after
    return extended


def _draw_estimate(
    plot: Any,
    x: NDArray[np.float64],
    value: NDArray[np.float64],
    std: NDArray[np.float64],
    measured: NDArray[np.bool_],
    held: NDArray[np.bool_],
    stills: bool,
) -> None:
    """Draw an axis with ±2 sigma: blue where it was measured, grey where it was held."""
    low, high = value - 2 * std, value + 2 * std
    finite = np.isfinite(low) & np.isfinite(high)
    kinds = (
        (_HELD, finite & (held if stills else _extended(held, measured)), "not determined"),
        (_LINE, finite & (measured if stills else _extended(measured, held)), "estimate ±2σ"),
    )
    for colour, mask, name in kinds:
        if not mask.any():
            continue
        columns = {"x": x, "value": value, "two_sigma": 2 * std}
        columns |= {"low": low, "high": high} if stills else {}
        source = ColumnDataSource({key: _single(column[mask]) for key, column in columns.items()})
        if stills:
            plot.segment("x", "low", "x", "high", source=source, color=colour, alpha=0.5)
        else:
            stretches = _stretches(mask)
            sides = _separated([np.concatenate([x[at], x[at][::-1]]) for at in stretches])
            band = _separated([np.concatenate([low[at], high[at][::-1]]) for at in stretches])
            plot.patch(sides, band, fill_color=colour, fill_alpha=0.22, line_color=None)
            lines = (_separated([column[at] for at in stretches]) for column in (x, value))
            plot.line(*lines, color=colour, line_width=1.8, legend_label=name)
        dots = plot.scatter("x", "value", source=source, size=5, color=colour, alpha=1.0 if stills else 0.0,
                            legend_label=name)  # fmt: skip
        tooltips = [("at", "@x{0.00}"), ("value", "@value{0.000} ± @two_sigma{0.000}")]
        plot.add_tools(HoverTool(renderers=[dots], tooltips=tooltips, mode="vline"))


def _separated(parts: Sequence[NDArray[np.float64]]) -> NDArray[np.floating[Any]]:
    """Return all parts in one, with a NaN after each: Bokeh draws them apart."""
    return _single(np.concatenate([np.append(part, np.nan) for part in parts]))


def _single(column: NDArray[np.float64]) -> NDArray[np.floating[Any]]:
    """Return a column in single precision where that is exact to a thousandth."""
    return column.astype(np.float32) if np.nanmax(np.abs(column), initial=0) < 1e4 else column


def _figure(label: str, x_range: Any, limits: tuple[float, float], height: int = 150) -> Any:
    return figure(
        height=height,
        sizing_mode="stretch_width",
        x_range=x_range,
        y_range=Range1d(*limits),
        y_axis_label=label,
        tools=_TOOLS,
        active_drag="xbox_zoom",
        active_scroll=None,
        output_backend="canvas",
        min_border_left=62,
    )


def _finish(plot: Any, is_last: bool, xlabel: str, legend: bool) -> None:
    plot.add_layout(Span(location=0, dimension="height", line_color="#d1242f", name=_NOW, visible=False))
    plot.toolbar.logo = None
    plot.outline_line_color = None
    plot.grid.grid_line_color = _GRID
    plot.axis.axis_line_color = plot.axis.major_tick_line_color = _GRID
    plot.axis.minor_tick_line_color = None
    plot.axis.major_label_text_font = plot.axis.axis_label_text_font = _FONT
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_color = plot.axis.major_label_text_color = _INK
    plot.xaxis.major_label_text_font_size = "12px" if is_last else "0px"
    if is_last:
        plot.xaxis.axis_label = xlabel
    if plot.legend:
        plot.legend.visible = legend
        plot.legend.orientation = "horizontal"
        plot.legend.location = "top_right"
        plot.legend.border_line_color = None
        plot.legend.background_fill_alpha = 0.7
        plot.legend.label_text_font = _FONT
        plot.legend.label_text_font_size = "12px"
        plot.legend.padding = plot.legend.margin = 2


def _x_range(x: NDArray[np.float64]) -> Range1d:
    low, high = (float(x.min()), float(x.max())) if len(x) else (0.0, 1.0)
    margin = 0.01 * max(high - low, 1e-3)
    return Range1d(low - margin, high + margin, bounds=(low - margin, high + margin))


def _limits(
    value: NDArray[np.float64], std: NDArray[np.float64], known: NDArray[np.bool_], axis: int
) -> tuple[float, float]:
    """Return limits that show the estimate; a wide start must not flatten the rest."""
    shown = known & np.isfinite(value) & np.isfinite(std)
    if not shown.any():
        return -1.0, 1.0
    value, std, least = value[shown], std[shown], _LEAST_RANGE[axis]
    band = np.minimum(2 * std, 1.5 * max(float(np.ptp(value)), least))
    low, high = float((value - band).min()), float((value + band).max())
    margin = 0.05 * (high - low) + max(0.0, 0.5 * (least - (high - low)))
    return low - margin, high + margin


def _dark(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return the colour for white paper."""
    red, green, blue = (round(0.72 * part) for part in colour)
    return red, green, blue
