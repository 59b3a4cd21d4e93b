"""The paper's Table I: RMSE over 300 frames and 100 Monte Carlo runs, beside the Cramér-Rao bound.

    python -m tools.reproduce_table1 --out out/table1

Prints "paper | here | bound" in degrees and centimetres at 30 and at 68 segments per boundary, and writes
table1.json and table1.png (estimate against truth).
"""

import json
import math
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from jsonargparse.typing import PositiveInt

from lanebev.app.drive.build import make_calibrator
from lanebev.estimation.calibrator import Calibrator
from lanebev.estimation.joint.config import JointConfig
from lanebev.estimation.joint.smoother import smooth_drive
from lanebev.estimation.kalman import symmetrise
from lanebev.testing.evaluation import UNITS
from lanebev.testing.experiment import Experiment, frames
from lanebev.types import AXES, Status
from train.commands import command_parser, one_line_errors, versions

VARIANCES = (0.5, 1.0, 2.0, 4.0, 9.0)
PAPER = {  # Table I: pitch, yaw, roll in degrees, height in centimetres
    0.5: (0.037, 0.104, 0.059, 0.60),
    1.0: (0.039, 0.105, 0.067, 0.69),
    2.0: (0.045, 0.111, 0.077, 0.83),
    4.0: (0.056, 0.120, 0.090, 1.03),
    9.0: (0.060, 0.141, 0.114, 1.40),
}


def run(
    calibrator: Calibrator[Any],
    exp: Experiment,
    runs: int,
    dtype: torch.dtype,
    seed: int,
    smooth: bool = False,
) -> dict[str, torch.Tensor]:
    """Run every noise level and every repetition as one row of the batch.

    Returns errors (T, V, R, 4), estimates (T, V, R, 4), NEES (T, V, R), truth and unit bound (T, 4), and the
    share of frames in TRACKING (V,). ``smooth``: of every frame from all frames.
    """
    generator = torch.Generator().manual_seed(seed)
    rows = runs * len(VARIANCES)
    std = torch.tensor(VARIANCES, dtype=torch.float64).sqrt().repeat_interleave(runs)
    intrinsics = exp.intrinsics().to(dtype).expand(rows, 3, 3)
    state = calibrator.initial_state(rows, dtype=dtype)
    calibrations, states, truths, bounds = [], [], [], []
    for frame in frames(exp, rows, generator):
        segments = frame.segments(std, generator, dtype)
        calibration, state = calibrator(segments, intrinsics, state, 1 / exp.fps, exp.lane_width)
        calibrations.append(calibration)
        states += [state] if smooth else []
        truths.append(frame.truth)
        bounds.append(frame.bound)
    if smooth:
        steps = [torch.full((rows,), 1 / exp.fps, dtype=dtype)] * exp.num_frames
        calibrations = smooth_drive(calibrations, states, steps, JointConfig())
    estimates, nees, tracking = [], [], []
    for calibration, true in zip(calibrations, truths, strict=True):
        estimate = calibration.extrinsics.stack().double()
        error = estimate - true
        cov = symmetrise(calibration.covariance.double())
        nees.append((error * torch.linalg.solve(cov, error)).sum(-1).reshape(len(VARIANCES), runs))
        estimates.append(estimate.reshape(len(VARIANCES), runs, 4))
        tracking.append((calibration.status == Status.TRACKING).reshape(len(VARIANCES), runs))
    truth = torch.stack(truths)
    estimate = torch.stack(estimates)
    return {
        "estimates": estimate,
        "errors": estimate - truth[:, None, None],
        "nees": torch.stack(nees),
        "truth": truth,
        "bound": torch.stack(bounds),
        "tracking": torch.stack(tracking).double().mean(dim=(0, 2)),
    }


def table(result: dict[str, torch.Tensor]) -> list[dict[str, object]]:
    """Return the RMSE of the paper, this run and the bound, and NEES, for each noise level."""
    rows: list[dict[str, object]] = []
    rmse = result["errors"].square().mean(dim=(0, 2)).sqrt() * UNITS
    unit = result["bound"].square().mean(0).sqrt() * UNITS
    for index, variance in enumerate(VARIANCES):
        rows.append(
            {
                "variance": variance,
                "paper": list(PAPER[variance]),
                "here": rmse[index].tolist(),
                "bound": (unit * math.sqrt(variance)).tolist(),
                "nees_per_dof": float(result["nees"][:, index].mean() / 4),
                "tracking": float(result["tracking"][index]),
            }
        )
    return rows


def show(rows: list[dict[str, object]], title: str) -> None:
    """Print one table."""
    print(f"\n{title}")
    print(
        f"{'σ²':>4} | "
        + " | ".join(f"{n + ' paper':>12} {'here':>7} {'bound':>7}" for n in AXES)
        + " | NEES/dof"
    )
    for row in rows:
        cells = zip(row["paper"], row["here"], row["bound"], strict=True)  # type: ignore[call-overload]
        print(
            f"{row['variance']:>4} | "
            + " | ".join(f"{p:>12.3f} {h:>7.4f} {b:>7.4f}" for p, h, b in cells)
            + f" | {row['nees_per_dof']:.2f}"
        )


def plot(result: dict[str, torch.Tensor], exp: Experiment, path: Path) -> None:
    """Estimate of the first run against truth, at the lowest and the highest noise."""
    from matplotlib.figure import Figure

    t = torch.arange(exp.num_frames) / exp.fps
    figure = Figure(figsize=(13, 9), layout="tight")
    axes = figure.subplots(4, 2, sharex=True, gridspec_kw={"width_ratios": [3, 2]})
    for k, name in enumerate(AXES):
        unit = "cm" if name == "height" else "deg"
        for index, colour in ((-1, "tab:orange"), (1, "tab:blue")):
            label = f"σ² = {VARIANCES[index]:g}"
            estimate = result["estimates"][:, index, 0, k] * UNITS[k]
            axes[k, 0].plot(t, estimate, color=colour, lw=1, label=label)
            axes[k, 1].plot(t, result["errors"][:, index, 0, k] * UNITS[k], color=colour, lw=0.8, label=label)
        axes[k, 0].plot(t, result["truth"][:, k] * UNITS[k], "k--", lw=0.8, label="truth")
        axes[k, 0].set_ylabel(f"{name} ({unit})")
        axes[k, 1].axhline(0, color="k", lw=0.5)
        axes[k, 1].set_ylabel(f"error ({unit})")
    axes[0, 0].legend(loc="upper right", ncol=3, fontsize=8)
    axes[-1, 0].set_xlabel("time (s)")
    axes[-1, 1].set_xlabel("time (s)")
    figure.savefig(path, dpi=110)


@one_line_errors()
def main() -> None:
    parser = command_parser(__doc__)
    parser.add_argument("--calibrator", choices=("two-stage", "joint"), default="two-stage")
    parser.add_argument(
        "--smooth", action="store_true", help="estimate every pose from all frames; joint only"
    )
    parser.add_argument("--runs", type=PositiveInt, default=100, help="Monte Carlo runs per noise level")
    parser.add_argument("--frames", type=PositiveInt, default=300)
    parser.add_argument(
        "--segments", type=PositiveInt, nargs="+", default=[30, 68], help="segments per boundary"
    )
    parser.add_argument("--float32", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/table1"))
    args = parser.parse_args()
    if args.smooth and args.calibrator != "joint":
        raise ValueError(f"smooth: expected --calibrator joint with it, got {args.calibrator}")
    args.out.mkdir(parents=True, exist_ok=True)
    dtype = torch.float32 if args.float32 else torch.float64
    report: dict[str, object] = {
        "calibrator": args.calibrator,
        "smooth": args.smooth,
        "runs": args.runs,
        "seed": args.seed,
        "dtype": str(dtype),
        **versions(),
    }
    worst, name = 0.0, args.calibrator + ("_smoothed" if args.smooth else "")
    for per_boundary in args.segments:
        exp = replace(Experiment(), segments_per_boundary=per_boundary, num_frames=args.frames)
        began = time.perf_counter()
        result = run(make_calibrator(args.calibrator), exp, args.runs, dtype, args.seed, args.smooth)
        rows = table(result)
        seconds = time.perf_counter() - began
        show(
            rows,
            f"{name}, {per_boundary} segments per boundary, {args.runs} runs ({seconds:.0f} s)",
        )
        report[f"segments_{per_boundary}"] = {"experiment": asdict(exp), "rows": rows, "seconds": seconds}
        plot(result, exp, args.out / f"table1_{name}_{per_boundary}.png")
        worst = max(worst, *(h / p for row in rows for h, p in zip(row["here"], row["paper"], strict=True)))  # type: ignore[call-overload]
    print(f"\nlargest ratio to the paper's table: {worst:.2f} (at or below 1: every cell is met)")
    (args.out / f"table1_{name}.json").write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
