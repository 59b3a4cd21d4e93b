"""The calibrators on the drives of ``tools/random_drives.py``.

Every seed is another drive, a row of one batch. The seeds are none that a test or a replay uses.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import HILLY_ROADS
from lanebev.estimation.joint.filter.update import UNSEEN
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.testing.evaluation import WARM_UP, Track, recovery, summarise, within_3_sigma
from lanebev.testing.moments import FPS
from tools.known_road import KnownRoad
from tools.random_drives import CONSTANT_BENDS, CREST, HILLS, IN_CURVE, KINDS, TURN, WINDING
from tools.replay.figures import as_track
from tools.replay.recording import Recording, record, replay

FIRST_SEED = 20_000
ALLOWED = 15
"""Frames after a shock that ratio and NEES leave out: so long it may take to come back."""

_GIVEN = ", speed given"
_TOLD = ", speed and road given"
_HILLY = ", HILLY_ROADS"

_NOT_TWO_STAGE = (  # kinds of the joint calibrator that show nothing new of this one
    "resumed",
    WINDING,
    TURN,
    "three lanes in view",
    "three lanes in view, unequal by 2 cm",
    *(f"{kind}, ego lane" for kind in ("motion up to 2.5°, 1.5 Hz", "drop", "knock", "cut", "resumed")),
    *(f"{kind}, ego lane, roll drawn" for kind in (IN_CURVE, "drop")),
)


class KindFigures(NamedTuple):
    """Statistics of all drives of a kind.

    Attributes:
        ratio: RMSE of pitch, yaw, roll and height by the per-frame bound; NaN where there is none.
        rmse: of pitch, yaw, roll (°) and height (cm).
        nees: NEES per degree of freedom of the whole pose.
        nees_seen: the same of what a single frame determines. These leave out the first half second, and
            ``ALLOWED`` frames after a shock.
        within: share within 3 sigma in the second in which it is lowest, all drives together.
        back: frames after the shock until all errors are below twice the bound, of every drive; inf if never.
    """

    ratio: tuple[float, ...]
    rmse: tuple[float, ...]
    nees: float
    nees_seen: float
    within: float
    back: tuple[float, ...]


def measure(kind: str, seeds: Sequence[int], calibrator: Calibrator[Any] | None = None) -> KindFigures:
    """Draw the drives of a kind, follow them, and compute the figures."""
    return figures_of(drawn(kind, seeds), calibrator or JointCalibrator())


def drawn(kind: str, seeds: Iterable[int]) -> list[Recording]:
    """Draw the drives of a kind; their speed is given if the name says so."""
    of_seed = (KINDS | CONSTANT_BENDS)[kind.removesuffix(_GIVEN)]
    return [record(replace(of_seed(seed), speed_given=kind.endswith(_GIVEN)), seed) for seed in seeds]


def figures_of(drives: Sequence[Recording], calibrator: Calibrator[Any]) -> KindFigures:
    """Follow drives of one kind, and compute the figures."""
    made = replay(calibrator, drives)
    each = [as_track(drive, made, row) for row, drive in enumerate(drives)]
    shock = each[0].hard
    after = torch.nn.functional.max_pool1d(
        torch.nn.functional.pad(shock.double()[None, None], (ALLOWED, 0)), ALLOWED + 1, 1
    )
    error, variance, nees, status, bound = (
        torch.cat(parts, dim=1) for parts in zip(*(track[:-1] for track in each), strict=True)
    )
    run = Track(error, variance, nees, status, bound, after.flatten() > 0)
    found = summarise(run)
    windows = within_3_sigma(run).unfold(0, round(FPS), 1).mean(-1)
    easy = (torch.arange(len(shock)) >= WARM_UP) & ~run.hard
    return KindFigures(
        ratio=tuple(found["ratio_to_bound"]),
        rmse=tuple(found["rmse"]),
        nees=found["nees_per_dof"],
        nees_seen=nees_of_determined(error[easy], made.covariance[easy], bound[easy]),
        within=float(windows.amin()),
        back=tuple(_frames(recovery(track, track.bounds[:, 0].sqrt())) for track in each if track.hard.any()),
    )


def nees_of_determined(error: Tensor, covariance: Tensor, bound: Tensor) -> float:
    """Compute the NEES per degree of freedom of the parameters that their frame determines.

    Args:
        error: (T, R, 4) rad and m.
        covariance: (T, R, 4, 4).
        bound: (T, R, 4), variances of the per-frame bound.
    """
    known = bound < bound.new_tensor(UNSEEN).square()
    both = known.unsqueeze(-1) & known.unsqueeze(-2)
    own = torch.where(both, covariance, torch.eye(4, dtype=covariance.dtype))
    left = torch.where(known, error, 0.0)
    return float((left * torch.linalg.solve(own, left)).sum() / known.sum())


def informed(kind: str) -> JointCalibrator:
    """Return the joint filter with what the name of a row says that it knows."""
    if kind.endswith(_TOLD):
        return KnownRoad(KINDS[IN_CURVE](FIRST_SEED).moments(), speed=30.0)
    return JointCalibrator(HILLY_ROADS if kind.endswith(_HILLY) else None)


def measure_all(count: int) -> dict[str, dict[str, Any]]:
    """Measure the joint filter on so many drives of every kind, print a row of each, and return them."""
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    print(
        "| kind | × bound: pitch yaw roll height | NEES/dof | NEES/dof, observed axes "
        "| within 3 σ, worst second | frames until recovered |"
    )
    print("|---|---|---|---|---|---|")
    results = {}
    others = (f"{kind}{what}" for kind in KINDS if kind.startswith(IN_CURVE) for what in (_GIVEN, _TOLD))
    for kind in (
        *KINDS,
        *others,
        f"{WINDING}{_GIVEN}",
        f"{TURN}{_GIVEN}",
        f"{CREST}{_HILLY}",
        f"{HILLS}{_HILLY}",
    ):
        found = measure(kind.removesuffix(_TOLD).removesuffix(_HILLY), seeds, informed(kind))
        ratio = " ".join("–" if math.isnan(value) else f"{value:.2f}" for value in found.ratio)
        back = f"{min(found.back):.0f} to {max(found.back):.0f}" if found.back else ""
        nees = f"{found.nees:.2f} | {found.nees_seen:.2f}"
        print(f"| {kind} | {ratio} | {nees} | {100 * found.within:.0f} % | {back} |", flush=True)
        results[kind] = found._asdict()
    return results


def measure_two_stage(count: int) -> dict[str, dict[str, Any]]:
    """Measure the paper's calibrator likewise, also with the covariance of its filters alone."""
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    print(
        "| kind | RMSE pitch, yaw, roll °, height cm | NEES/dof | within 3 σ, worst second "
        "| filters alone: NEES/dof | within 3 σ, worst second |"
    )
    print("|---|---|---|---|---|---|")
    results = {}
    for kind in (*(kind for kind in KINDS if kind not in _NOT_TWO_STAGE), *CONSTANT_BENDS):
        drives = [drive._replace(moments=()) for drive in drawn(kind, seeds)]  # without the bound
        found = figures_of(drives, TwoStageCalibrator())
        alone = figures_of(drives, TwoStageCalibrator(departures=False))
        rmse = " ".join(f"{value:.3f}" for value in found.rmse)
        two = " | ".join(f"{each.nees:.2f} | {100 * each.within:.0f} %" for each in (found, alone))
        print(f"| {kind} | {rmse} | {two} |", flush=True)
        results[kind] = {**found._asdict(), "filters_alone": alone._asdict()}
    return results


def _frames(seconds: float | None) -> float:
    return math.inf if seconds is None else round(seconds * FPS)
