"""Drives that break the paper's assumptions one at a time, as changes of the standard drive."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from lanebev.testing.moments import FPS, PLACES, WIDTH, Change, Moment, table1_offset, table1_pose
from lanebev.testing.motions import share_done


def _clothoid(s: Tensor, radius: float, transition: float) -> Tensor:
    """Return the road's curvature, 1/m: 60 m straight, a right bend, 30 m straight, a left bend.

    Each bend is a clothoid, 60 m of an arc and a clothoid back.
    """
    ways = torch.tensor([60.0, transition, 60.0, transition, 30.0, transition, 60.0, transition])
    knots = ways.double().cumsum(0)
    values = torch.tensor([0.0, 1.0, 1.0, 0.0, 0.0, -1.0, -1.0, 0.0], dtype=torch.float64) / radius
    s = s.clamp(float(knots[0]), float(knots[-1]) - 1e-6)
    right = torch.searchsorted(knots, s.contiguous(), right=True).clamp(1, len(knots) - 1)
    share = (s - knots[right - 1]) / (knots[right] - knots[right - 1])
    return values[right - 1] + share * (values[right] - values[right - 1])


def _curves(t: float, moment: Moment) -> Moment:
    return replace(
        moment, near=5.0, far=40.0, speed=30.0, curvature=lambda z: _clothoid(z + 30.0 * t, 300.0, 60.0)
    )


def _sharp_bends(t: float, moment: Moment) -> Moment:
    """Return the loop of an exit, of whose boundaries a detector shows three."""
    shown = replace(moment, near=5.0, far=30.0, visible=(1, 2, 3))
    return replace(shown, curvature=lambda z: _clothoid(z + 15.0 * t, 60.0, 20.0))


def _lane_change(t: float, moment: Moment) -> Moment:
    done = share_done(t, 2.0, 4.0)
    moved = WIDTH * (done - math.sin(2 * math.pi * done) / (2 * math.pi))  # camera to the right
    crossed = moved > WIDTH / 2
    return replace(
        moment, offset=moment.offset - moved + WIDTH * crossed, tag="change" if 0 < done < 1 else ""
    )


def _bumps(t: float, moment: Moment) -> Moment:
    phase = (t % 2.0) - 1.0
    bump = math.radians(1.0) * math.sin(math.pi * phase / 0.2) if 0 <= phase < 0.2 else 0.0
    pitch, yaw, roll, height = moment.pose
    return replace(moment, pose=(pitch + bump, yaw, roll, height), tag="bump" if 0 <= phase < 0.3 else "")


def _brake(t: float, moment: Moment) -> Moment:
    dive = math.radians(1.5) * share_done(t, 3.0, 0.3) * (1 - share_done(t, 5.0, 0.3))
    pitch, yaw, roll, height = moment.pose
    return replace(moment, pose=(pitch + dive, yaw, roll, height))


def _exit(t: float, moment: Moment) -> Moment:
    away = share_done(t, 3.0, 3.0)
    headings, places = moment.headings.clone(), moment.places.clone()
    if 0 < away < 1:
        headings[5], places[5] = 0.06, places[5] + 3.0 * away
    return replace(moment, headings=headings, places=places, tag="exit" if 0 < away < 1 else "")


_UNEQUAL = torch.tensor([0.10, -0.08, 0.0, 0.05, -0.12, 0.15], dtype=torch.float64)
_ONE_LARGE = torch.tensor([0.04, 0.17, 0.02, -0.03, 0.05, 0.22], dtype=torch.float64)
_SLIGHT = torch.tensor([-0.01, 0.03, 0.02, -0.01, -0.03, 0.02], dtype=torch.float64)


def _only(visible: tuple[int, ...], first: float, last: float) -> Change:
    def change(t: float, moment: Moment) -> Moment:
        inside = first <= t < last
        return replace(moment, visible=visible if inside else moment.visible, tag="less" if inside else "")

    return change


def _garbage(t: float, moment: Moment) -> Moment:
    bad = t < 0.33 or 3.0 <= t < 3.5
    return replace(moment, outliers=1.0 if bad else 0.0, tag="bad" if bad else "")


def _clock(t: float, moment: Moment) -> Moment:
    """Repeat one frame in ten, send one late, one without a time, and drop one."""
    k = round(t * FPS)

    def at(frame: int) -> Moment:
        return Moment(table1_pose(frame / FPS), table1_offset(frame / FPS))

    ten, phase = k // 10 * 9, k % 10  # nine true frames in ten: one twice, one late, one missing
    true = ten + (0, 1, 2, 2, 3, 3, 4, 5, 6, 8)[phase]
    now = at(true)
    if phase == 3:
        return replace(now, dt=0.0)
    if phase == 5:
        return replace(now, dt=-2 / FPS, stale=at(true - 2))
    return replace(now, dt={6: 3 / FPS, 7: float("nan"), 9: 2 / FPS}.get(phase, 1 / FPS))


def _far_start(t: float, moment: Moment) -> Moment:
    pitch, yaw, roll, height = moment.pose
    return replace(
        moment, pose=(pitch + math.radians(7), yaw - math.radians(6), roll + math.radians(9), height + 0.7)
    )


def _wrong_class(t: float, moment: Moment) -> Moment:
    k = round(t * FPS)
    return replace(moment, shift=(0, 1, -1)[k % 40 // 13 if k % 13 == 5 else 0])


SCENARIOS: dict[str, tuple[float, Change | None]] = {
    "straight": (6.0, None),
    "straight 5-40 m": (6.0, lambda t, m: replace(m, near=5.0, far=40.0)),
    "sharp bends R 60 m, three boundaries": (20.0, _sharp_bends),
    "curves R 300 m, 5-40 m": (17.0, _curves),
    "crest R 10 km, 5-40 m": (6.0, lambda t, m: replace(m, near=5.0, far=40.0, profile=1e-4)),
    "50 % outliers, 5 % wrong index": (6.0, lambda t, m: replace(m, outliers=0.5, wrong_index=0.05)),
    "lane change": (8.0, _lane_change),
    "bumps 1 deg in 0.2 s": (6.0, _bumps),
    "braking": (7.0, _brake),
    "2 s of nothing": (8.0, _only((), 3.0, 5.0)),
    "one lane for 4 s": (8.0, _only((2, 3), 3.0, 7.0)),
    "one boundary for 2 s": (8.0, _only((2,), 3.0, 5.0)),
    "exit": (8.0, _exit),
    "unequal lanes": (6.0, lambda t, m: replace(m, places=PLACES + _UNEQUAL)),
    "unequal lanes, one would explain them": (6.0, lambda t, m: replace(m, places=PLACES + _ONE_LARGE)),
    "slightly unequal lanes": (6.0, lambda t, m: replace(m, places=PLACES + _SLIGHT)),
    "wrong boundaries": (6.0, lambda t, m: replace(m, wrong_boundary=0.1)),
    "whole frames misnumbered": (6.0, _wrong_class),
    "short dashes": (6.0, lambda t, m: replace(m, longest=2)),
    "garbage at first and in between": (6.0, _garbage),
    "bad clock": (6.0, _clock),
    "far start": (4.0, _far_start),
}
"""Name: seconds, and the change to the standard drive."""
