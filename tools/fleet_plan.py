"""Plan the time and storage of many hours of video: python -m tools.fleet_plan [--hours 100000].

Measures, with one thread, what a frame costs where it is decoded and processed by the network, and where
poses are estimated from what was seen, views drawn and outputs written, and the bytes of each output. From
these follow cores, hours and disk, for the frame rates of the plan; nothing is taken from elsewhere. Frames
are rendered ones, of a road with traffic, or those of ``--video``.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from lanebev.app.config import RunConfig
from lanebev.app.continued.part_observation import observe_part
from lanebev.app.demo import write_drive
from lanebev.app.drive.build import make_network
from lanebev.app.drive.shared_network import SharedNetwork
from lanebev.app.run import run
from lanebev.numbers import parse_size
from lanebev.render import Drive
from train.commands import command_parser

_OUTPUTS = ("lanes.json", "extrinsics.csv", "covariance.csv", "frames.parquet", "bev.mp4", "overlay.mp4")


@dataclass(frozen=True)
class FrameCost:
    """Processor time and storage of a frame on one core.

    Attributes:
        look: s, decoding and network.
        rest: s, decoding again, poses, views, lanes.json, no videos.
        videos: s more, with ``bev.mp4`` and ``overlay.mp4``.
        sizes: bytes of a frame in each output, by name.
        report: bytes of a report, whatever the drive's length.
    """

    look: float
    rest: float
    videos: float
    sizes: dict[str, float]
    report: int


def plan(cost: FrameCost, hours: float, fps: float, cores: int, minutes: float) -> dict[str, float]:
    """Return what so many hours of video take.

    Args:
        cost: cost of a frame.
        hours: hours of video.
        fps: frames a second that are taken of it.
        cores: at work.
        minutes: length of a drive, for the number of reports.
    """
    frames = 3600 * hours * fps
    text = sum(size for name, size in cost.sizes.items() if not name.endswith(".mp4"))
    videos = sum(size for name, size in cost.sizes.items() if name.endswith(".mp4"))
    return {
        "frames": frames,
        "core_hours": frames * (cost.look + cost.rest) / 3600,
        "core_hours_network": frames * cost.look / 3600,
        "core_hours_videos": frames * cost.videos / 3600,
        "days": frames * (cost.look + cost.rest) / 86_400 / cores,
        "terabytes": frames * text / 1e12,
        "terabytes_parquet": frames * cost.sizes["frames.parquet"] / 1e12,
        "terabytes_videos": frames * videos / 1e12,
        "terabytes_reports": 60 * hours / minutes * cost.report / 1e12,
        "minutes_last_run_of_an_hour": 60 * fps * cost.rest,
    }


def measure(config: RunConfig, folder: Path) -> FrameCost:
    """Run on the frames of the settings, with one thread, and return what a frame takes."""
    torch.set_num_threads(1)
    network = SharedNetwork(make_network(*config.network))
    seen = folder / "seen.json"
    warm = replace(config, end=config.start + 0.5)
    observe_part(warm, folder / "warm.json", network)
    count, looked = _timed(lambda: observe_part(config, seen, network))
    seconds = []
    for number, no_video in enumerate((True, True, False)):  # the first warms up
        own = replace(config, out=str(folder / f"{number}"), formats=("parquet",), no_video=no_video)
        begin = os.times()
        run(own, network=network, parts=[seen])
        seconds.append(_cpu_since(begin))
    out = folder / "2"
    sizes = {name: (out / name).stat().st_size / count for name in _OUTPUTS}
    rest = seconds[1] / count
    videos = max(0.0, seconds[2] / count - rest)
    return FrameCost(looked / count, rest, videos, sizes, (out / "report.html").stat().st_size)


def _timed(call: Callable[[], int]) -> tuple[int, float]:
    begin = os.times()
    result = call()
    return result, _cpu_since(begin)


def _cpu_since(begin: os.times_result) -> float:
    """Return the processor's seconds, of all threads, that other processes do not disturb."""
    now = os.times()
    return now.user + now.system - begin.user - begin.system


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, plan, print."""
    parser = command_parser(__doc__)
    parser.add_argument("--hours", type=float, default=1e5, help="hours of video (%(default)g)")
    parser.add_argument("--fps", type=float, nargs="+", default=[30.0, 10.0], help="frame rates (30 10)")
    parser.add_argument("--cores", type=int, default=1000, help="number of cores (%(default)s)")
    parser.add_argument("--minutes", type=float, default=10.0, help="minutes per drive (%(default)g)")
    parser.add_argument("--frames", type=int, default=100, help="number of frames to measure (%(default)s)")
    parser.add_argument(
        "--size",
        type=parse_size,
        default=(720, 1280),
        metavar="WxH",
        help="size of rendered frames (1280x720)",
    )
    parser.add_argument("--video", help="video to measure, with --camera, instead of rendered frames")
    parser.add_argument("--camera", default="")
    options = parser.parse_args(arguments)
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if options.video is None:
            write_drive(Drive(1, options.size, options.frames, 20.0), folder.__truediv__)
            config = RunConfig(str(folder / "drive.mp4"), str(folder / "camera.yaml"))
        else:
            config = RunConfig(options.video, options.camera, end=options.frames / 30)
        cost = measure(config, folder)
    milliseconds = [1000 * each for each in (cost.look, cost.rest, cost.videos)]
    words = "a frame on one core: {:.0f} ms network, {:.0f} ms the rest, {:.0f} ms more with videos"
    print(words.format(*milliseconds))
    print("bytes a frame: " + ", ".join(f"{name} {size:.0f}" for name, size in cost.sizes.items()))
    print(f"a report: {cost.report / 1e6:.1f} MB")
    plans = {}
    for fps in options.fps:
        found = plan(cost, options.hours, fps, options.cores, options.minutes)
        plans[f"{fps:g}"] = {name: float(f"{value:.3g}") for name, value in found.items()}
        print(f"{options.hours:g} hours at {fps:g} frames a second:")
        print("\n".join(f"  {name.replace('_', ' ')}: {value:.3g}" for name, value in found.items()))
    print(json.dumps({"cost": vars(cost), "plans": plans, "seconds": round(time.perf_counter() - begin, 1)}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
