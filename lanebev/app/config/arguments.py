"""The command line's arguments. Imports nothing heavy."""

import argparse
import contextlib
import re
from collections.abc import Callable
from dataclasses import Field, fields
from typing import NoReturn

from lanebev import __version__
from lanebev.app.config.export import ExportConfig
from lanebev.app.config.options import parse_path, parsed
from lanebev.app.config.run import RunConfig
from lanebev.io.formats.names import FORMATS

DESCRIPTION = "Online camera-to-road calibration from lane boundaries, and a stable bird's-eye view."


_DOCTOR_SETTINGS = (
    "source", "camera", "fov", "rectified", "fps", "topic", "lane_width", "weights", "device",
)  # fmt: skip


RUN_GROUPS = {
    "source": ("source", "fps", "start", "end", "every", "stills", "topic", "keep_all"),
    "camera": ("camera", "fov", "focal_std", "rectified", "mount"),
    "lanes": ("lane_width", "lane_width_std", "lanes", "lanes_size", "lanes_crop"),
    "estimation": ("calibrator", "smooth", "hilly", "speed", "speed_topic", "resume"),
    "network": ("weights", "device", "precision", "network_width", "far_view", "backend", "exported"),
    "outputs": ("out", "formats", "no_video", "grid", "rerun"),
}
"""Groups of the options of ``run`` in its ``--help``: the fields of :class:`RunConfig`, each once."""

_RUN_EXAMPLES = """\
examples:
  lanebev run drive.mp4 --camera camera.yaml --lane-width 3.7 --out out/drive
  lanebev run drive.mp4 --fov 60 --out out/drive        only the field of view is known
  lanebev run images/ --camera camera.yaml --lanes lanes.json   lanes of another detector

Open report.html in the output folder first.
"""


_LONGEST = 300  # characters of an error that are printed: a glob without quotes can make it very long


class _Parser(argparse.ArgumentParser):
    """Reports an error in one line, that names the command to ask for help."""

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]  # of typeshed: three
        """Parse the arguments; what no option of a command takes is an error of this command."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return parsed, unknown

    def error(self, message: str) -> NoReturn:
        remedy = ""
        if message.startswith("unrecognized arguments: ") and " -" not in message:
            remedy = "; a glob needs quotes"
        if len(message) > _LONGEST:
            message = f"{message[:_LONGEST]} …"
        message += remedy
        self.exit(2, f"{self.prog}: error: {message}; see {self.prog} --help\n")


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``lanebev``; the options of ``run`` are the fields of :class:`RunConfig`."""
    words = "Begin with: lanebev demo, or lanebev run VIDEO --camera FILE. Options: lanebev COMMAND --help."
    top = _Parser(prog="lanebev", description=DESCRIPTION, epilog=words, allow_abbrev=False)
    top.add_argument("--version", action="version", version=f"lanebev {__version__}")
    top.add_argument(
        "--print-completion", choices=("bash", "zsh"), action=PrintCompletion, default=argparse.SUPPRESS,
        help="print a script that completes commands and options in this shell, and exit",
    )  # fmt: skip
    _add_verbose(top, False)
    names = f"{{{','.join(_COMMANDS)}}}"
    commands = top.add_subparsers(dest="command", required=True, metavar=names)
    for name, (words, add_arguments) in _COMMANDS.items():
        about = f"{words[0].upper()}{words[1:]}."
        command = commands.add_parser(name, help=words, description=about, allow_abbrev=False)
        add_arguments(command)
        _add_verbose(command, argparse.SUPPRESS)
    return top


def _add_demo(demo: argparse.ArgumentParser) -> None:
    words = "output folder (default %(default)s)"
    demo.add_argument("--out", type=_PATH, default="lanebev-demo", metavar="DIR", help=words)


def _add_run(run: argparse.ArgumentParser) -> None:
    settings = {setting.name: setting for setting in fields(RunConfig)}
    for title, names in RUN_GROUPS.items():
        group = run.add_argument_group(title)
        for name in names:
            _add_setting(group, settings[name])
    run.usage = "%(prog)s SOURCE [--camera FILE | --fov DEG] [options]"
    run.epilog, run.formatter_class = _RUN_EXAMPLES, argparse.RawDescriptionHelpFormatter
    words = "settings as YAML, under the names of the options (lane-width: 3.5); options here override them"
    run.add_argument("--config", type=_PATH, metavar="FILE", help=words)


def _add_compare(compare: argparse.ArgumentParser) -> None:
    words = "output folder of a run"
    compare.add_argument("first", type=_PATH, metavar="A", help=words)
    compare.add_argument("second", type=_PATH, metavar="B", help=f"{words} on the same frames")
    words = "page (default %(default)s)"
    compare.add_argument("--out", type=_PATH, default="lanebev-compare.html", metavar="FILE", help=words)


def _add_convert(convert: argparse.ArgumentParser) -> None:
    convert.add_argument("run", type=_PATH, metavar="DIR", help="output folder of a run")
    convert.add_argument("--to", choices=FORMATS, required=True, help="the format to write")
    convert.add_argument("--out", type=_PATH, metavar="FILE", help="the file to write (default: one in DIR)")
    words = "camera file, if DIR has no calibration.yaml"
    convert.add_argument("--camera", type=_PATH, metavar="FILE", help=words)
    words = "the run's source, whose images are added to mcap or rerun"
    convert.add_argument("--images", type=_PATH, metavar="SOURCE", help=words)


def _add_export(export: argparse.ArgumentParser) -> None:
    for setting in fields(ExportConfig):
        _add_setting(export, setting)


def _add_doctor(doctor: argparse.ArgumentParser) -> None:
    for setting in fields(RunConfig):
        if setting.name in _DOCTOR_SETTINGS:
            _add_setting(doctor, setting)


def _add_fleet(fleet: argparse.ArgumentParser) -> None:
    words = "YAML or CSV with the video, camera, ... of each drive"
    fleet.add_argument("manifest", type=_PATH, metavar="MANIFEST", help=words)
    words = "output folder (default %(default)s)"
    fleet.add_argument("--out", type=_PATH, default="lanebev-fleet", metavar="DIR", help=words)
    words = "address of a running Ray cluster (default: start one on this machine, for this command)"
    fleet.add_argument("--address", type=_PATH, metavar="ADDRESS", help=words)
    words = "worker processes on this machine (default: one per core)"
    fleet.add_argument("--workers", type=_at_least(1), metavar="N", help=words)
    words = "retries of a drive that fails (default %(default)s)"
    fleet.add_argument("--retries", type=_at_least(0), default=2, metavar="N", help=words)
    words = "drives per worker at a time, whose frames the network takes as one batch (default %(default)s)"
    fleet.add_argument("--batch", type=_at_least(1), default=1, metavar="N", help=words)
    words = "fraction of a GPU per worker, with device: cuda in the manifest (default %(default)s)"
    fleet.add_argument("--gpus", type=_named(float), default=0.0, metavar="FRACTION", help=words)
    words = "folder outside which no path may be (default: that of the manifest)"
    fleet.add_argument("--root", type=_PATH, metavar="DIR", help=words)
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


def _add_setting(parser: argparse._ActionsContainer, setting: Field[object]) -> None:
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

    def argument(text: str) -> object:
        try:
            return parsed(parse, text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return argument


_PATH = _named(parse_path)
_COMMANDS: dict[str, tuple[str, Callable[[argparse.ArgumentParser], None]]] = {
    "demo": ("render a drive and calibrate it", _add_demo),
    "run": ("calibrate on a video, images or a stream", _add_run),
    "compare": ("compare two runs on one page", _add_compare),
    "convert": ("write the results of a run in another program's format", _add_convert),
    "export": ("write parts of the model as ONNX files or torch.export programs", _add_export),
    "doctor": (
        "check if a camera fits a source; status 1 if something is doubtful, 2 if it does not fit",
        _add_doctor,
    ),
    "fleet": ("calibrate on many drives, on all cores or a cluster", _add_fleet),
}


class PrintCompletion(argparse.Action):
    """Prints the completion script of a shell, by shtab."""

    def __call__(self, parser: argparse.ArgumentParser, _: object, values: object, __: object = None) -> None:
        """Print the completion script and exit."""
        try:
            import shtab
        except ImportError:
            parser.error(
                "--print-completion: expected the library shtab, got none; install it with "
                "pip install 'lanebev[completion]'"
            )
        _complete_files(parser, shtab.FILE)
        with contextlib.suppress(OSError):  # nobody reads it
            print(shtab.complete(parser, shell=str(values)))
        parser.exit(0)


def _complete_files(parser: argparse.ArgumentParser, files: dict[str, str]) -> None:
    """Let every argument that is a path complete file names, also in subcommands."""
    for action in parser._actions:
        if action.metavar in ("FILE", "DIR", "SOURCE", "A", "B"):
            action.complete = files  # type: ignore[attr-defined]  # shtab looks for it
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _complete_files(command, files)
