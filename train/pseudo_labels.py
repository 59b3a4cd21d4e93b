"""Make training data from unlabelled video: ``python -m train.pseudo_labels RESULT SOURCE OUT``.

RESULT is the output folder of ``lanebev run`` on SOURCE. The labels are the network's boundaries, improved:
all boundaries of a frame are fitted together on the run's pose; a boundary's place on the road is the median
over neighbouring frames; one found in less than half of these is left out; a dashed or worn one is drawn as
a whole (also behind vehicles, which are not known). Frames with an uncertain pose and those of a lane change
are left out. OUT has images and ``labels.json`` in TuSimple's layout, for ``configs/adapt.yaml``.

Source: self-training with pseudo-labels (Lee 2013) made consistent over time.
"""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from jsonargparse.typing import PositiveInt
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lanebev.app.drive.sources import source_of_run
from lanebev.batch import masked_median
from lanebev.camera.model import Camera
from lanebev.estimation.joint.frame.boundary_curves import Boundaries, boundary_polylines, fit_boundaries
from lanebev.io.frames import Frame
from lanebev.io.lanes import read_lanes
from lanebev.io.results import ExtrinsicsRow, poses_of, read_extrinsics
from lanebev.observation.polylines import image_rows
from lanebev.observation.segments import segments_from_lines
from lanebev.report.lane_curves import curves_on_rows
from lanebev.report.run_folder import read_run
from lanebev.types import Extrinsics
from train.commands import command_parser, one_line_errors

SUPPORT = 1.0  # sum of segments' weights that a boundary needs in a frame
REACH = 60.0  # m ahead that a boundary is drawn at least
LANE_CHANGE = 0.6  # m, sideways within the neighbouring frames


def neighbours(values: Tensor, reach: int) -> Tensor:
    """Gather the values of neighbouring frames: (F, ...) to (F, ..., 2 reach + 1), NaN beyond both ends."""
    padding = values.new_full((reach, *values.shape[1:]), math.nan)
    return torch.cat([padding, values, padding]).unfold(0, 2 * reach + 1, 1)


def smoothed(curves: Boundaries, reach: int, least: float = 0.5) -> tuple[Boundaries, Tensor]:
    """Place the boundaries of each frame by the median over its neighbours.

    Args:
        curves: curves of F frames in order.
        reach: frames before and after.
        least: share of the neighbours in which a boundary must be.

    Returns:
        The curves, and (F,) bool, false where the camera moves from lane to lane.
    """
    there = neighbours(curves.present.to(curves.offset), reach)  # (F, L, N), NaN beyond the ends
    seen = there > 0.5
    share = torch.where(there.isfinite(), there, 0.0).sum(-1) / there.isfinite().sum(-1)
    offsets = neighbours(curves.offset, reach)
    offset = masked_median(offsets, seen)
    far = torch.where(seen, neighbours(curves.extent[..., 1], reach), 0.0).amax(-1)
    bends = neighbours(curves.curvature, reach)
    middle = slice(offset.shape[1] // 2 - 1, offset.shape[1] // 2 + 1)  # of the ego lane
    away = torch.where(seen, (offsets - offset.unsqueeze(-1)).abs(), 0.0)[:, middle].amax((1, 2))
    result = Boundaries(
        offset=offset,
        heading=masked_median(neighbours(curves.heading, reach), seen),
        extent=torch.stack([torch.ones_like(far), far.clamp(min=REACH)], dim=-1),
        present=share >= least,
        curvature=masked_median(bends, bends.isfinite()),
    )
    return result, away < LANE_CHANGE


def label_rows(curves: Boundaries, camera: Camera, extrinsics: Extrinsics) -> NDArray[np.float64]:
    """Draw curves on the rows of ``lanes.json``: (F, L, R) px of the image as taken, NaN for none."""
    intrinsics = camera.intrinsics.to(curves.offset).expand(len(curves.offset), 3, 3)
    lines, shown = boundary_polylines(curves, intrinsics, extrinsics, num_points=96)
    return np.stack([curves_on_rows(*each, camera) for each in zip(lines, shown, strict=True)])


def fitted_curves(result: Path, camera: Camera) -> tuple[Boundaries, list[ExtrinsicsRow]]:
    """Fit the boundaries of every frame of a run together, on the run's pose."""
    rows, entries = read_extrinsics(result / "extrinsics.csv"), read_lanes(result / "lanes.json")
    if len(rows) != len(entries):
        raise ValueError(
            f"{result}: expected as many frames in lanes.json as in extrinsics.csv, "
            f"got {len(entries)} and {len(rows)}"
        )
    segments = segments_from_lines([entry.lines for entry in entries], camera)
    intrinsics = camera.intrinsics.to(segments.endpoints).expand(len(rows), 3, 3)
    return fit_boundaries(segments, intrinsics, poses_of(rows), least_support=SUPPORT), rows


def write_labels(result: Path, source: str, out: Path, camera: Camera, reach: int, stride: int) -> int:
    """Write images and ``labels.json``, and return how many; nothing is left of a folder that fails.

    Args:
        result: folder of a run.
        source: source of its frames.
        out: new folder.
        camera: the camera that took them.
        reach: frames before and after that place a boundary.
        stride: write every Nth usable frame.

    Raises:
        ValueError: no frame is usable, or the frames or the camera are not those of the run.
    """
    check_camera_of_run(result, camera)
    curves, rows = fitted_curves(result, camera)
    curves, steady = smoothed(curves, reach)
    x = label_rows(curves, camera, poses_of(rows))
    sure = [row.status == "TRACKING" and bool(fine) for row, fine in zip(rows, steady, strict=True)]
    chosen = set([number for number, is_sure in enumerate(sure) if is_sure][::stride])
    if not chosen:
        raise ValueError(f"{result}: expected frames that are TRACKING, got none; is it the right camera?")
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=out.parent, prefix=f"{out.name}-") as folder:
        made = Path(folder) / out.name
        (made / "images").mkdir(parents=True)
        frames = frames_of_run(source, result)
        entries = [
            write_entry(made, frame, x[frame.number])
            for frame in frames
            if frame.image is not None and frame.number in chosen
        ]
        (made / "labels.json").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
        made.rename(out)
    return len(entries)


def check_camera_of_run(result: Path, camera: Camera) -> None:
    """Raise unless a camera is that of a run, by the ``calibration.yaml`` in its folder."""
    path = result / "calibration.yaml"
    if path.is_file() and Camera.from_file(path).fingerprint() != camera.fingerprint():
        raise ValueError(f"camera: expected the camera of the run, {path}, got another")


def frames_of_run(source: str, result: Path) -> Iterator[Frame]:
    """Yield the frames that a run took of its source."""
    run = read_run(result)
    got = 0
    for frame in source_of_run(source, run):
        yield frame
        got += 1
    if got != len(run.rows):
        raise ValueError(
            f"{source}: expected the {len(run.rows)} frames of {result}, got {got}; is it another?"
        )


def write_entry(out: Path, frame: Frame, x: NDArray[np.float64]) -> dict[str, object]:
    """Write the image of a frame, and return its entry of ``labels.json`` with boundaries (L, R) px."""
    assert frame.image is not None
    rows = image_rows(frame.image.shape[0])
    if len(rows) != x.shape[1]:
        raise ValueError(
            f"camera: expected one of images {frame.image.shape[0]} px high, with {len(rows)} rows of "
            f"boundaries, got one with {x.shape[1]}; give the camera of the run"
        )
    name = f"images/{frame.number:06d}.jpg"
    Image.fromarray(frame.image).save(out / name, quality=95)
    there = [k for k in range(len(x)) if np.isfinite(x[k]).sum() > 1]
    lanes = [np.nan_to_num(x[k], nan=-2.0).round(2).tolist() for k in there]
    return {"raw_file": name, "h_samples": rows.tolist(), "lanes": lanes, "boundary": there}


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("result", type=Path, help="output folder of lanebev run")
    parser.add_argument("source", help="video or images of that run")
    parser.add_argument("out", type=Path, help="new folder of the data")
    parser.add_argument("--camera", type=Path, required=True, help="camera file of the run")
    parser.add_argument(
        "--reach",
        type=PositiveInt,
        default=12,
        help="number of frames before and after over which boundaries are smoothed",
    )
    parser.add_argument("--stride", type=PositiveInt, default=3, help="write every Nth usable frame")
    args = parser.parse_args()
    if args.out.exists():
        parser.error(f"out: expected a new folder, got {args.out}, which is there")
    camera = Camera.from_file(args.camera)
    count = write_labels(args.result, args.source, args.out, camera, args.reach, args.stride)
    print(f"{args.out}: {count} labelled images")


if __name__ == "__main__":
    main()
