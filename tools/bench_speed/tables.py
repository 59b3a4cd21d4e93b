"""Tables and plots of what was measured."""

from collections.abc import Mapping
from pathlib import Path

from tools.bench_speed.measuring import Table, verdict


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
