"""The command line: parse arguments and call the commands."""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import Field, fields
from typing import Any, NoReturn

from lanebev import __version__
from lanebev.app.completion import PrintCompletion
from lanebev.app.config import RunConfig, parse_path
from lanebev.app.export_config import ExportConfig
from lanebev.app.progress import Item, Progress
from lanebev.app.settings_file import read_settings
from lanebev.io.formats.names import FORMATS

DESCRIPTION = "Online camera-to-road calibration from lane boundaries, and a stable bird's-eye view."


_DOCTOR_SETTINGS = (
    "source", "camera", "fov", "rectified", "fps", "topic", "lane_width", "weights", "device",
)  # fmt: skip


class _Parser(argparse.ArgumentParser):
    """Reports an error in one line."""

    def error(self, message: str) -> NoReturn:
        if message.startswith("unrecognized arguments: ") and " -" not in message:
            message += "; a glob needs quotes"
        self.exit(2, f"{self.prog}: error: {message}; see {self.prog} --help\n")


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``lanebev``; the options of ``run`` are the fields of :class:`RunConfig`."""
    top = _Parser(prog="lanebev", description=DESCRIPTION, allow_abbrev=False)
    top.add_argument("--version", action="version", version=f"lanebev {__version__}")
    words = "print a script that completes commands and options in this shell, and exit"
    top.add_argument(
        "--print-completion",
        choices=("bash", "zsh"),
        action=PrintCompletion,
        default=argparse.SUPPRESS,
        help=words,
    )
    _add_verbose(top, False)
    names = "{demo,run,compare,convert,export,doctor,fleet}"
    commands = top.add_subparsers(dest="command", required=True, metavar=names)
    demo = commands.add_parser("demo", help="render a drive and calibrate it", allow_abbrev=False)
    path = _named(parse_path)
    default = "lanebev-demo"
    demo.add_argument(
        "--out", type=path, default=default, metavar="DIR", help="output folder (default %(default)s)"
    )
    run = commands.add_parser("run", help="calibrate on a video, images or a stream", allow_abbrev=False)
    for setting in fields(RunConfig):
        _add_setting(run, setting)
    run.add_argument("--config", type=path, metavar="FILE", help="settings as YAML; options here override it")
    compare = commands.add_parser("compare", help="compare two runs on one page", allow_abbrev=False)
    folder = "output folder of a run"
    for name, words in (("first", folder), ("second", f"{folder} on the same frames")):
        compare.add_argument(name, type=path, metavar="AB"[name == "second"], help=words)
    default = "lanebev-compare.html"
    compare.add_argument(
        "--out", type=path, default=default, metavar="FILE", help="page (default %(default)s)"
    )
    words = "write the results of a run in another program's format"
    convert = commands.add_parser("convert", help=words, allow_abbrev=False)
    convert.add_argument("run", type=path, metavar="DIR", help="output folder of a run")
    convert.add_argument("--to", choices=FORMATS, required=True, help="the format to write")
    convert.add_argument("--out", type=path, metavar="FILE", help="the file to write (default: one in DIR)")
    words = "camera file, if DIR has no calibration.yaml"
    convert.add_argument("--camera", type=path, metavar="FILE", help=words)
    words = "the run's source, whose images are added to mcap or rerun"
    convert.add_argument("--images", type=path, metavar="SOURCE", help=words)
    words = "write parts of the model as ONNX files or torch.export programs"
    files = commands.add_parser("export", help=words, allow_abbrev=False)
    for setting in fields(ExportConfig):
        _add_setting(files, setting)
    words = "check if a camera fits a source; status 1 if something is doubtful, 2 if it does not fit"
    doctor = commands.add_parser("doctor", help=words, allow_abbrev=False)
    for setting in fields(RunConfig):
        if setting.name in _DOCTOR_SETTINGS:
            _add_setting(doctor, setting)
    words = "calibrate on many drives, on all cores or a cluster"
    fleet = commands.add_parser("fleet", help=words, allow_abbrev=False)
    _add_fleet(fleet)
    for command in (demo, run, compare, convert, files, doctor, fleet):
        _add_verbose(command, argparse.SUPPRESS)
    return top


def _add_fleet(fleet: argparse.ArgumentParser) -> None:
    path = _named(parse_path)
    words = "YAML or CSV with the video, camera, ... of each drive"
    fleet.add_argument("manifest", type=path, metavar="MANIFEST", help=words)
    words = "output folder (default %(default)s)"
    fleet.add_argument("--out", type=path, default="lanebev-fleet", metavar="DIR", help=words)
    words = "address of a running Ray cluster (default: start one on this machine, for this command)"
    fleet.add_argument("--address", type=path, metavar="ADDRESS", help=words)
    words = "worker processes on this machine (default: one per core)"
    fleet.add_argument("--workers", type=_at_least(1), metavar="N", help=words)
    words = "retries of a drive that fails (default %(default)s)"
    fleet.add_argument("--retries", type=_at_least(0), default=2, metavar="N", help=words)
    words = "drives per worker at a time, whose frames the network takes as one batch (default %(default)s)"
    fleet.add_argument("--batch", type=_at_least(1), default=1, metavar="N", help=words)
    words = "fraction of a GPU per worker, with device: cuda in the manifest (default %(default)s)"
    fleet.add_argument("--gpus", type=float, default=0.0, metavar="FRACTION", help=words)
    words = "folder outside which no path may be (default: that of the manifest)"
    fleet.add_argument("--root", type=path, metavar="DIR", help=words)
    words = "length of the parts into which longer videos are cut, for several workers (default: not cut)"
    fleet.add_argument("--part-minutes", type=_above_zero, metavar="MIN", help=words)
    words = "also run drives again that failed in an earlier call"
    fleet.add_argument("--again", action="store_true", help=words)


def _above_zero(text: str) -> float:
    number = float(text) if re.fullmatch(r"[0-9.]+", text) and text.count(".") < 2 and text != "." else 0.0
    if number <= 0:
        raise argparse.ArgumentTypeError(f"expected a number above zero, got {text!r}")
    return number


def _at_least(least: int) -> Callable[[str], int]:
    """Return a parser of whole numbers that are not below ``least``."""

    def parsed(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"expected a whole number from {least}, got {text!r}")
        return int(text)

    return parsed


def _add_verbose(parser: argparse.ArgumentParser, default: bool | str) -> None:
    parser.add_argument("--verbose", action="store_true", default=default, help="log each step to stderr")


def _add_setting(parser: argparse.ArgumentParser, setting: Field[object]) -> None:
    """Add the option of a setting; if it is not given, the parsed options do not contain it."""
    about = setting.metadata
    words = about["help"].replace("%", "%%")
    if setting.name == "source":
        parser.add_argument(
            setting.name, nargs="?", type=_named(about["parse"]), default=argparse.SUPPRESS,
            metavar=about["metavar"], help=words,
        )  # fmt: skip
        return
    flag = f"--{setting.name.replace('_', '-')}"
    if isinstance(setting.default, bool):
        parser.add_argument(flag, action="store_true", default=argparse.SUPPRESS, help=words)
    elif about["choices"]:
        parser.add_argument(flag, choices=about["choices"], default=argparse.SUPPRESS, help=words)
    else:
        parser.add_argument(
            flag, type=_named(about["parse"]), default=argparse.SUPPRESS, metavar=about["metavar"], help=words
        )


def _named(parse: Callable[[str], object]) -> Callable[[str], object]:
    """Return the same function with its ValueError turned into argparse's error."""
    if parse in (float, int):
        return parse

    def parsed(text: str) -> object:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return parsed


class _Stopped(KeyboardInterrupt):
    """Raised by a signal, whose number is the argument."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    The status is 0 on success, 2 (with one line on stderr) on bad input, and 128 + n if signal n stopped the
    command. ``doctor`` returns 1 if something is doubtful and 2 if the camera does not fit; ``fleet`` returns
    1 if drives failed.
    """
    options = vars(parser().parse_args(arguments))
    command = options.pop("command")
    if options.pop("verbose"):
        logging.basicConfig(format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")
        logging.getLogger("lanebev").setLevel(logging.DEBUG)
    try:
        with _signals_unwind():
            done = _COMMANDS[command](options)
            report, status = (done, 0) if isinstance(done, str) else done
    except (ValueError, OSError) as error:
        print(f"lanebev {command}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stopped:
        kept = "finished drives stay" if command == "fleet" else "nothing written"
        print(f"lanebev {command}: interrupted, {kept}", file=sys.stderr)
        return 128 + int(stopped.args[0] if isinstance(stopped, _Stopped) else signal.SIGINT)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # of signs that a terminal's encoding lacks
    try:
        print(report, flush=True)
    except OSError:  # nobody reads it; the outputs are there
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - else closing it at exit fails once more
    return status


@contextlib.contextmanager
def _signals_unwind() -> Iterator[None]:
    """Raise :class:`_Stopped` on SIGINT, SIGTERM, SIGHUP; a second signal waits while outputs are undone."""
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
    given = options.pop("config")
    settings = {} if given is None else read_settings(given)
    config = RunConfig(**(settings | options))  # type: ignore[arg-type]  # each parsed as its field
    from lanebev.app.run import run
    from lanebev.app.summary import summary

    return summary(run(config, _progress("calibrating")), config)


def _demo(options: dict[str, Any]) -> str:
    from lanebev.app.demo import demo

    return demo(options["out"], _progress)


def _compare(options: dict[str, Any]) -> str:
    from lanebev.app.compare import compare

    return compare(**options)


def _convert(options: dict[str, Any]) -> str:
    from lanebev.app.convert import convert

    return convert(**options)


def _export(options: dict[str, Any]) -> str:
    config = ExportConfig(**options)
    from lanebev.app.export import export

    return export(config)


def _doctor(options: dict[str, Any]) -> tuple[str, int]:
    config = RunConfig(**options)
    from lanebev.app.doctor import doctor

    return doctor(config, _progress("looking"))


def _fleet(options: dict[str, Any]) -> tuple[str, int]:
    from lanebev.app.fleet.cluster import Cluster
    from lanebev.app.fleet.fleet import fleet

    own = ("address", "workers", "retries", "gpus", "batch")
    cluster = Cluster(**{name: options.pop(name) for name in own})
    result = fleet(**options, cluster=cluster, progress=_progress("drives"))
    return result.text, int(any(outcome.failure for outcome in result.outcomes.values()))


_COMMANDS: dict[str, Callable[[dict[str, Any]], str | tuple[str, int]]] = {
    "run": _run,
    "demo": _demo,
    "compare": _compare,
    "convert": _convert,
    "export": _export,
    "doctor": _doctor,
    "fleet": _fleet,
}


def _progress(label: str) -> Progress:
    """Return a progress bar on stderr, which draws only on a terminal."""
    from rich import progress
    from rich.console import Console

    def follow(items: Iterator[Item], total: int) -> Iterator[Item]:
        columns = (
            progress.TextColumn(label),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TimeRemainingColumn(),
        )
        console = Console(stderr=True)
        if not console.is_terminal:
            yield from items
            return
        with progress.Progress(*columns, console=console, transient=True) as bar:
            yield from bar.track(items, total=total)

    return follow
