"""Common style of all plots, and Bokeh for the page."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.embed import json_item
from bokeh.layouts import gridplot
from bokeh.models import Range1d, Span
from bokeh.plotting import figure
from bokeh.resources import Resources
from numpy.typing import NDArray

GRID, INK = "#e5e9ef", "#57606a"
LEAST_RANGE = (0.5, 0.5, 0.5, 0.1)  # deg, deg, deg, m: smallest range of an axis in a plot
_NOW = "now"  # name of the lines that mark the frame shown
_TOOLS = "xpan,xbox_zoom,xwheel_zoom,reset,save"
_FONT = "system-ui, sans-serif"


def bokeh_script() -> str:
    """Return BokehJS to embed, with all addresses in it cut, so that it can load nothing."""
    script = "\n".join(Resources(mode="inline", components=["bokeh"], log_level="error").js_raw)
    return re.sub(r"([\"'`])https?://(?!www\.w3\.org/)", r"\1#", script)


def stacked(figures: Sequence[Any]) -> dict[str, Any]:
    """Return plots one below the other, to be embedded."""
    grid = gridplot([[plot] for plot in figures], sizing_mode="stretch_width", toolbar_location="right")
    item: dict[str, Any] = json_item(grid)
    return item


def separated(parts: Sequence[NDArray[np.float64]]) -> NDArray[np.floating[Any]]:
    """Return all parts in one, with a NaN after each: Bokeh draws them apart."""
    return single(np.concatenate([np.append(part, np.nan) for part in parts]))


def single(column: NDArray[np.float64]) -> NDArray[np.floating[Any]]:
    """Return a column in single precision where that is exact to a thousandth."""
    return column.astype(np.float32) if np.nanmax(np.abs(column), initial=0) < 1e4 else column


def new_figure(label: str, x_range: Any, limits: tuple[float, float], height: int = 150) -> Any:
    """Return an empty figure as wide as its place, that zooms along x."""
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


def finish(plot: Any, is_last: bool, xlabel: str, legend: bool) -> None:
    """Style a drawn figure, and add the line that marks the frame shown."""
    plot.add_layout(Span(location=0, dimension="height", line_color="#d1242f", name=_NOW, visible=False))
    plot.toolbar.logo = None
    plot.outline_line_color = None
    plot.grid.grid_line_color = GRID
    plot.axis.axis_line_color = plot.axis.major_tick_line_color = GRID
    plot.axis.minor_tick_line_color = None
    plot.axis.major_label_text_font = plot.axis.axis_label_text_font = _FONT
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_color = plot.axis.major_label_text_color = INK
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


def x_range(x: NDArray[np.float64]) -> Range1d:
    """Return the range of x that shows all, with a small margin."""
    low, high = (float(x.min()), float(x.max())) if len(x) else (0.0, 1.0)
    margin = 0.01 * max(high - low, 1e-3)
    return Range1d(low - margin, high + margin, bounds=(low - margin, high + margin))


def value_limits(
    value: NDArray[np.float64], std: NDArray[np.float64], known: NDArray[np.bool_], axis: int
) -> tuple[float, float]:
    """Return limits that show the estimate; a wide start must not flatten the rest."""
    shown = known & np.isfinite(value) & np.isfinite(std)
    if not shown.any():
        return -1.0, 1.0
    value, std, least = value[shown], std[shown], LEAST_RANGE[axis]
    band = np.minimum(2 * std, 1.5 * max(float(np.ptp(value)), least))
    low, high = float((value - band).min()), float((value + band).max())
    margin = 0.05 * (high - low) + max(0.0, 0.5 * (least - (high - low)))
    return low - margin, high + margin
