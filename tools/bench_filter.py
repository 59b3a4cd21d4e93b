"""Compare the information form of the Kalman update with the paper's gain form in time and result.

    python -m tools.bench_filter --out out/bench_filter.json

The gain form is Eqs. (15)-(17) as printed, which solves for the N × N innovation covariance.
"""

import json
from pathlib import Path

import torch
from jsonargparse.typing import PositiveFloat, PositiveInt
from torch import Tensor
from torch.utils.benchmark import Timer

from lanebev.estimation import kalman
from train.commands import command_parser, one_line_errors, versions


def information_form(
    mean: Tensor, cov: Tensor, innovation: Tensor, jacobian: Tensor, measurement_noise: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute the update as the package does it."""
    return kalman.update(mean, cov, *kalman.information(innovation, jacobian, measurement_noise))


def problem(rows: int, seed: int = 0) -> tuple[Tensor, ...]:
    """Sample a random update with four states, scaled like pitch, yaw and their rates."""
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(4, 4, generator=generator, dtype=torch.float64) * 0.03
    jacobian = torch.randn(rows, 4, generator=generator, dtype=torch.float64) * 0.2
    jacobian[:, 2:] = 0
    noise = torch.rand(rows, generator=generator, dtype=torch.float64) * 1e-6 + 1e-7
    innovation = torch.randn(rows, generator=generator, dtype=torch.float64) * 1e-3
    cov = root @ root.T + 1e-4 * torch.eye(4, dtype=torch.float64)
    return torch.zeros(4, dtype=torch.float64), cov, innovation, jacobian, noise


def measure(rows: int, seconds: float) -> dict[str, float]:
    """Measure the median ms of both forms, their ratio, and the largest difference of their results."""
    inputs = problem(rows)
    names = dict(zip(("m", "p", "y", "h", "q"), inputs, strict=True))
    milliseconds = {}
    for name, form in (("gain", kalman.update_gain_form), ("information", information_form)):
        timer = Timer(
            "form(m, p, y, h, q)", globals={"form": form, **names}, num_threads=torch.get_num_threads()
        )
        milliseconds[name] = timer.blocked_autorange(min_run_time=seconds).median * 1e3
    pairs = zip(kalman.update_gain_form(*inputs), information_form(*inputs), strict=True)
    difference = max(float((a - b).abs().max() / a.abs().max()) for a, b in pairs)
    return {
        "rows": rows,
        "gain_ms": milliseconds["gain"],
        "information_ms": milliseconds["information"],
        "ratio": milliseconds["gain"] / milliseconds["information"],
        "largest_relative_difference": difference,
    }


@one_line_errors()
def main() -> None:
    parser = command_parser(__doc__)
    parser.add_argument("--rows", type=PositiveInt, nargs="+", default=[60, 180, 408, 816])
    parser.add_argument("--seconds", type=PositiveFloat, default=1.0, help="seconds per measurement")
    parser.add_argument("--out", type=Path, default=Path("out/bench_filter.json"))
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)  # small matrices: more threads only wait for each other
    results = [measure(rows, args.seconds) for rows in args.rows]
    print(f"{'rows':>5} {'gain ms':>9} {'information ms':>15} {'ratio':>6} {'difference':>11}")
    for r in results:
        print(
            f"{r['rows']:>5.0f} {r['gain_ms']:>9.3f} {r['information_ms']:>15.3f} {r['ratio']:>6.1f} "
            f"{r['largest_relative_difference']:>11.1e}"
        )
    args.out.write_text(json.dumps({**versions(), "seed": 0, "results": results}, indent=1))


if __name__ == "__main__":
    main()
