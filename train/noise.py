"""How much less a network's vertices say together than each by itself: ``python -m train.noise WEIGHTS``.

A network errs alike along a line and from frame to frame. Held-out rendered drives tell what factor on
all sigmas that is worth: for each factor the calibrator's errors, median over the drives, and NEES/dof,
which is 1 where its covariance is as large as its errors. A drive alone would take a factor of 4 to 6; but
with sigmas as large as that an outlier is no longer told from a vertex, and single frames lean on the prior
(``python -m train.evaluate_poses``), so the shipped weights have 2 (``python -m train.export
--noise-factor``).
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
from train.evaluate_poses import AXES, load

WARM_UP = 10  # frames
FACTORS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)


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


class Outcome(NamedTuple):
    """Of a drive's tracked frames: RMSE (4,) in deg, deg, deg, cm, and NEES/dof; NaN where there are none."""

    rmse: Tensor
    nees: Tensor


@torch.inference_mode()
def outcome(seen: Seen, factor: float) -> Outcome:
    """How the calibrator fares on a drive with all sigmas times ``factor``."""
    calibrator = JointCalibrator()
    state = calibrator.initial_state(1, dtype=torch.float64)
    errors, nees = [], []
    for number, (segments, width) in enumerate(zip(seen.segments, seen.lane_width, strict=True)):
        noisy = segments._replace(sigma=factor * segments.sigma)
        out, state = calibrator(noisy, seen.intrinsics, state, seen.interval, width)
        if number >= WARM_UP and out.status.item() == Status.TRACKING:
            error = out.extrinsics.stack()[0] - seen.poses[number]
            errors.append(error)
            nees.append(error @ torch.linalg.solve(out.covariance[0], error) / 4)
    if not errors:
        return Outcome(seen.poses.new_full((4,), math.nan), seen.poses.new_tensor(math.nan))
    rmse = torch.stack(errors).square().mean(0).sqrt()
    return Outcome(torch.cat([rmse[:3].rad2deg(), 100 * rmse[3:]]), torch.stack(nees).mean())


def compare(drives: list[Seen], factors: tuple[float, ...] = FACTORS) -> dict[float, Outcome]:
    """Median outcome over the drives, for every factor."""
    report = {}
    for factor in factors:
        rmse, nees = zip(*(outcome(seen, factor) for seen in drives), strict=True)
        report[factor] = Outcome(torch.stack(rmse).nanmedian(0).values, torch.stack(nees).nanmedian())
    return report


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
    report = compare(drives)
    for factor, (rmse, nees) in report.items():
        errors = dict(zip(AXES, (round(value, 3) for value in rmse.tolist()), strict=True))
        line = {"weights": args.weights.name, "factor": factor, **errors}
        print(json.dumps({**line, "nees_per_dof": round(float(nees), 2)}))


if __name__ == "__main__":
    main()
