"""The worst moments of a drive, which its own rows show: largest sigmas, largest jumps, loss of support."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from lanebev.io.results import ExtrinsicsRow
from lanebev.report.axis_states import AXES, pose, sigmas

SETTLING = 1.0  # s after the first tracked frame, in which large sigmas and jumps are a matter of course
_STATUSES = ("COASTING", "LOST")
_LEAST_JUMP = (0.1, 0.1, 0.1, 0.01)  # deg, deg, deg, m: smaller ones are no event
_LEAST_SIGMAS = 3.0
_APART = 0.3  # s, that two moments told are apart


class Moment(NamedTuple):
    """One frame that is worth a look.

    Attributes:
        place: of its row.
        what: in words.
    """

    place: int
    what: str


def scores(row: ExtrinsicsRow, before: ExtrinsicsRow | None, settled: bool = True) -> dict[str, float]:
    """Return how remarkable a frame is, by kind of event; a kind that does not occur is left out.

    Args:
        row: of the frame.
        before: of the frame before, None for the first.
        settled: tracking began at least SETTLING ago.
    """
    found: dict[str, float] = {}
    if settled and row.status == "TRACKING":
        found |= {f"sigma {axis}": value for axis, value in zip(AXES, sigmas(row), strict=True)}
    if row.status in _STATUSES:
        found[row.status] = row.pitch_std_deg
    if "RESTARTED" in row.reasons.split("|") and settled:
        found["RESTARTED"] = 1.0
    if settled and before is not None and before.status in ("TRACKING", *_STATUSES):
        found |= {f"jump {axis}": value for axis, value in jumps(row, before).items()}
    return {kind: value for kind, value in found.items() if math.isfinite(value)}


def jumps(row: ExtrinsicsRow, before: ExtrinsicsRow) -> dict[str, float]:
    """Return the axes that change between two frames by more than usual: axis to change in sigmas."""
    found = {}
    for axis, now, then, std, least in zip(
        AXES, pose(row), pose(before), sigmas(before), _LEAST_JUMP, strict=True
    ):
        step = abs(now - then)
        if step > least and step > _LEAST_SIGMAS * std:
            found[axis] = step / max(std, 1e-9)
    return found


def worst_moments(rows: Sequence[ExtrinsicsRow]) -> list[Moment]:
    """Return the frames with the highest score of each kind, in order of time, each at least 0.3 s apart."""
    best: dict[str, tuple[float, int]] = {}
    score_of = EventScores()
    for place, row in enumerate(rows):
        for kind, score in score_of(row).items():
            if kind not in best or score > best[kind][0]:
                best[kind] = (score, place)
    words: dict[int, list[str]] = {}
    for kind, (score, place) in best.items():
        near = (at for at in words if abs(rows[at].time_s - rows[place].time_s) < _APART)
        words.setdefault(next(near, place), []).append(_describe(kind, score, rows, place))
    return [Moment(place, "; ".join(words[place])) for place in sorted(words)]


class EventScores:
    """Scores the frames of a drive one after another, see :func:`scores`."""

    def __init__(self) -> None:
        self._before: ExtrinsicsRow | None = None
        self._start = math.inf

    def __call__(self, row: ExtrinsicsRow) -> dict[str, float]:
        """Return the scores of the next frame by kind."""
        if row.status == "TRACKING":
            self._start = min(self._start, row.time_s)
        found = scores(row, self._before, row.time_s >= self._start + SETTLING)
        self._before = row
        return found


def _describe(kind: str, score: float, rows: Sequence[ExtrinsicsRow], place: int) -> str:
    row = rows[place]
    name, _, axis = kind.partition(" ")
    if name in _STATUSES:
        doing = "predicted" if name == "COASTING" else "lost"
        return f"least certain while {doing}: σ of pitch {_value(0, score)}"
    if name == "RESTARTED":
        return "started anew"
    number = AXES.index(axis)
    if name == "sigma":
        return f"largest σ of {axis}: {_value(number, score)}"
    step = pose(row)[number] - pose(rows[place - 1])[number]
    return f"{axis} jumps by {_value(number, step, '+')} ({score:.0f} σ)"


def _value(axis: int, value: float, sign: str = "") -> str:
    return f"{100 * value:{sign}.1f} cm" if AXES[axis] == "height" else f"{value:{sign}.2f}°"
