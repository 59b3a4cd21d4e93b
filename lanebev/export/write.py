"""Parts to files: ONNX, or a program of ``torch.export``."""

import contextlib
import inspect
import json
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch.export import Dim, ExportedProgram

from lanebev import __version__
from lanebev.export.part import Part

METADATA = "lanebev"
"""Key of the facts, as JSON, in an ONNX file's metadata."""

MISSING = "expected the packages of ONNX; install them with: pip install 'lanebev[export]'"


def export_program(part: Part) -> ExportedProgram:
    """Trace a part for any batch size, and any size of its free dimensions."""
    arguments = tuple(part.inputs.values())
    free = {axis: step * Dim(f"steps_{axis}", min=1) for axis, step in part.free.items()}
    batch = {0: Dim("batch", min=1), **free}
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return torch.export.export(
            part.module, arguments, dynamic_shapes=_like_arguments(part, batch), strict=False
        )


def write_program(part: Part, path: Path) -> None:
    """Write a part as a program, which ``torch.export.load`` reads once lanebev is imported."""
    torch.export.save(export_program(part), path, extra_files={METADATA: _facts(part)})


def write_onnx(part: Part, path: Path) -> None:
    """Write a part as one ONNX file."""
    try:
        from lanebev.export.operators import translations
    except ImportError as error:
        raise ValueError(f"onnx: {MISSING} ({error})") from error
    with torch.no_grad(), warnings.catch_warnings(), quiet_logs():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            export_program(part),
            dynamo=True,
            verbose=False,
            input_names=list(part.inputs),
            output_names=list(part.outputs),
            optimize=False,  # its passes did not end in 50 minutes on 20,000 nodes; ONNX Runtime has its own
            custom_translation_table=translations(),
        )
    assert program is not None
    program.model.metadata_props[METADATA] = _facts(part)
    program.save(path)


@contextlib.contextmanager
def quiet_logs() -> Iterator[None]:
    """Suppress what ONNX's packages log up to warnings, of optional packages and of their own steps."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def _like_arguments(part: Part, batch: dict[int, Any]) -> tuple[object, ...]:
    """Return the free dimensions as the module's arguments are: those after the named ones are one tuple."""
    kinds = inspect.signature(part.module.forward).parameters.values()
    named = sum(each.kind is not inspect.Parameter.VAR_POSITIONAL for each in kinds)
    rest = len(part.inputs) - named
    return (batch,) * min(named, len(part.inputs)) + (((batch,) * rest,) if len(kinds) > named else ())


def _facts(part: Part) -> str:
    return json.dumps({"version": __version__, **part.facts})
