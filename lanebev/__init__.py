"""lanebev: estimate the pose of a camera above the road, frame by frame, from lane boundaries.

Start with ``Session`` (live, frame by frame), ``LaneBEV`` (a layer, batched and differentiable),
``JointCalibrator`` (segments of your own detector) or ``BEVWarp`` (a bird's-eye view with a known pose).
Angles are in rad, lengths in m, times in s. ``lanebev --help`` is the command line.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"


def _is_command() -> bool:
    """Return whether this process is the command line, which answers ``--help`` before torch is imported."""
    program = next(iter(getattr(sys, "argv", [])), "")  # an embedding program may have none
    return program == "-m" or Path(program).stem == "lanebev"


if TYPE_CHECKING or not _is_command():
    from lanebev.api import *  # noqa: F403 - its __all__ are the public names
    from lanebev.api import __all__ as __all__
else:

    def __getattr__(name: str) -> Any:
        """Import the public names when the first of them is needed."""
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(importlib.import_module("lanebev.api"), name)
