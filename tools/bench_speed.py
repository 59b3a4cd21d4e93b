"""What views, extractor and calibrators cost, beside what others take for the same, and how it grows.

    python -m tools.bench_speed --out out/bench_speed
    python -m tools.bench_speed --parts warp frame --threads 1 --cpu-time

Prints and writes (bench_speed.json, bench_speed.md, and an SVG plot of every growing cost) medians and
interquartile ranges in ms; ratios come first, each to the first line of its table. Targets (TARGETS) are
marked as met or missed, and the last table has all ratios, bold where missed. Alternatives take turns within
one run, so that all of them see the same machine. ``--cpu-time`` takes the processor's time instead of the
clock's: of one thread, and for a machine that others use too.

- ``warp``: 1920 × 1020 px, three channels, or 64 channels at stride 8, to 1024 × 512 cells, against a bare
  ``grid_sample`` with its grid at hand and kornia's ``warp_perspective``; ``gradients``: and back;
  ``stages``: what is done before the resampling.
- ``frame``: one frame of bytes through the lens, against ``cv2.remap`` with its maps at hand, and with its
  maps computed, as they must be when the pose is another in every frame.
- ``extractor``: seven maps of 160 × 288.
- ``rows``, ``segments``, ``cells``: calibrators by rows of a batch and by segments, the warp by cells.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import kornia
import numpy as np
import torch
import torch.nn.functional as F
from jsonargparse.typing import PositiveFloat, PositiveInt
from kornia.geometry.transform import warp_perspective
from torch import Tensor
from torch.utils.benchmark import Measurement, Timer

from lanebev import (
    BEVGrid,
    BEVWarp,
    Camera,
    Extrinsics,
    JointCalibrator,
    LaneSegments,
    LineExtractor,
    TwoStageCalibrator,
    bev_from_image,
)
from lanebev.tensors import map_tensors
from lanebev.testing.segments import INTRINSICS, lanes
from lanebev.view.cells import cells_and_lens
from lanebev.view.frame import remap_frame
from lanebev.view.lens import Lens
from lanebev.view.projection import CellSums, normalised_intrinsics
from lanebev.view.sampling import MapSize, sampling_maps
from train.commands import one_line_errors

Calls = Mapping[str, Callable[[], object]]
Table = dict[str, dict[str, float]]

SIZE = (1020, 1920)  # px, (H, W)
GRID = BEVGrid(x=(-10.24, 10.24), z=(3.0, 43.96), resolution=0.04)  # 1024 × 512
BROWN = [-0.2, 0.03, 0.001, -0.001, 0.005]
RATIONAL = [-0.2, 0.03, 0.001, -0.001, 0.005, 0.1, 0.05, 0.01]
FISHEYE = [-0.05, 0.01, -0.003, 0.001]
POSE = [0.03, 0.02, 0.01, 1.5]
TARGETS = {  # largest ratio, or time
    "BEVWarp": ("ratio", 1.2),
    "BEVWarp, 5 coefficients": ("ratio", 1.3),
    "BEVWarp, 8 coefficients": ("ratio", 1.3),
    "BEVWarp, fisheye": ("ratio", 1.3),
    "remap_frame": ("ratio", 1.2),
    "LineExtractor": ("ms", 4.0),
}
_ONCE = 10  # times the seconds of an alternative, above which a call is measured once, without one to warm up


def camera(distortion: list[float] | None = None, model: str = "pinhole") -> Camera:
    return Camera.from_parameters(1050, 1050, 959.5, 509.5, SIZE[1], SIZE[0], distortion or [], model)


def poses(batch: int) -> Extrinsics:
    return Extrinsics.unstack(torch.tensor([POSE]).repeat(batch, 1))


def measure(calls: Calls, seconds: float, clock: Callable[[], float]) -> Table:
    """Time alternatives in turns for ``seconds`` each: median and quartiles, ms, and ratio to the first."""
    timers = {
        name: Timer("call()", globals={"call": call}, timer=clock, num_threads=torch.get_num_threads())
        for name, call in calls.items()
    }
    first = {name: timer.timeit(1) for name, timer in timers.items()}  # to warm up as well
    number = {name: max(1, int(0.02 / run.median)) for name, run in first.items()}
    longest = max(0.02, *(run.median for run in first.values()))
    turns = max(1 if longest > seconds else 3, int(seconds / longest))
    runs: dict[str, list[Measurement]] = {name: [] for name in calls}
    if longest > _ONCE * seconds:
        runs, turns = {name: [run] for name, run in first.items()}, 0
    for _ in range(turns):
        for name, timer in timers.items():
            runs[name].append(timer.timeit(number[name]))
    table: Table = {}
    for name, parts in runs.items():
        times = 1e3 * np.array([part.median for part in parts])
        low, median, high = np.quantile(times, [0.25, 0.5, 0.75])
        table[name] = {"ms": float(median), "low": float(low), "high": float(high)}
    base = next(iter(table.values()))["ms"]
    return {name: {"ratio": entry["ms"] / base, **entry} for name, entry in table.items()}


def judged(table: Table) -> Table:
    """Add to entries with a target whether they meet it, to two decimals."""
    return {
        name: {**entry, "met": round(entry[TARGETS[name][0]], 2) <= TARGETS[name][1]}
        if name in TARGETS
        else entry
        for name, entry in table.items()
    }


def verdict(name: str, entry: Mapping[str, float]) -> str:
    """Say whether a target is met; nothing of an entry without one."""
    if "met" not in entry:
        return ""
    what, most = TARGETS[name]
    return f"{'met' if entry['met'] else 'missed'}: {what} at most {most:g}"


def sampling_grid(batch: int) -> Tensor:
    """What the warp samples at, as ``grid_sample`` takes it."""
    intrinsics = camera().intrinsics.float().expand(batch, 3, 3)
    points, _ = BEVWarp(GRID).image_points(intrinsics, poses(batch))
    size = torch.tensor([SIZE[1], SIZE[0]])
    grid: Tensor = ((2 * points + 1) / size - 1).unflatten(1, GRID.shape)
    return grid


def warps(batch: int, channels: int, stride: int) -> Calls:
    """The warp and its peers on one image or feature map."""
    image = torch.rand(batch, channels, SIZE[0] // stride, SIZE[1] // stride)
    grid, warp, extrinsics = sampling_grid(batch), BEVWarp(GRID), poses(batch)
    ideal = camera().intrinsics.float().expand(batch, 3, 3)
    coarse = torch.diag(torch.tensor([1 / stride, 1 / stride, 1.0]))
    homography = bev_from_image(extrinsics, coarse @ ideal, GRID)

    def with_lens(distortion: list[float], model: str = "pinhole") -> Callable[[], object]:
        lens = torch.tensor([distortion]).expand(batch, -1)
        return lambda: warp(image, ideal, extrinsics, lens, model, SIZE)

    return {
        "grid_sample": lambda: F.grid_sample(image, grid, align_corners=False),
        "kornia warp_perspective": lambda: warp_perspective(image, homography, GRID.shape),
        "BEVWarp": lambda: warp(image, ideal, extrinsics, image_size=SIZE),
        "BEVWarp, 5 coefficients": with_lens(BROWN),
        "BEVWarp, 8 coefficients": with_lens(RATIONAL),
        "BEVWarp, fisheye": with_lens(FISHEYE, "fisheye"),
    }


def stages(distortion: list[float] | None) -> Calls:
    """The stages of a view of one image: alone, in a warm cache, and before the resampling."""
    image, grid, warp, extrinsics = torch.rand(1, 3, *SIZE), sampling_grid(1), BEVWarp(GRID), poses(1)
    ideal = camera().intrinsics.float()[None]
    lens = None if distortion is None else torch.tensor([distortion])

    def matrices() -> tuple[CellSums, Lens | None]:
        scaled = normalised_intrinsics(ideal, SIZE)
        return cells_and_lens(GRID, scaled, extrinsics, lens, "pinhole", torch.float32)

    def maps() -> object:
        return sampling_maps(*matrices(), [MapSize(*SIZE)], SIZE)

    def sample() -> Tensor:
        return F.grid_sample(image, grid, align_corners=False)

    return {
        "grid_sample": sample,
        "matrices alone": matrices,
        "matrices and map alone": maps,
        "matrices, grid_sample": lambda: (matrices(), sample()),
        "matrices, map, grid_sample": lambda: (maps(), sample()),
        "all of BEVWarp": lambda: warp(image, ideal, extrinsics, lens, image_size=SIZE),
    }


def backwards(batch: int, channels: int, stride: int) -> Calls:
    """The same with gradients of the image and of what it is sampled at."""
    image = torch.rand(batch, channels, SIZE[0] // stride, SIZE[1] // stride, requires_grad=True)
    grid = sampling_grid(batch).requires_grad_()
    values = torch.tensor([POSE]).repeat(batch, 1).requires_grad_()
    ideal, warp = camera().intrinsics.float().expand(batch, 3, 3), BEVWarp(GRID)
    coarse = torch.diag(torch.tensor([1 / stride, 1 / stride, 1.0]))
    weight = torch.rand(batch, channels, *GRID.shape)

    def both(forward: Callable[[], Tensor]) -> Callable[[], object]:
        def run() -> None:
            image.grad = grid.grad = values.grad = None
            forward().backward(weight)

        return run

    def warped(distortion: list[float] | None = None, model: str = "pinhole") -> Callable[[], object]:
        lens = None if distortion is None else torch.tensor([distortion]).expand(batch, -1)
        return both(lambda: warp(image, ideal, Extrinsics.unstack(values), lens, model, SIZE)[0])

    def by_kornia() -> Tensor:
        homography = bev_from_image(Extrinsics.unstack(values), coarse @ ideal, GRID)
        bev: Tensor = warp_perspective(image, homography, GRID.shape)
        return bev

    return {
        "grid_sample": both(lambda: F.grid_sample(image, grid, align_corners=False)),
        "kornia warp_perspective": both(by_kornia),
        "BEVWarp": warped(),
        "BEVWarp, 5 coefficients": warped(BROWN),
        "BEVWarp, 8 coefficients": warped(RATIONAL),
        "BEVWarp, fisheye": warped(FISHEYE, "fisheye"),
    }


def frames(model: str) -> Calls:
    """One frame of bytes through a lens."""
    taken = camera(FISHEYE if model == "fisheye" else BROWN, model)
    frame = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), np.uint8)
    extrinsics = Extrinsics(*(value.double() for value in poses(1)))
    matrix, distortion = taken.intrinsics.numpy(), taken.distortion.numpy()
    turn = (bev_from_image(extrinsics, taken.intrinsics[None], GRID)[0] @ taken.intrinsics).numpy()
    rectify: Any = cv2.fisheye.initUndistortRectifyMap if model == "fisheye" else cv2.initUndistortRectifyMap
    shape = (GRID.shape[1], GRID.shape[0])

    def maps() -> tuple[Any, Any]:
        first, second = rectify(matrix, distortion, turn, np.eye(3), shape, cv2.CV_16SC2)
        return first, second

    ready = maps()
    return {
        "cv2.remap": lambda: cv2.remap(frame, *ready, cv2.INTER_LINEAR),
        "cv2 maps and remap": lambda: cv2.remap(frame, *maps(), cv2.INTER_LINEAR),
        "remap_frame": lambda: remap_frame(frame, taken, extrinsics, GRID),
    }


def extractors() -> Calls:
    """Seven maps with six stripes, as the shipped network makes them of 576 × 320 px."""
    rows, columns = torch.arange(160.0).unsqueeze(-1), torch.arange(288.0)
    slopes = torch.tensor([-1.6, -1.0, -0.4, 0.3, 0.9, 1.5])
    middle = 144 + slopes[:, None, None] * (rows - 30)
    stripes = 8.0 * ((columns - middle).abs() < 1.2) * (rows > 40)
    logits = torch.cat([torch.full((1, 160, 288), 4.0), stripes])[None]
    logits = logits + 0.3 * torch.randn(logits.shape, generator=torch.Generator().manual_seed(0))
    extractor = LineExtractor()
    return {
        "softmax": lambda: logits.softmax(1),
        "LineExtractor": lambda: extractor(logits, SIZE, (320, 576)),
    }


def calibrators(rows: int, per_boundary: int) -> Calls:
    """One frame of each calibrator that is sure of its start: see ``JointConfig.doubt_frames``."""
    one = lanes(per=per_boundary, noise=0.5)
    seen = LaneSegments(*(part.expand(rows, *part.shape[1:]) for part in one))
    intrinsics = INTRINSICS.expand(rows, 3, 3)
    calls: dict[str, Callable[[], object]] = {}
    for name, calibrator in (("joint", JointCalibrator()), ("two-stage", TwoStageCalibrator())):
        state: Any = calibrator.initial_state(1, dtype=torch.float64)
        for _ in range(20):  # of one row, which the others equal
            _, state = calibrator(one, INTRINSICS.expand(1, 3, 3), state, 1 / 30)
        state = map_tensors(lambda part: part.expand(rows, *part.shape[1:]).clone(), state)
        calls[name] = partial(calibrator, seen, intrinsics, state, 1 / 30)
    return calls


def cells(resolution: float) -> Calls:
    """The warp on grids of one rectangle."""
    grid = BEVGrid(GRID.x, GRID.z, resolution)
    image, ideal, warp = torch.rand(1, 3, *SIZE), camera().intrinsics[None].float(), BEVWarp(grid)
    lens = torch.tensor([BROWN])
    return {
        "BEVWarp": lambda: warp(image, ideal, poses(1)),
        "BEVWarp, 5 coefficients": lambda: warp(image, ideal, poses(1), lens),
    }


Growth = tuple[str, list[int], Callable[[int], Calls]]

TABLES: dict[str, list[tuple[str, Callable[[], Calls]]]] = {
    "warp": [
        ("one image", lambda: warps(1, 3, 1)),
        ("8 images", lambda: warps(8, 3, 1)),
        ("64 channels at stride 8", lambda: warps(1, 64, 8)),
    ],
    "stages": [
        ("stages without a lens", lambda: stages(None)),
        ("stages with 5 coefficients", lambda: stages(BROWN)),
    ],
    "gradients": [
        ("one image and back", lambda: backwards(1, 3, 1)),
        ("8 images and back", lambda: backwards(8, 3, 1)),
        ("64 channels at stride 8 and back", lambda: backwards(1, 64, 8)),
    ],
    "frame": [
        ("a frame of bytes", lambda: frames("pinhole")),
        ("a fisheye's frame of bytes", lambda: frames("fisheye")),
    ],
    "extractor": [("maps to segments", extractors)],
}
GROWTHS: dict[str, Growth] = {
    "rows": ("rows of a batch", [1, 4, 16, 64, 256, 1024, 4096], lambda rows: calibrators(rows, 5)),
    "segments": ("segments", [12, 36, 120, 1200, 10_200], lambda count: calibrators(1, count // 6)),
    "cells": (
        "cells of the view",
        [10_000, 100_000, 1_000_000, 10_000_000],
        lambda count: cells((20.48 * 40.96 / count) ** 0.5),
    ),
}


def shown(title: str, table: Table) -> str:
    """A markdown table, ratios first."""
    lines = [f"**{title}**", "", "| | ratio | ms | quartiles | target |", "|---|---|---|---|---|"]
    for name, entry in table.items():
        quartiles = f"{entry['low']:.2f} to {entry['high']:.2f}"
        lines.append(
            f"| {name} | {entry['ratio']:.2f} | {entry['ms']:.2f} | {quartiles} | {verdict(name, entry)} |"
        )
    return "\n".join([*lines, ""])


def overview(tables: Mapping[str, Table]) -> str:
    """A markdown table of all ratios, bold where a target is missed, and how many are met."""
    names = list(dict.fromkeys(name for table in tables.values() for name in table))
    lines = [f"| | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for title, table in tables.items():
        row = [_ratio(table[name]) if name in table else "" for name in names]
        lines.append(f"| {title} | {' | '.join(row)} |")
    met = [entry["met"] for table in tables.values() for entry in table.values() if "met" in entry]
    return "\n".join(["**ratios**", "", *lines, "", f"{sum(map(int, met))} of {len(met)} targets met", ""])


def _ratio(entry: Mapping[str, float]) -> str:
    return f"{entry['ratio']:.2f}" if entry.get("met", True) else f"**{entry['ratio']:.2f}**"


def grown(title: str, results: dict[int, Table]) -> str:
    """A markdown table of ms by size."""
    names = list(next(iter(results.values())))
    lines = [f"**ms by {title}**", "", f"| {title} | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for size, table in results.items():
        lines.append(f"| {size} | " + " | ".join(f"{table[name]['ms']:.2f}" for name in names) + " |")
    return "\n".join([*lines, ""])


def plot(title: str, results: dict[int, Table], path: Path) -> None:
    """Cost against size, both logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3.2), layout="constrained")
    axes = figure.subplots()
    for name in next(iter(results.values())):
        entries = [table[name] for table in results.values()]
        axes.plot(list(results), [entry["ms"] for entry in entries], marker="o", label=name)
        axes.fill_between(list(results), [e["low"] for e in entries], [e["high"] for e in entries], alpha=0.2)
    axes.set(xscale="log", yscale="log", xlabel=title, ylabel="ms")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(path, metadata={"Date": None})


def facts(threads: int) -> dict[str, object]:
    return {
        "threads": threads,
        "seed": 0,
        "image": list(SIZE),
        "grid": list(GRID.shape),
        "torch": torch.__version__,
        "kornia": kornia.__version__,
        "cv2": cv2.__version__,
        "machine": platform.machine(),
        "processor": platform.processor(),
    }


def run(
    parts: list[str],
    seconds: float,
    largest: int,
    out: Path,
    clock: Callable[[], float],
    longest: float = 20.0,
) -> dict[str, Any]:
    """Measure the parts, print each table as it is done, and write all."""
    out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {}
    texts = []
    tables: dict[str, Table] = {}
    for part in parts:
        for title, calls in TABLES.get(part, []):
            with torch.set_grad_enabled(part == "gradients"):
                table = judged(measure(calls(), seconds, clock))
            results[title] = tables[title] = table
            texts.append(shown(title, table))
            print(texts[-1], flush=True)
        if part in GROWTHS:
            title, sizes, make = GROWTHS[part]
            by_size: dict[int, Table] = {}
            for size in sizes:
                slowest = max(
                    (entry["ms"] for table in by_size.values() for entry in table.values()), default=0
                )
                if size <= largest and slowest < 1e3 * longest:
                    with torch.no_grad():
                        by_size[size] = measure(make(size), seconds, clock)
            results[title] = {str(size): table for size, table in by_size.items()}
            texts.append(grown(title, by_size))
            print(texts[-1], flush=True)
            plot(title, by_size, out / f"{part}.svg")
    if tables:
        texts.append(overview(tables))
        print(texts[-1], flush=True)
    report = {**facts(torch.get_num_threads()), "clock": clock.__name__, "results": results}
    (out / "bench_speed.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    (out / "bench_speed.md").write_text("\n".join(texts), encoding="utf-8")
    return report


@one_line_errors()
def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    every = [*TABLES, *GROWTHS]
    parser.add_argument("--parts", nargs="+", choices=every, default=every)
    parser.add_argument("--threads", type=PositiveInt, default=2)
    parser.add_argument("--cpu-time", action="store_true", help="processor time, with --threads 1")
    parser.add_argument("--seconds", type=PositiveFloat, default=5.0, help="per alternative (%(default)s)")
    parser.add_argument("--largest", type=PositiveInt, default=10_000_000, help="size that costs grow to")
    parser.add_argument(
        "--longest",
        type=PositiveFloat,
        default=20.0,
        help="seconds of a call after which no larger size is tried",
    )
    parser.add_argument("--out", type=Path, default=Path("out/bench_speed"))
    args = parser.parse_args()
    if args.cpu_time and args.threads != 1:
        raise ValueError(f"cpu-time: expected --threads 1, got {args.threads}")
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    torch.manual_seed(0)
    clock = time.process_time if args.cpu_time else time.perf_counter
    run(args.parts, args.seconds, args.largest, args.out, clock, args.longest)


if __name__ == "__main__":
    main()
