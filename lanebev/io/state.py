"""States of calibrators and mount on disk: written atomically, read back exactly or not at all."""

import json
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from lanebev.io.output.whole_file import replacement

FORMAT = "lanebev-state"
VERSION = 3
_SEPARATOR = "."
_SAME_WIDTH = 1e-4  # relative difference of equal lane widths: one may have been a float32


class LoadedState(NamedTuple):
    """Result of :func:`load_state`.

    Attributes:
        states: the named tuples of tensors, by name; empty if the file was refused.
        metadata: the plain values saved beside them.
        problem: None, or one line saying why the file cannot be used.
    """

    states: dict[str, Any]
    metadata: dict[str, Any]
    problem: str | None


def save_state(path: str | Path, contents: Mapping[str, Any]) -> None:
    """Write states and plain values to one safetensors file, whole or not at all.

    Args:
        path: path of the file; its folder must exist. An older file stays until the new one is complete.
        contents: by name, NamedTuples of tensors (``JointState``, ``TwoStageState``, ``MountState``), single
            tensors, or values that JSON can hold (str, int, float, bool, None, lists and dicts of them).

    Raises:
        ValueError: a name with a dot, a value of another kind, or a state with a non-finite number.
        OSError: the file can't be written.
    """
    tensors: dict[str, Tensor] = {}
    kinds: dict[str, str] = {}
    plain: dict[str, Any] = {}
    for name, value in contents.items():
        if _SEPARATOR in name or not name:
            raise ValueError(f"name: expected one without {_SEPARATOR!r}, got {name!r}")
        fields = _fields(value)
        if fields is None:
            plain[name] = _jsonable(name, value)
            continue
        kinds[name] = type(value).__name__
        for field, tensor in fields.items():
            _check_finite(f"{name}{_SEPARATOR}{field}", tensor)
            tensors[f"{name}{_SEPARATOR}{field}"] = tensor.detach().cpu().contiguous().clone()
    header = {
        "format": FORMAT,
        "version": str(VERSION),
        "kinds": json.dumps(kinds),
        "metadata": json.dumps(plain),
    }
    with replacement(path) as whole:
        _save(tensors, str(whole), header)
        with open(whole, "rb") as file:
            os.fsync(file.fileno())
        whole.chmod(0o644)


def _save(tensors: Mapping[str, Tensor], path: str, header: dict[str, str]) -> None:
    """Write the file; where the system refuses, that is an OSError as of any other file."""
    try:
        save_file(dict(tensors), path, metadata=header)
    except SafetensorError as error:
        if (number := re.search(r"os error (\d+)", str(error))) is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1])), path) from error


def load_state(
    path: str | Path, like: Mapping[str, Any] | None = None, device: torch.device | str | None = None
) -> LoadedState:
    """Read a file of :func:`save_state`. If there is a problem, it is reported and nothing is used.

    Args:
        path: path of the file.
        like: by name, states as they are expected (``calibrator.initial_state(1)``): same type, fields,
            shapes and dtypes, else the file is refused. Names that are not in ``like`` come back as dicts
            of tensors by field.
        device: device of the tensors; None is the CPU.

    Returns:
        states, metadata and the problem, if there was one (a missing file is one too).
    """
    try:
        kinds, metadata, tensors = _read(path)
        states = _by_state(kinds, tensors, device)
        return LoadedState(_rebuilt(kinds, states, like or {}), metadata, None)
    except _RefusedError as error:
        return LoadedState({}, {}, f"{path}: {error}")


def lane_width_remark(loaded: LoadedState, lane_width: float) -> str:
    """Return a remark on a state that was saved with lanes of another width; else nothing.

    Its heights, those of the mount too, are proportional to that width.

    Args:
        loaded: the state with its plain values, ``lane_width`` (m) among them.
        lane_width: m, as it is now.
    """
    before = loaded.metadata.get("lane_width")
    if before is None or math.isclose(before, lane_width, rel_tol=_SAME_WIDTH):
        return ""
    return (
        f"the state was saved with lanes {before:g} m wide, now they are {lane_width:g} m; if the road is "
        "the same, one of the widths is wrong, and so are the heights: start without the state"
    )


class _RefusedError(Exception):
    """The reason why a file is not used."""


def _read(path: str | Path) -> tuple[dict[str, str], dict[str, Any], dict[str, Tensor]]:
    """Read the kind of each state by name, the plain values, and all tensors."""
    if Path(path).exists() and not os.access(path, os.R_OK):  # safetensors says that there is none
        raise _RefusedError("no permission to read it")
    try:
        with safe_open(str(path), framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise _RefusedError("it was not written by lanebev")
            if header.get("version") != str(VERSION):
                raise _RefusedError(f"expected version {VERSION}, got {header.get('version')}")
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
            return json.loads(header["kinds"]), json.loads(header["metadata"]), tensors
    except FileNotFoundError as error:
        raise _RefusedError("there is no such file") from error
    except (OSError, SafetensorError, KeyError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise _RefusedError(f"it is cut or not a state file ({reason})") from error


def _by_state(
    kinds: Mapping[str, str], tensors: Mapping[str, Tensor], device: torch.device | str | None
) -> dict[str, dict[str, Tensor]]:
    """Sort the tensors by state and field."""
    states: dict[str, dict[str, Tensor]] = {name: {} for name in kinds}
    for key, tensor in tensors.items():
        name, _, field = key.partition(_SEPARATOR)
        if name not in states:
            raise _RefusedError(f"{key} belongs to no state")
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise _RefusedError(f"{key} is not finite")
        states[name][field] = tensor.to(device) if device is not None else tensor
    return states


def _rebuilt(
    kinds: Mapping[str, str], states: Mapping[str, dict[str, Tensor]], like: Mapping[str, Any]
) -> dict[str, Any]:
    """Make states of the classes of ``like`` again; what is not in it stays as it was read."""
    built: dict[str, Any] = {}
    for name, fields in states.items():
        if name not in like:
            built[name] = fields[""] if set(fields) == {""} else fields
            continue
        if problem := _mismatch(name, kinds[name], fields, like[name]):
            raise _RefusedError(problem)
        built[name] = type(like[name])(**fields)
    if missing := [name for name in like if name not in built]:
        raise _RefusedError(f"expected {', '.join(missing)}, found {', '.join(built) or 'nothing'}")
    return built


def _fields(value: Any) -> dict[str, Tensor] | None:
    """Return a NamedTuple's tensors by field, a tensor's under '', None for anything else."""
    if isinstance(value, Tensor):
        return {"": value}
    names = getattr(value, "_fields", None)
    if names is None or not all(isinstance(getattr(value, name), Tensor) for name in names):
        return None
    return {name: getattr(value, name) for name in names}


def _jsonable(name: str, value: Any) -> Any:
    try:
        text = json.dumps(value, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name}: expected a NamedTuple of tensors, a tensor or a plain finite value, got {value!r}"
        ) from error
    return json.loads(text)


def _check_finite(key: str, tensor: Tensor) -> None:
    if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
        bad = math.prod(tensor.shape) - int(tensor.isfinite().sum())
        raise ValueError(f"{key}: expected finite numbers, got {bad} that are not; nothing was written")


def _mismatch(name: str, kind: str, fields: Mapping[str, Tensor], like: Any) -> str | None:
    """Return why the saved fields are not those of ``like``, or None."""
    if kind != type(like).__name__:
        return f"{name} is a {kind}, expected {type(like).__name__}"
    expected = _fields(like) or {}
    if set(fields) != set(expected):
        return f"expected a state of this version of lanebev, got one of another, whose {kind} differs"
    for field, tensor in expected.items():
        got = fields[field]
        if got.shape != tensor.shape or got.dtype != tensor.dtype:
            asked = "; is it of another version of lanebev, batch size or number of boundaries?"
            return (
                f"{name}{_SEPARATOR}{field} is {got.dtype} {tuple(got.shape)}, "
                f"expected {tensor.dtype} {tuple(tensor.shape)}{asked if got.shape != tensor.shape else ''}"
            )
    return None
