"""Compare the time of ``lanebev run`` per frame with the network's forward pass alone.

    python -m tools.bench_run [--frames 60] [--precision bfloat16] [--json FILE] [--profile]

A rendered drive of 1280 x 720 is written to a video, run with all outputs, and the network's forward pass is
timed on its input before and after. The ratio is what counts: machines differ, and drift. Beside it stands
the ratio of processor times, which says more where other programs run: all cores together, so that at best
the run's time is its processor time by the number of cores.
"""

import cProfile
import json
import pstats
import tempfile
import time
from fractions import Fraction
from pathlib import Path

import torch
from jsonargparse.typing import PositiveInt

from lanebev.app.config import PRECISIONS, RunConfig
from lanebev.app.drive.build import with_precision
from lanebev.app.run import run
from lanebev.io.video.writer import VideoWriter
from lanebev.observation.frames import image_bytes
from lanebev.pipeline import LaneBEV
from lanebev.render import Drive
from lanebev.weights import load_segmenter
from train.commands import command_parser, one_line_errors, versions

SIZE, FPS, RENDERED = (720, 1280), 20, 8
_REPEATS = 9  # of a forward pass


def write_video(folder: Path, frames: int) -> tuple[str, str]:
    """Write a drive of so many frames (a few rendered ones, forth and back) and its camera."""
    drive = Drive(3, SIZE, RENDERED, float(FPS))
    pictures = [image_bytes(drive.frame(k).image[0]) for k in range(min(RENDERED, frames))]
    order = [k if k < len(pictures) else 2 * len(pictures) - 1 - k for k in range(2 * len(pictures))]
    video, camera = folder / "drive.mp4", folder / "camera.yaml"
    with VideoWriter(video, Fraction(FPS)) as writer:
        for number in range(frames):
            writer.write(pictures[order[number % len(order)]])
    drive.camera.to_file(camera)
    return str(video), str(camera)


def forward_seconds(precision: str) -> tuple[float, float]:
    """Time the network's forward pass on one image of its size: medians of wall and of processor time."""
    model = with_precision(LaneBEV.from_pretrained(), precision).eval()
    image = torch.rand(1, 3, *load_segmenter().image_size)
    taken = []
    with torch.inference_mode():
        for _ in range(_REPEATS + 2):
            begin = _clocks()
            model.segmenter(image)
            taken.append(_since(begin))
    wall, processor = (sorted(each)[_REPEATS // 2] for each in zip(*taken[2:], strict=True))
    return wall, processor


def _clocks() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def _since(begin: tuple[float, float]) -> tuple[float, float]:
    wall, processor = _clocks()
    return wall - begin[0], processor - begin[1]


@one_line_errors()
def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("--frames", type=PositiveInt, default=60)
    parser.add_argument("--precision", choices=PRECISIONS, default=PRECISIONS[0], help="of the network")
    parser.add_argument("--json", type=Path, help="file for the results as JSON")
    parser.add_argument("--profile", action="store_true", help="print where the main thread spends its time")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        video, camera = write_video(Path(name), args.frames)
        before = forward_seconds(args.precision)
        profile = cProfile.Profile()
        begin = _clocks()
        if args.profile:
            profile.enable()
        run(RunConfig(video, camera, str(Path(name) / "out"), precision=args.precision))
        profile.disable()
        whole = _since(begin)
        after = forward_seconds(args.precision)
    wall, processor = (1e3 * each / args.frames for each in whole)
    forward, forward_processor = (500 * (one + other) for one, other in zip(before, after, strict=True))
    figures = {
        "frames": args.frames,
        "precision": args.precision,
        "run_ms": round(wall, 1),
        "forward_ms": round(forward, 1),
        "ratio": round(wall / forward, 2),
        "run_cpu_ms": round(processor, 1),
        "forward_cpu_ms": round(forward_processor, 1),
        "cpu_ratio": round(processor / forward_processor, 2),
        **versions(),
    }
    print(json.dumps(figures))
    if args.profile:
        pstats.Stats(profile).sort_stats("cumtime").print_stats(45)
    if args.json is not None:
        args.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
