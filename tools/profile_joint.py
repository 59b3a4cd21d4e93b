"""Where a frame of the joint calibrator spends its time: processor time of torch's operations by function.

    python -m tools.profile_joint --rows 256 --segments 408

Prints for each function of the package the time of the operations that it calls itself, ms, the smallest of
several runs for each operation, and their number. Views count as operations. One thread.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from jsonargparse import auto_cli
from jsonargparse.typing import PositiveInt
from torch.utils._python_dispatch import TorchDispatchMode

import lanebev
from tools.bench_speed.calibration import calibrators

_PACKAGE = str(Path(lanebev.__file__).parent)


class Recorder(TorchDispatchMode):
    """Record of every operation the function that called it and its processor time, ns."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.calls: list[tuple[str, int]] = []

    def __torch_dispatch__(
        self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        begin = time.thread_time_ns()
        result = func(*args, **(kwargs or {}))
        spent = time.thread_time_ns() - begin
        self.calls.append((_caller(), spent))
        return result


def _caller() -> str:
    """The innermost function of the package on the stack, as file and name."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith(_PACKAGE):
            return f"{Path(code.co_filename).stem}.{code.co_name}"
        frame = frame.f_back
    return "other"


def profile(rows: int, segments: int, runs: int) -> dict[str, tuple[float, int]]:
    """Measure a frame: time in ms and number of operations by function, the longest first."""
    call = calibrators(rows, segments // 6)["joint"]
    call()
    recorded = []
    for _ in range(runs):
        with Recorder() as recorder:
            call()
        recorded.append(recorder.calls)
    spent: Counter[str] = Counter()
    number: Counter[str] = Counter()
    for same in zip(*recorded, strict=True):
        function = same[0][0]
        spent[function] += min(each for _, each in same)
        number[function] += 1
    return {function: (1e-6 * total, number[function]) for function, total in spent.most_common()}


def main(rows: PositiveInt = 256, segments: PositiveInt = 408, runs: PositiveInt = 10) -> None:
    """Print a frame's time by function.

    Args:
        rows: of the batch.
        segments: of each row, six boundaries.
        runs: of which the smallest time of each operation counts.
    """
    torch.set_num_threads(1)
    found = profile(rows, segments, runs)
    total = (sum(ms for ms, _ in found.values()), sum(number for _, number in found.values()))
    for function, (ms, number) in {"all": total, **found}.items():
        print(f"{ms:8.2f} ms {number:5d} operations  {function}")


if __name__ == "__main__":
    auto_cli(main)
