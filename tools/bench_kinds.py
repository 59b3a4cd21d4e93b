"""The joint filter on drives whose motions and shocks are drawn at random from stated families.

Every seed is another drive, a row of one batch. The seeds are none that a test or a replay uses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from random import Random
from statistics import NormalDist
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.dynamics import MotionConfig
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.joint.state import HILLY_ROADS
from lanebev.estimation.joint.update import UNSEEN
from lanebev.testing.evaluation import WARM_UP, Track, recovery, summarise, within_3_sigma
from lanebev.testing.moments import FPS, PLACES, Moment, moments
from lanebev.testing.motions import Pose, fall, landing_time, moved, sinusoids
from lanebev.testing.scenarios import SCENARIOS
from lanebev.testing.streets import wandering
from tools.replay.figures import as_track
from tools.replay.kinds import EGO_LANE, FRAMES, Generated
from tools.replay.recording import record, replay
from tools.told_road import ToldRoad

FIRST_SEED = 20_000
SHOCK = 1.5
"""s, when a knock or a cut comes."""

ALLOWED = 15
"""Frames after a shock that ratio and NEES leave out: so long it may take to come back."""

_IN_CURVE = "motion up to 1.5°, 1.2 Hz, R 300 m"
_CREST = "crest or dip, R 5 to 20 km"
_HILLS = "crests and dips in turn"
_GIVEN = ", speed given"
_TOLD = ", speed and road given"
_HILLY = ", HILLY_ROADS"

Change = Callable[[float, Moment], Moment]


class KindFigures(NamedTuple):
    """Of all drives of a kind.

    Attributes:
        ratio: RMSE of pitch, yaw, roll and height by the per-frame bound; NaN where there is none.
        nees: NEES per degree of freedom of the whole pose.
        nees_seen: the same of what a single frame determines. These leave out the first half second, and
            ``ALLOWED`` frames after a shock.
        within: share within 3 sigma in the second in which it is lowest, all drives together.
        back: frames after the shock until all errors are below twice the bound, of every drive; inf if never.
    """

    ratio: tuple[float, ...]
    nees: float
    nees_seen: float
    within: float
    back: tuple[float, ...]


def measure(kind: str, seeds: Sequence[int], calibrator: JointCalibrator | None = None) -> KindFigures:
    """Draw the drives of a kind, follow them, and compute the figures."""
    drives = [record(KINDS[kind](seed), seed) for seed in seeds]
    made = replay(calibrator or JointCalibrator(), drives)
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


def speed_given() -> JointCalibrator:
    """Return the joint filter with the speed of the drives in bends as prior, to 0.5 m/s."""
    return JointCalibrator(motion=MotionConfig(speed=30.0, speed_std=0.5))


def informed(kind: str) -> JointCalibrator:
    """Return the joint filter with the priors that the name of a row says are given."""
    if kind.endswith(_TOLD):
        return ToldRoad(KINDS[_IN_CURVE](FIRST_SEED).moments(), speed=30.0)
    if kind.endswith(_GIVEN):
        return speed_given()
    return JointCalibrator(HILLY_ROADS if kind.endswith(_HILLY) else None)


def measure_all(count: int) -> dict[str, dict[str, Any]]:
    """Measure every kind on so many drives, print a row of each, and return them for JSON."""
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    print(
        "| kind | × bound: pitch yaw roll height | NEES/dof | of what is seen | within 3 σ, worst second "
        "| frames until back |"
    )
    print("|---|---|---|---|---|---|")
    results = {}
    others = (f"{kind}{what}" for kind in KINDS if kind.startswith(_IN_CURVE) for what in (_GIVEN, _TOLD))
    for kind in (*KINDS, *others, f"{_CREST}{_HILLY}", f"{_HILLS}{_HILLY}"):
        found = measure(
            kind.removesuffix(_GIVEN).removesuffix(_TOLD).removesuffix(_HILLY), seeds, informed(kind)
        )
        ratio = " ".join("–" if math.isnan(value) else f"{value:.2f}" for value in found.ratio)
        back = f"{min(found.back):.0f} to {max(found.back):.0f}" if found.back else ""
        nees = f"{found.nees:.2f} | {found.nees_seen:.2f}"
        print(f"| {kind} | {ratio} | {nees} | {100 * found.within:.0f} % | {back} |", flush=True)
        results[kind] = found._asdict()
    return results


def _frames(seconds: float | None) -> float:
    return math.inf if seconds is None else round(seconds * FPS)


def _drawn(
    seed: int, change: Change | None = None, largest_deg: float = 1.5, highest_hz: float = 1.2
) -> Generated:
    """Draw a drive whose pitch, yaw and roll are sums of three sinusoids."""
    motion = sinusoids(seed, largest_deg, highest_hz=highest_hz)
    return Generated("", lambda: moments(FRAMES / FPS, change, motion))


def _curve(seed: int) -> Generated:
    """Draw the same motion from the straight through a clothoid into R = 300 m and half out of it."""
    change = SCENARIOS["curves R 300 m, 5-40 m"][1]
    return Generated("", lambda: moments(FRAMES / FPS, change, sinusoids(seed), start=2.0))


def difference(seed: int, degrees: float, metres: float) -> Pose:
    """Draw a change of the pose of that size in every axis, the signs at random."""
    random = Random(seed)
    size = (math.radians(degrees),) * 3 + (metres,)
    pitch, yaw, roll, height = (random.choice((-1.0, 1.0)) * value for value in size)
    return pitch, yaw, roll, height


def _drop(seed: int) -> Generated:
    """Fall 1.2 m onto the wheels from the first frame on."""

    def change(t: float, moment: Moment) -> Moment:
        tag = "falling" if t < landing_time() else ""
        return replace(moment, pose=moved(moment.pose, fall(t)), tag=tag)

    return _drawn(seed, change)


def _knock(seed: int) -> Generated:
    """Knock the camera by 3° and 25 cm in 0.1 s, for good."""
    by = difference(seed, 3.0, 0.25)

    def change(t: float, moment: Moment) -> Moment:
        share = min(max((t - SHOCK) / 0.1, 0.0), 1.0)
        return replace(moment, pose=moved(moment.pose, by, share), tag="knock" if 0 < share < 1 else "")

    return _drawn(seed, change)


def _other_vehicle(seed: int, moment: Moment) -> Moment:
    random = Random(seed)
    pitch, yaw, roll, _ = difference(seed, random.uniform(1.0, 4.0), 0.0)
    by = (pitch, yaw, roll, random.uniform(-0.3, 1.2))
    return replace(moment, pose=moved(moment.pose, by), offset=moment.offset + random.uniform(-1.0, 1.0))


def _cut(seed: int) -> Generated:
    """Cut to another vehicle's camera, 1 to 4° and -0.3 to 1.2 m away, up to a metre beside."""

    def change(t: float, moment: Moment) -> Moment:
        if t < SHOCK:
            return moment
        return replace(_other_vehicle(seed, moment), tag="cut" if t < SHOCK + 0.5 / FPS else "")

    return _drawn(seed, change)


def _resumed(seed: int) -> Generated:
    """Resume with the state of another vehicle's camera in a bend of R = 400 m."""

    def bend(z: torch.Tensor) -> torch.Tensor:
        return torch.full_like(z, 1 / 400)

    def before(t: float, moment: Moment) -> Moment:
        return replace(_other_vehicle(seed, moment), curvature=bend, far=40.0)

    def change(t: float, moment: Moment) -> Moment:
        return replace(moment, tag="resumed" if t == 0 else "")

    return replace(_drawn(seed, change), resumed=lambda: moments(1.0, before))


def _crest(seed: int) -> Generated:
    """Drive over a crest or through a dip of R = 5 to 20 km, seen from 5 to 40 m."""
    random = Random(seed)
    vertical = random.choice((-1.0, 1.0)) / random.uniform(5e3, 20e3)
    return _drawn(seed, lambda t, moment: replace(moment, near=5.0, far=40.0, profile=vertical))


def _hills(seed: int) -> Generated:
    """Drive over crests and through dips in turn, of R = 5 to 20 km at the sharpest, one in 3 to 8 s."""
    random = Random(seed)
    sharpest, duration = 1 / random.uniform(5e3, 20e3), random.uniform(3.0, 8.0)
    first = random.uniform(0.0, 2 * math.pi)

    def change(t: float, moment: Moment) -> Moment:
        vertical = sharpest * math.sin(first + math.pi * t / duration)
        return replace(moment, near=5.0, far=40.0, profile=vertical)

    return _drawn(seed, change)


def _unequal(seed: int, std: float) -> Generated:
    """Put every boundary out of its place for good, independently, by a normal deviate."""
    random = Random(seed)
    out = torch.tensor([random.gauss(0.0, std) for _ in PLACES], dtype=PLACES.dtype)
    return _drawn(seed, lambda t, moment: replace(moment, places=PLACES + out))


def _street(seed: int, std: float, speed: float) -> Generated:
    """Drive along a street, three to five boundaries in view from 4 to 30 m, each of which wanders by itself.

    The camera is mounted at up to some degrees of pitch and roll, and moves by 0.4°.
    """
    random = Random(seed)
    visible = random.choice(((1, 2, 3), (2, 3, 4), (1, 2, 3, 4), (0, 1, 2, 3), (1, 2, 3, 4, 5)))
    mount = (math.radians(random.gauss(0.0, 1.0)), 0.0, math.radians(random.gauss(0.0, 1.0)), 0.0)
    aside = wandering(seed, std)

    def change(t: float, moment: Moment) -> Moment:
        there = replace(moment, near=4.0, far=30.0, visible=visible, pose=moved(moment.pose, mount))
        return replace(there, wander=lambda z: aside(z + speed * t))

    return _drawn(seed, change, largest_deg=0.4)


def _two_lanes(seed: int, std: float) -> Generated:
    """Leave two lanes in view, which the same pose fits whether they are equal or not."""
    drive = _unequal(seed, std)
    return replace(drive, moments=lambda: [replace(one, visible=(1, 2, 3)) for one in drive.moments()])


def _kerb(seed: int) -> Generated:
    """Leave the ego lane in view; a second later a line joins it, 0.5 to 1.8 m from where a lane ends."""
    random = Random(seed)
    places = PLACES.clone()
    places[4] += random.choice((-1, 1)) * random.uniform(0.5, 1.8)
    return _drawn(
        seed, lambda t, moment: replace(moment, places=places, visible=(2, 3) if t < 1 else (2, 3, 4))
    )


def mounted_roll(seed: int) -> float:
    """Draw the roll of a mount, rad, normal with the standard deviation of the estimator's prior.

    Seeds in a row give quantiles spread evenly (Weyl's sequence), so that a few are like many.
    """
    share = (seed * 0.6180339887498949) % 1.0
    return NormalDist(0.0, FramePrior().roll_std).inv_cdf(min(max(share, 0.01), 0.99))


def in_ego_lane(drive: Generated, roll: float = 0.0) -> Generated:
    """Leave only the ego lane in view, of a camera that is mounted with a roll (rad), which is not seen."""

    def only(moment: Moment) -> Moment:
        return replace(moment, visible=EGO_LANE, pose=moved(moment.pose, (0.0, 0.0, roll, 0.0)))

    return replace(drive, moments=lambda: [only(moment) for moment in drive.moments()])


_ALL_LANES: dict[str, Callable[[int], Generated]] = {
    "motion up to 1.5°, 1.2 Hz": _drawn,
    "motion up to 2.5°, 1.5 Hz": partial(_drawn, largest_deg=2.5, highest_hz=1.5),
    _IN_CURVE: _curve,
    "drop": _drop,
    "knock": _knock,
    "cut": _cut,
    "resumed": _resumed,
}


def _ego_lane_of(kind: str, seed: int) -> Generated:
    return in_ego_lane(_ALL_LANES[kind](seed))


def _rolled_ego_lane_of(kind: str, seed: int) -> Generated:
    return in_ego_lane(_ALL_LANES[kind](seed), mounted_roll(seed))


KINDS: dict[str, Callable[[int], Generated]] = {
    **_ALL_LANES,
    _CREST: _crest,
    _HILLS: _hills,
    "lanes unequal by 2 cm": partial(_unequal, std=0.02),
    "lanes unequal by 10 cm": partial(_unequal, std=0.1),
    "two lanes in view": partial(_two_lanes, std=0.0),
    **{
        f"two lanes in view, unequal by {size} cm": partial(_two_lanes, std=size / 100) for size in (2, 5, 10)
    },
    "a kerb beside the ego lane": _kerb,
    **{
        f"{kind}, boundaries wander by {size} cm": partial(_street, std=size / 100, speed=speed)
        for kind, speed in (("street at 8 m/s", 8.0), ("standing in a street", 0.0))
        for size in (5, 15)
    },
    **{f"{kind}, ego lane": partial(_ego_lane_of, kind) for kind in _ALL_LANES},
    **{
        f"{kind}, ego lane, roll drawn": partial(_rolled_ego_lane_of, kind)
        for kind in ("motion up to 1.5°, 1.2 Hz", _IN_CURVE, "drop")
    },
}
"""A drive of each kind by its seed."""
