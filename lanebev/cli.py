"""The command line: call the commands and report how they end."""

import contextlib
import io
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from lanebev.app.config import RunConfig
from lanebev.app.config.arguments import parser
from lanebev.app.config.export import ExportConfig
from lanebev.app.config.file import read_settings
from lanebev.app.progress import Item, Progress
from lanebev.signals import handlers_kept


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    The status is 0 on success, 2 (with one line on stderr) on bad input, and 128 + n if signal n stopped the
    command. ``doctor`` returns 1 if something is doubtful and 2 if the camera does not fit; ``fleet`` returns
    1 if drives failed.
    """
    try:
        options = vars(parser().parse_args(arguments))
    except SystemExit:
        _print("")  # flush the text of --help or --version
        raise
    command = options.pop("command")
    if options.pop("verbose"):
        logging.basicConfig(format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")
        logging.getLogger("lanebev").setLevel(logging.DEBUG)
    received: list[int] = []
    try:
        with _signals_unwind(received):
            done = _COMMANDS[command](options)
            report, status = (done, 0) if isinstance(done, str) else done
    except (ValueError, OSError) as error:
        print(f"lanebev {command}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except MemoryError:
        print(f"lanebev {command}: error: expected enough memory, got too little", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        kept = "finished drives stay" if command == "fleet" else "nothing written"
        print(f"lanebev {command}: interrupted, {kept}", file=sys.stderr)
        return 128 + (received[0] if received else signal.SIGINT)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # for characters that a terminal's encoding lacks
    _print(f"{report}\n")
    return status


def _print(text: str) -> None:
    """Print a text; it is no error if nobody reads it."""
    try:
        print(text, end="", flush=True)
    except OSError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - else closing it at exit fails once more


@contextlib.contextmanager
def _signals_unwind(received: list[int]) -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGINT, SIGTERM, SIGHUP; a second signal waits while outputs are undone.

    The signals' numbers are added to ``received``, since Ray raises an exception of its own instead.
    """

    def stop(number: int, _: object) -> None:
        received.append(number)
        if len(received) != 2:  # the first may have been swallowed, or what it undoes may hang
            raise KeyboardInterrupt

    with handlers_kept() as before:
        for number, handler in before.items():
            if handler in (signal.SIG_DFL, signal.default_int_handler):  # not what nohup ignores
                signal.signal(number, stop)
        yield


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

    return export(config, lambda line: print(f"lanebev export: {line}", file=sys.stderr, flush=True))


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
