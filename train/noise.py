"""How much larger a network's errors are than its maps say: ``python -m train.noise WEIGHTS``.

A network errs alike along a line and from frame to frame, so that its vertices together say less than each
by itself. Held-out rendered drives tell by how much: the factor on all sigmas with which the calibrator's
errors are as large as its covariance says, NEES/dof = 1 on the median drive. It goes into the weights file
(``python -m train.export --noise-factor``).
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from lanebev.estimation.joint import JointCalibrator
from lanebev.io.lane_rows import rows_from_segments, segments_from_rows
from lanebev.observation.lines import LineExtractor
from lanebev.observation.segmenter import LaneSegmenter
from lanebev.pipeline import LaneBEV
from lanebev.render import Drive
from lanebev.types import LaneSegments, Status
from train.evaluate_poses import load

WARM_UP = 10  # frames


class Seen(NamedTuple):
    """What a network saw of a drive: segments, lane widths (L - 1,) and poses (4,) of its frames."""

    segments: list[LaneSegments]
    lane_width: list[Tensor]
    poses: Tensor
    intrinsics: Tensor
    interval: float


def watch(segmenter: LaneSegmenter, seed: int, frames: int, fps: float) -> Seen:
    """A rendered drive through the network, its sigmas as the maps say, by way of ``lanes.json``'s rows."""
    drive = Drive(seed, num_frames=frames, fps=fps)
    config = segmenter.config
    extractor = LineExtractor.for_network(config)
    model = LaneBEV(segmenter, extractor, JointCalibrator(), network_width=config.image_size[1]).eval()
    segments, widths, poses = [], [], []
    for i in range(frames):
        frame = drive.frame(i)
        with torch.inference_mode():
            _, found = model.observe(frame.image, frame.intrinsics)
        rows = rows_from_segments(found, drive.camera)
        taken = segments_from_rows([rows], drive.camera)
        segments.append(taken._replace(sigma=taken.sigma / config.noise_factor))
        widths.append(frame.lane_width.double())
        poses.append(frame.extrinsics.stack()[0].double())
    return Seen(segments, widths, torch.stack(poses), frame.intrinsics.double(), 1 / fps)


@torch.inference_mode()
def consistency(seen: Seen, factor: float) -> float:
    """NEES/dof of the pose over a drive's tracked frames, with all sigmas times ``factor``."""
    calibrator = JointCalibrator()
    state = calibrator.initial_state(1, dtype=torch.float64)
    nees = []
    for segments, width, pose in zip(seen.segments, seen.lane_width, seen.poses, strict=True):
        noisy = segments._replace(sigma=factor * segments.sigma)
        out, state = calibrator(noisy, seen.intrinsics, state, seen.interval, width)
        error = (out.extrinsics.stack() - pose).unsqueeze(-1)
        value = (error.mT @ torch.linalg.solve(out.covariance, error)).item() / 4
        nees.append(value if out.status.item() == Status.TRACKING else math.nan)
    return float(torch.tensor(nees[WARM_UP:]).nanmean())


def noise_factor(drives: list[Seen], steps: int = 6) -> float:
    """The factor between 1 and 16 with NEES/dof = 1 on the median drive, by bisection of its logarithm."""
    low, high = 1.0, 16.0
    for _ in range(steps):
        middle = math.sqrt(low * high)
        values = torch.tensor([consistency(seen, middle) for seen in drives])
        low, high = (middle, high) if float(values.nanmedian()) > 1 else (low, middle)
    return math.sqrt(low * high)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--drives", type=int, default=12)
    parser.add_argument("--frames", type=int, default=90, help="of each drive")
    parser.add_argument("--fps", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=81_000)
    args = parser.parse_args()
    try:
        segmenter = load(args.weights)
    except (ValueError, OSError) as error:
        parser.exit(2, f"error: {error}\n")
    drives = [watch(segmenter, args.seed + i, args.frames, args.fps) for i in range(args.drives)]
    factor = noise_factor(drives)
    nees = {f"{at:.2f}": [round(consistency(seen, at), 2) for seen in drives] for at in (1.0, factor)}
    print(json.dumps({"weights": args.weights.name, "noise_factor": round(factor, 2), "nees_per_dof": nees}))


if __name__ == "__main__":
    main()
