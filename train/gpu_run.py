"""Train weights in a few minutes on a GPU: ``python -m train.gpu_run --minutes 9 --out OUT``.

It trains (``configs/gpu.yaml``), exports and evaluates within the given time:

    OUT/weights.safetensors      final averaged weights, with the measured pose_sigma_scale
    OUT/snapshot-1, -2           the same after a third and two thirds of the training
    OUT/figures.json             views, noise and held-out recall
    OUT/throughput.csv, fit.log  how the run used its time

Training runs in a separate process. If it runs out of memory, it continues from its last checkpoint with
half the batch; after another failure it continues unchanged; if it does not end, it is stopped. The newest
checkpoint is exported in any case. The noise is measured on the second snapshot, on the CPU while training
continues; if there is time, measure that of the final weights with ``python -m train.noise``. ``--smoke
--minutes 1.5`` does everything once, after ``python -m train.smoke``.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from jsonargparse.typing import PositiveFloat, PositiveInt

from lanebev.io.output.whole_file import whole_file
from train.commands import command_parser, one_line_errors
from train.evaluate_roads import HELD_OUT_SEED, OWN_KINDS, evaluate, records
from train.export import checkout_commit, export, trained_segmenter
from train.processes import Measurement, Training

START = 25.0  # s, imports and the first batch
EXPORT = 6.0  # s, reading a checkpoint and writing weights
RECALL = 25.0  # s, after which no further batch begins
BATCH = 5.0  # s, kept for the first batch of the recall, whose time is not known before
FIXED = START + RECALL + 2 * EXPORT
SMOKE = 120.0  # s at most, before the given time begins
GRACE = 20.0  # s, a training may take to end by itself
SHARES = (1 / 3, 2 / 3)
RESTARTS = 6
SIGMA_SCALE = 2.25  # see train.noise


def train_until(
    training: Training,
    deadline: float,
    snapshot: Callable[[int], None],
) -> None:
    """Train to the deadline (of ``time.monotonic``), with snapshots 1 and 2, also after failures."""
    begin = time.monotonic()
    budget = deadline - begin - START
    training.start(budget)
    wanted = [begin + START + share * budget for share in SHARES]
    restarts = 0
    while True:
        time.sleep(0.5)
        now = time.monotonic()
        status = training.ended()
        if status == 0:
            return
        if status is not None:
            restarts += 1
            left = deadline - now - START
            if restarts > RESTARTS or left < 5:
                print(f"gpu_run: training ended with status {status}, and is not begun again", flush=True)
                return
            if training.out_of_memory():
                training.batch_share /= 2
            print(f"gpu_run: status {status}, on with {training.batch_share} of the batch", flush=True)
            training.start(training.trained() + left)
        elif now > deadline + GRACE:
            print("gpu_run: training did not end in time and is ended", flush=True)
            training.stop()
            return
        if wanted and now >= wanted[0]:
            wanted.pop(0)
            snapshot(len(SHARES) - len(wanted))


def save(training: Training, path: Path, changes: dict[str, Any], record: dict[str, Any]) -> bool:
    """Export the newest checkpoint, and return whether there was one. Errors are printed."""
    newest = training.checkpoint()
    if newest is None:
        print(f"gpu_run: no checkpoint for {path.name} yet", flush=True)
        return False
    try:
        with whole_file(path) as whole:
            export(newest, whole, changes, **record)
    except (ValueError, OSError, RuntimeError) as error:  # a run goes on without it
        print(f"gpu_run: {path.name}: {error}", flush=True)
        return False
    print(f"gpu_run: {path.name} of {newest.name}, {path.stat().st_size / 1e6:.1f} MB", flush=True)
    return True


def pose_scale(noise: list[dict[str, Any]]) -> dict[str, float]:
    """Return the sigma scale of the shipped weights and the pose's that was measured with it, or nothing."""
    return next(
        (
            {"sigma_scale": SIGMA_SCALE, "pose_sigma_scale": max(1.0, line["pose_sigma_scale"])}
            for line in noise
            if line["factor"] == SIGMA_SCALE and line["pose_sigma_scale"] is not None
        ),
        {},
    )


def _commit() -> str:
    try:
        return checkout_commit()
    except ValueError as error:
        print(f"gpu_run: {error}", flush=True)
        return "unknown"


def time_parts(out: Path, seconds: float) -> None:
    """Run ``train.smoke``, for so long at most. Errors are printed."""
    try:
        subprocess.run([sys.executable, "-m", "train.smoke", "--out", str(out)], timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        print("gpu_run: train.smoke took too long and is ended", flush=True)


def held_out_recall(weights: Path, views: int, until: float) -> list[dict[str, Any]]:
    """Evaluate weights on held-out views, on the GPU if there is one, within RECALL.

    It ends before ``until``, a time of ``time.monotonic``, if no batch takes longer than BATCH. It runs in
    this process, which has loaded all it needs already. Errors are printed.
    """
    cuda = torch.cuda.is_available()
    try:
        segmenter = trained_segmenter(weights)[0].to("cuda" if cuda else "cpu")
        each, batch = -(-views // len(OWN_KINDS)), 64 if cuda else 8
        deadline = min(time.monotonic() + RECALL, until - BATCH)
        return records(evaluate(segmenter, each, list(OWN_KINDS), HELD_OUT_SEED, batch, deadline))
    except (ValueError, RuntimeError) as error:  # the weights are there without it
        print(f"gpu_run: recall: {error}", flush=True)
        return []


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("--minutes", type=PositiveFloat, default=9.0, help="duration of the whole command")
    parser.add_argument("--out", type=Path, required=True, help="output folder")
    parser.add_argument("--work", type=Path, help="folder of the checkpoints (default: a temporary one)")
    parser.add_argument("--config", type=Path, default=Path("configs/gpu.yaml"))
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument(
        "--views", type=PositiveInt, default=384, help="number of held-out views for the recall"
    )
    parser.add_argument("--smoke", action="store_true", help="time the parts first")
    args, options = parser.parse_known_args()
    if 60 * args.minutes <= FIXED:
        raise ValueError(
            f"--minutes: expected more than {FIXED / 60:.1f}, which start, export and evaluation take, got "
            f"{args.minutes:g}"
        )
    begin = time.monotonic()
    args.out.mkdir(parents=True, exist_ok=True)
    work = args.work or Path(tempfile.mkdtemp(prefix="lanebev-"))
    if args.smoke:
        time_parts(args.out, SMOKE)
    end = time.monotonic() + 60 * args.minutes
    record = {"seed": args.seed, "commit": _commit()}
    seeds = [f"--seed_everything={args.seed}", f"--data.init_args.seed={args.seed}"]
    training = Training(args.config, work, args.out / "fit.log", [*seeds, *options])
    weights, until_export = args.out / "weights.safetensors", end - RECALL - 2 * EXPORT
    seconds = until_export - time.monotonic()
    noise: list[Measurement] = []

    def snapshot(number: int) -> None:
        path = args.out / f"snapshot-{number}.safetensors"
        if save(training, path, {}, record) and number == len(SHARES):
            jobs = max(1, (os.cpu_count() or 2) - 4)
            amount = [f"--drives={max(12, jobs)}", "--frames=40", f"--jobs={jobs}"]
            noise.append(Measurement("train.noise", str(path), *amount))

    try:
        train_until(training, until_export, snapshot)
    finally:
        training.stop()
        there = save(training, weights, {}, record)
        for table in sorted(work.rglob("throughput.csv")):
            shutil.copy(table, args.out / "throughput.csv")
    if not there:
        raise ValueError(
            f"{work}: expected a checkpoint of {seconds:.0f} s of training, got none; give more than "
            f"--minutes {args.minutes:g}, unless {args.out / 'fit.log'} ends with an error; {args.config} is "
            "for a GPU"
        )
    until = end - EXPORT
    figures = {"recall": held_out_recall(weights, args.views, until)}
    figures["noise"] = noise[0].result(until - time.monotonic()) if noise else []
    (args.out / "figures.json").write_text(json.dumps(figures, indent=1))
    save(training, weights, pose_scale(figures["noise"]), {**record, "metrics": figures["recall"]})
    print(f"gpu_run: done in {time.monotonic() - begin:.0f} s: {sorted(p.name for p in args.out.iterdir())}")


if __name__ == "__main__":
    main()
