"""The verdict on a run in words: how much of it is calibrated, and what is not determined, when and why."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress, groupby

import numpy as np
from numpy.typing import NDArray

from lanebev.estimation.reasons import REASON_WORDS, UNSEEN, WHOLE_FRAME, Reason, telling_reasons
from lanebev.io.results import ExtrinsicsRow
from lanebev.report.axis_states import LARGEST_STD, AxisState, all_axis_states, estimate_stds, with_unit
from lanebev.types import AXES

_WORDS = {str(reason.name): words for reason, words in REASON_WORDS.items()}
_WHOLE_FRAME, _UNSEEN = ([str(reason.name) for reason in some] for some in (WHOLE_FRAME, UNSEEN))
_STATUS_WORDS = {
    "LOST": "pose lost",
    "COASTING": "pose only predicted",
    "UNINITIALISED": "not yet calibrated",
}
_SEVERITY = ("no frames", *_STATUS_WORDS.values(), "not determined", "uncertain")
_JOINED = 0.5  # s, largest gap between two intervals of the same kind that are joined
_SHORTEST = 0.2  # s, shortest interval that is listed
_GAP = 1.0  # s; a longer interval has missing frames,
_GAP_STEPS = 5.0  # if it is also longer than so many median intervals
_MOST_FINDINGS = 8  # findings


@dataclass(frozen=True)
class Finding:
    """A condition that holds from one frame to another.

    Attributes:
        subject: an axis, several, or empty for the whole pose.
        what: e.g. "not determined".
        first, last: its frames' places in the rows.
        start, end: s; numbers of images where each is on its own.
        why: reasons in words, may be empty.
        frames: how many of the frames from first to last it holds in.
    """

    subject: str
    what: str
    first: int
    last: int
    start: float
    end: float
    why: str
    frames: int = 0


@dataclass(frozen=True)
class Verdict:
    """The verdict on a run, in words.

    Attributes:
        grade: "good", "fair" or "poor".
        headline: one sentence.
        precision: one sentence, empty if nothing was calibrated.
        findings: problems, the most severe first.
        omitted: number of further findings.
    """

    grade: str
    headline: str
    precision: str
    findings: tuple[Finding, ...]
    omitted: int = 0

    @property
    def text(self) -> str:
        """All of it in one line."""
        words = [describe(finding) for finding in self.findings]
        more = [f"and {self.omitted} more"] if self.omitted else []
        return "; ".join([self.headline.removesuffix("."), *words, *more])


def verdict(rows: Sequence[ExtrinsicsRow], stills: bool = False) -> Verdict:
    """Return the verdict on a run from the status, reasons and sigmas of its frames."""
    if not rows:
        return Verdict("poor", "Not calibrated: there was no frame.", "", ())
    tracked = np.array([row.status == "TRACKING" for row in rows])
    states = all_axis_states(rows)
    whole = (states == AxisState.MEASURED).all(-1)
    share, complete = float(tracked.mean()), float(whole.mean())
    if not tracked.any():
        why = _frequent(rows)
        return Verdict("poor", f"Not calibrated: {why or 'no usable frame'}.", "", ())
    if stills:
        headline = f"{tracked.sum()} of {len(rows)} {_images(len(rows))} calibrated"
        part = f"all four axes determined in {whole.sum()}"
    else:
        headline = f"Calibrated for {percent(share)} of the drive"
        part = f"all four axes determined for {percent(complete)}"
    headline += "." if complete == share else f", {part}."
    grade = "good" if complete >= 0.9 else "fair" if share >= 0.5 else "poor"
    found = image_findings(rows) if stills else drive_findings(rows)
    return Verdict(
        grade, headline, _precision(rows, states), tuple(found[:_MOST_FINDINGS]), len(found[_MOST_FINDINGS:])
    )


def describe(finding: Finding) -> str:
    """Return a finding in words, such as "roll not determined from 7.2 to 9.8 s: one lane only"."""
    subject = f"{finding.subject} " if finding.subject else ""
    why = f": {finding.why}" if finding.why else ""
    if finding.frames:
        return f"{subject}{finding.what} in {finding.frames} {_images(finding.frames)}{why}"
    return f"{subject}{finding.what} from {finding.start:.1f} to {finding.end:.1f} s{why}"


def drive_findings(rows: Sequence[ExtrinsicsRow]) -> list[Finding]:
    """Return the problems of a drive: intervals without frames, support or one of the axes."""
    times = np.array([row.time_s for row in rows])
    found = [*_missing_frames(times)]
    for status, words in _STATUS_WORDS.items():
        at = np.array([row.status == status for row in rows])
        for first, last in intervals(at, times):
            why = _frequent([row for row in rows[first : last + 1] if row.status == status])
            found.append(_finding("", words, first, last, times, why))
    states = all_axis_states(rows)
    undetermined = states == AxisState.UNDETERMINED
    tracked = np.array([row.status == "TRACKING" for row in rows])
    parts: list[Finding] = []
    for axis, name in enumerate(AXES):
        most = f"σ above {with_unit(name, LARGEST_STD[axis])}"
        for first, last in intervals(undetermined[:, axis] & tracked, times):
            part = slice(first, last + 1)
            why = _unseen_why(compress(rows[part], undetermined[part, axis]))
            parts.append(_finding(name, "not determined", first, last, times, why))
        for first, last in intervals(states[:, axis] == AxisState.UNCERTAIN, times):
            parts.append(_finding(name, "uncertain", first, last, times, most))
    found += _joined_axes(parts)
    return sorted(found, key=lambda one: (_SEVERITY.index(one.what), one.start - one.end))


def image_findings(rows: Sequence[ExtrinsicsRow]) -> list[Finding]:
    """Return the problems of independent images: in how many of them, and the first."""
    states = all_axis_states(rows)
    tracked = np.array([row.status == "TRACKING" for row in rows])
    lost = [row for row in rows if row.status != "TRACKING"]
    found = [*_in_images("", "no calibration", ~tracked, _frequent(lost))]
    for axis, name in enumerate(AXES):
        undetermined = tracked & (states[:, axis] == AxisState.UNDETERMINED)
        uncertain = states[:, axis] == AxisState.UNCERTAIN
        why = _unseen_why(compress(rows, undetermined))
        found += _in_images(name, "not determined", undetermined, why)
        found += _in_images(name, "uncertain", uncertain, f"σ above {with_unit(name, LARGEST_STD[axis])}")
    return found


def intervals(
    at: NDArray[np.bool_], times: NDArray[np.float64], joined: float = _JOINED, shortest: float = _SHORTEST
) -> Iterator[tuple[int, int]]:
    """Yield first and last frame of each interval in which ``at`` holds.

    Args:
        at: (F,).
        times: (F,) s.
        joined: s, intervals that are not further apart are one.
        shortest: s, shorter ones are left out.
    """
    places = np.flatnonzero(at)
    if not len(places):
        return
    breaks = np.flatnonzero((np.diff(times[places]) > joined) & (np.diff(places) > 1)) + 1
    for part in np.split(places, breaks):
        first, last = int(part[0]), int(part[-1])
        if _end(times, last) - times[first] >= shortest - 1e-9:
            yield first, last


def percent(share: float) -> str:
    """Return a share in per cent, 0 % and 100 % only where they are exact."""
    if 0.0 < share < 1.0:
        return f"{min(max(round(100 * share), 1), 99)} %"
    return f"{100 * share:.0f} %"


def reason_words(names: Sequence[str]) -> list[str]:
    """Return reasons in words; of the unseen axes the one that implies the others."""
    known = Reason.NONE
    for name in names:
        known |= Reason.__members__.get(name, Reason.NONE)
    new = [name.lower().replace("_", " ") for name in names if name not in _WORDS]
    return [REASON_WORDS[reason] for reason in telling_reasons(known)] + new


def _in_images(subject: str, what: str, at: NDArray[np.bool_], why: str) -> Iterator[Finding]:
    places: list[int] = np.flatnonzero(at).tolist()
    if places:
        yield Finding(subject, what, places[0], places[-1], places[0], places[-1], why, len(places))


def _missing_frames(times: NDArray[np.float64]) -> Iterator[Finding]:
    steps = np.diff(times)
    if len(steps) < 2:
        return
    for place in np.flatnonzero(steps > max(_GAP, _GAP_STEPS * float(np.median(steps)))).tolist():
        yield Finding("", "no frames", place, place + 1, float(times[place]), float(times[place + 1]), "")


def _finding(subject: str, what: str, first: int, last: int, times: NDArray[np.float64], why: str) -> Finding:
    return Finding(subject, what, first, last, float(times[first]), _end(times, last), why)


def _end(times: NDArray[np.float64], last: int) -> float:
    """Return the time of the next frame, s, or a median step later."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    following = float(times[last + 1]) if last + 1 < len(times) else np.inf
    return min(following, float(times[last]) + max(step, 0.0))


def _joined_axes(parts: Sequence[Finding]) -> list[Finding]:
    """Join the findings of axes with the same problem in the same frames."""

    def same(one: Finding) -> tuple[str, int, int, str]:
        return one.what, one.first, one.last, one.why if one.what == "not determined" else ""

    found = []
    for _, group in groupby(sorted(parts, key=lambda one: (same(one), AXES.index(one.subject))), same):
        members = list(group)
        why = ", ".join(dict.fromkeys(one.why for one in members))
        found.append(replace(members[0], subject=_listed([one.subject for one in members]), why=why))
    return found


def _frequent(rows: Sequence[ExtrinsicsRow]) -> str:
    """Return the reasons of whole frames that hold in a fifth of them or more, in words."""
    counts = Counter(name for row in rows for name in row.reason_names if name in _WHOLE_FRAME)
    frequent = [name for name, count in counts.most_common() if count >= 0.2 * len(rows)]
    return ", ".join(_WORDS[name] for name in frequent)


def _unseen_why(rows: Iterable[ExtrinsicsRow]) -> str:
    """Return why an axis was not seen in most of the frames, in words."""
    named = [next((name for name in _UNSEEN if name in row.reason_names), None) for row in rows]
    counts = Counter(name for name in named if name)
    return _WORDS[counts.most_common(1)[0][0]] if counts else ""


def _precision(rows: Sequence[ExtrinsicsRow], states: NDArray[np.int64]) -> str:
    """Return the median of ±2σ over the frames that measure an axis."""
    std = estimate_stds(rows)
    parts = [
        f"{name} ±{with_unit(name, 2 * float(np.median(std[states[:, axis] <= AxisState.UNCERTAIN, axis])))}"
        for axis, name in enumerate(AXES)
        if (states[:, axis] <= AxisState.UNCERTAIN).any()
    ]
    return f"Typical uncertainty (2σ): {', '.join(parts)}." if parts else ""


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _images(count: int) -> str:
    return "image" if count == 1 else "images"
