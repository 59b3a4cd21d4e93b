"""Time alternatives in turns, judge the results by targets, and show them as tables and plots."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch.utils.benchmark import Measurement, Timer

Calls = Mapping[str, Callable[[], object]]
Table = dict[str, dict[str, float]]

TARGETS = {  # largest ratio, or time
    "BEVWarp": ("ratio", 1.2),
    "BEVWarp, 5 coefficients": ("ratio", 1.3),
    "BEVWarp, 8 coefficients": ("ratio", 1.3),
    "BEVWarp, fisheye": ("ratio", 1.3),
    "remap_frame": ("ratio", 1.2),
    "LineExtractor": ("ms", 4.0),
}
_ONCE = 10  # times the seconds of an alternative, above which a call is measured once, without one to warm up


def measure(calls: Calls, seconds: float, clock: Callable[[], float]) -> Table:
    """Time alternatives in turns for ``seconds`` each: median and quartiles, ms, and ratio to the first."""
    timers = {
        name: Timer("call()", globals={"call": call}, timer=clock, num_threads=torch.get_num_threads())
        for name, call in calls.items()
    }
    first = {name: timer.timeit(1) for name, timer in timers.items()}  # to warm up as well
    number = {name: max(1, int(0.02 / run.median)) for name, run in first.items()}
    longest = max(0.02, *(run.median for run in first.values()))
    turns = max(1 if longest > seconds else 3, int(seconds / longest))
    runs: dict[str, list[Measurement]] = {name: [] for name in calls}
    if longest > _ONCE * seconds:
        runs, turns = {name: [run] for name, run in first.items()}, 0
    for _ in range(turns):
        for name, timer in timers.items():
            runs[name].append(timer.timeit(number[name]))
    table: Table = {}
    for name, parts in runs.items():
        times = 1e3 * np.array([part.median for part in parts])
        low, median, high = np.quantile(times, [0.25, 0.5, 0.75])
        table[name] = {"ms": float(median), "low": float(low), "high": float(high)}
    base = next(iter(table.values()))["ms"]
    return {name: {"ratio": entry["ms"] / base, **entry} for name, entry in table.items()}


def judged(table: Table) -> Table:
    """Add to entries with a target whether they meet it, to two decimals."""
    return {
        name: {**entry, "met": round(entry[TARGETS[name][0]], 2) <= TARGETS[name][1]}
        if name in TARGETS
        else entry
        for name, entry in table.items()
    }


def verdict(name: str, entry: Mapping[str, float]) -> str:
    """Say whether a target is met; nothing of an entry without one."""
    if "met" not in entry:
        return ""
    what, most = TARGETS[name]
    return f"{'met' if entry['met'] else 'missed'}: {what} at most {most:g}"


def shown(title: str, table: Table) -> str:
    """Return a markdown table, ratios first."""
    lines = [f"**{title}**", "", "| | ratio | ms | quartiles | target |", "|---|---|---|---|---|"]
    for name, entry in table.items():
        quartiles = f"{entry['low']:.2f} to {entry['high']:.2f}"
        lines.append(
            f"| {name} | {entry['ratio']:.2f} | {entry['ms']:.2f} | {quartiles} | {verdict(name, entry)} |"
        )
    return "\n".join([*lines, ""])


def overview(tables: Mapping[str, Table]) -> str:
    """Return a markdown table of all ratios, bold where a target is missed, and how many are met."""
    names = list(dict.fromkeys(name for table in tables.values() for name in table))
    lines = [f"| | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for title, table in tables.items():
        row = [_ratio(table[name]) if name in table else "" for name in names]
        lines.append(f"| {title} | {' | '.join(row)} |")
    met = [entry["met"] for table in tables.values() for entry in table.values() if "met" in entry]
    return "\n".join(["**ratios**", "", *lines, "", f"{sum(map(int, met))} of {len(met)} targets met", ""])


def _ratio(entry: Mapping[str, float]) -> str:
    return f"{entry['ratio']:.2f}" if entry.get("met", True) else f"**{entry['ratio']:.2f}**"


def grown(title: str, results: dict[int, Table]) -> str:
    """Return a markdown table of ms by size."""
    names = list(next(iter(results.values())))
    lines = [f"**ms by {title}**", "", f"| {title} | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for size, table in results.items():
        lines.append(f"| {size} | " + " | ".join(f"{table[name]['ms']:.2f}" for name in names) + " |")
    return "\n".join([*lines, ""])


def plot(title: str, results: dict[int, Table], path: Path) -> None:
    """Plot time against size, both logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3.2), layout="constrained")
    axes = figure.subplots()
    for name in next(iter(results.values())):
        entries = [table[name] for table in results.values()]
        axes.plot(list(results), [entry["ms"] for entry in entries], marker="o", label=name)
        axes.fill_between(list(results), [e["low"] for e in entries], [e["high"] for e in entries], alpha=0.2)
    axes.set(xscale="log", yscale="log", xlabel=title, ylabel="ms")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(path, metadata={"Date": None})
