"""Evaluate real and third-party images, with all results beside their targets.

    python -m tools.evaluate_real [--data ../shared/data] [--json FILE] [--weights FILE]
        [--width PX] [--only PART] [--hilly] [--far-view] [--precision bfloat16]

Nothing of these images has been trained on.
"""

import json
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import lanebev
from lanebev.app.drive.build import make_calibrator
from tools.network_options import make_model, network_parser
from tools.real_figures import Figure, carla_drive, carla_stills, tusimple_labels, tusimple_pixels, udacity
from train.commands import one_line_errors, versions

NEEDED = {
    "tusimple": "label_data.json",
    "carla": "truth.csv",
    "udacity": "camera.yaml",
}


@one_line_errors()
def main() -> None:
    parser = network_parser(__doc__)
    parser.add_argument("--json", type=Path, help="file for the results as JSON")
    parser.add_argument("--only", help="run only parts whose name contains this")
    parser.add_argument("--hilly", action="store_true", help="the joint calibrator with HILLY_ROADS")
    options = parser.parse_args()
    missing = [f"{name}/{file}" for name, file in NEEDED.items() if not (options.data / name / file).exists()]
    if missing:
        raise ValueError(f"{options.data}: missing {', '.join(missing)}; give the folder with --data")
    calibrators = {name: make_calibrator(name) for name in ("two-stage", "joint")}
    if options.hilly:
        calibrators["joint"] = lanebev.JointCalibrator(lanebev.HILLY_ROADS)
    model = make_model(options)
    start = time.monotonic()
    figures = [figure for part in parts(options, model, calibrators) for figure in part]
    print_table(figures)
    if options.json:
        options.json.write_text(json.dumps(as_json(figures, options, time.monotonic() - start), indent=1))


def parts(options: Any, model: Any, calibrators: dict[str, Any]) -> Iterator[Iterable[Figure]]:
    """Return the requested parts, each an iterable of figures."""

    def wanted(name: str) -> bool:
        return not options.only or options.only in name

    if wanted("tusimple labels"):
        yield tusimple_labels(options.data, calibrators)
    for function in (carla_stills, carla_drive, udacity, tusimple_pixels):
        if wanted(function.__name__.replace("_", " ")):
            yield function(options.data, model, calibrators)


def print_table(figures: list[Figure]) -> None:
    """Print the results beside the targets."""
    table = Table("part", "figure", "calibrator", "here", "target", "met")
    for i, figure in enumerate(figures):
        sign = "≥" if figure.least else "≤"
        target = "" if figure.target is None else f"{sign} {figure.target:.3g} {figure.unit}"
        met = {True: "yes", False: "NO", None: ""}[figure.met]
        last = i + 1 == len(figures) or figures[i + 1].part != figure.part
        here = f"{figure.value:.3g} {figure.unit}"
        table.add_row(figure.part, figure.name, figure.calibrator, here, target, met, end_section=last)
    Console(width=None if sys.stdout.isatty() else 130).print(table)
    judged = [figure.met for figure in figures if figure.met is not None]
    print(
        f"{sum(judged)} of {len(judged)} targets met; TuSimple's camera is not published: f = 1000 px assumed"
    )


def as_json(figures: list[Figure], options: Any, seconds: float) -> dict[str, Any]:
    """Return the figures with the versions and settings that gave them."""
    return {
        "command": "python -m tools.evaluate_real",
        **versions(),
        "weights": str(options.weights.name) if options.weights else "shipped",
        "seconds": round(seconds, 1),
        "figures": [figure.as_dict() for figure in figures],
    }


if __name__ == "__main__":
    main()
