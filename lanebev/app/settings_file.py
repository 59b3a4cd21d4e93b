"""Read the settings of a run from YAML. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path

import yaml

from lanebev.app.config import RunConfig
from lanebev.numbers import read_text


def read_settings(path: str | Path) -> dict[str, object]:
    """Read the settings of a YAML file, with names and values as on the command line.

    Raises:
        ValueError: the file is missing or not a YAML mapping, or has an unknown name or a bad value.
    """
    try:
        given = yaml.safe_load(read_text(Path(path)))
    except (ValueError, yaml.YAMLError) as error:
        reason = "not YAML" if isinstance(error, yaml.YAMLError) else error
        raise ValueError(f"config {path}: expected a YAML file of settings, got: {reason}") from error
    if not isinstance(given, dict):
        raise ValueError(f"config {path}: expected a YAML file of settings, got {type(given).__name__}")
    try:
        return parsed_settings(given)
    except ValueError as error:
        raise ValueError(f"config {path}: {error}") from error


def parsed_settings(given: Mapping[str, object]) -> dict[str, object]:
    """Parse the names and values of a YAML file to settings, as the command line does.

    Raises:
        ValueError: an unknown name, or a value that its setting does not allow.
    """
    known = {setting.name: setting for setting in fields(RunConfig)}
    values: dict[str, object] = {}
    for key, value in given.items():
        name = str(key).replace("-", "_")
        if name not in known:
            raise ValueError(f"expected one of {', '.join(known)}, got {key!r}")
        try:
            values[name] = _parsed(value, known[name].default, known[name].metadata["parse"])
        except ValueError as error:
            raise ValueError(f"{key}: {error}") from error
    return values


def _parsed(value: object, default: object, parse: Callable[[str], object]) -> object:
    """Parse a value of a YAML file as the command line does."""
    if isinstance(default, bool) or isinstance(value, bool):
        if not isinstance(value, bool) or not isinstance(default, bool):
            expected = "true or false" if isinstance(default, bool) else "a text or number"
            raise ValueError(f"expected {expected}, got {value!r}")
        return value
    if not isinstance(value, (str, int, float)):
        raise ValueError(f"expected a text or number, got {value!r}")
    return parse(str(value))
