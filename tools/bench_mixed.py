"""Drives in which everything is drawn at random together: motion, road, lanes, boundaries in view, detector.

    python -m tools.bench_mixed [--drives 60] [--first SEED]

The drives of ``tools/random_drives.py`` have one difficulty each; these have several at once, each with a
probability of its own. Prints NEES per degree of freedom and the share of errors within 3 sigma, of all
drives and of those with each difficulty, then the drives with the smallest shares. Frames that are not
TRACKING, and half a second after a start and after a knock, are left out.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from random import Random
from typing import NamedTuple

import torch
from jsonargparse.typing import PositiveInt
from torch import Tensor

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.testing.moments import CAMERA, PLACES, WIDTH, Change, Moment, observe, table1_offset
from lanebev.testing.motions import Motion, Pose, moved, share_done, sinusoids, suspension
from lanebev.types import Status
from train.commands import command_parser, one_line_errors

FIRST_SEED = 1000
SECONDS = 10.0
SETTLING = 0.5  # s after a start, and after a knock
SIGMAS = 3.0
WORST = 5  # drives that are listed

SHARES = {
    "bends": 0.6,
    "hills": 0.3,
    "unequal lanes": 0.4,
    "boundaries come and go": 0.4,
    "outliers": 0.4,
    "wrong boundaries": 0.3,
    "nothing in view": 0.25,
    "lane change": 0.25,
    "knock": 0.12,
}
"""Probability of each difficulty."""

_IN_VIEW = (*[tuple(range(6))] * 2, *[(1, 2, 3, 4)] * 2, (0, 1, 2, 3), (2, 3, 4), (1, 2, 3), (2, 3))
_CHANGE, _KNOCK = 4.0, 0.1  # s that they take


@dataclass(frozen=True)
class Drive:
    """A drive that was drawn.

    Attributes:
        moments: its frames; those that are not evaluated have a tag.
        difficulties: names in ``SHARES``.
        sigma: px, noise of an end point.
        per_boundary: segments of each boundary.
        words: frame rate, motion, boundaries in view.
    """

    moments: list[Moment]
    difficulties: tuple[str, ...]
    sigma: float
    per_boundary: int
    words: str


class Errors(NamedTuple):
    """Errors by sigma (F, 4) and NEES per degree of freedom (F,) of the F evaluated frames of a drive."""

    by_sigma: Tensor
    nees: Tensor

    def within(self) -> Tensor:
        """Compute the share (4,) of errors within 3 sigma."""
        return (self.by_sigma.abs() < SIGMAS).double().mean(0)


def draw(seed: int) -> Drive:
    """Draw a drive of 10 s."""
    random = Random(seed)
    fps, speed = random.choice((10, 15, 25, 30, 60)), random.uniform(5.0, 35.0)
    mount = (
        math.radians(random.gauss(0.0, 2.5)),
        math.radians(random.gauss(0.0, 1.5)),
        math.radians(random.gauss(0.0, 1.2)),
        random.uniform(1.1, 2.4),
    )
    name, motion = _motion(random, seed, mount)
    difficulties = tuple(one for one, share in SHARES.items() if random.random() < share)
    visible, near, far = random.choice(_IN_VIEW), random.uniform(4.0, 10.0), random.uniform(25.0, 75.0)
    changes = [_CHANGES[one](random, speed) for one in difficulties]
    moments, t = [], 0.0
    while t < SECONDS:
        dt = random.uniform(0.9, 1.1) / fps
        t += dt
        tag = "start" if t < SETTLING else ""
        moment = Moment(
            motion(t), 0.5 * table1_offset(0.5 * t), visible=visible, near=near, far=far, dt=dt, tag=tag
        )
        for change in changes:
            moment = change(t, moment)
        moments.append(moment)
    words = f"{fps} frames/s, {name}, boundaries {visible}, {near:.0f} to {far:.0f} m"
    return Drive(moments, difficulties, random.uniform(0.3, 2.5), random.choice((5, 10, 20, 30)), words)


def _motion(random: Random, seed: int, mount: Pose) -> tuple[str, Motion]:
    if random.random() < 0.5:
        return "suspension", suspension(seed, SECONDS, random.uniform(0.3, 2.0), mount)
    degrees, hertz = random.uniform(0.1, 2.0), random.uniform(0.3, 1.5)
    motion = sinusoids(seed, degrees, random.uniform(0.0, 0.08), hertz, mount=mount)
    return f"{degrees:.1f}° {hertz:.1f} Hz", motion


def _bends(random: Random, speed: float) -> Change:
    """Clothoids between curvatures of up to 1/150 m and 3 m/s² every 50 to 150 m, some of them straight."""
    sharpest = min(1 / math.exp(random.uniform(math.log(150.0), math.log(2000.0))), 3.0 / speed**2)
    knots, values = [0.0], [random.choice((0.0, random.uniform(-sharpest, sharpest)))]
    while knots[-1] < speed * SECONDS + 150.0:
        knots.append(knots[-1] + random.uniform(50.0, 150.0))
        values.append(random.choice((0.0, random.uniform(-sharpest, sharpest), values[-1])))
    way, curvature = (torch.tensor(part, dtype=torch.float64) for part in (knots, values))

    def at(start: float, z: Tensor) -> Tensor:
        s = (z + start).clamp(0.0, float(way[-1]) - 1e-6)
        right = torch.searchsorted(way, s.contiguous(), right=True).clamp(1, len(way) - 1)
        share = (s - way[right - 1]) / (way[right] - way[right - 1])
        return curvature[right - 1] + share * (curvature[right] - curvature[right - 1])

    return lambda t, moment: replace(moment, curvature=partial(at, speed * t))


def _hills(random: Random, speed: float) -> Change:
    """Crests and dips of R = 5 to 30 km at the sharpest, one of each in 100 to 400 m."""
    sharpest, length = 1 / random.uniform(5e3, 30e3), random.uniform(100.0, 400.0)
    first = random.uniform(0.0, 2 * math.pi)

    def change(t: float, moment: Moment) -> Moment:
        return replace(moment, profile=sharpest * math.sin(2 * math.pi * speed * t / length + first))

    return change


def _unequal_lanes(random: Random, speed: float) -> Change:
    """Every boundary beside its place for good, by a deviation of 1 to 12 cm."""
    std = random.uniform(0.01, 0.12)
    out = torch.tensor([random.gauss(0.0, std) for _ in PLACES], dtype=torch.float64)
    return lambda t, moment: replace(moment, places=PLACES + out)


def _come_and_go(random: Random, speed: float) -> Change:
    """Every boundary missing for 0.2 to 2.5 s, 3 s apart on average."""
    gaps: list[list[tuple[float, float]]] = [[] for _ in PLACES]
    for gap in gaps:
        t = random.expovariate(1 / 3.0)
        while t < SECONDS:
            end = t + random.uniform(0.2, 2.5)
            gap.append((t, end))
            t = end + random.expovariate(1 / 3.0)

    def change(t: float, moment: Moment) -> Moment:
        seen = (k for k in moment.visible if not any(start <= t < end for start, end in gaps[k]))
        return replace(moment, visible=tuple(seen))

    return change


def _outliers(random: Random, speed: float) -> Change:
    """Up to a quarter of the segments anywhere on the road."""
    share = random.uniform(0.0, 0.25)
    return lambda t, moment: replace(moment, outliers=share)


def _wrong_boundaries(random: Random, speed: float) -> Change:
    """Up to 5 % of the segments, and 2 % of whole boundaries, with another boundary's index."""
    share, whole = random.uniform(0.0, 0.05), random.choice((0.0, 0.02))
    return lambda t, moment: replace(moment, wrong_index=share, wrong_boundary=whole)


def _nothing_in_view(random: Random, speed: float) -> Change:
    """No boundary for 0.2 to 3 s."""
    start = random.uniform(1.0, 7.0)
    end = start + random.uniform(0.2, 3.0)
    return lambda t, moment: replace(moment, visible=()) if start <= t < end else moment


def _lane_change(random: Random, speed: float) -> Change:
    """To the left or right in 4 s, from 1.5 to 5 s on."""
    start, side = random.uniform(1.5, 5.0), random.choice((-1, 1))

    def change(t: float, moment: Moment) -> Moment:
        done = share_done(t, start, _CHANGE)
        aside = side * WIDTH * (done - math.sin(2 * math.pi * done) / (2 * math.pi))
        crossed = side if abs(aside) > WIDTH / 2 else 0
        places = PLACES + (moment.places - PLACES).roll(-crossed)
        return replace(moment, offset=moment.offset - aside + WIDTH * crossed, places=places)

    return change


def _knock(random: Random, speed: float) -> Change:
    """The camera turned by up to 3° about each axis and 20 cm higher or lower, in 0.1 s, for good."""
    start = random.uniform(2.0, 7.0)
    pitch, yaw, roll = (math.radians(random.uniform(-3.0, 3.0)) for _ in range(3))
    jump = (pitch, yaw, roll, random.uniform(-0.2, 0.2))

    def change(t: float, moment: Moment) -> Moment:
        share = share_done(t, start, _KNOCK)
        tag = "knock" if start <= t < start + _KNOCK + SETTLING else moment.tag
        return replace(moment, pose=moved(moment.pose, jump, share), tag=tag)

    return change


_CHANGES: dict[str, Callable[[Random, float], Change]] = {
    "bends": _bends,
    "hills": _hills,
    "unequal lanes": _unequal_lanes,
    "boundaries come and go": _come_and_go,
    "outliers": _outliers,
    "wrong boundaries": _wrong_boundaries,
    "nothing in view": _nothing_in_view,
    "lane change": _lane_change,
    "knock": _knock,
}


def run_drive(drive: Drive, seed: int, calibrator: JointCalibrator) -> Errors:
    """Run the calibrator on a drive."""
    state = calibrator.initial_state(1, dtype=torch.float64)
    by_sigma, nees = [torch.zeros(0, 4, dtype=torch.float64)], [torch.zeros(0, dtype=torch.float64)]
    frames = observe(drive.moments, 1, drive.sigma, drive.per_boundary, seed, torch.float64)
    with torch.inference_mode():
        for moment, segments in frames:
            found, state = calibrator(segments, CAMERA[None], state, moment.dt, WIDTH)
            if moment.tag or int(found.status) != int(Status.TRACKING):
                continue
            error = found.extrinsics.stack() - torch.tensor(moment.pose, dtype=torch.float64)
            by_sigma.append(error / found.covariance.diagonal(dim1=1, dim2=2).sqrt())
            nees.append((error * torch.linalg.solve(found.covariance, error)).mean(-1))
    return Errors(torch.cat(by_sigma), torch.cat(nees))


def table_row(name: str, errors: Sequence[Errors]) -> str:
    """Write a row of the table. Every drive that was calibrated counts the same."""
    judged = [one for one in errors if len(one.nees)]
    if not judged:
        return f"| {name} | {len(errors)} | – | – |"
    nees = torch.stack([one.nees.mean() for one in judged]).mean()
    within = torch.stack([one.within() for one in judged]).mean(0)
    return f"| {name} | {len(errors)} | {nees:.2f} | {' '.join(f'{100 * one:.1f}' for one in within)} |"


def print_mixed(drives: int, first: int) -> None:
    """Measure the joint calibrator on drives drawn at random."""
    seeds = range(first, first + drives)
    drawn = [draw(seed) for seed in seeds]
    found = [run_drive(drive, seed, JointCalibrator()) for drive, seed in zip(drawn, seeds, strict=True)]
    print("| drives with | drives | NEES/dof | % within 3 σ: pitch yaw roll height |\n|---|---|---|---|")
    print(table_row("anything", found))
    for one in SHARES:
        having = [errors for errors, drive in zip(found, drawn, strict=True) if one in drive.difficulties]
        print(table_row(one, having))
    least = [float(errors.within().amin()) if len(errors.nees) else 1.0 for errors in found]
    for k in sorted(range(drives), key=least.__getitem__)[:WORST]:
        what = f"{drawn[k].words}; {', '.join(drawn[k].difficulties)}"
        print(table_row(f"seed {seeds[k]}: {what}", found[k : k + 1]))


@one_line_errors()
def main() -> None:
    parser = command_parser(__doc__)
    parser.add_argument("--drives", type=PositiveInt, default=60, help="number of drives (%(default)s)")
    words = "seed of the first drive (%(default)s)"
    parser.add_argument("--first", type=int, default=FIRST_SEED, metavar="SEED", help=words)
    print_mixed(**vars(parser.parse_args()))


if __name__ == "__main__":
    main()
