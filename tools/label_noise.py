"""Measure the distance of TuSimple's labels and of the network's lines from the paint.

    python -m tools.label_noise [--data ../shared/data] [--weights FILE]

On rows where a label and the network's line pass the same stripe, the stripe's centre is measured in the
image: the centroid of what is brighter than halfway between the ground and the stripe. A distance that is
zero at the horizon is an offset on the road and does not change the yaw; a distance at the horizon is an
error of the yaw. Prints medians over lines, in px of the image: the mean distance,
and the distance at the horizon by a straight line through all distances.

And how far the labels agree with themselves: the yaw by two of an image's lines against that by two others.
Half of the difference estimates, in the median over images, the error of the yaw by all four.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import lanebev
from lanebev import LaneSegments
from lanebev.app.drive.observers import NetworkObserver
from lanebev.estimation.joint.frame.single_frame import fit_single_frame
from lanebev.estimation.joint.frame_prior import FramePrior
from lanebev.estimation.still import calibrate_still
from lanebev.io.lanes import read_lanes
from lanebev.io.opening import open_source
from lanebev.observation.polylines import rows_from_vertices
from tools.real_figures import TUSIMPLE_FOCAL, TUSIMPLE_LANE_WIDTH, tusimple_camera, tusimple_segments
from train.commands import evaluation_parser, one_line_errors

REACH = 30  # px about a line in which its stripe is looked for
APART = 25.0  # px, label and network mean the same stripe if nearer
WIDTHS = (2, 40)  # px, of a stripe
CONTRAST = 20.0  # grey levels
FIRST_ROW = 340  # px; above it stripes are too thin to be measured
STRAIGHT = FramePrior(curvature_std=1e-6, curvature_rate_std=1e-8)
LEAST_ROWS, LEAST_SPAN = 6, 100  # rows with paint, and px from the first to the last, of a line that counts


def stripe_centre(row: NDArray[np.uint8], about: float) -> float:
    """Find the centre of the one bright stripe within REACH px, NaN where there is none or more than one."""
    first = round(about) - REACH
    if first < 0 or first + 2 * REACH + 1 > len(row):
        return float("nan")
    strip = row[first : first + 2 * REACH + 1].astype(float)
    ground, top = float(np.median(strip)), float(strip.max())
    if top - ground < CONTRAST:
        return float("nan")
    bright = np.flatnonzero(strip > 0.5 * (ground + top))
    if len(bright) != np.ptp(bright) + 1 or not WIDTHS[0] <= len(bright) <= WIDTHS[1]:
        return float("nan")
    excess = strip[bright] - ground
    return first + float((bright * excess).sum() / excess.sum())


class Offsets(NamedTuple):
    """Offsets of a line from its stripe, px to the right: mean over rows with paint, and at the horizon."""

    mean: float
    horizon: float


def line_offsets(
    grey: NDArray[np.uint8],
    rows: NDArray[np.float64],
    label: NDArray[np.float64],
    line: NDArray[np.float64],
    horizon: float,
) -> tuple[Offsets, Offsets] | None:
    """Compute the offsets of label and network's line (R,) on image rows (R,); None with too little paint."""
    found = []
    for y, one, other in zip(rows, label, line, strict=True):
        if y >= FIRST_ROW and abs(one - other) < APART:
            centre = stripe_centre(grey[int(y)], 0.5 * (one + other))
            found += [(y - horizon, one - centre, other - centre)] if np.isfinite(centre) else []
    if len(found) < LEAST_ROWS or np.ptp([below for below, *_ in found]) < LEAST_SPAN:
        return None
    below, *distances = np.array(found).T
    first, second = (Offsets(float(d.mean()), float(np.polyfit(below, d, 1)[1])) for d in distances)
    return first, second


def split_half_yaw(segments: LaneSegments, intrinsics: Tensor, prior: FramePrior) -> Tensor:
    """Compute half the difference of the yaw by boundaries 1 and 3 and by 2 and 4, (n,) rad.

    Args:
        segments: (B, N).
        intrinsics: (B, 3, 3).
        prior: prior of the fits.
    """
    yaws, valid = [], []
    for half in ((1, 3), (2, 4)):
        mine = torch.stack([segments.boundary == k for k in half]).any(0)
        part = segments._replace(weight=segments.weight * mine)
        fit = fit_single_frame(part, intrinsics, TUSIMPLE_LANE_WIDTH, prior)
        seen = [((segments.boundary == k) & (segments.weight > 0)).any(1) for k in half]
        yaws.append(fit.extrinsics.yaw)
        valid.append(fit.valid & fit.observed[:, 1] & seen[0] & seen[1])
    return 0.5 * (yaws[0] - yaws[1]).abs()[valid[0] & valid[1]]


@one_line_errors()
def main() -> None:
    parser = evaluation_parser(__doc__)
    options = parser.parse_args()
    labels = options.data / "tusimple" / "label_data.json"
    if not labels.exists():
        raise ValueError(f"{labels}: missing; give the folder with --data")
    model = lanebev.LaneBEV.from_pretrained(options.weights)
    images, segments = tusimple_segments(options.data)
    camera = tusimple_camera()
    intrinsics = camera.intrinsics.expand(len(images), 3, 3)
    pose = calibrate_still(lanebev.TwoStageCalibrator(), segments, intrinsics, TUSIMPLE_LANE_WIDTH).extrinsics
    horizons = (camera.intrinsics[1, 2] - camera.intrinsics[1, 1] * pose.pitch.tan()).tolist()
    observer = NetworkObserver(model, camera)
    offsets = []
    for image, entry, horizon in zip(images, read_lanes(labels), horizons, strict=True):
        frame = next(iter(open_source(image)))
        seen = rows_from_vertices(observer(frame).vertices, camera.image_size)
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        for labelled in entry.lines:
            x = np.interp(seen.rows, labelled.points[:, 1], labelled.points[:, 0], np.nan, np.nan)
            for line in seen.x:
                pair = line_offsets(grey, seen.rows, x, line, horizon)
                offsets += [] if pair is None else [pair]
    both = np.median(np.abs(offsets), axis=0)  # (2, 2)
    print(f"{len(offsets)} lines with paint in {len(images)} images")
    for name, (mean, horizon) in zip(("labels", "network"), both, strict=True):
        yaw = np.degrees(np.arctan(horizon / TUSIMPLE_FOCAL))
        print(f"{name}: median distance {mean:.2f} px, at the horizon {horizon:.2f} px ({yaw:.3f} deg)")
    for name, prior in (("as ever", FramePrior()), ("curvature held at zero", STRAIGHT)):
        halves = split_half_yaw(segments, intrinsics, prior).rad2deg()
        print(f"labels' own yaw, {name}: off by {float(halves.median()):.3f} deg, {len(halves)} images")


if __name__ == "__main__":
    main()
