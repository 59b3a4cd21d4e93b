"""Read the settings of a run from YAML. Imports nothing heavy."""

import difflib
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path

import yaml

from lanebev.app.config.options import parsed
from lanebev.app.config.run import RunConfig
from lanebev.numbers import read_text
from lanebev.plain_yaml import PlainLoader, plain_documents

_FLAGS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


class _SettingsLoader(PlainLoader):
    """Loader that also knows true and false, and merge keys."""


for _tag, _pattern, _begin in (
    ("bool", "true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("merge", "<<", ["<"]),
):
    _SettingsLoader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), _begin
    )


def load_plain_yaml(text: str) -> object:
    """Load YAML, with null, true and false, and all other plain values as texts.

    Raises:
        yaml.YAMLError: the text is none.
        ValueError: a key is given twice, or is none, or there is more than one document.
    """
    documents: list[object] = list(plain_documents(text, _SettingsLoader))
    if len(documents) > 1:
        raise ValueError(
            f"expected one YAML document, got {len(documents)}; leave out the line --- between them"
        )
    return documents[0] if documents else None


def read_settings(path: str | Path) -> dict[str, object]:
    """Read the settings of a YAML file, with names and values as on the command line.

    Raises:
        ValueError: the file is missing or not a YAML mapping, or has an unknown name or a bad value.
    """
    try:
        given = load_plain_yaml(read_text(Path(path)))
    except (ValueError, yaml.YAMLError) as error:
        reason = _not_yaml(error) if isinstance(error, yaml.YAMLError) else error
        raise ValueError(f"config {path}: expected a YAML file of settings, got: {reason}") from error
    if given is None:
        raise ValueError(f"config {path}: expected a YAML file of settings, got none; is it empty?")
    if not isinstance(given, dict):
        raise ValueError(f"config {path}: expected a YAML file of settings, got {type(given).__name__}")
    try:
        return parsed_settings(given)
    except ValueError as error:
        raise ValueError(f"config {path}: {error}") from error


def _not_yaml(error: yaml.YAMLError) -> str:
    """Return what is wrong with a text that is no YAML."""
    mark = getattr(error, "problem_mark", None)
    remedy = "; write spaces instead of a tab" if "\\t" in str(getattr(error, "problem", "")) else ""
    return f"not YAML at line {mark.line + 1}{remedy}" if mark else "not YAML"


def parsed_settings(given: Mapping[str, object]) -> dict[str, object]:
    """Parse the names and values of a YAML file to settings, as the command line does."""
    known = {setting.name: setting for setting in fields(RunConfig)}
    values: dict[str, object] = {}
    for key, value in given.items():
        name = str(key).replace("-", "_")
        if name not in known:
            like = difflib.get_close_matches(name.lower(), known, n=1)
            asked = f"; is {like[0]} meant?" if like else ""
            raise ValueError(f"expected one of {', '.join(known)}, got {key!r}{asked}")
        if name in values:
            raise ValueError(f"{key}: expected it once, got it with - and with _")
        try:
            values[name] = _parsed(value, known[name].default, known[name].metadata["parse"])
        except ValueError as error:
            raise ValueError(f"{key}: {error}") from error
    return values


def _parsed(value: object, default: object, parse: Callable[[str], object]) -> object:
    """Parse a value of a YAML file as the command line does."""
    if isinstance(default, bool) and isinstance(value, str):
        value = _FLAGS.get(value.lower(), value)
    if isinstance(default, bool) or isinstance(value, bool):
        if not isinstance(value, bool) or not isinstance(default, bool):
            expected = "true or false" if isinstance(default, bool) else "a text or number"
            raise ValueError(f"expected {expected}, got {value!r}")
        return value
    if isinstance(default, tuple) and not default and isinstance(value, list):
        value = ",".join(map(str, value))  # of names
    if not isinstance(value, (str, int, float)):
        raise ValueError(f"expected a text or number, got {value!r}")
    return parsed(parse, str(value))
