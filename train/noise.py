"""Measure the two sigma factors of a network: ``python -m train.noise WEIGHTS``.

A network's errors are correlated along a line and from frame to frame. On held-out rendered drives this
command prints, for several factors on all sigmas, the median errors of the calibrator over the drives, and
NEES/dof, which is 1 if the covariance is as large as the errors. Drives alone would need a factor of 4, but
with such sigmas outliers cannot be recognised and single frames depend on the prior (``python -m
train.evaluate_poses``), so the shipped weights have 2.25 (``python -m train.export --sigma-scale``). The
square root of the remaining NEES is the factor on the pose's sigmas, ``--pose-sigma-scale``.
"""

import json
import math
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jsonargparse.typing import PositiveFloat, PositiveInt
from torch import Tensor

from lanebev.estimation.joint.config import HILLY_ROADS, JointConfig
from train.commands import command_parser, one_line_errors
from train.drives import WARM_UP, DriveObservations, observe_drive, run_calibrator
from train.evaluate_poses import AXES
from train.export import trained_segmenter

FACTORS = (1.0, 1.5, 2.0, 2.25, 3.0, 4.0, 6.0)


class Outcome(NamedTuple):
    """RMSE (4,) in deg, deg, deg, cm and NEES/dof over a drive's tracked frames; NaN if there are none."""

    rmse: Tensor
    nees: Tensor


class Summary(NamedTuple):
    """Median RMSE (4,), median and mean NEES/dof over drives, as in :class:`Outcome`."""

    rmse: Tensor
    nees: Tensor
    mean_nees: Tensor


def outcome(seen: DriveObservations, factor: float, config: JointConfig | None = None) -> Outcome:
    """Return the calibrator's errors on a drive with all sigmas times ``factor``."""
    followed = run_calibrator(seen, factor, config)
    error, covariance = (part[followed.tracking] for part in followed[:2])
    if not len(error):
        return Outcome(seen.poses.new_full((4,), math.nan), seen.poses.new_tensor(math.nan))
    rmse = error.square().mean(0).sqrt()
    nees = (error * torch.linalg.solve(covariance, error)).sum(-1) / 4
    return Outcome(torch.cat([rmse[:3].rad2deg(), 100 * rmse[3:]]), nees.mean())


def summaries(
    drives: list[DriveObservations],
    factors: tuple[float, ...] = FACTORS,
    over: Callable[..., Iterable[Outcome]] = map,
    config: JointConfig | None = None,
) -> dict[float, Summary]:
    """Summarise the outcomes over the drives for every factor; ``over`` is :func:`map` or a pool's."""
    pairs = [(seen, factor, config) for factor in factors for seen in drives]
    outcomes = list(over(outcome, *zip(*pairs, strict=True)))
    report = {}
    for number, factor in enumerate(factors):
        rmse, nees = zip(*outcomes[number * len(drives) : (number + 1) * len(drives)], strict=True)
        every = torch.stack(nees)
        report[factor] = Summary(torch.stack(rmse).nanmedian(0).values, every.nanmedian(), every.nanmean())
    return report


def figures(summary: Summary) -> dict[str, float | None]:
    """Round a summary for JSON, which has no NaN: what no tracked frame tells is None."""
    rmse, nees, mean = summary
    known = {name: round(value, 3) for name, value in zip(AXES, rmse.tolist(), strict=True)}
    known |= {"nees_per_dof": round(float(nees), 2), "pose_sigma_scale": round(float(nees) ** 0.5, 2)}
    known["mean_nees_per_dof"] = round(float(mean), 2)
    return {name: None if math.isnan(value) else value for name, value in known.items()}


def _observe_one(weights: Path, frames: int, fps: float, seed: int) -> DriveObservations:
    return observe_drive([trained_segmenter(weights)[0]], seed, frames, fps)[0]


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--drives", type=PositiveInt, default=12)
    parser.add_argument("--frames", type=PositiveInt, default=90, help="frames per drive")
    parser.add_argument("--fps", type=PositiveFloat, default=20.0)
    parser.add_argument("--seed", type=int, default=81_000)
    parser.add_argument("--hilly", action="store_true", help="with the configuration for hilly roads")
    parser.add_argument("--jobs", type=PositiveInt, default=1, help="number of processes")
    args = parser.parse_args()
    if args.frames <= WARM_UP:
        raise ValueError(
            f"--frames: expected more than {WARM_UP}, which are not evaluated, got {args.frames}"
        )
    one = partial(_observe_one, args.weights, args.frames, args.fps)
    seeds = range(args.seed, args.seed + args.drives)
    config = HILLY_ROADS if args.hilly else None
    if args.jobs == 1:
        report = summaries([one(seed) for seed in seeds], config=config)
    else:
        context = torch.multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(
            args.jobs, context, initializer=torch.set_num_threads, initargs=(1,)
        ) as pool:
            report = summaries(list(pool.map(one, seeds)), over=pool.map, config=config)
    for factor, summary in report.items():
        print(json.dumps({"weights": args.weights.name, "factor": factor, **figures(summary)}))


if __name__ == "__main__":
    main()
