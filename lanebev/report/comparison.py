"""Compare two runs: differences of their estimates over common frames, and of their settings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from lanebev.io.results import ExtrinsicsRow
from lanebev.report.axis_states import AxisState, all_axis_states, estimate_stds, estimates
from lanebev.report.figures import bokeh_script
from lanebev.report.plots import plot_differences, plot_two
from lanebev.report.run_folder import RunFolder
from lanebev.report.templates import template
from lanebev.report.timeline import places_on_axis, shown_frames, strips, ticks
from lanebev.report.verdict import describe, percent, verdict
from lanebev.types import AXES

Pair = tuple[ExtrinsicsRow, ExtrinsicsRow]
_ANGLE, _LENGTH = "{:+.3f}°", "{:+.1f} cm"


@dataclass(frozen=True)
class AxisDifference:
    """The differences of an axis, second run minus first, over the frames in which both measured it.

    Attributes:
        axis: its name.
        count: frames.
        mean, rms, largest: deg, or m; ``largest`` with its sign.
        at: number of the frame, in the pairs, of the largest.
        beyond: share of the frames that differ by more than two joint standard deviations.
    """

    axis: str
    count: int
    mean: float
    rms: float
    largest: float
    at: int
    beyond: float

    @property
    def words(self) -> list[str]:
        """Mean, rms and largest difference with their units."""
        values = (self.mean, self.rms, self.largest)
        if self.axis == "height":
            return [_LENGTH.format(100 * value) for value in values]
        return [_ANGLE.format(value) for value in values]


def common_frames(first: RunFolder, second: RunFolder) -> list[Pair]:
    """Return the rows of the same frames: of images by name, else by number in the source.

    The name is the end of the path, as long as needed to be unique among the frames of each run.
    """
    keys: tuple[Sequence[object], Sequence[object]] | None = _names(first.rows, second.rows)
    if keys is None:
        keys = first.source_numbers(), second.source_numbers()
    of_second = dict(zip(keys[1], second.rows, strict=True))
    pairs = [(row, of_second[key]) for row, key in zip(first.rows, keys[0], strict=True) if key in of_second]
    if not pairs:
        raise ValueError("compare: expected two runs with frames in common, got none")
    return pairs


def differences(pairs: Sequence[Pair]) -> list[AxisDifference]:
    """Return how each axis differs, where both runs measured it."""
    first, second = ([pair[i] for pair in pairs] for i in (0, 1))
    change, sigma = difference_and_sigma(pairs)
    both = _measured(first) & _measured(second) & np.isfinite(change)
    found = []
    for axis, name in enumerate(AXES):
        at = np.flatnonzero(both[:, axis])
        if len(at):
            value, std = change[at, axis], sigma[at, axis]
            worst = int(np.abs(value).argmax())
            beyond = float((np.abs(value) > 2 * std).mean())
            rms = float(np.sqrt(np.mean(value**2)))
            found.append(
                AxisDifference(
                    name, len(at), float(value.mean()), rms, float(value[worst]), int(at[worst]), beyond
                )
            )
    return found


def difference_and_sigma(pairs: Sequence[Pair]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the change from first to second (F, 4) in deg and m, and its sigma if both err independently."""
    first, second = ([pair[i] for pair in pairs] for i in (0, 1))
    return estimates(second) - estimates(first), np.hypot(estimate_stds(first), estimate_stds(second))


def differing(first: Mapping[str, str], second: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return the settings that are not the same, with both values; a dash where one is missing."""
    names = dict.fromkeys([*first, *second])
    both = {name: (first.get(name, "–"), second.get(name, "–")) for name in names}
    return {name: values for name, values in both.items() if values[0] != values[1]}


def render_comparison(first: RunFolder, second: RunFolder) -> str:
    """Return the page that shows two runs side by side."""
    pairs = common_frames(first, second)
    stills = bool(pairs[0][0].image) and len({row.time_s for row, _ in pairs}) == 1
    found = differences(pairs)
    shown = shown_frames([row for row, _ in pairs], [each.at for each in found])
    shown_pairs = [pairs[place] for place in shown]
    x = places_on_axis([row for row, _ in pairs], stills)[:-1]
    several = len(pairs) > 1
    plots = {
        "two": plot_two(x[shown], [a for a, _ in shown_pairs], [b for _, b in shown_pairs], stills),
        "differences": plot_differences(x[shown], *difference_and_sigma(shown_pairs), stills),
    } if several else {}  # fmt: skip
    return template("compare.html.j2").render(
        title=f"{first.name} and {second.name}",
        runs=[
            _summary("A", first, [row for row, _ in pairs], stills),
            _summary("B", second, [row for _, row in pairs], stills),
        ],
        common=len(pairs),
        differences=found,
        percent=percent,
        frames={each.axis: pairs[each.at][0] for each in found},
        settings=differing(first.settings, second.settings),
        lens=differing(first.lens, second.lens),
        known=bool(first.settings and second.settings),
        moments=_moments(found, pairs, first, second),
        stills=stills,
        plots=plots,
        bokeh=Markup(bokeh_script()) if several else "",
    )


def _summary(letter: str, run: RunFolder, rows: Sequence[ExtrinsicsRow], stills: bool) -> dict[str, Any]:
    """Return the values of one run that the page shows, with its verdict over the common frames."""
    result, several = verdict(rows, stills), len(rows) > 1
    return {
        "letter": letter,
        "name": run.name,
        "verdict": result,
        "findings": [describe(finding) for finding in result.findings],
        "strips": strips(rows, stills) if several else [],
        "ticks": ticks(places_on_axis(rows, stills)) if several else [],
        "frames": len(run.rows),
    }


def comparison_summary(first: RunFolder, second: RunFolder) -> str:
    """Return the text to print: the frames in common, how each axis differs, the settings that do."""
    pairs = common_frames(first, second)
    lines = [f"{len(pairs)} frame{'s'[: len(pairs) != 1]} in common; {second.name} minus {first.name}:"]
    for each in differences(pairs):
        mean, rms, largest = each.words
        frame = pairs[each.at][0].frame
        lines.append(f"{each.axis}: mean {mean}, rms {rms.lstrip('+')}, largest {largest} (frame {frame})")
    changed = differing(first.settings, second.settings)
    lines += [f"{name}: {a} | {b}" for name, (a, b) in changed.items()]
    return "\n".join(lines)


def _names(
    first: Sequence[ExtrinsicsRow], second: Sequence[ExtrinsicsRow]
) -> tuple[list[tuple[str, ...]], list[tuple[str, ...]]] | None:
    """Return the names of the images of both runs; None where two frames have the same name."""
    parts = [[PurePath(row.image).parts for row in rows] for rows in (first, second)]
    if not all(each for names in parts for each in names):
        return None
    for length in range(1, max(len(each) for names in parts for each in names) + 1):
        ends = [[each[-length:] for each in names] for names in parts]
        if all(len(set(names)) == len(names) for names in ends):
            return ends[0], ends[1]
    return None


def _measured(rows: Sequence[ExtrinsicsRow]) -> NDArray[np.bool_]:
    return all_axis_states(rows) <= AxisState.UNCERTAIN


def _moments(
    found: Sequence[AxisDifference], pairs: Sequence[Pair], first: RunFolder, second: RunFolder
) -> list[dict[str, Any]]:
    """Return the pictures of both runs nearest to the largest difference of each axis."""
    moments: dict[int, dict[str, Any]] = {}
    for each in found:
        rows = pairs[each.at]
        numbers = [_nearest(run.pictures, row.frame) for run, row in zip((first, second), rows, strict=True)]
        if None in numbers:
            continue
        pictures = [run.pictures[n] for run, n in zip((first, second), numbers, strict=True) if n is not None]
        moment = moments.setdefault(
            each.at, {"row": rows[0], "axes": [], "pictures": pictures, "frames": numbers}
        )
        moment["axes"].append(f"{each.axis} {each.words[2]}")
    return [moments[at] for at in sorted(moments)]


def _nearest(pictures: Mapping[int, object], frame: int) -> int | None:
    return min(pictures, key=lambda number: abs(number - frame), default=None)
