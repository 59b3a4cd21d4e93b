"""The parts of the benchmark: what is timed against what, and at which sizes."""

import json
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import kornia
import torch

from tools.bench_speed import calibration, scene, views
from tools.bench_speed.measuring import Calls, Table, grown, judged, measure, overview, plot, shown

Growth = tuple[str, list[int], Callable[[int], Calls]]

TABLES: dict[str, list[tuple[str, Callable[[], Calls]]]] = {
    "warp": [
        ("one image", lambda: views.warps(1, 3, 1)),
        ("8 images", lambda: views.warps(8, 3, 1)),
        ("64 channels at stride 8", lambda: views.warps(1, 64, 8)),
    ],
    "stages": [
        ("stages without a lens", lambda: views.stages(None)),
        ("stages with 5 coefficients", lambda: views.stages(scene.BROWN)),
    ],
    "compiled": [
        ("compiled without a lens", lambda: views.compiled(None)),
        ("compiled with 5 coefficients", lambda: views.compiled(scene.BROWN)),
    ],
    "compiled_step": [("a compiled frame of the joint calibrator", calibration.compiled)],
    "gradients": [
        ("one image and back", lambda: views.backwards(1, 3, 1)),
        ("8 images and back", lambda: views.backwards(8, 3, 1)),
        ("64 channels at stride 8 and back", lambda: views.backwards(1, 64, 8)),
    ],
    "frame": [
        ("a frame of bytes", lambda: views.frames(scene.BROWN)),
        ("an undistorted frame of bytes", lambda: views.frames([])),
        ("a fisheye's frame of bytes", lambda: views.frames(scene.FISHEYE, "fisheye")),
    ],
    "extractor": [("maps to segments", calibration.extractors)],
}
GROWTHS: dict[str, Growth] = {
    "rows": (
        "rows of a batch",
        [1, 4, 16, 64, 256, 1024, 4096],
        lambda rows: calibration.calibrators(rows, 5),
    ),
    "dense": (
        "rows of 408 segments",
        [1, 16, 256],
        lambda rows: calibration.calibrators(rows, 68),
    ),
    "segments": (
        "segments",
        [12, 36, 120, 1200, 10_200],
        lambda count: calibration.calibrators(1, count // 6),
    ),
    "cells": (
        "cells of the view",
        [10_000, 100_000, 1_000_000, 10_000_000],
        lambda count: views.cells((20.48 * 40.96 / count) ** 0.5),
    ),
}


def facts(threads: int) -> dict[str, object]:
    return {
        "threads": threads,
        "seed": 0,
        "image": list(scene.SIZE),
        "grid": list(scene.GRID.shape),
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
            slowest = 0.0
            for size in (size for size in sizes if size <= largest):
                if slowest < 1e3 * longest:
                    with torch.no_grad():
                        by_size[size] = measure(make(size), seconds, clock)
                    slowest = max(slowest, *(entry["ms"] for entry in by_size[size].values()))
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
