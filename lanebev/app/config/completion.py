"""Completion of commands and options in a shell. Imports nothing heavy."""

import argparse


class PrintCompletion(argparse.Action):
    """Prints the completion script of a shell, by shtab."""

    def __call__(self, parser: argparse.ArgumentParser, _: object, values: object, __: object = None) -> None:
        """Print it and end."""
        try:
            import shtab
        except ImportError:
            parser.error(
                "--print-completion: expected the library shtab, got none; install it with "
                "pip install 'lanebev[completion]'"
            )
        _complete_files(parser, shtab.FILE)
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
