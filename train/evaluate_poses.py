"""Errors of the pose on held-out rendered drives: ``python -m train.evaluate_poses BEFORE AFTER``.

All weights files (safetensors, or Lightning checkpoints) are evaluated on the same frames. Without
``--online`` each frame is fitted alone. An axis counts if every network's fit is valid and observes it;
under ``every_frame`` all count, with the prior for what is not observed. With ``--online`` the joint
calibrator runs on each drive, and all frames after its warm-up count. For every network but the first, the
95 % interval of the reduction of its RMSE against the first is printed too.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
import torch
from jsonargparse.typing import PositiveFloat, PositiveInt
from numpy.typing import NDArray
from torch import Tensor

from lanebev.observation.lines import LineExtractor
from lanebev.observation.segmenter import LaneSegmenter
from lanebev.render import Drive
from train.commands import command_parser, one_line_errors
from train.drives import WARM_UP, observe_drive, run_calibrator
from train.export import trained_segmenter
from train.poses import fit_poses

AXES = ("pitch_deg", "yaw_deg", "roll_deg", "height_cm")
UNIT = (*[math.degrees(1)] * 3, 100.0)  # of rad and m


def held_out_frames(drives: int, frames: int, size: tuple[int, int], seed: int) -> tuple[Tensor, ...]:
    """Return images (N, 3, H, W), poses (N, 4), lane widths (N, L - 1), intrinsics (N, 3, 3).

    Training never sees drives: it is given single views with other seeds.
    """
    parts = []
    for number in range(drives):
        drive = Drive(seed + number, size, num_frames=frames, fps=1.0)
        for i in range(frames):
            frame = drive.frame(i)
            parts.append((frame.image, frame.extrinsics.stack(), frame.lane_width, frame.intrinsics))
    return tuple(torch.cat(field) for field in zip(*parts, strict=True))


@torch.no_grad()
def pose_errors(segmenter: LaneSegmenter, frames: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Return errors (N, 4) in rad and m, and whether the frame determines the axis, (N, 4) bool."""
    extractor = LineExtractor.for_network(segmenter.config, correlation=0)
    errors, said = [], []
    for image, pose, lane_width, intrinsics in zip(*(field.split(8) for field in frames), strict=True):
        size = (image.shape[-2], image.shape[-1])
        none = image.new_zeros(len(image), 0)
        fit = fit_poses(segmenter(image), size, intrinsics, none, lane_width, extractor)
        errors.append(fit.extrinsics.stack() - pose)
        said.append(fit.observed & fit.valid.unsqueeze(-1))
    return torch.cat(errors), torch.cat(said)


def online_errors(
    segmenters: list[LaneSegmenter], drives: int, frames: int, fps: float, seed: int
) -> list[Tensor]:
    """Compute the joint calibrator's errors (N, 4) on drives, rad and m, at each network's image size."""
    errors: list[list[Tensor]] = [[] for _ in segmenters]
    for number in range(drives):
        all_seen = observe_drive(segmenters, seed + number, frames, fps)
        for segmenter, seen, own in zip(segmenters, all_seen, errors, strict=True):
            own.append(run_calibrator(seen, segmenter.config.sigma_scale).error)
    return [torch.cat(own) for own in errors]


def gain(before: Tensor, after: Tensor, counted: Tensor, drives: int) -> dict[str, list[float]]:
    """Compute how much the RMSE is lower, with 95 % intervals over drives, in degrees and centimetres.

    Source: paired bootstrap (Efron and Tibshirani 1993) over drives, whose frames are not independent.

    Args:
        before: (N, 4) errors in rad and m, drive after drive.
        after: (N, 4) errors of the other network on the same frames.
        counted: (N, 4) bool.
        drives: number of them.
    """
    unit = before.new_tensor(UNIT)
    sums = [
        torch.where(counted, each, 0.0).unflatten(0, (drives, -1)).sum(1).T.double().numpy()
        for each in ((before * unit).square(), (after * unit).square(), counted.to(before))
    ]

    def lower_by(*parts: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
        first, second, number = (part.sum(axis) for part in parts)
        count = np.maximum(number, 1)
        lower: NDArray[np.float64] = np.sqrt(first / count) - np.sqrt(second / count)
        return lower

    report = {}
    for name, *data in zip(AXES, *sums, strict=True):
        found = scipy.stats.bootstrap(
            data, lower_by, paired=True, vectorized=True, method="percentile", random_state=0
        )
        report[name] = [round(float(bound), 3) for bound in found.confidence_interval]
    return report


def summary(error: Tensor, counted: Tensor) -> dict[str, Any]:
    """Compute root mean square and median of the absolute error per axis, in degrees and centimetres."""
    unit = error.new_tensor(UNIT)
    report = {}
    for axis, (name, values) in enumerate(zip(AXES, (error * unit).T, strict=True)):
        own = values[counted[:, axis]]
        rmse, median = own.square().mean().sqrt(), own.abs().median()
        report[name] = {"rmse": round(float(rmse), 3), "median": round(float(median), 3), "frames": len(own)}
    return report


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("weights", type=Path, nargs="+")
    parser.add_argument("--drives", type=PositiveInt, default=12)
    parser.add_argument(
        "--frames", type=PositiveInt, help="frames per drive: 12, one a second, or 40 with --online"
    )
    parser.add_argument(
        "--size",
        type=int,
        nargs=2,
        default=(192, 320),
        metavar=("HEIGHT", "WIDTH"),
        help="image size, without --online",
    )
    parser.add_argument("--seed", type=int, default=70_000)
    parser.add_argument("--online", action="store_true", help="run the joint calibrator on each drive")
    parser.add_argument(
        "--fps", type=PositiveFloat, default=10.0, help="frame rate of the drives, with --online"
    )
    args = parser.parse_args()
    args.frames = args.frames or (40 if args.online else 12)
    if args.online and args.frames <= WARM_UP:
        parser.error(f"--frames: expected more than the warm-up of {WARM_UP}, got {args.frames}")
    networks = [trained_segmenter(path)[0] for path in args.weights]
    counted = {}
    if args.online:
        errors = online_errors(networks, args.drives, args.frames, args.fps, args.seed)
        shares: list[dict[str, Any]] = [{} for _ in errors]
    else:
        held_out = held_out_frames(args.drives, args.frames, tuple(args.size), args.seed)
        found = [pose_errors(network, held_out) for network in networks]
        errors, said = [error for error, _ in found], [observed for _, observed in found]
        shares = [{"valid": round(float(own[:, 0].double().mean()), 3)} for own in said]
        counted["observed"] = torch.stack(said).all(0)
    counted["every_frame"] = torch.ones_like(errors[0]).bool()
    for path, share, error in zip(args.weights, shares, errors, strict=True):
        figures = {name: summary(error, frames) for name, frames in counted.items()}
        if error is not errors[0] and args.drives > 1:
            for name, frames in counted.items():
                figures[name]["rmse_below_first_by"] = gain(errors[0], error, frames, args.drives)
        print(json.dumps({"weights": path.name, **share, **figures}))


if __name__ == "__main__":
    main()
