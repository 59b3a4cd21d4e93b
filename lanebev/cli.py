"""The command line: arguments, nothing else."""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

from lanebev import __version__

DESCRIPTION = "Online camera-to-road calibration from lane boundaries, and a stable bird's-eye view."
CAMERA_HELP = "of OpenCV, ROS, Kalibr, EuRoC, KITTI, nuScenes; or YAML of fx fy cx cy width height"
SOURCE_HELP = "a video, a folder of images, a quoted glob ('DIR/**/*.jpg'), or one image"


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}; see {self.prog} --help\n")


def _path(text: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError("expected a path, got an empty string")
    return text


def _size(text: str) -> tuple[int, int]:
    from lanebev.io.lane_size import parse_size

    try:
        return parse_size(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def parser() -> argparse.ArgumentParser:
    """The parser of ``lanebev``."""
    top = _Parser(prog="lanebev", description=DESCRIPTION, allow_abbrev=False)
    top.add_argument("--version", action="version", version=f"lanebev {__version__}")
    top.add_argument("--verbose", action="store_true", help="say on stderr what is done")
    commands = top.add_subparsers(dest="command", required=True, metavar="{demo,run}")
    demo = commands.add_parser("demo", help="a rendered drive end to end", allow_abbrev=False)
    demo.add_argument(
        "--out", type=_path, default="lanebev-demo", metavar="DIR", help="output folder (%(default)s)"
    )
    run = commands.add_parser("run", help="calibrate on images or a video", allow_abbrev=False)
    run.add_argument("source", type=_path, metavar="SOURCE", help=SOURCE_HELP)
    run.add_argument("--camera", type=_path, required=True, metavar="FILE",
                     help=CAMERA_HELP)  # fmt: skip
    run.add_argument("--rectified", action="store_true",
                     help="the images were rectified: take the projection matrix P")  # fmt: skip
    run.add_argument("--lane-width", type=float, default=3.7, metavar="M", help="metres (%(default)s)")
    run.add_argument("--lanes", type=_path, metavar="FILE",
                     help="lanes of another detector: TuSimple JSON lines, CULane .lines.txt, OpenLane JSON, "
                     "or a folder of them")  # fmt: skip
    run.add_argument("--lanes-size", type=_size, metavar="WxH",
                     help="size of the images that --lanes was drawn on, if not the source's")  # fmt: skip
    run.add_argument("--stills", action="store_true", help="every image on its own, not frames of a drive")
    run.add_argument(
        "--out", type=_path, default="lanebev-out", metavar="DIR", help="output folder (%(default)s)"
    )
    run.add_argument("--resume", type=_path, metavar="DIR",
                     help="begin with the state that a run left in this folder")  # fmt: skip
    run.add_argument("--calibrator", default="joint", choices=("joint", "two-stage"),
                     help="two-stage is the paper's (%(default)s)")  # fmt: skip
    run.add_argument("--fps", type=float, metavar="HZ",
                     help="frame rate of a folder or glob (what names of seconds say, else 30) or of a raw "
                     "stream; a video knows its own")  # fmt: skip
    return top


class _Stopped(KeyboardInterrupt):
    """By a signal, its number the argument."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; 0 when it is done, 2 with one line on bad input, 128 + the signal that stopped it."""
    options = vars(parser().parse_args(arguments))
    command = options.pop("command")
    if options.pop("verbose"):
        logging.basicConfig(format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")
        logging.getLogger("lanebev").setLevel(logging.DEBUG)
    try:
        with _signals_unwind():
            report = _run(options) if command == "run" else _demo(options)
    except (ValueError, OSError) as error:
        print(f"lanebev {command}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stopped:
        print(f"lanebev {command}: interrupted, nothing written", file=sys.stderr)
        return 128 + int(stopped.args[0] if isinstance(stopped, _Stopped) else signal.SIGINT)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # of signs that a terminal's encoding lacks
    try:
        print(report, flush=True)
    except OSError:  # nobody reads it; the outputs are there
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - else closing it at exit fails once more
    return 0


@contextlib.contextmanager
def _signals_unwind() -> Iterator[None]:
    """Ctrl-C, a job scheduler, a closed terminal: outputs are undone, for which a second signal waits."""
    known = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {each: signal.getsignal(each) for each in known}
    usual = (signal.SIG_DFL, signal.default_int_handler)
    own = [each for each, handler in before.items() if handler in usual]  # not what nohup ignores
    if threading.current_thread() is not threading.main_thread():
        own = []  # Python lets no other thread set them
    sent = itertools.count(1)

    def stop(number: int, _: object) -> None:
        if next(sent) != 2:  # the first may have been swallowed, or what it undoes may hang
            raise _Stopped(number)

    for each in own:
        signal.signal(each, stop)
    try:
        yield
    finally:
        for each in own:
            signal.signal(each, before[each])


def _run(options: dict[str, Any]) -> str:
    from lanebev.app.run import RunConfig, run, summary

    config = RunConfig(**options)
    return summary(run(config, _progress("calibrating")), config)


def _demo(options: dict[str, Any]) -> str:
    from lanebev.app.demo import demo

    return str(demo(options["out"], _progress))


def _progress(label: str) -> Any:
    """A progress bar on stderr; on anything but a terminal it stays silent."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    def follow(items: Iterator[Any], total: int) -> Iterator[Any]:
        columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        console = Console(stderr=True)
        if not console.is_terminal:
            yield from items
            return
        with Progress(*columns, console=console, transient=True) as bar:
            yield from bar.track(items, total=total)

    return follow
