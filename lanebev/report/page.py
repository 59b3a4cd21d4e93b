"""``report.html``: one page that holds everything it shows."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lanebev.io.results import ExtrinsicsRow
from lanebev.report.overlay import Picture
from lanebev.report.plots import plot_estimates, plot_widths, width_deviation

_STYLE = """
:root { color-scheme: light; --ink: #1c2128; --quiet: #57606a; --line: #d9dee5; }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: #fff;
       max-width: 1180px; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.5rem; margin: 0; } h2 { font-size: 1.1rem; margin: 2.2rem 0 .6rem; }
p.sub { color: var(--quiet); margin: .2rem 0 1.4rem; }
table { border-collapse: collapse; } th, td { text-align: left; padding: .25rem 1.4rem .25rem 0;
       border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; color: var(--quiet); }
td.n { text-align: right; font-variant-numeric: tabular-nums; }
img { max-width: 100%; height: auto; display: block; } figure { margin: 0 0 1.2rem; }
figcaption { color: var(--quiet); font-size: .85rem; margin-top: .25rem; }
ul.problems { color: #b42318; }
"""


@dataclass
class Report:
    """What goes on the page.

    Attributes:
        title: the source's name.
        rows: of ``extrinsics.csv``.
        before: (F, L-1) m, lane widths in the view with the pose before.
        after: (F, L-1) m, with the online pose.
        lane_width: m, assumed.
        facts: what ran, label to value.
        stills: caption and picture.
        problems: frames that did not decode and the like, one line each.
        is_stills: each image on its own.
        before_title: what "before" is.
        truth: a row per frame, of a rendered drive.
    """

    title: str
    rows: Sequence[ExtrinsicsRow]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    lane_width: float
    facts: Mapping[str, str]
    stills: Sequence[tuple[str, Picture]] = ()
    problems: Sequence[str] = field(default_factory=list)
    is_stills: bool = False
    before_title: str = "first frame's pose held"
    truth: Sequence[ExtrinsicsRow] | None = None


def write_report(path: str | Path, report: Report) -> None:
    """Write the page; nothing in it is loaded from elsewhere."""
    rows = report.rows
    tracking = sum(row.status == "TRACKING" for row in rows)
    share = f"{tracking} of {len(rows)} {'images' if report.is_stills else 'frames'} TRACKING"
    after_title = "calibrated" if report.is_stills else "online"
    parts = [f"<h1>{html.escape(report.title)}</h1>", f'<p class="sub">{share}</p>']
    parts += [_pose_table(rows), "<h2>Run</h2>", _facts(report.facts)]
    if report.problems:
        items = "".join(f"<li>{html.escape(problem)}</li>" for problem in report.problems)
        parts.append(f'<h2>Problems</h2><ul class="problems">{items}</ul>')
    if len(rows) > 1:
        x = np.array([row.frame if report.is_stills else row.time_s for row in rows], dtype=np.float64)
        parts += [
            "<h2>Estimates</h2>",
            _figure(plot_estimates(rows, report.is_stills, report.truth), "png", "±2σ"),
        ]
        widths = plot_widths(
            x,
            report.before,
            report.after,
            report.lane_width,
            (report.before_title, after_title),
            "image" if report.is_stills else "time (s)",
        )
        note = f"Widths of all lanes seen in the bird's-eye view; dashed: {report.lane_width:.4g} m assumed."
        parts += ["<h2>Lane widths in the bird's-eye view</h2>", _figure(widths, "png", note)]
    if report.stills:
        parts.append("<h2>Stills</h2>")
        parts += [_figure(_jpeg(picture), "jpeg", caption) for caption, picture in report.stills]
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(report.title)}</title>"
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head>'
        f"<body>{''.join(parts)}</body></html>"
    )
    Path(path).write_text(page, encoding="utf-8", errors="replace")


def summary_facts(report: Report) -> dict[str, str]:
    """Lane widths before and after in a line each, where lanes were seen."""
    names = {report.before_title: report.before, "calibrated": report.after}
    return {
        f"lane width σ, {name}": f"{100 * width_deviation(widths):.1f} cm"
        for name, widths in names.items()
        if np.isfinite(widths).sum() > 1
    }


def _pose_table(rows: Sequence[ExtrinsicsRow]) -> str:
    good = [row for row in rows if row.status == "TRACKING"]
    if not good:
        return "<p>No frame was calibrated.</p>"
    body = ""
    for name, unit, digits in (
        ("pitch", "deg", 2),
        ("yaw", "deg", 2),
        ("roll", "deg", 2),
        ("height", "m", 3),
    ):
        value = np.array([getattr(row, f"{name}_{unit}") for row in good])
        std = np.median([getattr(row, f"{name}_std_{unit}") for row in good])
        sign = "°" if unit == "deg" else " m"
        cells = [np.median(value), value.min(), value.max(), std]
        body += f"<tr><th>{name}</th>" + "".join(f'<td class="n">{c:.{digits}f}{sign}</td>' for c in cells)
        body += "</tr>"
    head = "<tr><th></th><th>median</th><th>least</th><th>most</th><th>median σ</th></tr>"
    return f"<table>{head}{body}</table>"


def _facts(facts: Mapping[str, str]) -> str:
    cells = (f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in facts.items())
    return f"<table>{''.join(cells)}</table>"


def _figure(data: bytes, kind: str, caption: str) -> str:
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    text = html.escape(caption)
    return f'<figure><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>'


def _jpeg(picture: Picture) -> bytes:
    data = io.BytesIO()
    Image.fromarray(picture).save(data, format="JPEG", quality=88)
    return data.getvalue()
