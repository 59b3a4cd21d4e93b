"""Compute the paper's pseudo ground truth: single-frame extrinsics from annotated lanes.

    python -m tools.pseudo_ground_truth LANES --camera camera.yaml --out pseudo.csv

Source: Sec. VI-C. Pitch and yaw minimise Eq. (11) over the frame's segments, roll and height then Eq. (19);
no filter, so each frame is estimated alone. With --estimate, the root-mean-square difference of a
run's extrinsics.csv to it is printed and both are drawn; images are paired by their paths, a video's frames
by order.
"""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jsonargparse.typing import PositiveFloat
from torch import Tensor

from lanebev import Camera, Extrinsics, LaneSegments
from lanebev.estimation.two_stage.lane_width import boundary_angles, initial_roll_height
from lanebev.estimation.two_stage.vanishing import incidence_noise, vanishing_dir_least_squares
from lanebev.geometry.road import great_circle_normals, segment_rays
from lanebev.geometry.rotation import pitch_yaw_from_vanishing_dir
from lanebev.io.lanes import match_frames, read_lanes
from lanebev.io.lanes.parsing import FrameLines
from lanebev.io.results import ExtrinsicsRow, read_extrinsics
from lanebev.observation.segments import segments_from_lines
from lanebev.types import NUM_BOUNDARIES
from train.commands import command_parser, one_line_errors

COLUMNS = ("pitch_deg", "yaw_deg", "roll_deg", "height_m")
_REWEIGHTINGS = 10


class PseudoTruth(NamedTuple):
    """Extrinsics, each (B,), and which of them the frame's lanes determine."""

    extrinsics: Extrinsics
    direction_known: Tensor  # (B,) two boundaries
    roll_known: Tensor  # (B,) two lanes
    height_known: Tensor  # (B,) one lane


def pseudo_ground_truth(segments: LaneSegments, intrinsics: Tensor, lane_width: float) -> PseudoTruth:
    """Compute the per-frame optimum of the paper's two measurements with the annotated lanes.

    Args:
        segments: (B, N) of annotated boundaries.
        intrinsics: (B, 3, 3) px.
        lane_width: m.

    Returns:
        the optimum, per row.
    """
    ends, _, weight, sigma = segments
    batch = ends.shape[0]
    rays = segment_rays(ends, intrinsics)
    normals = great_circle_normals(rays)
    forward = ends.new_tensor([0.0, 0.0, 1.0]).expand(batch, 3)
    direction = forward
    for _ in range(_REWEIGHTINGS):  # by the distance to the vanishing point
        noise = incidence_noise(rays, direction, sigma, intrinsics)
        direction, _ = vanishing_dir_least_squares(normals, noise, weight, forward)
    pitch, yaw = pitch_yaw_from_vanishing_dir(direction)
    angles = boundary_angles(segments, rays, intrinsics, pitch, yaw, NUM_BOUNDARIES)
    prior = ends.new_full((batch, NUM_BOUNDARIES - 1), lane_width)
    roll, height = initial_roll_height(angles, prior, torch.zeros_like(pitch), num_iterations=20)
    lanes = (angles.present[:, 1:] & angles.present[:, :-1]).sum(-1)
    return PseudoTruth(
        Extrinsics(pitch, yaw, roll, height), angles.present.sum(-1) >= 2, lanes >= 2, lanes >= 1
    )


def as_table(truth: PseudoTruth) -> np.ndarray:
    """Convert to (B, 4) in degrees and metres, NaN where the frame's lanes do not determine a value."""
    values = truth.extrinsics.stack() * torch.tensor([180 / math.pi] * 3 + [1.0], dtype=torch.float64)
    known = torch.stack(
        [truth.direction_known, truth.direction_known, truth.roll_known, truth.height_known], -1
    )
    return torch.where(known, values, torch.nan).numpy()


def estimate_table(rows: Sequence[ExtrinsicsRow], frames: Sequence[FrameLines]) -> np.ndarray:
    """Read a run as :func:`as_table`, a row per frame, NaN where the run has no such image."""
    table = np.full((len(frames), len(COLUMNS)), np.nan)
    if any(row.image for row in rows):
        matches = match_frames([row.image for row in rows], frames)
    elif len(rows) == len(frames):
        matches = list(range(len(frames)))
    else:
        raise ValueError(
            f"--estimate: expected {len(frames)} rows, one per frame of the lanes, got {len(rows)}; give the "
            "run over these frames"
        )
    for row, match in zip(rows, matches, strict=True):
        if match is not None:
            table[match] = [getattr(row, name) for name in COLUMNS]
    return table


def plot(table: np.ndarray, estimate: np.ndarray | None, path: Path) -> None:
    """Plot the pseudo truth, and a run's estimate, of every frame."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 8), layout="tight")
    axes = figure.subplots(4, 1, sharex=True)
    for axis, name, column in zip(axes, COLUMNS, range(4), strict=True):
        axis.plot(table[:, column], "k.", ms=3, label="pseudo ground truth, each frame alone")
        if estimate is not None:
            axis.plot(estimate[:, column], color="tab:blue", lw=1, label="estimate")
        axis.set_ylabel(name.replace("_", " (") + ")")
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    axes[-1].set_xlabel("frame")
    figure.savefig(path, dpi=110)


@one_line_errors()
def main() -> None:
    parser = command_parser(__doc__)
    parser.add_argument("lanes", type=Path, help="TuSimple JSON lines, CULane .lines.txt or OpenLane JSON")
    parser.add_argument("--camera", type=Path, required=True)
    parser.add_argument("--lane-width", type=PositiveFloat, default=3.7, help="lane width, m")
    parser.add_argument("--estimate", type=Path, help="extrinsics.csv of a run over the same frames")
    parser.add_argument("--out", type=Path, default=Path("out/pseudo_ground_truth.csv"))
    args = parser.parse_args()
    camera = Camera.from_file(args.camera)
    frames = read_lanes(args.lanes)
    estimate = estimate_table(read_extrinsics(args.estimate), frames) if args.estimate else None
    segments = segments_from_lines([frame.lines for frame in frames], camera)
    intrinsics = camera.intrinsics.expand(len(frames), 3, 3)
    table = as_table(pseudo_ground_truth(segments, intrinsics, args.lane_width))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("frame", *COLUMNS, "image"))
        for number, (values, frame) in enumerate(zip(table, frames, strict=True)):
            cells = ("" if math.isnan(v) else f"{v:.6f}" for v in values)
            writer.writerow((number, *cells, frame.name))
    plot(table, estimate, args.out.with_suffix(".png"))
    print(
        f"{len(table)} frames; median "
        + ", ".join(f"{n} {m:.3f}" for n, m in zip(COLUMNS, np.nanmedian(table, 0), strict=True))
    )
    if estimate is not None:
        rms = np.sqrt(np.nanmean((estimate - table) ** 2, axis=0))
        print(
            f"rms difference of the estimate, {np.isfinite(estimate).all(-1).sum()} frames: "
            + ", ".join(f"{n} {r:.3f}" for n, r in zip(COLUMNS, rms, strict=True))
        )


if __name__ == "__main__":
    main()
