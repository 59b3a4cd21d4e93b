"""Drives whose motions and shocks are drawn at random, of each kind one by its seed."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from random import Random
from statistics import NormalDist

import torch
from torch import Tensor

from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.testing.moments import FPS, PLACES, Change, Moment, moments
from lanebev.testing.motions import Pose, moved, sinusoids
from lanebev.testing.streets import wandering
from tools.replay.kinds import (
    EGO_LANE,
    FRAMES,
    SHOCK,
    Generated,
    bend,
    changing_crossfall,
    drop,
    in_curve,
    knock,
    turn,
    winding,
)

IN_CURVE = "motion up to 1.5°, 1.2 Hz, R 300 m"
WINDING = "winding road at 3 to 12 m/s"
TURN = "turn of R 15 to 60 m at 4 to 10 m/s"
CREST = "crest or dip, R 5 to 20 km"
HILLS = "crests and dips in turn"
NARROWING = "ego lane narrows by 0.4 to 0.8 m, nothing else in view"
CROWN = "crown, both sides fall by 1 to 3 %"
CROSSFALL = "crossfall changes by 2 to 6 %"


def _drawn(
    seed: int, change: Change | None = None, largest_deg: float = 1.5, highest_hz: float = 1.2
) -> Generated:
    """Draw a drive whose pitch, yaw and roll are sums of three sinusoids."""
    motion = sinusoids(seed, largest_deg, highest_hz=highest_hz)
    return Generated("", lambda: moments(FRAMES / FPS, change, motion))


def _curve(seed: int) -> Generated:
    """Draw the same motion from the straight through a clothoid into R = 300 m and half out of it."""
    return Generated("", in_curve(seed))


def _winding(seed: int) -> Generated:
    """Drive along a winding road, R = 150 to 800 m at the sharpest, seen from 5 to 40 m.

    Its curvature is a sum of two sinusoids of 200 to 600 m.
    """
    random = Random(seed)
    sharpest = random.uniform(150.0, 800.0)
    waves = [(random.uniform(200.0, 600.0), random.random(), 0.3 + random.random()) for _ in range(2)]
    speed = random.uniform(3.0, 12.0)
    return _drawn(seed, winding(speed, sharpest, waves))


def difference(seed: int, degrees: float, metres: float) -> Pose:
    """Draw a change of the pose of that size in every axis, the signs at random."""
    random = Random(seed)
    size = (math.radians(degrees),) * 3 + (metres,)
    pitch, yaw, roll, height = (random.choice((-1.0, 1.0)) * value for value in size)
    return pitch, yaw, roll, height


def _drop(seed: int) -> Generated:
    return _drawn(seed, drop)


def _knock(seed: int) -> Generated:
    """Knock the camera by 3° and 25 cm in 0.1 s, for good."""
    return _drawn(seed, knock(difference(seed, 3.0, 0.25)))


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

    def before(t: float, moment: Moment) -> Moment:
        return replace(_other_vehicle(seed, moment), curvature=bend(400), far=40.0)

    def change(t: float, moment: Moment) -> Moment:
        return replace(moment, tag="resumed" if t == 0 else "")

    return replace(_drawn(seed, change), resumed=lambda: moments(1.0, before))


def _turn(seed: int) -> Generated:
    """Drive through a turn of R = 15 to 60 m at 4 to 10 m/s, two to four boundaries in sight."""
    random = Random(seed)
    radius = math.exp(random.uniform(math.log(15.0), math.log(60.0)))
    speed = min(random.uniform(4.0, 10.0), 2 * math.sqrt(radius))  # 4 m/s² across at most
    transition, arc = random.uniform(0.3, 0.8) * radius, random.uniform(0.3, 1.0) * radius
    visible = random.choice(((2, 3), (1, 2, 3), (2, 3, 4), (1, 2, 3, 4)))
    change = turn(speed, random.choice((-1, 1)) * radius, transition, arc, visible)
    motion = sinusoids(seed, 1.0, largest_m=0.03)
    return Generated("", lambda: moments(2 * FRAMES / FPS, change, motion))


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


def _crossfall(seed: int) -> Generated:
    """Drive at 10 to 30 m/s over a change of the crossfall by 2 to 6 % in 30 to 80 m, seen from 5 to 40 m."""
    random = Random(seed)
    by = random.choice((-1.0, 1.0)) * random.uniform(0.02, 0.06)
    start, length, speed = random.uniform(20.0, 60.0), random.uniform(30.0, 80.0), random.uniform(10.0, 30.0)

    def change(t: float, moment: Moment) -> Moment:
        return replace(
            moment,
            near=5.0,
            far=40.0,
            speed=speed,
            crossfall=changing_crossfall(by, start - speed * t, length),
        )

    return _drawn(seed, change)


def _crown(seed: int) -> Generated:
    """Drive beside a crown, a line of the ego lane from which both sides fall by 1 to 3 %.

    Three to five boundaries are in view. A straight line that is lower by d appears as one of the ego lane's
    plane that is nearer to the camera by the factor h / (h + d).
    """
    random = Random(seed)
    fall, crown = random.uniform(0.01, 0.03), random.choice((2, 3))
    choices: tuple[tuple[int, ...], ...] = ((1, 2, 3), (1, 2, 3, 4), (0, 1, 2, 3), (0, 1, 2, 3, 4))
    visible = random.choice(choices)
    if crown == 3:
        visible = tuple(5 - number for number in reversed(visible))
    away = (PLACES - PLACES[crown]) * (1 if crown == 3 else -1)

    def change(t: float, moment: Moment) -> Moment:
        lower = 2 * fall * away.clamp(min=0.0)
        seen = (PLACES + moment.offset) * moment.pose[3] / (moment.pose[3] + lower) - moment.offset
        return replace(moment, places=seen, visible=visible)

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
        return replace(there, speed=speed, wander=lambda z: aside(z + speed * t))

    return _drawn(seed, change, largest_deg=0.4)


def _unequal_in_view(seed: int, std: float, visible: tuple[int, ...]) -> Generated:
    """Leave some boundaries in view; one pose fits three of them whether lanes are equal or not."""
    drive = _unequal(seed, std)
    return replace(drive, moments=lambda: [replace(one, visible=visible) for one in drive.moments()])


def _bend(seed: int, radius: float) -> Generated:
    """Drive in a bend of constant radius, seen from 5 to 40 m."""
    return _drawn(seed, lambda t, moment: replace(moment, near=5.0, far=40.0, curvature=bend(radius)))


def _narrowing(seed: int) -> Generated:
    """Drive at 12 to 30 m/s in a lane whose right line moves in by 0.4 to 0.8 m, within 0, 30 or 60 m."""
    random = Random(seed)
    by, length, speed = (
        random.uniform(0.4, 0.8),
        random.choice((1e-3, 30.0, 60.0)),
        random.uniform(12.0, 30.0),
    )
    start = random.uniform(4.0, 7.0) * speed
    moves = (torch.arange(6) > 2).unsqueeze(-1)

    def change(t: float, moment: Moment) -> Moment:
        def wander(z: Tensor) -> Tensor:
            return -by * moves * ((z + speed * t - start) / length).clamp(0.0, 1.0)

        return replace(moment, visible=EGO_LANE, near=5.0, far=40.0, speed=speed, wander=wander)

    motion = sinusoids(seed, 1.5, highest_hz=1.2)
    return Generated("", lambda: moments(3 * FRAMES / FPS, change, motion))


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
    IN_CURVE: _curve,
    "drop": _drop,
    "knock": _knock,
    "cut": _cut,
    "resumed": _resumed,
}


_STREETS: dict[str, Callable[[int], Generated]] = {
    f"{kind}, boundaries wander by {size} cm": partial(_street, std=size / 100, speed=speed)
    for kind, speed in (("street at 8 m/s", 8.0), ("standing in a street", 0.0))
    for size in (5, 15)
}


def _ego_lane_of(kind: str, seed: int) -> Generated:
    return in_ego_lane((_ALL_LANES | _STREETS)[kind](seed))


def _rolled_ego_lane_of(kind: str, seed: int) -> Generated:
    return in_ego_lane(_ALL_LANES[kind](seed), mounted_roll(seed))


KINDS: dict[str, Callable[[int], Generated]] = {
    **_ALL_LANES,
    WINDING: _winding,
    TURN: _turn,
    CREST: _crest,
    HILLS: _hills,
    CROSSFALL: _crossfall,
    CROWN: _crown,
    "lanes unequal by 2 cm": partial(_unequal, std=0.02),
    "lanes unequal by 10 cm": partial(_unequal, std=0.1),
    **{
        f"{number} lanes in view{f', unequal by {size} cm' if size else ''}": partial(
            _unequal_in_view, std=size / 100, visible=visible
        )
        for number, visible, sizes in (("two", (1, 2, 3), (0, 2, 5, 10)), ("three", (1, 2, 3, 4), (0, 2)))
        for size in sizes
    },
    "a kerb beside the ego lane": _kerb,
    NARROWING: _narrowing,
    **_STREETS,
    **{f"{kind}, ego lane": partial(_ego_lane_of, kind) for kind in _ALL_LANES | _STREETS},
    **{
        f"{kind}, ego lane, roll drawn": partial(_rolled_ego_lane_of, kind)
        for kind in ("motion up to 1.5°, 1.2 Hz", IN_CURVE, "drop")
    },
}
"""A drive of each kind by its seed."""

CONSTANT_BENDS: dict[str, Callable[[int], Generated]] = {
    f"constant bend, R {radius} m": partial(_bend, radius=float(radius)) for radius in (300, 1000, 3000)
}
"""For calibrators that do not estimate the curvature."""
