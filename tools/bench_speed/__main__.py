"""Times of views, extractor and calibrators beside those of other libraries, and their growth.

    python -m tools.bench_speed --out out/bench_speed
    python -m tools.bench_speed --parts warp frame --threads 1 --cpu-time

Prints and writes (bench_speed.json, bench_speed.md, and an SVG plot of every growing cost) medians and
interquartile ranges in ms; ratios come first, each to the first line of its table. Targets (TARGETS) are
marked as met or missed, and the last table has all ratios, bold where missed. Alternatives take turns within
one run, so that all of them see the same machine. ``--cpu-time`` takes the processor's time instead of the
clock's: of one thread, and for a machine that others use too.

- ``warp``: 1920 × 1020 px, three channels, or 64 channels at stride 8, to 1024 × 512 cells, against a bare
  ``grid_sample`` with its grid at hand and kornia's ``warp_perspective``; ``gradients``: and back;
  ``stages``: what is done before the resampling; ``compiled`` (if asked for): by inductor.
- ``frame``: one frame of bytes, against ``cv2.remap`` with its maps at hand, in fixed point and in float32,
  and with its maps computed, as they must be when the pose is another in every frame.
- ``extractor``: seven maps of 160 × 288.
- ``compiled_step`` (if asked for): a frame of the joint calibrator by inductor, which compiles for minutes.
- ``rows``, ``dense``, ``segments``, ``cells``: calibrators by rows of a batch, with 30 and with 408 segments
  each, and by segments, the warp by cells.
"""

import time
from pathlib import Path

import cv2
import torch
from jsonargparse.typing import PositiveFloat, PositiveInt

from tools.bench_speed.parts import GROWTHS, TABLES, run
from train.commands import command_parser, one_line_errors


@one_line_errors()
def main() -> None:
    parser = command_parser(__doc__)
    every = [*TABLES, *GROWTHS]
    default = [part for part in every if not part.startswith("compiled")]
    parser.add_argument("--parts", nargs="+", choices=every, default=default)
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
