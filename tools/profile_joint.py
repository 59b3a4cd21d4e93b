"""Processor time of torch's operations in a frame of the joint calibrator, by function.

    python -m tools.profile_joint --rows 256 --segments 408

Prints for each function of the package the time of the operations that it calls itself, ms, the smallest of
several runs for each operation; the bytes that they read and write, MB; and their number. Views count as
operations, without bytes. At last the bandwidth of the memory, in the caches and beyond them. One thread.
"""

import math
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from jsonargparse.typing import PositiveInt
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves

import lanebev
from tools.bench_speed.calibration import calibrators
from train.commands import command_parser, one_line_errors

_PACKAGE = str(Path(lanebev.__file__).parent)


class Recorder(TorchFunctionMode):
    """Record of every operation the function that called it, its processor time, ns, and its bytes.

    No mode of dispatch: under such a mode the package computes what it skips otherwise (``replace_rows``).
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[str, int, int]] = []

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        begin = time.thread_time_ns()
        result = func(*args, **(kwargs or {}))
        spent = time.thread_time_ns() - begin
        if _tensors(result):
            moved = 0 if _is_view(func, args, result) else _bytes((args, kwargs, result))
            self.calls.append((_caller(), spent, moved))
        return result


def _tensors(values: Any) -> list[torch.Tensor]:
    """List all tensors in a tree."""
    return [leaf for leaf in tree_leaves(values) if isinstance(leaf, torch.Tensor)]


def _is_view(func: Callable[..., Any], args: Any, result: Any) -> bool:
    """Return whether a result is memory of an argument that the function did not write."""
    name = func.__name__
    writes = name.endswith("_") and not name.endswith("__")
    given = {tensor.untyped_storage().data_ptr() for tensor in _tensors(args)}
    return not writes and _tensors(result)[0].untyped_storage().data_ptr() in given


def _bytes(values: Any) -> int:
    """Count the bytes of all tensors in a tree, those that are repeated by broadcasting once."""
    tensors = _tensors(values)
    sizes = ([n for n, stride in zip(t.shape, t.stride(), strict=True) if stride] for t in tensors)
    return sum(math.prod(size) * t.element_size() for size, t in zip(sizes, tensors, strict=True))


def _caller() -> str:
    """The innermost function of the package on the stack, as file and name."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith(_PACKAGE):
            return f"{Path(code.co_filename).stem}.{code.co_name}"
        frame = frame.f_back
    return "other"


def profile(rows: int, segments: int, runs: int) -> dict[str, tuple[float, float, int]]:
    """Measure a frame: time in ms, MB and number of operations by function, the longest first."""
    call = calibrators(rows, segments // 6)["joint"]
    call()
    recorded = []
    for _ in range(runs):
        with Recorder() as recorder:
            call()
        recorded.append(recorder.calls)
    spent: Counter[str] = Counter()
    moved: Counter[str] = Counter()
    number: Counter[str] = Counter()
    for same in zip(*recorded, strict=True):
        function, _, size = same[0]
        spent[function] += min(each for _, each, _ in same)
        moved[function] += size
        number[function] += 1
    return {name: (1e-6 * total, 1e-6 * moved[name], number[name]) for name, total in spent.most_common()}


def bandwidth(megabytes: int) -> float:
    """Measure GB/s read and written by the multiplication of two tensors of so many MB."""
    one = torch.rand(megabytes * 125_000, dtype=torch.float64)
    result = torch.empty_like(one)
    times = []
    for _ in range(10):
        begin = time.thread_time_ns()
        torch.mul(one, one, out=result)
        times.append(time.thread_time_ns() - begin)
    return 2e6 * megabytes / min(times)


def print_profile(rows: int, segments: int, runs: int) -> None:
    """Print a frame's time by function."""
    torch.set_num_threads(1)
    found = profile(rows, segments, runs)
    times, sizes, numbers = zip(*found.values(), strict=True)
    for function, (ms, moved, number) in {"all": (sum(times), sum(sizes), sum(numbers)), **found}.items():
        print(f"{ms:8.2f} ms {moved:8.1f} MB {number:5d} operations  {function}")
    for size in (1, 64):
        print(f"{bandwidth(size):8.0f} GB/s of tensors of {size} MB")


@one_line_errors()
def main() -> None:
    parser = command_parser(__doc__)
    parser.add_argument("--rows", type=PositiveInt, default=256, help="rows of the batch (%(default)s)")
    words = "segments of each row, on six boundaries (%(default)s)"
    parser.add_argument("--segments", type=PositiveInt, default=408, help=words)
    words = "runs, of which the smallest time of each operation counts (%(default)s)"
    parser.add_argument("--runs", type=PositiveInt, default=10, help=words)
    print_profile(**vars(parser.parse_args()))


if __name__ == "__main__":
    main()
