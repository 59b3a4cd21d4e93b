"""Every calibrator on every hard drive of lanebev/testing/scenarios.py, Monte Carlo runs as rows of a batch.

    python -m tools.bench_calibration --out out/bench

Prints and writes (bench.json) the RMSE of every parameter, its ratio to the per-frame Cramér-Rao
bound, NEES per degree of freedom, the time in each status and the time to recover. ``--stream N`` runs N
frames of an endless drive and watches memory, covariance, drift, and float32 against float64. ``--kinds N``
draws N drives of each kind of ``tools/random_drives.py``, motions and shocks at random, and runs the joint
calibrator; with ``--calibrators two-stage`` that one.

"Hard" frames are those a scenario names (nothing to see, a bump, a line crossed); they are counted on their
own. The first half second is left out of every figure.
"""

import importlib.util
import json
import math
import resource
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jsonargparse.typing import PositiveFloat, PositiveInt
from torch import Tensor

from lanebev.estimation.joint.calibrator import JointCalibrator
from lanebev.estimation.joint.config import HILLY_ROADS
from lanebev.estimation.two_stage.calibrator import TwoStageCalibrator
from lanebev.geometry.precision import cast_floating
from lanebev.testing.evaluation import NAMES, UNITS, WARM_UP, rms, summarise, track
from lanebev.testing.moments import CAMERA, FPS, WIDTH, moments, observe
from lanebev.testing.scenarios import SCENARIOS
from lanebev.types import Status
from tools.bench_kinds import measure_all, measure_two_stage
from tools.textbook_ekf import TextbookEKF
from train.commands import command_parser, one_line_errors, versions

CALIBRATORS: dict[str, Callable[[], Any]] = {
    "joint": JointCalibrator,
    "two-stage": TwoStageCalibrator,
    "textbook EKF": TextbookEKF,
    "joint-hilly-roads": partial(JointCalibrator, HILLY_ROADS),
}
PER_BOUNDARY = 8  # segments, of :func:`stream`
DEFAULT = ("joint", "two-stage", "textbook EKF")


def run_scenarios(
    names: list[str], scenarios: list[str], rows: int, seconds: float | None, sigma: float
) -> dict[str, Any]:
    """Run all scenarios with all calibrators; return figures by scenario and calibrator."""
    results: dict[str, Any] = {}
    reference: dict[str, Tensor] = {}
    for scenario in scenarios:
        length, change = SCENARIOS[scenario]
        drive = moments(min(length, seconds or length), change)
        results[scenario] = {}
        for name in names:
            began = time.perf_counter()
            run = track(CALIBRATORS[name](), drive, rows if name != "textbook EKF" else min(rows, 4), sigma)
            if name not in reference:
                later = torch.arange(len(run.hard)) >= WARM_UP
                reference[name] = rms(run.errors[later])
            figures = summarise(run, reference[name])
            figures["seconds"] = time.perf_counter() - began
            results[scenario][name] = figures
            print(_line(scenario, name, figures), flush=True)
    return results


def _line(scenario: str, name: str, figures: dict[str, Any]) -> str:
    def numbers(values: list[float]) -> str:
        return " ".join(f"{value:7.3f}" for value in values)

    text = f"{scenario:>32} | {name:>12} | {numbers(figures['rmse'])} | {numbers(figures['ratio_to_bound'])}"
    text += f" | {figures['nees_per_dof']:6.2f} | {_status_text(figures)}"
    if "hard" in figures:
        hard = figures["hard"]
        text += f" | hard: {numbers(hard['rmse'])}, sigma to {numbers(hard['largest_sigma'])}"
        text += f", NEES {hard['nees_per_dof']:.2f}, recovers {_seconds(figures.get('recovery_s'))}"
    return text


def _status_text(figures: dict[str, Any]) -> str:
    shares = figures["time_in_status"]
    return ", ".join(f"{100 * share:.0f} % {name}" for name, share in shares.items() if share > 0)


def _seconds(value: float | None) -> str:
    return "not" if value is None else f"{value:.2f} s"


def stream(frames: int, rows: int) -> dict[str, Any]:
    """Yield an endless straight drive, its observations drawn from one period of the motion and re-noised.

    The same frames go to a float32 and a float64 calibrator.

    Returns:
        memory at a tenth and at the end, smallest eigenvalue of the correlation matrix, RMSE of the first and
        the last tenth, and the difference between the precisions in sigmas.
    """
    period = moments(20.0)  # the motion's frequencies are multiples of 0.1 Hz, the drift's of 0.05 Hz
    bank = list(observe(period, rows, 0.0, PER_BOUNDARY, 0, torch.float64))
    generator = torch.Generator().manual_seed(1)
    single, double = JointCalibrator(), JointCalibrator()
    low = single.initial_state(rows, dtype=torch.float32)
    high = double.initial_state(rows, dtype=torch.float64)
    tenth = max(frames // 10, 1)
    squared = {"first": torch.zeros(4, dtype=torch.float64), "last": torch.zeros(4, dtype=torch.float64)}
    apart, smallest, lost, memory = torch.zeros(4, dtype=torch.float64), math.inf, 0, {}
    with torch.inference_mode():
        for k in range(frames):
            moment, exact = bank[k % len(bank)]
            noise = torch.randn(exact.endpoints.shape, generator=generator, dtype=torch.float64)
            segments = exact._replace(endpoints=exact.endpoints + noise, sigma=torch.ones_like(exact.sigma))
            rough = cast_floating(segments, torch.float32)
            one, low = single(rough, CAMERA.float().expand(rows, 3, 3), low, 1 / FPS, WIDTH)
            two, high = double(segments, CAMERA.expand(rows, 3, 3), high, 1 / FPS, WIDTH)
            pose = two.extrinsics.stack()
            error = pose - torch.tensor(moment.pose, dtype=torch.float64)
            part = "first" if k < tenth else "last" if k >= frames - tenth else None
            if part:
                squared[part] += error.square().mean(0)
            std = two.covariance.diagonal(dim1=1, dim2=2).sqrt()
            apart += ((one.extrinsics.stack().double() - pose) / std).square().mean(0)
            lost += int((one.status != Status.TRACKING).sum() + (two.status != Status.TRACKING).sum())
            if k % 1000 == 0 or k == frames - 1:
                smallest = min(smallest, smallest_eigenvalue(low.cov), smallest_eigenvalue(high.cov))
            if k in (tenth, frames - 1):
                memory[k] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {
        "frames": frames,
        "rows": rows,
        "segments_per_boundary": PER_BOUNDARY,
        "memory_mb": list(memory.values()),
        "smallest_eigenvalue_of_correlation": smallest,
        "rmse_first_tenth": ((squared["first"] / tenth).sqrt() * UNITS).tolist(),
        "rmse_last_tenth": ((squared["last"] / tenth).sqrt() * UNITS).tolist(),
        "float32_from_float64_sigmas": (apart / frames).sqrt().tolist(),
        "rows_not_tracking": lost,
    }


def smallest_eigenvalue(cov: Tensor) -> float:
    """Return the least eigenvalue of correlation matrices (B, D, D): positive if all covariances are."""
    size = cov.double().diagonal(dim1=1, dim2=2).rsqrt()
    return float(torch.linalg.eigvalsh(size.unsqueeze(-1) * cov.double() * size.unsqueeze(-2)).min())


@one_line_errors()
def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = command_parser(__doc__)
    parser.add_argument("--calibrators", nargs="+", choices=list(CALIBRATORS), default=DEFAULT)
    parser.add_argument("--scenarios", nargs="+", choices=list(SCENARIOS), default=list(SCENARIOS))
    parser.add_argument("--rows", type=PositiveInt, default=32, help="Monte Carlo runs")
    parser.add_argument("--sigma", type=PositiveFloat, default=1.0, help="noise of an end point, px")
    parser.add_argument("--quick", action="store_true", help="2 rows, 1.5 s of the first two scenarios")
    parser.add_argument("--stream", type=PositiveInt, metavar="N", help="stream N frames instead")
    parser.add_argument("--kinds", type=PositiveInt, metavar="N", help="N random drives of each kind instead")
    parser.add_argument("--stream-rows", type=PositiveInt, default=2, help="vehicles streamed side by side")
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    args = parser.parse_args(arguments)
    names = [n for n in args.calibrators if n != "textbook EKF" or importlib.util.find_spec("filterpy")]
    if len(names) < len(args.calibrators):
        print("textbook EKF: left out, filterpy is not installed (pip install filterpy)")
    report: dict[str, Any] = {
        **versions(),
        "seed": 0,
        "rows": 2 if args.quick else args.rows,
        "sigma_px": args.sigma,
        "units": NAMES,
    }
    args.out.mkdir(parents=True, exist_ok=True)
    if args.stream:
        report["stream"] = stream(args.stream, args.stream_rows)
        print(json.dumps(report["stream"], indent=1))
        (args.out / "stream.json").write_text(json.dumps(report, indent=1))
        return report
    if args.kinds:
        measured = measure_two_stage if list(args.calibrators) == ["two-stage"] else measure_all
        report["kinds"] = measured(args.kinds)
        (args.out / "kinds.json").write_text(json.dumps(report, indent=1))
        return report
    scenarios = args.scenarios[:2] if args.quick else args.scenarios
    with torch.inference_mode():
        results = run_scenarios(names, scenarios, report["rows"], 1.5 if args.quick else None, args.sigma)
    report["scenarios"] = results
    (args.out / "bench.json").write_text(json.dumps(report, indent=1))
    return report


if __name__ == "__main__":
    main()
