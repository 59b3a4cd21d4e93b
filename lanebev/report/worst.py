"""The worst moments of a drive: largest sigmas, largest jumps, losses of tracking."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from lanebev.io.results import ExtrinsicsRow
from lanebev.report.axis_states import with_unit
from lanebev.types import AXES

SETTLING = 1.0  # s after the first tracked frame, in which large sigmas and jumps are a matter of course
_STATUSES = ("COASTING", "LOST")
_LEAST_JUMP = (0.1, 0.1, 0.1, 0.01)  # deg, deg, deg, m: smaller ones are no event
_LEAST_SIGMAS = 3.0
_APART = 0.3  # s, least time between two listed moments


class Moment(NamedTuple):
    """A frame to look at, with the reason.

    Attributes:
        place: index of its row.
        what: in words.
    """

    place: int
    what: str


def scores(
    row: ExtrinsicsRow, before: Sequence[ExtrinsicsRow] = (), settled: bool = True
) -> dict[str, float]:
    """Return how remarkable a frame is, by kind of event; a kind that does not occur is left out.

    Args:
        row: row of the frame.
        before: rows of the two frames before it, fewer at the start.
        settled: tracking began at least SETTLING ago.
    """
    found: dict[str, float] = {}
    if settled and row.status == "TRACKING":
        found |= {f"sigma {axis}": value for axis, value in zip(AXES, row.std, strict=True)}
    if row.status in _STATUSES:
        found[row.status] = row.pitch_std_deg
    if settled and "RESTARTED" in row.reason_names:
        found["RESTARTED"] = 1.0
    if settled and len(before) == 2 and all(one.status in ("TRACKING", *_STATUSES) for one in before):
        large = zip(AXES, jumps(row, *before), before[1].std, _LEAST_JUMP, strict=True)
        for axis, jump, std, least in large:
            if abs(jump) > max(least, _LEAST_SIGMAS * std):
                found[f"jump {axis}"] = abs(jump) / max(std, 1e-9)
    return {kind: value for kind, value in found.items() if math.isfinite(value)}


def jumps(row: ExtrinsicsRow, earlier: ExtrinsicsRow, before: ExtrinsicsRow) -> list[float]:
    """Return the differences of pitch, yaw, roll (deg) and height (m) from their linear extrapolation.

    Args:
        row: row of the frame.
        earlier: two frames before.
        before: one frame before.
    """
    step = before.time_s - earlier.time_s
    share = (row.time_s - before.time_s) / step if step > 0 else 0.0
    values = zip(row.pose, earlier.pose, before.pose, strict=True)
    return [now - (then + share * (then - first)) for now, first, then in values]


def worst_moments(rows: Sequence[ExtrinsicsRow]) -> list[Moment]:
    """Return the frames with the highest score of each kind, in order of time, each at least 0.3 s apart."""
    best: dict[str, tuple[float, int]] = {}
    score_of = EventScores()
    for place, row in enumerate(rows):
        for kind, score in score_of(row).items():
            if kind not in best or score > best[kind][0]:
                best[kind] = (score, place)
    moments: dict[int, dict[str, tuple[float, int]]] = {}
    for kind, (score, place) in best.items():
        near = (at for at in moments if abs(rows[at].time_s - rows[place].time_s) < _APART)
        moments.setdefault(next(near, place), {})[kind] = (score, place)
    return [Moment(place, _describe(moments[place], rows)) for place in sorted(moments)]


class EventScores:
    """Scores the frames of a drive one after another, see :func:`scores`."""

    def __init__(self) -> None:
        self._before: tuple[ExtrinsicsRow, ...] = ()
        self._start = math.inf

    def __call__(self, row: ExtrinsicsRow) -> dict[str, float]:
        """Return the scores of the next frame by kind."""
        if row.status == "TRACKING":
            self._start = min(self._start, row.time_s)
        found = scores(row, self._before, row.time_s >= self._start + SETTLING)
        self._before = (*self._before, row)[-2:]
        return found


def _describe(events: Mapping[str, tuple[float, int]], rows: Sequence[ExtrinsicsRow]) -> str:
    """Return what happens in a moment in words; events: kind to score and place."""
    words, stds, leaps = [], [], []
    for kind, (score, place) in events.items():
        name, _, axis = kind.partition(" ")
        if name == "sigma":
            stds.append(f"{axis} {with_unit(axis, score)}")
        elif name == "jump":
            jump = jumps(rows[place], *rows[place - 2 : place])[AXES.index(axis)]
            leaps.append(f"{axis} {with_unit(axis, jump, '+')} ({score:.0f} σ)")
        elif name == "RESTARTED":
            words.append("started in this frame")
        else:
            doing = "predicted" if name == "COASTING" else "lost"
            words.append(f"least certain while {doing}: σ of pitch {with_unit('pitch', score)}")
    words += [f"largest jump: {', '.join(leaps)}"] if leaps else []
    words += [f"largest σ while tracking: {', '.join(stds)}"] if stds else []
    return "; ".join(words)
