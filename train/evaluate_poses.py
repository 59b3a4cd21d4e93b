"""Errors of the pose on held-out rendered drives: ``python -m train.evaluate_poses BEFORE AFTER``.

Every weights file (safetensors, or a Lightning checkpoint) sees the same frames. Each frame is taken on its
own, an axis counting where every network's fit is valid and observes it; or, with ``--online``, the joint
calibrator follows each drive, and all frames after its warm-up count, whatever their status.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import torch
from torch import Tensor

from lanebev.observation.lines import LineExtractor
from lanebev.observation.segmenter import LaneSegmenter
from lanebev.render import Drive
from train.drives import WARM_UP, follow, watch
from train.export import trained_segmenter
from train.poses import fit_poses

AXES = ("pitch_deg", "yaw_deg", "roll_deg", "height_cm")


def held_out_frames(drives: int, frames: int, size: tuple[int, int], seed: int) -> tuple[Tensor, ...]:
    """Images (N, 3, H, W), poses (N, 4), lane widths (N, L - 1), intrinsics (N, 3, 3), of spread-out frames.

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
    """Errors (N, 4) in rad and m, and where the frame says something of the axis (N, 4) bool."""
    extractor = LineExtractor.for_network(segmenter.config)
    errors, said = [], []
    for image, pose, lane_width, intrinsics in zip(*(field.split(8) for field in frames), strict=True):
        size = (image.shape[-2], image.shape[-1])
        none = image.new_zeros(len(image), 0)
        fit = fit_poses(segmenter(image), size, intrinsics, none, lane_width, extractor)
        errors.append(fit.extrinsics.stack() - pose)
        said.append(fit.observed & fit.valid.unsqueeze(-1))
    return torch.cat(errors), torch.cat(said)


def online_errors(segmenter: LaneSegmenter, drives: int, frames: int, fps: float, seed: int) -> Tensor:
    """Errors (N, 4) in rad and m of the joint calibrator on drives, at the size the network runs at."""
    factor = segmenter.config.noise_factor
    return torch.cat([follow(watch(segmenter, seed + i, frames, fps), factor).error for i in range(drives)])


def summary(error: Tensor, counted: Tensor) -> dict[str, dict[str, float]]:
    """Root mean square and median of the absolute error per axis, in degrees and centimetres."""
    unit = error.new_tensor([math.degrees(1)] * 3 + [100.0])
    report = {}
    for axis, (name, values) in enumerate(zip(AXES, (error * unit).T, strict=True)):
        own = values[counted[:, axis]]
        rmse, median = own.square().mean().sqrt(), own.abs().median()
        report[name] = {"rmse": round(float(rmse), 3), "median": round(float(median), 3), "frames": len(own)}
    return report


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("weights", type=Path, nargs="+")
    parser.add_argument("--drives", type=int, default=12)
    parser.add_argument("--frames", type=int, help="of each drive: 12, a second apart, or online 40")
    parser.add_argument(
        "--size", type=int, nargs=2, default=(192, 320), metavar=("HEIGHT", "WIDTH"), help="not online"
    )
    parser.add_argument("--seed", type=int, default=70_000)
    parser.add_argument("--online", action="store_true", help="follow each drive with the joint calibrator")
    parser.add_argument("--fps", type=float, default=10.0, help="of the drives followed online")
    args = parser.parse_args()
    args.frames = args.frames or (40 if args.online else 12)
    if args.online and args.frames <= WARM_UP:
        parser.error(f"--frames: expected more than the warm-up of {WARM_UP}, got {args.frames}")
    try:
        networks = [trained_segmenter(path)[0] for path in args.weights]
    except (ValueError, OSError) as error:
        parser.exit(2, f"error: {error}\n")
    if args.online:
        for path, network in zip(args.weights, networks, strict=True):
            error = online_errors(network, args.drives, args.frames, args.fps, args.seed)
            print(
                json.dumps({"weights": path.name, **summary(error, torch.ones_like(error).bool())}),
                flush=True,
            )
        return
    frames = held_out_frames(args.drives, args.frames, tuple(args.size), args.seed)
    found = [pose_errors(network, frames) for network in networks]
    common = torch.stack([said for _, said in found]).all(0)
    for path, (error, said) in zip(args.weights, found, strict=True):
        valid = round(float(said[:, 0].double().mean()), 3)
        print(json.dumps({"weights": path.name, "valid": valid, **summary(error, common)}))


if __name__ == "__main__":
    main()
