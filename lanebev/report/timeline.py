"""The timeline: strips of status and of every axis over the drive, as stretches of equal state."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lanebev.io.results import ExtrinsicsRow
from lanebev.report.axis_states import AxisState, all_axis_states
from lanebev.report.verdict import reason_words
from lanebev.types import AXES

STATUSES = ("TRACKING", "COASTING", "LOST", "UNINITIALISED")  # the better first
STATE_WORDS = {
    AxisState.MEASURED: "measured",
    AxisState.UNCERTAIN: "uncertain",
    AxisState.UNDETERMINED: "not determined",
    AxisState.LOST: "lost",
    AxisState.UNKNOWN: "not known yet",
}
_MOST = 600  # stretches of a strip
_MOST_FRAMES = 2000


class Stretch(NamedTuple):
    """A stretch of equal state: where it begins and how long it is, in per cent, its kind and words."""

    start: float
    width: float
    kind: str
    words: str


class Strip(NamedTuple):
    """A strip of the timeline, for one axis or the status."""

    name: str
    stretches: tuple[Stretch, ...]


def places_on_axis(rows: Sequence[ExtrinsicsRow], stills: bool) -> NDArray[np.float64]:
    """Return (F+1,) where each frame begins and the last one ends: s, or the number of the image."""
    if stills or len(rows) < 2:
        return np.arange(len(rows) + 1, dtype=np.float64)
    times = np.maximum.accumulate(np.array([row.time_s for row in rows]))
    step = float(np.median(np.diff(times)))
    return np.append(times, times[-1] + max(step, 1e-6))


def strips(rows: Sequence[ExtrinsicsRow], stills: bool = False) -> list[Strip]:
    """Return the strips of status, pitch, yaw, roll and height."""
    if not rows:
        return []
    edges = places_on_axis(rows, stills)
    status = np.array([STATUSES.index(row.status) if row.status in STATUSES else 3 for row in rows])
    states = all_axis_states(rows)
    found = [_strip("status", status, [(name.lower(), name.lower()) for name in STATUSES], edges, rows)]
    kinds = [(state.name.lower(), STATE_WORDS[state]) for state in AxisState]
    return found + [_strip(name, states[:, i], kinds, edges, rows) for i, name in enumerate(AXES)]


def shown_frames(rows: Sequence[ExtrinsicsRow], always: Sequence[int]) -> list[int]:
    """Return places of frames: 2000 evenly spaced ones, changes of status, and ``always``."""
    every = max(1, -(-len(rows) // _MOST_FRAMES))
    changes = [i for i in range(1, len(rows)) if rows[i].status != rows[i - 1].status][:_MOST_FRAMES]
    return sorted({*range(0, len(rows), every), *changes, *always})


def ticks(edges: NDArray[np.float64]) -> list[tuple[float, str]]:
    """Return places in per cent and words of some round numbers on the time line."""
    span = float(edges[-1] - edges[0])
    rough = span / 6
    scale = 10.0 ** math.floor(math.log10(rough))
    step = next(scale * nice for nice in (1, 2, 5, 10) if scale * nice >= rough)
    first = math.ceil(float(edges[0]) / step - 1e-9) * step
    numbers = np.arange(first, float(edges[-1]) + 1e-9, step)
    return [(100 * (float(number) - float(edges[0])) / span, f"{number:g}") for number in numbers]


def _strip(
    name: str,
    states: NDArray[np.int64],
    kinds: Sequence[tuple[str, str]],
    edges: NDArray[np.float64],
    rows: Sequence[ExtrinsicsRow],
) -> Strip:
    """Join equal neighbours; of a long drive, each of 600 parts has the worst state in it.

    Args:
        name: name of the strip.
        states: (F,) places in ``kinds``.
        kinds: name of each state, and its words.
        edges: (F+1,) of the frames, see :func:`places_on_axis`.
        rows: of the frames.
    """
    begins = np.unique(np.linspace(0, len(states), _MOST + 1).astype(int)[:-1])
    worst = np.maximum.reduceat(states, begins)
    first = np.flatnonzero(np.append(True, np.diff(worst) != 0))
    bounds = [*begins[first].tolist(), len(states)]
    per_cent = 100 * (edges - edges[0]) / (edges[-1] - edges[0])
    stretches = []
    for state, start, end in zip(worst[first].tolist(), bounds[:-1], bounds[1:], strict=True):
        kind, words = kinds[state]
        why = ", ".join(_usual_reasons(rows[start:end])) if state else ""
        place = f"{edges[start]:.1f} to {edges[end]:.1f}"
        text = f"{name} {words}, {place}" + (f": {why}" if why else "")
        stretches.append(Stretch(per_cent[start], per_cent[end] - per_cent[start], kind, text))
    return Strip(name, tuple(stretches))


def _usual_reasons(rows: Sequence[ExtrinsicsRow]) -> list[str]:
    (most, _), *_ = Counter(tuple(row.reason_names) for row in rows).most_common(1)
    return reason_words(most)
