"""Measure what rendering costs apart from pixels: ``python -m tools.render_cost``.

For views rendered together it prints

    operations  operations on the device, and those a view: each costs the host about 10 microseconds
    waits       times that the host waits for the device
    sampling    host's seconds for the scenes of 1000 views
    issuing     host's seconds for the operations of 1000 views, taken from images of 16 x 24 px on the CPU

On a GPU (``--device cuda``) also frames a second, the seconds in which it computes, the kernels that take
longest, and how often memory is allocated. If it computes nearly all the time, pixels are what limits.
"""

import time

import torch
from jsonargparse.typing import PositiveInt
from torch.profiler import ProfilerActivity, profile

from lanebev.render import WindowConfig
from lanebev.render.scene.world import Scene
from lanebev.render.views import render_scenes, sample_views
from tools.other_device import ELSEWHERE, other_device
from train.commands import command_parser

TINY = (16, 24)
FEW = 16  # views, whose operations take the host as long as those of many
WINDOW = WindowConfig(scale=(0.45, 1.05))


def scene_of(count: int, size: tuple[int, int], seed: int = 3) -> Scene:
    """Sample scenes of training."""
    return sample_views(count, size, torch.Generator().manual_seed(seed), window=WINDOW)[0]


def sampling_seconds(views: int, threads: int, repeats: int) -> list[float]:
    """Return the seconds of sampling scenes on so many threads, in order."""
    sample = sample_views.__wrapped__  # type: ignore[attr-defined]  # which does not set the number of threads
    torch.set_num_threads(threads)
    taken = []
    for seed in range(repeats):
        begin = time.perf_counter()
        sample(views, TINY, torch.Generator().manual_seed(seed), window=WINDOW)
        taken.append(time.perf_counter() - begin)
    torch.set_num_threads(1)
    return sorted(taken)


def host_seconds(views: int, repeats: int) -> tuple[float, float]:
    """Return the host's seconds for sampling so many scenes, and for issuing their operations, at best."""
    sampling, issuing = [], []
    few = scene_of(FEW, TINY)
    for _ in range(repeats):
        begin = time.thread_time()
        scene_of(views, TINY)
        middle = time.thread_time()
        render_scenes(few, TINY, list(range(FEW)), rows=FEW)
        sampling.append(middle - begin)
        issuing.append(time.thread_time() - middle)
    return min(sampling), min(issuing)


def count_operations(views: int, size: tuple[int, int]) -> tuple[int, int, int]:
    """Return the operations of views rendered together, the waits for the device, and the bytes moved."""
    scene = scene_of(views, size)
    with other_device() as device:
        render_scenes(scene, size, list(range(views)), device=ELSEWHERE, rows=views)
    return sum(device.launches.values()), sum(device.waits.values()), device.read_and_written


def on_gpu(views: int, size: tuple[int, int], repeats: int) -> None:
    """Render on a GPU and print how it spends the time."""
    scene, seeds = scene_of(views, size), list(range(views))

    def render() -> float:
        torch.cuda.synchronize()
        begin = time.perf_counter()
        render_scenes(scene, size, seeds, device="cuda", rows=views)
        torch.cuda.synchronize()
        return time.perf_counter() - begin

    first = render()
    best = min(render() for _ in range(repeats))
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        render()
    events = profiler.key_averages()
    busy = sum(event.self_device_time_total for event in events) / 1e6
    memory = torch.cuda.memory_stats()
    peak, kept = (memory[f"{name}_bytes.all.peak"] / 2**30 for name in ("allocated", "reserved"))
    print(
        f"  {views / best:.0f} frames/s: {best:.3f} s, at first {first:.2f} s; computing {busy:.3f} s of it"
    )
    print(
        f"  {peak:.1f} GiB of {kept:.1f}; {memory.get('num_device_alloc', 0)} times more memory was asked for"
    )
    longest = sorted(events, key=lambda event: event.self_device_time_total, reverse=True)
    for event in longest[:12]:
        print(f"  {event.self_device_time_total / 1e3:8.1f} ms {event.count:6d} {event.key[:80]}")


def main() -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("--views", type=PositiveInt, nargs="+", default=(64, 512, 1024))
    parser.add_argument("--size", type=int, nargs=2, default=(320, 576), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--bytes", type=int, default=0, metavar="VIEWS", help="count bytes of so many views")
    parser.add_argument("--threads", type=PositiveInt, default=1, help="sample scenes on so many threads too")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--repeats", type=PositiveInt, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    size = (args.size[0], args.size[1])
    for views in args.views:
        operations, waits, _ = count_operations(views, TINY)
        sampling, issuing = (1000 / views * seconds for seconds in host_seconds(views, args.repeats))
        print(
            f"{views} together: {operations} operations, {operations / views:.1f} a view, {waits} waits; "
            f"host of 1000 views: sampling {sampling:.2f} s, issuing {issuing:.2f} s",
            flush=True,
        )
        if args.device.startswith("cuda"):
            on_gpu(views, size, args.repeats)
    for threads in {1, args.threads}:
        taken = " ".join(
            f"{seconds:.2f}" for seconds in sampling_seconds(max(args.views), threads, args.repeats)
        )
        print(f"sampling {max(args.views)} scenes on {threads} threads: {taken} s")
    if args.bytes:
        moved = count_operations(args.bytes, size)[2]
        print(f"{size[0]} x {size[1]}: {moved / args.bytes / 1e9:.2f} GB read and written a view")


if __name__ == "__main__":
    main()
