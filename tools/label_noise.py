"""How far TuSimple's labels and the network's lines lie from the paint itself: what limits comparing the two.

    python -m tools.label_noise [--data ../shared/data] [--weights FILE]

On rows where a label and the network's line pass the same stripe, the stripe's centre is measured in the
image: the centroid of what is brighter than halfway between the ground and the stripe. Prints the median over
lines of the mean distance from it, in px of the image, and what an angle of yaw that is at the horizon.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import lanebev
from lanebev.io.lanes import read_lanes
from lanebev.io.video import open_source
from lanebev.observers import NetworkObserver
from tools.real_figures import TUSIMPLE_FOCAL, TUSIMPLE_LANE_WIDTH, tusimple_camera, tusimple_segments

REACH = 30  # px about a line in which its stripe is looked for
APART = 25.0  # px, label and network mean the same stripe if nearer
WIDTHS = (3, 40)  # px, of a stripe
CONTRAST = 25.0  # grey levels
NEAREST_ROW = 430  # px; above it stripes are too thin to be measured
LEAST_ROWS = 4  # with paint, of a line that counts


def stripe_centre(row: NDArray[np.uint8], about: float) -> float:
    """Centre of the one bright stripe within REACH px, or NaN where there is none or more than one."""
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


def line_offsets(
    grey: NDArray[np.uint8], rows: NDArray[np.float64], label: NDArray[np.float64], line: NDArray[np.float64]
) -> tuple[float, float] | None:
    """Mean distance, px to the right, of label and network's line from the stripe; None: no paint."""
    pairs = []
    for y, one, other in zip(rows, label, line, strict=True):
        if y < NEAREST_ROW or not abs(one - other) < APART:
            continue
        centre = stripe_centre(grey[int(y)], 0.5 * (one + other))
        pairs.append((one - centre, other - centre))
    found = np.array([pair for pair in pairs if np.isfinite(pair[0])])
    return None if len(found) < LEAST_ROWS else (float(found[:, 0].mean()), float(found[:, 1].mean()))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=default, help="folder of the data (../shared/data)")
    parser.add_argument("--weights", type=Path, help="other weights than the shipped")
    options = parser.parse_args()
    labels = options.data / "tusimple" / "label_data.json"
    if not labels.exists():
        print(f"{labels}: missing; give the folder with --data", file=sys.stderr)
        return 2
    images, _ = tusimple_segments(options.data)
    observer = NetworkObserver(
        lanebev.LaneBEV.from_pretrained(options.weights), tusimple_camera(), TUSIMPLE_LANE_WIDTH
    )
    offsets = []
    for image, entry in zip(images, read_lanes(labels), strict=True):
        frame = next(iter(open_source(image)))
        seen, _ = observer(frame)
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        for labelled in entry.lines:
            x = np.interp(seen.rows, labelled.points[:, 1], labelled.points[:, 0], np.nan, np.nan)
            for line in seen.x:
                pair = line_offsets(grey, seen.rows, x, line)
                offsets += [] if pair is None else [pair]
    both = np.abs(np.array(offsets))
    print(f"{len(both)} lines with paint in {len(images)} images")
    for name, values in zip(("labels", "network"), both.T, strict=True):
        middle, most = np.median(values), np.percentile(values, 90)
        yaw = np.degrees(np.arctan(middle / TUSIMPLE_FOCAL))
        print(f"{name}: median {middle:.2f} px ({yaw:.3f} deg), nine in ten within {most:.2f} px")
    return 0


if __name__ == "__main__":
    sys.exit(main())
