"""The kinds of drive of a replay, and the generated drives."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from lanebev.camera.model import Camera
from lanebev.testing.moments import PLACES, Change, Moment, moments, table1_pose
from lanebev.testing.motions import (
    MOUNT,
    Motion,
    Pose,
    fall,
    landing_time,
    moved,
    share_done,
    sinusoids,
    suspension,
)
from lanebev.testing.scenarios import SCENARIOS
from lanebev.testing.streets import wandering

FRAMES = 120
"""Of every drive, so that all of them are rows of one batch."""


@dataclass(frozen=True)
class Generated:
    """A drive with known truth, drawn with a seed.

    Attributes:
        kind: what is difficult about it, for several drives.
        moments: the truth of every frame; called once.
        camera: the lens; None is the ideal camera of :mod:`lanebev.testing.moments`.
        resumed: the drive whose last state is the first one here; None begins anew.
        mount: also run the mount estimator.
        speed_given: also give the calibrator the vehicle's speed.
    """

    kind: str
    moments: Callable[[], list[Moment]]
    camera: Camera | None = None
    resumed: Callable[[], list[Moment]] | None = None
    mount: bool = False
    speed_given: bool = False


def _degrees(pitch: float, yaw: float, roll: float, height: float) -> Pose:
    """Convert differences in degrees and m to a pose."""
    return math.radians(pitch), math.radians(yaw), math.radians(roll), height


EGO_LANE = (2, 3)
KNOCK = _degrees(3.0, -2.0, 3.0, -0.25)  # a knocked camera: 3° and 25 cm in 0.1 s, for good
REMOUNT = _degrees(3.0, -4.0, 3.0, 0.2)
TRUCK = _degrees(-3.0, 3.0, -2.0, 0.9)  # the camera of another vehicle
SHOCK = 1.5  # s, when a knock comes
_BEFORE_TURN = 15.0  # m, from the first frame to the clothoid into a turn
_LARGEST_TURN = 1.0  # rad, up to which a boundary is seen
_CUT_AT, _MOVED_AT = 2.0, 20.0  # s


def _drive(
    change: Change | None = None,
    motion: Motion = table1_pose,
    fps: float = 30.0,
    start: float = 0.0,
) -> Callable[[], list[Moment]]:
    return lambda: moments(FRAMES / fps, change, motion, fps, start)


def _scenario(name: str, fps: float = 30.0, start: float = 0.0) -> Callable[[], list[Moment]]:
    """Return a part of a drive of :data:`lanebev.testing.scenarios.SCENARIOS`."""
    return _drive(SCENARIOS[name][1], fps=fps, start=start)


def in_curve(seed: int) -> Callable[[], list[Moment]]:
    """Return a road from straight through a clothoid to R = 300 m and half out of it, from 75 to 195 m."""
    return _drive(SCENARIOS["curves R 300 m, 5-40 m"][1], sinusoids(seed), start=2.0)


def _only(visible: tuple[int, ...], moment: Moment) -> Moment:
    return replace(moment, visible=visible)


def _hill(t: float, moment: Moment) -> Moment:
    return replace(moment, near=5.0, far=40.0, profile=1e-4 * math.cos(t))


def winding(speed: float, sharpest: float, waves: Sequence[tuple[float, float, float]]) -> Change:
    """Drive along a road whose curvature is a sum of sinusoids, seen from 5 to 40 m.

    Args:
        speed: m/s.
        sharpest: radius where all sinusoids are at their crest, m.
        waves: wavelength in m, phase in turns and relative amplitude of each.
    """
    size = 1 / (sharpest * sum(part for *_, part in waves))

    def change(t: float, moment: Moment) -> Moment:
        def curvature(z: torch.Tensor) -> torch.Tensor:
            way = z + speed * t
            each = [part * (2 * math.pi * (way / length + at)).sin() for length, at, part in waves]
            return size * torch.stack(each).sum(0)

        return replace(moment, near=5.0, far=40.0, speed=speed, curvature=curvature)

    return change


def turn(speed: float, radius: float, transition: float, arc: float, visible: tuple[int, ...]) -> Change:
    """Drive from a straight road through a turn into another straight road, seen from 4 to 30 m.

    No boundary is seen farther than where it has turned by a radian, so that none is hidden or comes back.

    Args:
        speed: m/s.
        radius: m, positive to the right.
        transition: m, length of the clothoids into the turn and out of it.
        arc: m, length of the turn between them.
        visible: boundaries in sight.
    """
    widest = max(0.0, *(float(PLACES[k]) * math.copysign(1.0, radius) for k in visible)) + 1.0  # m, inside

    def change(t: float, moment: Moment) -> Moment:
        start = _BEFORE_TURN - speed * t

        def curvature(z: torch.Tensor) -> torch.Tensor:
            into, out = (((z - start - at) / transition).clamp(0, 1) for at in (0.0, transition + arc))
            return (into - out) / radius

        along = torch.arange(0.0, 60.0, 0.1, dtype=torch.float64)
        heading = torch.cumulative_trapezoid(curvature(along), dx=0.1)
        ahead = torch.cumulative_trapezoid(heading.cos(), dx=0.1)[heading[1:].abs() < _LARGEST_TURN]
        turned = len(ahead) < len(heading) - 1
        far = float(ahead[-1]) - (widest * math.sin(_LARGEST_TURN) if turned else 0.0)
        return replace(
            moment, near=4.0, far=min(30.0, max(7.0, far)), visible=visible, speed=speed, curvature=curvature
        )

    return change


def bend(radius: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return the curvature of a bend of constant radius (m), 1/m, as a function of Z."""
    return lambda z: torch.full_like(z, 1 / radius)


def changing_crossfall(by: float, start: float, length: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return the crossfall less that at the camera, as a function of Z.

    Args:
        by: change of the crossfall, positive down to the right.
        start: Z at which it begins to change, m.
        length: of the road on which it changes, linearly, m.
    """

    def crossfall(z: torch.Tensor) -> torch.Tensor:
        return by * ((z - start) / length).clamp(0, 1)

    at_camera = float(crossfall(torch.zeros(())))
    return lambda z: crossfall(z) - at_camera


def _banked(t: float, moment: Moment) -> Moment:
    """Drive at 20 m/s over 40 m in which the crossfall changes by 5 %, seen from 5 to 40 m."""
    return replace(moment, near=5.0, far=40.0, crossfall=changing_crossfall(0.05, 30.0 - 20.0 * t, 40.0))


_WINDING = winding(5.0, 250.0, [(300.0, 0.0, 1.0)])


def drop(t: float, moment: Moment) -> Moment:
    """Fall 1.2 m onto the wheels from the first frame on."""
    tag = "falling" if t < landing_time() else ""
    return replace(moment, pose=moved(moment.pose, fall(t)), tag=tag)


def knock(by: Pose) -> Change:
    """Turn and move the camera by a pose in 0.1 s, for good."""

    def change(t: float, moment: Moment) -> Moment:
        share = share_done(t, SHOCK, 0.1)
        return replace(moment, pose=moved(moment.pose, by, share), tag="knock" if 0 < share < 1 else "")

    return change


def _cut(t: float, moment: Moment) -> Moment:
    """Cut to another vehicle's camera on another road, nearer to the left boundary."""
    if t < _CUT_AT:
        return moment
    tag = "cut" if t < _CUT_AT + 0.02 else ""
    return replace(moment, pose=moved(moment.pose, TRUCK), offset=moment.offset + 0.8, tag=tag)


def _truck(t: float, moment: Moment) -> Moment:
    return replace(moment, pose=moved(moment.pose, TRUCK), offset=-0.6, curvature=bend(400), far=40.0)


def _unequal(t: float, moment: Moment) -> Moment:
    """Make a lane half a metre narrower than its neighbours, as in towns."""
    return replace(moment, places=PLACES + torch.tensor([0.1, 0.0, 0.25, -0.25, 0.0, -0.1]).double())


def _two_then_more(t: float, moment: Moment) -> Moment:
    """Show two unequal lanes for 2 s, then their neighbours too."""
    return _only((2, 3, 4) if t < 1.99 else (1, 2, 3, 4, 5), _unequal(t, moment))


_WANDERING = wandering(7, 0.1)


def _along_street(t: float, moment: Moment) -> Moment:
    """Drive at 8 m/s along a street whose boundaries each wander by 10 cm; four of them are in view."""
    there = replace(moment, near=4.0, far=30.0, visible=(1, 2, 3, 4))
    return replace(there, wander=lambda z: _WANDERING(z + 8.0 * t))


def _in_street(t: float, moment: Moment) -> Moment:
    """Stand in the same street: nothing but the noise changes."""
    return _along_street(0.0, replace(moment, pose=MOUNT, offset=-0.4))


def _nothing(first: float, last: float) -> Change:
    def change(t: float, moment: Moment) -> Moment:
        gone = first <= t < last
        return replace(moment, visible=() if gone else moment.visible, tag="gap" if gone else "")

    return change


def _stuck(t: float, moment: Moment) -> Moment:
    """Stop the clock from 1 s to 2 s; then it is right again."""
    if not 1.0 <= t < 2.0:
        return replace(moment, dt=1.0 + 1 / 30 if round(30 * t) == 60 else moment.dt)
    return replace(moment, dt=0.0, tag="stuck")


def _not_positive(t: float, moment: Moment) -> Moment:
    """Give no frame after 1 s a later time than the one before: 0 and -1/30 s by turns."""
    if t < 1.0:
        return moment
    return replace(moment, dt=-1 / 30 if round(30 * t) % 2 else 0.0)


def _remount(t: float, moment: Moment) -> Moment:
    tag = "moved" if _MOVED_AT <= t < _MOVED_AT + 0.3 else ""
    return replace(moment, pose=moved(moment.pose, REMOUNT, float(t >= _MOVED_AT)), tag=tag)


def _in_ego_lane(change: Change) -> Change:
    return lambda t, moment: _only(EGO_LANE, change(t, moment))


def _lens(distortion: tuple[float, ...], model: str = "pinhole", focal: float = 1050.0) -> Camera:
    return Camera.from_parameters(focal, focal, 959.5, 509.5, 1920, 1020, distortion, model)


_RADIAL = (-0.30, 0.12, 0.0006, -0.0004, -0.02)
_RATIONAL = (0.42, 0.11, 0.0003, -0.0002, 0.004, 0.80, 0.24, 0.021)
_PRISM = (*_RADIAL, 0.0, 0.0, 0.0, 0.001, -0.0004, -0.0008, 0.0003)

GENERATED: dict[str, Generated] = {
    "straight": Generated("straight", _drive()),
    # Pitch, yaw and roll are sums of three sinusoids up to 1.2 Hz and 1.5° in all.
    "strong-motion-1": Generated("strong motion", _drive(motion=sinusoids(1))),
    "strong-motion-2": Generated("strong motion", _drive(motion=sinusoids(2))),
    "strong-motion-3": Generated("strong motion", _drive(motion=sinusoids(3))),
    "curve-1": Generated("strong motion in a curve", in_curve(4)),
    "curve-2": Generated("strong motion in a curve", in_curve(5)),
    "suspension": Generated("suspension", _drive(motion=suspension(6, 4.0))),
    # R = 60 m at 15 m/s, boundaries 1, 2, 3 in sight, 45 to 105 m.
    "sharp-bends": Generated("sharp bends", _scenario("sharp bends R 60 m, three boundaries", start=3.0)),
    # R = 25 m at 7 m/s, boundaries 1 to 4 in sight.
    "turn": Generated("turn", _drive(turn(7.0, 25.0, 12.0, 15.0, (1, 2, 3, 4)), sinusoids(9, 1.0), fps=20.0)),
    "winding-road": Generated("winding road", _drive(_WINDING, sinusoids(8))),
    "winding-road-speed-given": Generated("speed given", _drive(_WINDING, sinusoids(8)), speed_given=True),
    "crest": Generated("crest", _scenario("crest R 10 km, 5-40 m")),
    # From a crest into a dip of R = 10 km.
    "crest-and-dip": Generated("crest", _drive(_hill)),
    "crossfall": Generated("crossfall", _drive(_banked)),
    "drop": Generated("drop", _drive(drop)),
    "drop-ego-lane": Generated("drop", _drive(_in_ego_lane(drop))),
    "knock": Generated("knock", _drive(knock(KNOCK))),
    "knock-ego-lane": Generated("knock", _drive(_in_ego_lane(knock(KNOCK)))),
    "cut": Generated("cut", _drive(_cut)),
    "cut-ego-lane": Generated("cut", _drive(_in_ego_lane(_cut))),
    # With the state of another vehicle's camera in a bend.
    "resumed": Generated("resumed", _drive(), resumed=lambda: moments(2.0, _truck)),
    "resumed-ego-lane": Generated(
        "resumed", _drive(lambda t, m: _only(EGO_LANE, m)), resumed=lambda: moments(2.0, _truck)
    ),
    "ego-lane": Generated("ego lane", _drive(lambda t, m: _only(EGO_LANE, m))),
    "lane-change": Generated("lane change", _scenario("lane change", fps=20.0, start=1.0)),
    "outliers": Generated("outliers", _scenario("50 % outliers, 5 % wrong index")),
    "wrong-boundaries": Generated("outliers", _scenario("wrong boundaries")),
    "misnumbered": Generated("outliers", _scenario("whole frames misnumbered")),
    "unequal-lanes": Generated("unequal lanes", _scenario("unequal lanes")),
    "narrow-lane": Generated("unequal lanes", _drive(_unequal)),
    "two-unequal-lanes": Generated(
        "unequal lanes", _drive(lambda t, m: _only((2, 3, 4), replace(_unequal(t, m), tag="")))
    ),
    "two-lanes-then-four": Generated("unequal lanes", _drive(_two_then_more)),
    "street": Generated("street", _drive(_along_street)),
    "street-standing": Generated("street", _drive(_in_street)),
    "gap-2-s": Generated("gap", _drive(_nothing(1.0, 3.0))),
    "gap-6-s": Generated("gap", _drive(_nothing(1.5, 7.5), fps=12.0)),
    "clock-irregular": Generated("clock", _scenario("bad clock")),
    "clock-stuck": Generated("clock", _drive(_stuck)),
    "clock-not-positive": Generated("clock", _drive(_not_positive)),
    # The camera is mounted anew after 20 s; three frames a second, for the mount needs 20 s of blocks.
    "remount": Generated("remount", _drive(_remount, fps=3.0), mount=True),
    "remount-ego-lane": Generated("remount", _drive(_in_ego_lane(_remount), fps=3.0), mount=True),
    "lens-radial": Generated("lens: pinhole, radial", _drive(), _lens(_RADIAL)),
    "lens-rational": Generated("lens: pinhole, rational", _drive(), _lens(_RATIONAL)),
    "lens-thin-prism": Generated("lens: pinhole, thin prism", _drive(), _lens(_PRISM)),
    "lens-tilted": Generated("lens: pinhole, tilted", _drive(), _lens((*_PRISM, 0.03, -0.02))),
    "lens-fisheye": Generated(
        "lens: fisheye", _drive(), _lens((-0.012, 0.004, -0.003, 0.0005), "fisheye", 620.0)
    ),
    "lens-omni": Generated(
        "lens: omni", _drive(), _lens((1.2, -0.08, 0.02, 0.0003, -0.0002), "omni", 1500.0)
    ),
}
"""By name, which is also that of the reference files."""
