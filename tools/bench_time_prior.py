"""Measure a prior of the network's maps by time (``tools/time_prior.py``) on held-out rendered drives.

    python -m tools.bench_time_prior [--drives 12] [--frames 60] [--event cut] [--data ../shared/data]

For each pair of gain and penalty the command prints the recall of rows by the maps, also of rows behind other
vehicles; rows with a false boundary; medians over drives of the errors of the pose; median and mean NEES/dof;
and the share of frames TRACKING. An event in the middle of each drive is a cut to another drive ("cut"), or
an error of the state of 1 degree in pitch and half a lane ("wrong"); then the figures are of the frames
after it. With ``--data`` follow those figures of ``tools/evaluate_real.py`` that depend on a drive.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import torch
from jsonargparse.typing import PositiveInt

from lanebev.camera.model import Camera
from lanebev.estimation.joint.measurement import OFFSET, PITCH
from lanebev.observation.lines import LineExtractor
from lanebev.observation.segments import segments_from_vertices
from lanebev.pipeline import LaneBEV
from lanebev.render import Drive
from lanebev.types import Status
from lanebev.weights import load_segmenter
from tools.real_figures import Figure, carla_drive, udacity
from tools.time_prior import PriorCalibrator, PriorSegmenter, RememberedSegmenter
from train.commands import one_line_errors
from train.drives import WARM_UP
from train.evaluate_roads import judge_rows
from train.labels import ViewConfig

PRIORS = {"none": (0.0, 0.0), "0.5, 0.5": (0.5, 0.5), "1, 0": (1.0, 0.0), "1, 1": (1.0, 1.0)}
"""Gain and penalty, in nats."""

KINDS = ("highway", "varied", "works", "night")


@torch.inference_mode()
def run_drive(segmenter: Any, number: int, frames: int, event: str) -> dict[str, dict[str, Any]]:
    """Return for each prior the sums of rows, errors (F, 4) in rad and m, NEES/dof (F,) and TRACKING (F,)."""
    size, view = segmenter.image_size, ViewConfig(output_stride=segmenter.config.output_stride)
    cut = [Drive(82_000 + number + 50 * i, size, frames, kind=KINDS[number % 4]) for i in range(2)]
    extractor = LineExtractor.for_network(segmenter.config)
    filters = {name: PriorCalibrator(prior, cut[0].camera, size) for name, prior in PRIORS.items()}
    states = {name: each.initial_state(1, dtype=torch.float64) for name, each in filters.items()}
    found: dict[str, dict[str, Any]] = {name: {"rows": torch.zeros(5), "poses": []} for name in PRIORS}
    for index in range(frames):
        after = event != "none" and index >= frames // 2
        frame = cut[event == "cut" and after].frame(index)
        raw, truth = segmenter(frame.image), frame.extrinsics.stack()[0].double()
        for name, each in filters.items():
            if event == "wrong" and index == frames // 2:
                wrong = states[name].mean.clone()
                wrong[0, PITCH] += math.radians(1.0)
                wrong[0, OFFSET] += 0.5 * frame.lane_width[0, 2]
                each.last = states[name] = states[name]._replace(mean=wrong)
            logits = each.add_prior(raw)
            seen = segments_from_vertices(extractor.vertices(logits, size), frame.intrinsics.double(), None)
            widths = frame.lane_width.double()
            out, states[name] = each(seen, frame.intrinsics.double(), states[name], 0.05, widths)
            if after or (event == "none" and index >= WARM_UP):
                rows = judge_rows(logits, frame, view)
                painted = judge_rows(logits, frame._replace(visible=frame.painted), view)
                behind = painted.there & ~rows.there
                counted = (rows.there, rows.found, behind, behind & painted.found, rows.false)
                found[name]["rows"] += torch.stack([each.sum() for each in counted])
                error = out.extrinsics.stack()[0] - truth
                cov = out.with_std_scaled(segmenter.config.pose_sigma_scale).covariance[0]
                nees = error @ torch.linalg.solve(cov, error) / 4
                found[name]["poses"].append((error, nees, out.status[0] == Status.TRACKING))
    return found


def summarise(drives: list[dict[str, Any]]) -> dict[str, float]:
    """Compute the figures of one prior over drives; those of the pose are NaN if no frame is TRACKING."""
    there, seen, behind, behind_seen, false = torch.stack([drive["rows"] for drive in drives]).sum(0).tolist()
    errors, nees, tracked = [], [], []
    for drive in drives:
        error, own, tracking = (torch.stack(part) for part in zip(*drive["poses"], strict=True))
        tracked.append(tracking.double().mean())
        rmse = error[tracking].square().mean(0).sqrt()
        errors.append(torch.cat([rmse[:3].rad2deg(), 100 * rmse[3:]]))
        nees.append(own[tracking].mean())
    middle = torch.stack(errors).nanmedian(0).values.tolist()
    return {
        "recall": seen / max(there, 1),
        "recall behind vehicles": behind_seen / max(behind, 1),
        "false": false / max(there, 1),
        **dict(zip(("pitch, deg", "yaw, deg", "roll, deg", "height, cm"), middle, strict=True)),
        "NEES/dof, median": float(torch.stack(nees).nanmedian()),
        "NEES/dof, mean": float(torch.stack(nees).nanmean()),
        "TRACKING": float(torch.stack(tracked).mean()),
    }


@torch.inference_mode()
def real_figures(segmenter: Any, prior: tuple[float, float], data: Path) -> list[Figure]:
    """Evaluate one prior on the CARLA drive and the highways."""
    found: list[Figure] = []
    for evaluate, folder in ((carla_drive, "carla"), (udacity, "udacity")):
        camera = Camera.from_file(data / folder / "camera.yaml")
        plain = LaneBEV.from_pretrained()
        calibrator = PriorCalibrator(prior, camera, plain.network_size(camera.image_size))
        network = PriorSegmenter(segmenter, calibrator)
        width, pixels = plain.network_width, plain.network_pixels
        model = LaneBEV(network, plain.extractor, calibrator, None, width, network_pixels=pixels)
        found += evaluate(data, model, {"joint": calibrator})
    return found


def print_table(title: str, columns: dict[str, dict[str, float]]) -> None:
    """Print figures by name, a column for each prior."""
    print(f"| {title} | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
    for name in next(iter(columns.values())):
        print(f"| {name} | {' | '.join(f'{column[name]:.3g}' for column in columns.values())} |")
    print()


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--drives", type=PositiveInt, default=12, help="number of drives")
    parser.add_argument("--frames", type=PositiveInt, default=60, help="frames per drive")
    parser.add_argument("--event", choices=("none", "cut", "wrong"), default="none", help="in the middle")
    parser.add_argument("--data", type=Path, help="folder that has the drives of tools/evaluate_real.py")
    options = parser.parse_args()
    if options.event == "none" and options.frames <= WARM_UP:
        parser.error(f"--frames: expected more than the warm-up of {WARM_UP}, got {options.frames}")
    torch.set_num_threads(1)
    segmenter = load_segmenter().eval()
    if options.data is not None:
        once = RememberedSegmenter(segmenter)
        columns = {name: real_figures(once, prior, options.data) for name, prior in PRIORS.items()}
        print_table(
            "gain, penalty",
            {
                name: {f"{each.part}: {each.name}": each.value for each in column}
                for name, column in columns.items()
            },
        )
    drives = [run_drive(segmenter, each, options.frames, options.event) for each in range(options.drives)]
    title = f"gain, penalty: {options.drives} drives, event: {options.event}"
    print_table(title, {name: summarise([drive[name] for drive in drives]) for name in PRIORS})


if __name__ == "__main__":
    main()
