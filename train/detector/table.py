"""The experiment's tables: ``python -m train.detector.table RUN --plot ap_by_angle.svg``.

Means over seeds, and the standard deviation between them.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from train.commands import command_parser, one_line_errors
from train.detector.precision import DISTANCES
from train.detector.predict import AXES, OFFSETS_DEG
from train.detector.settings import ARMS

NAMES = {
    "nominal": "(a) nominal mount",
    "noisy": "(a') nominal, trained with noise",
    "online": "(b) LaneBEV, frozen",
    "tuned": "(c) LaneBEV, end to end",
    "true": "(d) true pose",
}
Results = dict[str, list[dict[str, Any]]]


def read_results(folder: Path) -> Results:
    """Read the results of a run by arm."""
    results = {arm: [json.loads(p.read_text()) for p in sorted(folder.glob(f"{arm}-*.json"))] for arm in ARMS}
    if not any(results.values()):
        raise ValueError(f"{folder}: expected results of train.detector, got none")
    return {arm: each for arm, each in results.items() if each}


def recovered_share(arm: Sequence[float], nominal: Sequence[float], true: Sequence[float]) -> float:
    """Compute the share of what ``nominal`` loses against ``true`` that ``arm`` does not, of their means."""
    low, high = float(np.mean(nominal)), float(np.mean(true))
    return (float(np.mean(arm)) - low) / (high - low) if high != low else float("nan")


def mean_and_spread(values: Sequence[float], digits: int = 3) -> str:
    """Write the mean and the standard deviation between seeds."""
    spread = np.std(values, ddof=1) if len(values) > 1 else np.nan
    return f"{np.mean(values):.{digits}f} ± {spread:.{digits}f}"


def precision_of(results: list[dict[str, Any]], span: int, distance: float) -> list[float]:
    """Return AP of each seed, in one of the ranges."""
    return [result["scores"][span]["precision"][f"{distance:g}"] for result in results]


def spans_of(results: Results) -> list[tuple[float, float, int]]:
    """Return the ranges, m, and the number of true boxes in each."""
    first = next(iter(results.values()))[0]["scores"]
    return [(*score["range"], score["positives"]) for score in first]


def arm_table(results: Results) -> list[str]:
    """Return lines of AP over all ranges, the recovered share, and the errors of the pose."""
    lines = [
        "| arm | AP 0.5 m | AP 1 m | AP 2 m | won back of AP 1 m | pose RMSE, ° and cm |",
        "|---|---|---|---|---|---|",
    ]
    for arm, own in results.items():
        ap = [mean_and_spread(precision_of(own, 0, distance)) for distance in DISTANCES]
        share = "–"
        if {"nominal", "true"} <= results.keys() and arm not in ("nominal", "true"):
            low, high = (precision_of(results[name], 0, 1.0) for name in ("nominal", "true"))
            share = f"{100 * recovered_share(precision_of(own, 0, 1.0), low, high):.0f} %"
        pose = np.mean([result["pose_rmse"] for result in own], axis=0)
        shown = " ".join(f"{value:.2f}" for value in pose)
        lines.append(f"| {NAMES[arm]} | {' | '.join(ap)} | {share} | {shown} |")
    return lines


def range_table(results: Results) -> list[str]:
    """Return lines of AP at 1 m and of the mean error by range."""
    spans = spans_of(results)[1:]
    columns = [f"{kind} {low:g}–{high:g} m" for kind in ("AP 1 m,", "error m,") for low, high, _ in spans]
    lines = ["| arm | " + " | ".join(columns) + " |", "|---" * (1 + len(columns)) + "|"]
    for arm, own in results.items():
        numbers = range(1, len(spans) + 1)
        cells = [mean_and_spread(precision_of(own, span, 1.0)) for span in numbers]
        cells += [mean_and_spread([result["scores"][span]["error"] for result in own], 2) for span in numbers]
        lines.append(f"| {NAMES[arm]} | " + " | ".join(cells) + " |")
    return lines


def offset_table(true: list[dict[str, Any]]) -> list[str]:
    """Return lines of AP with the true pose rotated about one axis at a time."""
    lines = ["| axis | 0° | " + " | ".join(f"{d:g}°" for d in OFFSETS_DEG) + " |"]
    lines.append("|---" * (2 + len(OFFSETS_DEG)) + "|")
    for axis in AXES:
        curve = offset_curve(true, axis, 1.0)
        lines.append(f"| {axis} | " + " | ".join(mean_and_spread(list(each)) for each in curve) + " |")
    return lines


def offset_curve(true: list[dict[str, Any]], axis: str, distance: float) -> list[list[float]]:
    """Return AP of each seed, for no angle and each of OFFSETS_DEG."""
    rows = [precision_of(true, 0, distance)]
    for degrees in OFFSETS_DEG:
        own = [
            next(off for off in result["off"] if (off["axis"], off["degrees"]) == (axis, degrees))
            for result in true
        ]
        rows.append([off["scores"][0]["precision"][f"{distance:g}"] for off in own])
    return rows


def plot_offsets(true: list[dict[str, Any]], path: Path) -> None:
    """Draw AP over the angle (evenly spaced, not to scale), an axis a panel, mean and seeds' range."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3), layout="constrained")
    angles = [0.0, *OFFSETS_DEG]
    places = range(len(angles))
    for axes, axis in zip(figure.subplots(1, len(AXES), sharey=True), AXES, strict=True):
        for distance in DISTANCES:
            curve = np.array(offset_curve(true, axis, distance))
            axes.plot(places, curve.mean(1), marker="o", ms=3, label=f"AP at {distance:g} m")
            axes.fill_between(places, curve.min(1), curve.max(1), alpha=0.2, lw=0)
        axes.set(xlabel=f"error of {axis} (°)", ylim=(0, None))
        axes.set_xticks(places, [f"{angle:g}" for angle in angles])
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center")
    figure.axes[0].set_ylabel("average precision")
    figure.savefig(path)


@one_line_errors()
def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("run", type=Path, help="folder of results")
    parser.add_argument("--plot", type=Path, help="file for the plot of AP by angle")
    given = parser.parse_args(args)
    results = read_results(given.run)
    first = next(iter(results.values()))[0]
    seeds = max(map(len, results.values()))
    print(f"{first['train_frames']} frames of training, {first['frames']} of the test, {seeds} seeds; boxes:")
    print(", ".join(f"{count} at {low:g}–{high:g} m" for low, high, count in spans_of(results)), end="\n\n")
    tables = [arm_table(results), range_table(results)]
    if "true" in results:
        tables.append(offset_table(results["true"]))
        if given.plot:
            plot_offsets(results["true"], given.plot)
    print("\n\n".join("\n".join(lines) for lines in tables))


if __name__ == "__main__":
    main()
